//! The kinematics against what is published of the arm, and inverse against forward kinematics.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use proptest::prelude::*;
use ratn_model::pose::Pose;
use ratn_motion::aimm;
use ratn_motion::arm;
use ratn_motion::arm::line;
use ratn_motion::description::RobotDescription;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::robot::{Configuration, Robot};
use std::f64::consts::{FRAC_PI_2, PI};

/// The LWR 4+ by its Denavit-Hartenberg parameters (a = 0): flange as seen from the foot.
fn by_denavit_hartenberg(arm: &JointVector) -> Pose {
    let lengths = [0.3105, 0.0, 0.40, 0.0, 0.39, 0.0, 0.078];
    let twists = [FRAC_PI_2, -FRAC_PI_2, -FRAC_PI_2, FRAC_PI_2, FRAC_PI_2, -FRAC_PI_2, 0.0];
    (0..7).fold(Pose::IDENTITY, |pose, i| {
        let turned = pose.compose(&Pose::from_rpy([0.0; 3], 0.0, 0.0, arm[i]));
        turned.compose(&Pose::from_rpy([0.0, 0.0, lengths[i]], twists[i], 0.0, 0.0))
    })
}

fn postures() -> impl Strategy<Value = JointVector> {
    let robot = Robot::aimm();
    let limits = robot.arm_joints().iter().map(|j| j.lower..j.upper).collect::<Vec<_>>();
    limits.prop_map(|v| JointVector::read(&v).unwrap())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 200, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn the_chain_is_that_of_the_published_parameters(arm in postures(), x in -2.0..2.0, yaw in -3.0..3.0) {
        let robot = Robot::aimm();
        let base = Pose::from_rpy([x, 0.5, 0.0], 0.0, 0.0, yaw);
        let configuration = Configuration { arm, ..robot.at_zero().with_base(&base) };
        let flange = robot.pose(&configuration, robot.link("arm_7").unwrap());
        let foot = robot.pose(&configuration, robot.link("arm_0").unwrap());
        let expected = foot.compose(&by_denavit_hartenberg(&arm));
        prop_assert!(flange.distance(&expected) < 1e-9 && flange.angle(&expected) < 1e-6);
    }

    #[test]
    fn a_straight_line_is_straight(dx in -0.05..0.05, dz in 0.0..0.1) {
        let robot = Robot::aimm();
        let reach = arm::reach(&robot);
        let start = reach.pose(&aimm::HOME);
        let postures = line(&reach, &aimm::HOME, [dx, 0.0, dz]).unwrap();
        for pair in postures.windows(2) {
            let middle = ratn_motion::collision::between(&pair[0], &pair[1], 0.5);
            let tool = reach.pose(&middle);
            let [x, y, z] = [0, 1, 2].map(|i| tool.position[i] - start.position[i]);
            prop_assert!(y.abs() < 1e-4 && (x * dz - z * dx).abs() < 1e-4 && tool.angle(&start) < 1e-3);
        }
    }
}

#[test]
fn the_robot_has_the_thirteen_degrees_of_freedom_of_the_paper() {
    let robot = Robot::aimm();
    assert_eq!(robot.model.joints.len(), 13);
    let degrees = |x: f64| (x * 180.0 / PI).round();
    let limits: Vec<f64> = robot.arm_joints().iter().map(|j| degrees(j.upper)).collect();
    let speeds: Vec<f64> = robot.arm_joints().iter().map(|j| degrees(j.velocity)).collect();
    assert_eq!(limits, [170.0, 120.0, 170.0, 120.0, 170.0, 120.0, 170.0]);
    assert_eq!(speeds, [110.0, 110.0, 128.0, 128.0, 204.0, 184.0, 184.0]);
    assert_eq!(robot.open_finger_m() * 2.0, aimm::GRIPPER_OPENING_M);
}

#[test]
fn looking_at_a_point_puts_it_on_the_optical_axis() {
    let robot = Robot::aimm();
    let base = Pose::from_rpy([0.2, -0.1, 0.0], 0.0, 0.0, 0.4);
    let target = base.transform(aimm::TABLE_CENTRE);
    let (pan, tilt) = robot.look_at(&robot.at_zero().with_base(&base), target);
    let camera = robot.camera_pose(&Configuration { pan, tilt, ..robot.at_zero().with_base(&base) }).unwrap();
    let seen = camera.inverse().transform(target);
    assert!(seen[0].abs() < 1e-6 && seen[1].abs() < 1e-6 && seen[2] > 1.0, "{seen:?}");
    // The image is upright: what is higher in the world is further up, which is -y.
    let above = camera.inverse().transform([target[0], target[1], target[2] + 0.1]);
    assert!(above[1] < -0.05 && above[0].abs() < 0.01, "{above:?}");
}

#[test]
fn a_description_without_a_joint_is_refused_by_name() {
    let description = RobotDescription::read(include_str!("../robots/aimm.toml")).unwrap();
    let urdf = r#"<robot name="r"><link name="world"/><link name="tool"/><joint name="j" type="fixed"><parent link="world"/><child link="tool"/></joint></robot>"#;
    let error = Robot::of(description, urdf, Some("<robot/>"), &mut |_| unreachable!("it has no meshes")).unwrap_err();
    assert_eq!(error.to_string(), "the robot description has no joint `arm_joint_1`");
}

#[test]
fn the_camera_looks_from_where_the_arm_has_lifted_it() {
    let joint = |name: &str, kind: &str, parent: &str, axis: &str| {
        format!(
            "<link name='{name}'/><joint name='{name}_joint' type='{kind}'><parent link='{parent}'/><child link='{name}'/>\
             <axis xyz='{axis}'/><limit lower='-1.5' upper='1.5' velocity='1' effort='1'/></joint>"
        )
    };
    let urdf = format!(
        "<robot name='lift'><link name='foot'/>{}{}{}{}<link name='eye'/><joint name='eye_joint' type='fixed'><parent link='tilt'/>\
         <child link='eye'/><origin rpy='-1.5707963267948966 0 -1.5707963267948966'/></joint></robot>",
        joint("lift", "prismatic", "foot", "0 0 1"),
        joint("tool", "revolute", "lift", "0 0 1"),
        joint("pan", "revolute", "lift", "0 0 1"),
        joint("tilt", "revolute", "pan", "0 1 0"),
    );
    let toml = "name = 'lift'\nurdf = 'lift'\n[arm]\njoints = ['lift_joint', 'tool_joint']\ntool = 'tool'\n\
        [head]\njoints = ['pan_joint', 'tilt_joint']\n[camera]\nlink = 'eye'\n";
    let description = ratn_motion::description::RobotDescription::read(toml).unwrap();
    let robot = Robot::of(description, &urdf, None, &mut |_| unreachable!("it has no meshes")).unwrap();
    for lift in [0.0, 1.0] {
        let here = Configuration { arm: [lift, 0.0].into(), ..robot.at_zero() };
        let (pan, tilt) = robot.look_at(&here, [1.0, 0.0, 0.0]);
        assert!(pan.abs() < 1e-6 && (tilt - lift.atan2(1.0)).abs() < 1e-6, "{pan} {tilt} at {lift}");
    }
}
