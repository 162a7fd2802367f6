//! Recordings that are gone through again, and states that a cell is put back to.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may panic")]

mod bench;

use bench::{Bench, grasp};
use ratn_cell::config::CellConfig;
use ratn_cell::core::objects::TrueObject;
use ratn_cell::core::protocol::{Command, Ending, Event, Product, Request};
use ratn_cell::core::recording::{Line, ReplayError, replay};
use ratn_cell::core::snapshot::{Snapshot, SnapshotError};
use ratn_motion::aimm;
use ratn_motion::plan::Goal;
use ratn_motion::robot::Robot;
use std::time::Duration;

/// A box is grasped, lifted and lost, and the camera is blind for a while: as lines.
fn eventful() -> Vec<String> {
    eventful_with("grasp_slips@9", None)
}

/// With such a fault, and a tick so often besides, or only where the cell wakes up.
fn eventful_with(slips: &str, tick: Option<Duration>) -> Vec<String> {
    let faults = [slips, "sensor_dropout~0.5"].iter().map(|text| text.parse().unwrap()).collect();
    let mut bench = Bench::of(CellConfig { boxes: 3, seed: 4, faults, ..CellConfig::default() });
    bench.tick = tick;
    bench.lines.push(Line::header(&bench.cell));
    bench.reach_for(0);
    bench.done(grasp());
    let lift = bench.plan(&bench.cell.scene(), vec![Goal::Joints(aimm::OBSERVATION)], 0.10, 0.0);
    bench.perform(Request::Follow { trajectory: lift });
    for _ in 0..4 {
        bench.perform(Request::Capture { frames: 2 });
    }
    bench.pass(10.0);
    bench.start(Request::SenseArm);
    bench.lines.iter().map(|line| serde_json::to_string(line).unwrap()).collect()
}

fn replayed(lines: &[String]) -> Result<ratn_cell::core::recording::Replayed, ReplayError> {
    replay(lines.iter().map(|line| Ok(line.clone())))
}

#[test]
fn the_same_comes_of_a_recording_and_another_thing_is_noticed_at_its_line() {
    let lines = eventful();
    let same = replayed(&lines).unwrap();
    assert!(same.events >= 8 && same.goals >= 7 && same.end_s > 10.0, "{same:?}");

    let moved = lines.iter().map(|line| line.replace("\"seed\":4", "\"seed\":5")).collect::<Vec<_>>();
    assert!(matches!(replayed(&moved), Err(ReplayError::Differs { .. })));
    let ended = lines.iter().rposition(|line| line.contains("\"how\":\"done\"")).unwrap();
    let mut other = lines.clone();
    other[ended] = other[ended].replace("done", "stopped");
    assert!(matches!(replayed(&other), Err(ReplayError::Differs { line, .. }) if line == ended + 1));
}

#[test]
fn what_is_lost_between_two_ticks_ends_the_motion_at_the_same_time_in_a_replay() {
    // While it is lifted.
    let ticked = eventful_with("grasp_slips@3.0", Some(Duration::from_millis(5)));
    assert!(ticked.iter().any(|line| line.contains("slipped out of the fingers; the arm holds")));
    replayed(&ticked).unwrap();
}

#[test]
fn what_is_no_recording_is_refused_with_the_line() {
    for (lines, at) in [
        (vec!["{}".to_owned()], 1),
        (eventful()[1..].to_vec(), 1),
        (
            {
                let mut l = eventful();
                l[3].push('x');
                l
            },
            4,
        ),
    ] {
        assert!(matches!(replayed(&lines), Err(ReplayError::NoRecording { line, .. }) if line == at));
    }
}

fn saved(bench: &mut Bench) -> Box<Snapshot> {
    let commands = bench.cell.handle(bench.now, Event::Save);
    let [Command::Saved { snapshot }] = &commands[..] else { panic!("{commands:?}") };
    snapshot.clone()
}

/// Carries what is held to a place on the deck; where everything is then.
fn deliver(bench: &mut Bench) -> String {
    bench.carry();
    bench.done(Request::Release);
    bench.pass(3.0);
    // How far it leaned is looked at step by step, and steps may fall elsewhere.
    let settled = bench.cell.ground_truth().into_iter().map(|o| TrueObject { greatest_tilt_rad: 0.0, ..o });
    format!("{:?}", settled.collect::<Vec<_>>())
}

