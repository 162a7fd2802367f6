//! What goes wrong in the cell on request, and what holds and slips by itself.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod bench;

use bench::{Bench, grasp};
use ratn_cell::config::{CellConfig, GripperConfig};
use ratn_cell::core::protocol::{Ending, Event, Product, Request};
use ratn_motion::aimm;
use ratn_motion::collision::distance;
use ratn_motion::plan::Goal;

fn with(faults: &[&str]) -> Bench {
    let faults = faults.iter().map(|text| text.parse().unwrap()).collect();
    Bench::of(CellConfig { boxes: 2, seed: 4, faults, ..CellConfig::default() })
}

fn reason(ending: Ending) -> String {
    match ending {
        Ending::Aborted(reason) => reason,
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_grasp_that_slips_holds_nothing_and_the_next_one_holds() {
    let mut bench = with(&["grasp_slips:1"]);
    bench.reach_for(0);
    assert!(reason(bench.perform(grasp())).contains("slipped out of the fingers"));
    assert!(bench.cell.ground_truth().iter().all(|b| !b.held && b.on == "table"));
    bench.done(Request::Release);
    bench.done(grasp());
    assert!(bench.cell.ground_truth()[0].held);
}

#[test]
fn what_slips_out_of_a_moving_gripper_stops_the_arm_and_falls() {
    let mut bench = with(&[]);
    bench.reach_for(0);
    bench.done(grasp());
    let at_s = bench.now.seconds() + 0.5;
    bench.cell.handle(bench.now, Event::Fault { fault: format!("grasp_slips@{at_s}").parse().unwrap() });
    let lift = bench.plan(&bench.cell.scene(), vec![Goal::Joints(aimm::OBSERVATION)], 0.10, 0.0);
    let ending = bench.perform(Request::Follow { trajectory: lift });
    assert!(reason(ending).contains("slipped out of the fingers; the arm holds"));
    assert!(bench.now.seconds() > at_s && distance(&bench.arm(), &aimm::OBSERVATION) > 0.1);
    bench.pass(5.0);
    let fallen = bench.cell.ground_truth()[0].clone();
    assert!(!fallen.held && !fallen.on_base && !fallen.on.is_empty(), "{fallen:?}");
}

#[test]
fn a_box_held_with_too_little_force_slides_out_by_itself_and_with_enough_it_does_not() {
    let held_after = |force_n: f64| {
        let gripper = GripperConfig { force_n, ..GripperConfig::default() };
        let mut bench = Bench::of(CellConfig { boxes: 1, seed: 7, gripper, ..CellConfig::default() });
        bench.reach_for(0);
        bench.done(grasp());
        let tool = |bench: &Bench| bench.cell.robot().tool_pose(&bench.cell.configuration());
        let before = tool(&bench).inverse().compose(&bench.cell.ground_truth()[0].pose);
        let lift = bench.plan(&bench.cell.scene(), vec![Goal::Joints(aimm::OBSERVATION)], 0.10, 0.0);
        let lifted = bench.perform(Request::Follow { trajectory: lift });
        let truth = bench.cell.ground_truth()[0].clone();
        let after = tool(&bench).inverse().compose(&truth.pose);
        (matches!(lifted, Ending::Done(_)), truth.held, after.distance(&before))
    };
    let (arrived, held, slid) = held_after(40.0);
    assert!(arrived && held && slid < 1e-9, "{slid}");
    let (arrived, held, _) = held_after(0.5);
    assert!(!arrived && !held);
}

#[test]
fn an_object_that_somebody_moved_stands_elsewhere_on_the_table_and_only_that_one() {
    let mut bench = with(&["object_moved:2"]);
    let before = bench.cell.ground_truth();
    bench.done(Request::Capture { frames: 1 });
    assert_eq!(bench.cell.ground_truth(), before);
    bench.done(Request::Capture { frames: 1 });
    bench.pass(2.0);
    let after = bench.cell.ground_truth();
    let moved = before.iter().zip(&after).filter(|(a, b)| a.pose.distance(&b.pose) > 0.02).count();
    assert_eq!(moved, 1);
    assert!(after.iter().all(|b| b.on == "table"), "{after:?}");
    let gap = after[0].pose.distance(&after[1].pose);
    assert!(gap > 0.1, "{gap}");
    assert!(matches!(&bench.noted[..], [what] if what.contains("somebody moves slc_")), "{:?}", bench.noted);
}

#[test]
fn a_blind_camera_and_a_lost_robot_say_so_and_the_next_picture_is_good() {
    let mut bench = with(&["sensor_dropout:1", "localisation_lost@5", "sensor_dropout@20"]);
    let picture = || Request::Capture { frames: 3 };
    assert!(reason(bench.perform(picture())).contains("no image"));
    assert!(matches!(bench.done(picture()), Product::Captured { .. }));
    bench.pass(5.0);
    assert!(reason(bench.perform(picture())).contains("does not know where it stands"));
    bench.pass(3.0);
    bench.done(picture());
    bench.pass(20.2 - bench.now.seconds());
    assert!(reason(bench.perform(picture())).contains("no image"));
    bench.pass(3.0);
    bench.done(picture());
}

#[test]
fn a_controller_that_gives_up_leaves_the_arm_half_way_and_takes_the_next_motion() {
    let to = |joints| Request::MoveTo { joints, speed: 0.3 };
    for faults in [["controller_abort:1"], ["controller_abort@1"]] {
        let mut bench = with(&faults);
        assert!(reason(bench.perform(to(aimm::OBSERVATION))).contains("gave up"), "{faults:?}");
        assert!(distance(&bench.arm(), &aimm::HOME) > 0.1 && distance(&bench.arm(), &aimm::OBSERVATION) > 0.1);
        bench.done(to(aimm::OBSERVATION));
        assert!(distance(&bench.arm(), &aimm::OBSERVATION) < 1e-9);
    }
}

#[test]
fn a_controller_told_to_give_up_while_the_arm_stands_does_so_in_the_next_motion() {
    let mut bench = with(&["controller_abort@1"]);
    bench.pass(2.0);
    assert!(reason(bench.perform(Request::MoveTo { joints: aimm::OBSERVATION, speed: 0.3 })).contains("gave up"));
}
