//! Fingers that open: when they push what they meet, and when their arm may leave what they let go.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_cell::config::{CellConfig, Goods};
use ratn_cell::core::arms::FIRST;
use ratn_cell::core::protocol::{Command, Ending, Event, Module, Request, Ticket};
use ratn_cell::core::snapshot::Snapshot;
use ratn_model::pose::Pose;
use ratn_model::value::{Trajectory, TrajectoryPoint};
use ratn_motion::aimm;
use ratn_motion::plan::Goal;

mod bench;
use bench::{Bench, grasp as close};

fn refused(bench: &mut Bench, request: Request) -> String {
    match &bench.start(request).1[..] {
        [Command::Ended { ending: Ending::Aborted(reason), .. }] => reason.clone(),
        other => panic!("{other:?}"),
    }
}

fn starts(bench: &mut Bench, request: Request) -> Ticket {
    let (ticket, commands) = bench.start(request);
    assert_eq!(commands, []);
    ticket
}

fn stop(bench: &mut Bench, ticket: Ticket) {
    let commands = bench.event(Event::Stop { ticket, reason: "a test".to_owned() });
    assert!(matches!(&commands[..], [Command::Ended { ending: Ending::Preempted(_), .. }]), "{commands:?}");
}

fn saved(bench: &mut Bench) -> serde_json::Value {
    let commands = bench.event(Event::Save);
    let [Command::Saved { snapshot }] = &commands[..] else { panic!("{commands:?}") };
    serde_json::from_str(&snapshot.to_json()).unwrap()
}

fn put_back(bench: &mut Bench, state: &serde_json::Value) {
    let snapshot = Snapshot::from_json(&state.to_string()).unwrap();
    bench.event(Event::PutBack { snapshot: Box::new(snapshot) });
}

/// The first box of a table with one, in the fingers of the built-in robot.
fn holding() -> Bench {
    let mut bench = Bench::of(CellConfig { boxes: 1, seed: 4, ..CellConfig::default() });
    bench.reach_for(0);
    bench.done(close());
    bench
}

/// The arm a little farther up.
fn away(bench: &Bench) -> Request {
    let mut joints = bench.arm();
    joints[1] -= 0.05;
    Request::MoveTo { joints, speed: 0.1 }
}

#[test]
fn fingers_that_have_parted_push_what_they_meet_though_they_are_not_all_open() {
    let mut bench = Bench::of(CellConfig { boxes: 1, seed: 4, ..CellConfig::default() });
    assert!(matches!(bench.perform(close()), Ending::Aborted(_)), "they close around nothing");
    bench.done(Request::OpenTo { width: 0.01 });
    let before = bench.cell.ground_truth()[0].clone();
    // Beside the box, and then where it stands.
    for aside_m in [before.size[1] / 2.0 + 0.05, 0.0] {
        let aside = Pose::at(0.0, aside_m, 0.0);
        let goals = aimm::grasp_poses(&before.pose, before.size).map(|tool| Goal::Pose(tool.compose(&aside)));
        bench.go_regardless_of(&before.id, goals.to_vec(), 0.0, 0.0);
    }
    let after = &bench.cell.ground_truth()[0];
    assert!(before.pose.distance(&after.pose) > 0.01, "{before:?} {after:?}");
    let told = bench.cell.unintended_contacts();
    let pushed = told.iter().find(|contact| contact.pushed_m > 0.01);
    assert!(pushed.is_some_and(|contact| contact.bodies[0].starts_with("finger")), "{told:?}");
}

#[test]
fn no_arm_leaves_what_its_fingers_let_go_before_they_have_parted_whatever_ended_their_opening() {
    let refused_to_leave = |bench: &mut Bench| {
        let request = away(bench);
        let reason = refused(bench, request);
        assert!(reason.contains("have not parted from what they let go"), "{reason}");
    };
    // It went all its way, which was no more than that.
    let mut bench = holding();
    let closed = bench.cell.measured().finger;
    bench.done(Request::OpenTo { width: 2.0 * closed + 0.0002 });
    refused_to_leave(&mut bench);
    let state = saved(&mut bench);
    // Nor does the base, nor an arm that was put back to there.
    let point =
        |time_s: f64, x: f64| TrajectoryPoint { time_s, positions: vec![x, 0.0, 0.0], velocities: vec![0.0; 3] };
    let joints = bench.cell.robot().base_joints().iter().map(|joint| joint.name.clone()).collect();
    let trajectory = Trajectory { joints, points: vec![point(0.0, 0.0), point(5.0, -0.1)] };
    let reason = refused(&mut bench, Request::Drive { trajectory });
    assert!(reason.contains("have not parted from what they let go"), "{reason}");
    put_back(&mut bench, &state);
    refused_to_leave(&mut bench);
    bench.done(Request::OpenTo { width: 2.0 * closed + 0.0061 });
    let leaves = away(&bench);
    bench.done(leaves);

    // It was stopped.
    let mut bench = holding();
    let ticket = starts(&mut bench, Request::Release);
    bench.pass(0.02);
    stop(&mut bench, ticket);
    assert!(bench.cell.measured().finger > closed && !bench.cell.is_active(Module::Gripper(FIRST)));
    refused_to_leave(&mut bench);
    // What they close around again they hold.
    bench.done(close());
    let leaves = away(&bench);
    bench.done(leaves);
}

/// The built-in robot with a box in its fingers, put back to a snapshot that was taken of that, with this change of it.
fn restored(change: impl Fn(&mut serde_json::Value)) -> (Bench, f64) {
    let mut bench = holding();
    let closed = bench.cell.measured().finger;
    let mut state = saved(&mut bench);
    change(&mut state);
    put_back(&mut bench, &state);
    (bench, closed)
}

#[test]
fn where_fingers_hold_something_they_have_closed_whatever_a_snapshot_says() {
    for said in [None, Some(0.0), Some(0.02)] {
        let (mut bench, _closed) = restored(|state| {
            let posture = state["posture"].as_object_mut().unwrap();
            match said {
                None => drop(posture.remove("closed_finger")),
                Some(at) => drop(posture.insert("closed_finger".to_owned(), at.into())),
            }
        });
        starts(&mut bench, Request::Release);
        bench.pass(0.02);
        let leaves = away(&bench);
        let reason = refused(&mut bench, leaves);
        assert!(reason.contains("nor before they have parted from what they let go"), "{said:?}: {reason}");
    }
}

#[test]
fn a_grasp_that_was_stopped_has_closed_as_far_as_it_came_and_a_reset_forgets_where_fingers_closed() {
    let mut bench = holding();
    let closed = bench.cell.measured().finger;
    bench.done(Request::Release);
    bench.go(vec![Goal::Joints(aimm::HOME)], 0.10, 0.0);
    let ticket = starts(&mut bench, close());
    while bench.cell.measured().finger > closed - 0.01 {
        bench.pass(0.01);
    }
    stop(&mut bench, ticket);
    let stopped = bench.cell.measured().finger;
    starts(&mut bench, Request::Release);
    while bench.cell.measured().finger < stopped + 0.004 {
        bench.pass(0.01);
    }
    assert!(bench.cell.measured().finger < closed);
    let leaves = away(&bench);
    starts(&mut bench, leaves);

    let mut bench = holding();
    let goods = Goods { boxes: 1, ..bench.cell.config().goods() };
    bench.event(Event::Reset { seed: 4, goods });
    let mut fresh = Bench::of(CellConfig { boxes: 1, seed: 4, ..CellConfig::default() });
    let [after, before] = [&mut bench, &mut fresh].map(|bench| saved(bench)["posture"].clone());
    assert_eq!(after, before);
}
