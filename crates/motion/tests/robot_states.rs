//! The joints that are not planned for: where they are counts, in every check, and what mimics follows.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use common::{Cell, request};
use ratn_model::pose::Pose;
use ratn_motion::aimm;
use ratn_motion::collision::Contact;
use ratn_motion::description::RobotDescription;
use ratn_motion::exact::Exact;
use ratn_motion::geometry::Geometry;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::mechanism::Mechanism;
use ratn_motion::plan::{Goal, PlanError, Request};
use ratn_motion::reach::{Reach, Target};
use ratn_motion::robot::{Configuration, Robot};
use ratn_motion::robot_model::RobotModel;
use ratn_motion::robot_state::{RobotState, StateError};
use ratn_motion::space::{Obstacle, Space};
use ratn_motion::validate::{Violation, validate_trajectory};
use std::collections::BTreeMap;

/// A shoulder `a`, and beyond it joints that are said, each link a ball 0.3 m beyond the one before it.
fn chain(joints: &[(&str, &str)]) -> String {
    let mut urdf = "<robot name='chain'><link name='base'/>".to_owned();
    let mut parent = "base".to_owned();
    for (i, (name, inside)) in joints.iter().enumerate() {
        let origin = if i == 0 { 0.0 } else { 0.3 };
        urdf += &format!(
            "<link name='{name}_link'><collision><origin xyz='0.3 0 0'/><geometry><sphere radius='0.05'/></geometry>\
             </collision></link><joint name='{name}' type='revolute'><parent link='{parent}'/><child \
             link='{name}_link'/><origin xyz='{origin} 0 0'/><axis xyz='0 0 1'/><limit lower='-3' upper='3' \
             velocity='1' effort='1'/>{inside}</joint>"
        );
        parent = format!("{name}_link");
    }
    urdf + "</robot>"
}

fn named(positions: &[(&str, f64)]) -> BTreeMap<String, f64> {
    positions.iter().map(|(name, position)| ((*name).to_owned(), *position)).collect()
}

/// The tip of a planar chain of 0.3 m long links, each turned against the one before it.
fn tip(turns: &[f64]) -> [f64; 2] {
    let mut heading = 0.0;
    turns.iter().fold([0.0; 2], |[x, y], turn| {
        heading += turn;
        [x + 0.3 * f64::cos(heading), y + 0.3 * f64::sin(heading)]
    })
}

/// Where the last link's ball is.
fn ball(mechanism: &Mechanism, positions: &[f64]) -> [f64; 2] {
    let poses = mechanism.poses(positions);
    let [x, y, _] = poses[poses.len() - 1].transform([0.3, 0.0, 0.0]);
    [x, y]
}

fn is_close(a: [f64; 2], b: [f64; 2]) -> bool {
    (a[0] - b[0]).hypot(a[1] - b[1]) < 1e-9
}

#[test]
fn a_mimic_of_a_mimic_moves() {
    let urdf = chain(&[("a", ""), ("b", "<mimic joint='a'/>"), ("c", "<mimic joint='b'/>")]);
    let mechanism = Mechanism::read(&urdf, None, &["a".to_owned()]).unwrap();
    for q in [0.0, 0.4, -0.7] {
        let at = ball(&mechanism, &[q]);
        assert!(is_close(at, tip(&[q, q, q])), "{q}: {at:?}");
    }
}

