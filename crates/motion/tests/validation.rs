//! What a controller refuses is what would happen between the knots, not only at them.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use common::Cell;
use ratn_model::pose::Pose;
use ratn_model::value::{Trajectory, TrajectoryPoint};
use ratn_motion::aimm;
use ratn_motion::base::{DriveViolation, check_drive};
use ratn_motion::collision::Contact;
use ratn_motion::robot::{Configuration, Joint, Robot};
use ratn_motion::validate::{Violation, validate_trajectory};
use ratn_world::scene::{Placement, SceneObject, Shape};

/// One joint of several moves with these jerks for so long each, from rest, out and back; the others stand.
fn moving(joints: &[Joint], start: &[f64], which: usize, phases: &[(f64, f64)]) -> Trajectory {
    let (mut t, mut q, mut v, mut a) = (0.0, start[which], 0.0, 0.0);
    let point = |time_s: f64, q: f64, v: f64| {
        let (mut positions, mut velocities) = (start.to_vec(), vec![0.0; start.len()]);
        (positions[which], velocities[which]) = (q, v);
        TrajectoryPoint { time_s, positions, velocities }
    };
    let mut points = vec![point(0.0, q, 0.0)];
    for (jerk, lasts) in phases {
        q += lasts * (v + lasts * (a / 2.0 + lasts * jerk / 6.0));
        v += lasts * (a + lasts * jerk / 2.0);
        a += lasts * jerk;
        t += lasts;
        points.push(point(t, q, v));
    }
    points.last_mut().unwrap().velocities[which] = 0.0;
    Trajectory { joints: joints.iter().map(|j| j.name.clone()).collect(), points }
}

/// Out and back: between the two knots in the middle, which are at the same place, it goes out by v² / 2 a, and comes back.
fn out_and_back(jerk: f64, acceleration: f64, velocity: f64) -> Vec<(f64, f64)> {
    let rise = acceleration / jerk;
    let hold = velocity / acceleration - rise / 2.0;
    let out = [(jerk, rise), (0.0, hold), (-jerk, 2.0 * rise)];
    let back = out.iter().rev().map(|(jerk, lasts)| (-jerk, *lasts));
    out.iter().copied().chain([(0.0, 2.0 * velocity / acceleration)]).chain(back).collect()
}

#[test]
fn a_joint_that_leaves_its_limits_between_two_knots_and_comes_back_is_refused() {
    let mut cell = Cell::with_boxes(0, 1);
    let joints = cell.robot.arm_joints().to_vec();
    let phases = out_and_back(70.0, 7.0, 1.5);
    let ends_at = moving(&joints, &cell.arm, 0, &phases[..3]).points[3].positions[0] - cell.arm[0];
    // Its knots stay 0.05 rad within the limit; in the middle it goes 1.5² / 14 rad farther.
    for (room, refused) in [(0.05, true), (0.15, true), (0.17, false)] {
        cell.arm[0] = joints[0].upper - ends_at - room;
        let trajectory = moving(&joints, &cell.arm, 0, &phases);
        assert!(trajectory.points.iter().all(|p| p.positions[0] < joints[0].upper - room + 1e-9));
        let outcome = validate_trajectory(&cell.robot, &cell.scene, &cell.state(), &trajectory, Contact::None);
        match outcome {
            Err(Violation::Limit { what: "position", value, .. }) => {
                assert!(refused && (value - (joints[0].upper - room + 1.5 * 1.5 / 14.0)).abs() < 1e-6, "{value}");
            }
            other => assert!(!refused && !matches!(other, Err(Violation::Limit { .. })), "{room}: {other:?}"),
        }
    }
}

#[test]
fn too_much_jerk_and_a_step_of_the_acceleration_are_refused() {
    let cell = Cell::with_boxes(0, 1);
    let joints = cell.robot.arm_joints().to_vec();
    let check = |trajectory: &Trajectory| {
        validate_trajectory(&cell.robot, &cell.scene, &cell.state(), trajectory, Contact::None).map(|_| ())
    };
    let there = |jerk: f64| {
        let t = 2.0 / jerk;
        moving(&joints, &cell.arm, 0, &[(jerk, t), (-jerk, 2.0 * t), (jerk, t)])
    };
    assert_eq!(check(&there(joints[0].jerk)), Ok(()));
    let outcome = check(&there(joints[0].jerk * 1.1));
    let said = outcome.as_ref().err().map(ToString::to_string).unwrap_or_default();
    assert!(said.contains("reaches jerk ") && said.ends_with(" rad/s³"), "{said}");
    assert!(matches!(outcome, Err(Violation::Limit { what: "jerk", .. })), "{outcome:?}");
    // One cubic from rest to rest: the acceleration is there at once.
    let mut steps = there(joints[0].jerk);
    let end = steps.points[3].positions[0];
    steps.points.drain(1..3);
    steps.points[1].time_s = 0.1;
    let outcome = check(&steps);
    let expected = 6.0 * (end - cell.arm[0]) / 0.01;
    let said = outcome.as_ref().err().map(ToString::to_string).unwrap_or_default();
    assert!(said.contains(" rad/s² at "), "{said}");
    assert!(matches!(outcome, Err(Violation::Step { step, .. }) if (step - expected).abs() < 1e-9), "{outcome:?}");
}

#[test]
fn a_base_that_drives_out_and_back_between_two_knots_meets_what_stands_there() {
    let mut cell = Cell::with_boxes(0, 1);
    cell.scene.objects.clear();
    let joints = cell.robot.base_joints().to_vec();
    let phases = out_and_back(7.0, 0.7, 0.6);
    let trajectory = moving(&joints, &[0.0; 3], 1, &phases);
    let middle = trajectory.points[3].positions[1];
    assert!((trajectory.points[4].positions[1] - middle).abs() < 1e-12);
    let configuration = Configuration { arm: aimm::STOWED, ..Robot::aimm().at_zero() };
    // The base is 0.6 m wide; in the middle it goes 0.6² / 1.4 m beyond the knots.
    for (beyond, touches) in [(0.05, true), (0.25, true), (0.28, false)] {
        cell.scene.objects.clear();
        let place = Pose::at(-0.2, 0.3 + middle + beyond + 0.005, 0.3);
        let shape = Shape::Box { size: [0.01, 0.01, 0.6] };
        cell.scene.objects.push(SceneObject { name: "post".into(), shape, placement: Placement::World(place) });
        let outcome = check_drive(&cell.robot, &cell.scene, &configuration, &[], &trajectory);
        match outcome {
            Err(DriveViolation::Touch { touch, .. }) => assert!(touches && touch.other == "post", "{touch}"),
            other => assert!(!touches && other.is_ok(), "{beyond}: {other:?}"),
        }
    }
}
