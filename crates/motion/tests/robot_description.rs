//! A robot as data: what a `robot.toml` may say, and how it is refused.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_motion::description::RobotDescription;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::robot::{Robot, RobotFault};

/// An arm of two joints with a tool and a joint of no part.
const URDF: &str = r#"<robot name="two">
  <link name="foot"/><link name="upper"/><link name="lower"/><link name="tool"/><link name="lid"/>
  <joint name="a" type="revolute"><parent link="foot"/><child link="upper"/><axis xyz="0 0 1"/>
    <limit lower="-2" upper="2" velocity="1" effort="1"/></joint>
  <joint name="b" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="0.5 0 0"/><axis xyz="0 0 1"/>
    <limit lower="-2" upper="2" velocity="1" effort="1"/></joint>
  <joint name="end" type="fixed"><parent link="lower"/><child link="tool"/><origin xyz="0.4 0 0"/></joint>
  <joint name="hinge" type="revolute"><parent link="foot"/><child link="lid"/><axis xyz="0 1 0"/>
    <limit lower="0.5" upper="1" velocity="1" effort="1"/></joint>
</robot>"#;

const TOML: &str = r#"
name = "two"
urdf = "two.urdf"
[arm]
joints = ["a", "b"]
tool = "tool"
[postures]
home = [0.1, -0.2]
"#;

fn read(toml: &str) -> Result<Robot, RobotFault> {
    let description = RobotDescription::read(toml).unwrap();
    Robot::of(description, URDF, None, &mut |_| unreachable!("it has no meshes"))
}

#[test]
fn a_robot_of_two_joints_has_what_its_description_says_and_nothing_else() {
    let robot = read(TOML).unwrap();
    assert_eq!((robot.name(), robot.arm_joints().len()), ("two", 2));
    assert_eq!(robot.posture("home"), Some(JointVector::of([0.1, -0.2])));
    assert_eq!(robot.posture("stowed"), None);
    assert!(robot.base_joints().is_empty() && robot.head_joints().is_empty() && robot.finger().is_none());
    let home = robot.tool_pose(&robot.at_zero());
    assert!((home.position[0] - 0.9).abs() < 1e-12);
    assert_eq!(robot.camera_pose(&robot.at_zero()), None);
    // What it says of all its parts reads back.
    let at = robot.at_zero();
    assert_eq!(robot.configuration(&at.values()), Some(at));
    assert_eq!(robot.configuration(&[0.0; 3]), None);
}

#[test]
fn every_built_in_robot_takes_its_postures() {
    for name in Robot::built_in_names() {
        let robot = Robot::built_in(name).unwrap();
        assert_eq!(robot.name(), name);
        assert!(robot.postures().iter().all(|(_, posture)| robot.clamp(posture) == *posture));
    }
}

#[test]
fn what_does_not_fit_is_refused_by_its_name() {
    let refused = |from: &str, to: &str| read(&TOML.replace(from, to)).unwrap_err().to_string();
    assert_eq!(refused(r#""b"]"#, r#""c"]"#), "the robot description has no joint `c`");
    assert_eq!(refused(r#""b"]"#, r#""a"]"#), "the joint `a` is named twice among those to be planned for");
    assert_eq!(refused(r#"tool = "tool""#, r#"tool = "hand""#), "the robot description has no link `hand`");
    assert_eq!(
        refused(r#"tool = "tool""#, r#"tool = "upper""#),
        "the joint `b` of the arm does not move its tool, the link `upper`"
    );
    assert_eq!(
        refused(r#""b"]"#, r#""hinge"]"#),
        "the joint `hinge` of the arm does not move its tool, the link `tool`"
    );
    assert_eq!(refused("[0.1, -0.2]", "[0.1]"), "the posture `home` has 1 positions: the arm has 2 joints");
    assert_eq!(refused("[0.1, -0.2]", "[0.1, 2.5]"), "the posture `home` has b at 2.5: its limits are -2 to 2");
    let unknown = RobotDescription::read(&TOML.replace("tool =", "tol =")).unwrap_err();
    assert!(unknown.contains("line 6") && unknown.contains("tol"), "{unknown}");
}