#[test]
fn mimics_multiply_and_add_along_their_chain_in_every_check() {
    let followers = [
        ("a", ""),
        ("b", "<mimic joint='a' multiplier='-0.5' offset='0.2'/>"),
        ("c", "<mimic joint='b' multiplier='2' offset='-0.1'/>"),
    ];
    let mechanism = Mechanism::read(&chain(&followers), None, &[]).unwrap();
    assert_eq!(mechanism.joints.len(), 1);
    let turns = |q: f64| [q, -0.5 * q + 0.2, 2.0 * (-0.5 * q + 0.2) - 0.1];
    let reach = Reach::new(&mechanism, 3, Pose::at(0.3, 0.0, 0.0));
    for i in 0..=20 {
        let q = -1.5 + 0.15 * f64::from(i);
        let [x, y] = tip(&turns(q));
        assert!(is_close(ball(&mechanism, &[q]), [x, y]));
        let mut positions = JointVector::of([q]);
        let pose = reach.pose(&positions);
        assert!(is_close([pose.position[0], pose.position[1]], [x, y]));
        // The vector kernel and the exact check see a post where the ball is, and none 0.12 m beside it.
        for (beside, touches) in [(0.0, true), (0.12, false)] {
            let geometry = Geometry::Sphere { radius: 0.02 };
            let post = Obstacle { name: "post".into(), pose: Pose::at(x, y, beside), geometry };
            let obstacles = [post];
            let mut state = [0.0; 16];
            state[0] = q as f32;
            assert_eq!(Space::new(&mechanism, &obstacles).is_free(&state), !touches, "{q}");
            assert_eq!(Exact::new(&mechanism, &obstacles).touch(&[q]).is_some(), touches, "{q}");
        }
        // The descent knows how much faster the tip moves.
        let target = Target { tolerance_rad: [9.0; 3], ..Target::at(pose) };
        positions[0] = q + 0.05;
        let found = reach.descend(&target, &positions);
        assert!(found.is_some_and(|found| (found[0] - q).abs() < 1e-2), "{q}: {found:?}");
    }
}

#[test]
fn joints_that_mimic_in_a_circle_are_refused() {
    let urdf = chain(&[("a", ""), ("b", "<mimic joint='c'/>"), ("c", "<mimic joint='b'/>")]);
    let error = Mechanism::read(&urdf, None, &[]).unwrap_err().to_string();
    assert!(error.contains("`b`") && error.contains("mimics itself"), "{error}");
}

#[test]
fn a_joint_that_is_not_planned_for_counts_where_it_is() {
    let urdf = chain(&[("a", ""), ("b", ""), ("c", "<mimic joint='b' multiplier='0.5'/>")]);
    let model = RobotModel::read(&urdf, None).unwrap();
    let planned = |b: f64| {
        let state = RobotState::neutral(&model).with(&model, &named(&[("b", b)])).unwrap();
        model.planned(&["a".to_owned()], &state).unwrap()
    };
    let [x, y] = tip(&[0.3, 1.2, 0.6]);
    let geometry = Geometry::Sphere { radius: 0.02 };
    let obstacles = [Obstacle { name: "post".into(), pose: Pose::at(x, y, 0.0), geometry }];
    let mut state = [0.0; 16];
    state[0] = 0.3;
    for (b, touches) in [(0.0, false), (1.2, true)] {
        let mechanism = planned(b);
        assert!(is_close(ball(&mechanism, &[0.3]), tip(&[0.3, b, b / 2.0])));
        assert_eq!(Space::new(&mechanism, &obstacles).is_free(&state), !touches);
        assert_eq!(Exact::new(&mechanism, &obstacles).touch(&[0.3]).is_some(), touches);
    }
    let refused =
        |name: &str, position: f64| RobotState::neutral(&model).with(&model, &named(&[(name, position)])).unwrap_err();
    assert_eq!(refused("d", 0.0), StateError::Unknown { joint: "d".into() });
    assert_eq!(refused("c", 0.0), StateError::Mimics { joint: "c".into() });
    let beyond = |position| StateError::Beyond { joint: "b".into(), position, lower: -3.0, upper: 3.0 };
    assert_eq!(refused("b", 3.5), beyond(3.5));
    assert!(matches!(refused("b", f64::NAN), StateError::Beyond { .. }));
}

#[test]
fn a_wrist_that_is_kept_level_by_the_shoulder_is_one_branch_of_joints() {
    let urdf = chain(&[("a", ""), ("b", ""), ("c", "<mimic joint='a' multiplier='-1'/>")]);
    let mechanism = Mechanism::read(&urdf, None, &["a".to_owned(), "b".to_owned()]).unwrap();
    let mut state = [0.0; 16];
    state[..2].copy_from_slice(&[0.4, 0.3]);
    assert!(Space::new(&mechanism, &[]).is_free(&state));
    assert!(is_close(ball(&mechanism, &[0.4, 0.3]), tip(&[0.4, 0.3, -0.4])));
}