#[test]
fn a_cell_put_back_goes_on_as_it_did_with_the_box_still_in_its_fingers() {
    let mut bench = Bench::new(2, 4);
    bench.reach_for(0);
    bench.done(grasp());
    let snapshot = saved(&mut bench);
    let delivered = deliver(&mut bench);
    assert!(delivered.contains("on_base: true"));

    let again = Snapshot::from_json(&snapshot.to_json()).unwrap();
    assert_eq!(again, *snapshot);
    bench.cell.handle(bench.now, Event::PutBack { snapshot: Box::new(again.clone()) });
    assert!(bench.cell.ground_truth()[0].held);
    assert_eq!(deliver(&mut bench), delivered);

    let mut elsewhere = Bench::new(1, 9);
    elsewhere.cell.handle(elsewhere.now, Event::PutBack { snapshot: Box::new(again) });
    assert_eq!(deliver(&mut elsewhere), delivered);
}

#[test]
fn a_goal_under_way_ends_when_the_cell_is_put_back() {
    let mut bench = Bench::new(1, 4);
    let snapshot = saved(&mut bench);
    bench.start(Request::MoveTo { joints: aimm::OBSERVATION, speed: 0.3 });
    bench.pass(1.0);
    let commands = bench.cell.handle(bench.now, Event::PutBack { snapshot });
    assert!(
        matches!(&commands[..], [Command::Ended { ending: Ending::Aborted(reason), .. }] if reason.contains("put back"))
    );
    assert_eq!(bench.arm(), aimm::HOME);
}

#[test]
fn what_is_no_snapshot_is_refused_with_the_reason() {
    let text = saved(&mut Bench::new(1, 4)).to_json();
    let refused = |from: &str, to: &str| Snapshot::from_json(&text.replace(from, to)).unwrap_err();
    let [here, other] = [Robot::aimm(), Robot::built_in("ur5").unwrap()];
    let whole = Snapshot::from_json(&text).unwrap();
    assert_eq!(whole.check_robot(&here), Ok(()));
    let another = whole.check_robot(&other).unwrap_err().to_string();
    assert!(
        another.contains("of the robot `aimm` (digest ") && another.contains("the robot `ur5` (digest "),
        "{another}"
    );
    // Numbers from which physics cannot go on: a size, a place, a turn, a speed of the first object, a joint.
    let object = |part: usize| format!("/environment/objects/0/{part}");
    for (place, number) in [
        (format!("{}/size/1", object(0)), -1e308),
        (format!("{}/size/0", object(0)), 0.0),
        (format!("{}/pose/position/0", object(1)), 1e308),
        (format!("{}/pose/quaternion_xyzw/3", object(1)), 9.2e18),
        (format!("{}/velocity/2", object(1)), 1e300),
        ("/posture/arm/0".to_owned(), 1e300),
        ("/posture/base/1".to_owned(), -1e300),
    ] {
        let mut wrong: serde_json::Value = serde_json::from_str(&text).unwrap();
        *wrong.pointer_mut(&place).unwrap_or_else(|| panic!("{place}: {text}")) = number.into();
        let refused = Snapshot::from_json(&wrong.to_string()).unwrap_err();
        assert!(matches!(refused, SnapshotError::Inconsistent(_)), "{place}: {refused}");
    }
    // One of an earlier version says no robot.
    let mut earlier: serde_json::Value = serde_json::from_str(&text).unwrap();
    earlier.as_object_mut().unwrap().remove("robot");
    let earlier = Snapshot::from_json(&earlier.to_string()).unwrap();
    assert_eq!(earlier.check_robot(&here), Ok(()));
    let six = earlier.check_robot(&other).unwrap_err();
    assert_eq!(six, SnapshotError::OtherRobot { of: 7, here: 6 });
    assert!(six.to_string().contains("7 joints") && six.to_string().contains("6, so"), "{six}");
    assert!(matches!(refused("{", "["), SnapshotError::Unreadable(_)));
    assert_eq!(refused("\"form\":1", "\"form\":2"), SnapshotError::OtherForm(2));
    assert!(matches!(refused("\"ids\":[\"slc_1\"]", "\"ids\":[]"), SnapshotError::Inconsistent(_)));
}

#[test]
fn the_arm_says_where_it_is_and_the_gripper_whether_it_holds_something() {
    let mut bench = Bench::new(1, 4);
    assert_eq!(bench.done(Request::SenseArm), Product::ArmSensed { joints: aimm::HOME });
    assert!(
        matches!(bench.done(Request::SenseGripper), Product::GripperSensed { holding: false, width } if width > 0.1)
    );
    bench.reach_for(0);
    bench.done(grasp());
    let size = bench.cell.ground_truth()[0].size;
    let sensed = bench.done(Request::SenseGripper);
    assert!(matches!(sensed, Product::GripperSensed { holding: true, width } if (width - size[1]).abs() < 1e-9));
}
