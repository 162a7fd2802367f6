//! An arm whose joints turn without end, in the cell: it goes on from wherever its encoders count, the short way.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod bench;
mod roller;

use bench::Bench;
use ratn_cell::config::CellConfig;
use ratn_cell::core::protocol::{Command, Ending, Event, Product, Request};
use ratn_cell::core::snapshot::Snapshot;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::plan::Goal;
use roller::{ENDLESS, HOME};
use std::f64::consts::TAU;

/// A cell whose robot begins somewhere.
fn beginning_at(home: [f64; 7]) -> (Bench, tempfile::TempDir) {
    let folder = tempfile::tempdir().unwrap();
    let path = roller::write(folder.path());
    let description = std::fs::read_to_string(&path).unwrap();
    std::fs::write(&path, description.replace(&format!("{HOME:?}"), &format!("{home:?}"))).unwrap();
    let robot = path.display().to_string();
    (Bench::of(CellConfig { robot, boxes: 1, seed: 2, ..CellConfig::default() }), folder)
}

fn posture(last: f64) -> [f64; 7] {
    [0.0, -0.785, 0.0, -2.356, 0.0, 1.571, last]
}

/// Follows a plan to a posture, and says where the arm ends.
fn go(bench: &mut Bench, goal: [f64; 7]) -> JointVector {
    bench.go(vec![Goal::Joints(JointVector::of(goal))], 0.0, 0.0);
    bench.arm()
}

#[test]
fn an_arm_that_stands_at_any_number_of_turns_takes_the_next_motion_the_short_way() {
    for (from, to, turns) in [(3.5, -3.5, -0.717), (3.0, -3.0, 0.283), (-7.0, 0.0, 0.717), (100.0 * TAU, 0.5, 0.5)] {
        let (mut bench, _folder) = beginning_at(posture(from));
        let end = go(&mut bench, posture(to));
        assert!((end[6] - from - turns).abs() < 1e-3, "from {from} to {to}: it ended at {}", end[6]);
        // And from there the next one.
        let end = go(&mut bench, posture(from));
        assert!((end[6] - from).abs() < 1e-3, "back to {from}: it ended at {}", end[6]);
    }
}

#[test]
fn a_line_that_nobody_planned_goes_the_short_way_too() {
    let (mut bench, _folder) = beginning_at(posture(3.0));
    let request = Request::MoveTo { joints: posture(-3.0).into(), speed: 0.5 };
    assert!(matches!(bench.done(request), Product::Moved { .. }));
    assert!((bench.arm()[6] - (TAU - 3.0)).abs() < 1e-3, "{:?}", bench.arm());
}

#[test]
fn a_trajectory_that_begins_whole_turns_away_is_followed_from_where_the_arm_is() {
    let (mut bench, _folder) = beginning_at(HOME);
    let mut trajectory = bench.plan(&bench.cell.scene(), vec![Goal::Joints(JointVector::of(posture(2.0)))], 0.0, 0.0);
    let (first, last) = (trajectory.points[0].clone(), trajectory.points[trajectory.points.len() - 1].clone());
    assert!(ENDLESS.iter().all(|j| (first.positions[*j] - HOME[*j]).abs() < 1e-9), "{first:?}");
    // As one is that was planned from a fact of the task, which knows of no turns.
    for point in &mut trajectory.points {
        point.positions[0] += 5.0 * TAU;
        point.positions[6] -= TAU;
    }
    bench.done(Request::Follow { trajectory: trajectory.clone() });
    for j in 0..7 {
        assert!((bench.arm()[j] - last.positions[j]).abs() < 1e-3, "{:?}", bench.arm());
    }
    // A part of a turn is none, nor is a whole one of a joint with limits.
    for (joint, by) in [(6, 1.0), (1, TAU)] {
        let mut elsewhere = trajectory.clone();
        elsewhere.points.iter_mut().for_each(|point| point.positions[joint] += by);
        let refused = bench.perform(Request::Follow { trajectory: elsewhere });
        assert!(matches!(&refused, Ending::Aborted(reason) if reason.contains("starts at")), "{refused:?}");
    }
}

#[test]
fn a_cell_that_is_put_back_goes_on_from_where_its_joints_had_come_to() {
    let (mut bench, _folder) = beginning_at(posture(3.0));
    go(&mut bench, posture(-3.0));
    let stood = bench.arm();
    let saved = bench.event(Event::Save);
    let [Command::Saved { snapshot }] = &saved[..] else { panic!("{saved:?}") };
    let snapshot = Snapshot::from_json(&snapshot.to_json()).unwrap();
    go(&mut bench, posture(0.0));
    bench.event(Event::PutBack { snapshot: Box::new(snapshot) });
    assert_eq!(bench.arm(), stood);
    let end = go(&mut bench, posture(-2.5));
    assert!((end[6] - (TAU - 2.5)).abs() < 1e-3, "{end:?}");
}