#[test]
fn a_state_that_puts_a_link_in_the_way_does_not_except_it_from_the_checks() {
    let ball = |name: &str, parent: &str, at: &str| {
        format!(
            "<link name='{name}_link'><collision><origin xyz='0.3 0 0'/><geometry><sphere radius='0.05'/></geometry>\
             </collision></link><joint name='{name}' type='revolute'><parent link='{parent}'/><child \
             link='{name}_link'/><origin xyz='{at}'/><axis xyz='0 0 1'/><limit lower='-3.2' upper='3.2' \
             velocity='1' effort='1'/></joint>"
        )
    };
    let (near, far) = (ball("a", "base", "0 0 0"), ball("b", "base", "0.6 0 0"));
    let model = RobotModel::read(&format!("<robot name='two'><link name='base'/>{near}{far}</robot>"), None).unwrap();
    for b in [3.1, 2.7] {
        let state = RobotState::neutral(&model).with(&model, &named(&[("b", b)])).unwrap();
        let mechanism = model.planned(&["a".to_owned()], &state).unwrap();
        // Where it meets the other one.
        let mut at = [0.0; 16];
        at[0] = (0.3 * f64::sin(b)).atan2(0.6 + 0.3 * f64::cos(b)) as f32;
        let touches = (0.3 * f64::sin(b)).hypot(0.6 + 0.3 * f64::cos(b)) < 0.4;
        assert!(touches, "the test's own");
        assert!(!Space::new(&mechanism, &[]).is_free(&at), "{b}");
        assert!(Exact::new(&mechanism, &[]).touch(&[f64::from(at[0])]).is_some(), "{b}");
    }
}

/// Our robot with a long lamp beside its camera: with the head straight ahead it is far from the arm, turned to the left it reaches in front
/// of the mast, above the arm.
fn with_a_lamp() -> Robot {
    let urdf = include_str!("../robots/aimm.urdf");
    let camera = r#"<origin xyz="0.02 0 0"/><geometry><box size="0.06 0.14 0.06"/></geometry>"#;
    assert!(urdf.contains(camera));
    let lamp = r#"<origin xyz="0.02 -0.5 -0.35"/><geometry><box size="0.06 1.1 0.06"/></geometry>"#;
    let description = RobotDescription::read(include_str!("../robots/aimm.toml")).unwrap();
    let srdf = Some(include_str!("../robots/aimm.srdf"));
    Robot::of(description, &urdf.replace(camera, lamp), srdf, &mut |_| unreachable!("it has no meshes")).unwrap()
}

#[test]
fn a_head_that_is_turned_into_the_way_of_the_arm_is_in_its_way() {
    let mut cell = Cell::with_boxes(0, 1);
    cell.robot = with_a_lamp();
    // Nearly stretched upwards, in front of the mast.
    let raised = JointVector::of([-1.57, -0.1, 0.0, 0.1, 0.0, 0.0, 0.0]);
    let ahead = cell.state();
    let turned = Configuration { pan: std::f64::consts::FRAC_PI_2, ..ahead };
    let to = |start: Configuration, goal| Request { ..request(start, vec![Goal::Joints(goal)]) };
    let plan = cell.plan(&to(ahead, raised)).unwrap();
    let check =
        |here: &Configuration| validate_trajectory(&cell.robot, &cell.scene, here, &plan.trajectory, Contact::None);
    assert!(check(&ahead).is_ok(), "{:?}", check(&ahead));
    let refused = check(&turned);
    assert!(
        matches!(&refused, Err(Violation::Collision { collision, .. }) if collision.other == "link tilt"),
        "{refused:?}"
    );
    let refused = cell.plan(&to(turned, raised));
    assert!(matches!(&refused, Err(PlanError::NoGoal { reasons, .. }) if reasons[0].contains("tilt")), "{refused:?}");
    // On the way to somewhere else it is kept away from.
    let there = cell.plan(&to(turned, aimm::HOME)).unwrap();
    validate_trajectory(&cell.robot, &cell.scene, &turned, &there.trajectory, Contact::None).unwrap();
}

#[test]
fn a_head_beyond_its_limits_is_refused() {
    let cell = Cell::with_boxes(0, 1);
    let start = Configuration { tilt: 2.0, ..cell.state() };
    let refused = cell.plan(&request(start, vec![Goal::Joints(aimm::HOME)])).unwrap_err().to_string();
    assert_eq!(refused, "the start's tilt is 2: expected -0.800 to 1.600 rad");
}
