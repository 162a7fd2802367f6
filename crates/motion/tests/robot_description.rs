//! A robot as data: what a `robot.toml` may say, and how it is refused.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_motion::description::RobotDescription;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::mesh::MeshError;
use ratn_motion::robot::{Robot, RobotFault};
use std::path::PathBuf;

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
fn what_does_not_fit_is_refused_with_its_line() {
    let folder = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join(format!("descriptions-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let file = folder.join("robot.toml");
    let refused = |toml: &str, urdf: &str| {
        std::fs::write(&file, toml).unwrap();
        std::fs::write(folder.join("two.urdf"), urdf).unwrap();
        let said = Robot::from_file(&file).unwrap_err().to_string();
        said.strip_prefix(&format!("{}: ", file.display())).map(str::to_owned).unwrap_or(said)
    };
    let changed = |from: &str, to: &str| {
        assert!(TOML.contains(from), "{from}");
        refused(&TOML.replace(from, to), URDF)
    };
    assert_eq!(changed(r#""b"]"#, r#""c"]"#), "line 5: the robot description has no joint `c`");
    assert!(changed(r#"tool = "tool""#, r#"tool = "hand""#).starts_with("line 6: `arm.tool`"));
    // Where a name is written, and not where a comment has it.
    let said = changed("[arm]\njoints = [\"a\", \"b\"]", "# was \"c\"\n[arm]\njoints = [\n  \"a\",\n  \"c\",\n]");
    assert!(said.starts_with("line 8: "), "{said}");
    let without = URDF.replacen("<limit lower=\"-2\" upper=\"2\" velocity=\"1\" effort=\"1\"/>", "", 1);
    let said = refused(TOML, &without);
    assert_eq!(
        said,
        "line 5: the joint `a` cannot be planned for: it has no `<limit>`; add one with `lower`, `upper` and `velocity` (line 3 of the URDF)"
    );
    std::fs::remove_dir_all(&folder).unwrap();
}

#[test]
fn what_does_not_fit_is_refused_by_its_name() {
    let refused = |from: &str, to: &str| read(&TOML.replace(from, to)).unwrap_err().to_string();
    assert_eq!(refused(r#""b"]"#, r#""c"]"#), "the robot description has no joint `c`");
    assert_eq!(refused(r#""b"]"#, r#""a"]"#), "the joint `a` is named twice among those to be planned for");
    assert_eq!(
        refused(r#"tool = "tool""#, r#"tool = "hand""#),
        "`arm.tool`: the robot description has no link `hand`; there is `foot`, `lid`, `lower`, `tool`, `upper`"
    );
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
    assert_eq!(
        refused(r#""a", "b""#, r#""b", "a""#),
        "`arm.joints` goes from the foot to the tool: the joint `a` is nearer to the foot than `b`, put it before that one"
    );
    let unknown = RobotDescription::read(&TOML.replace("tool =", "tol =")).unwrap_err();
    assert!(unknown.contains("line 6") && unknown.contains("tol"), "{unknown}");
}

#[test]
fn what_needs_no_mesh_is_refused_before_one_is_read() {
    let mesh = r#"<link name="foot"><collision><geometry><mesh filename="foot.stl"/></geometry></collision></link>"#;
    let urdf = URDF.replace(r#"<link name="foot"/>"#, mesh);
    let refused = |toml: &str| {
        let (description, mut files) = (RobotDescription::read(toml).unwrap(), Vec::new());
        let read = Robot::of(description, &urdf, None, &mut |file| {
            files.push(file.to_owned());
            Err(MeshError::Kind)
        });
        (read.unwrap_err().to_string(), files)
    };
    let (said, files) = refused(&format!("{TOML}[gripper]\njoint = 'hinge'\nhand = 'foot'\nfinger = 'lid'\n"));
    assert!(said.contains("the joint `hinge` turns"), "{said}");
    assert_eq!(files, Vec::<String>::new());
    let (said, files) = refused(TOML);
    assert!(said.contains("the mesh `foot.stl` of link `foot`"), "{said}");
    assert_eq!(files, ["foot.stl"]);
}

/// A base, an arm of one joint, a head and two fingers, of joints as they are given.
fn mobile(joints: &[(&str, &str)], more: &str) -> Result<Robot, RobotFault> {
    let limit = "<limit lower='-10' upper='10' velocity='1' effort='1'/>";
    let mut parents = ["world", "along_x", "along_y", "base", "arm", "base", "pan", "arm", "arm"].into_iter();
    let mut urdf = "<robot name='mobile'><link name='world'/>".to_owned();
    for (name, kind) in [
        ("along_x", "prismatic 1 0 0"),
        ("along_y", "prismatic 0 1 0"),
        ("base", "revolute 0 0 1"),
        ("arm", "revolute 0 1 0"),
        ("tool", "fixed 1 0 0"),
        ("pan", "revolute 0 0 1"),
        ("tilt", "revolute 0 1 0"),
        ("left", "prismatic 0 1 0"),
        ("right", "prismatic 0 -1 0"),
    ] {
        let kind = joints.iter().find(|(joint, _)| *joint == name).map_or(kind, |(_, kind)| kind);
        let (kind, axis) = kind.split_once(' ').unwrap();
        let (axis, origin) = axis.split_once(" at ").unwrap_or((axis, "0 0 0"));
        let mimic = if name == "right" { "<mimic joint='left_joint'/>" } else { "" };
        urdf += &format!(
            "<link name='{name}'/><joint name='{name}_joint' type='{kind}'><parent link='{}'/><child link='{name}'/>\
             <origin xyz='{origin}'/><axis xyz='{axis}'/>{limit}{mimic}</joint>",
            parents.next().unwrap()
        );
    }
    let toml = format!(
        "name = 'mobile'\nurdf = 'x'\n[arm]\njoints = ['arm_joint']\ntool = 'tool'\n\
         [head]\njoints = ['pan_joint', 'tilt_joint']\n\
         [gripper]\njoint = 'left_joint'\nhand = 'arm'\nfinger = 'left'\n\
         [base]\njoints = ['along_x_joint', 'along_y_joint', 'base_joint']\nbody = 'base'\n{more}"
    );
    let description = RobotDescription::read(&toml).unwrap();
    Robot::of(description, &(urdf + "</robot>"), None, &mut |_| unreachable!("it has no meshes"))
}

#[test]
fn joints_that_cannot_move_their_part_are_refused_by_name() {
    assert!(mobile(&[], "").is_ok());
    let refused = |joint: &str, kind: &str| mobile(&[(joint, kind)], "").unwrap_err().to_string();
    let says = |joint: &str, kind: &str, parts: &[&str]| {
        let said = refused(joint, kind);
        assert!(parts.iter().all(|part| said.contains(part)), "{said}");
    };
    says("left", "revolute 0 1 0", &["`gripper.joint`", "`left_joint`", "turns about (0, 1, 0)", "slides a finger"]);
    says("right", "revolute 1 0 0", &["`gripper.joint`", "`left_joint`", "turns about (1, 0, 0)", "mimic"]);
    says("pan", "prismatic 0 0 1", &["`head.joints`", "`pan_joint`", "slides along (0, 0, 1)", "turns"]);
    says("along_x", "prismatic -1 0 0", &["`base.joints`", "`along_x_joint`", "slides along (-1, 0, 0)", "(1, 0, 0)"]);
    says("along_y", "revolute 0 1 0", &["`base.joints`", "`along_y_joint`", "turns about", "slides along (0, 1, 0)"]);
    says("base", "revolute 0 0 -1", &["`base.joints`", "`base_joint`", "turns about (0, 0, -1)", "about (0, 0, 1)"]);
}

#[test]
fn a_base_that_is_not_where_its_joints_say_is_refused() {
    for (joint, kind) in [
        ("along_x", "prismatic 1 0 0 at 0 0 0.1"),
        ("along_y", "prismatic 0 1 0 at 0.3 0 0"),
        ("base", "revolute 0 0 1 at 0 -1 0"),
    ] {
        let said = mobile(&[(joint, kind)], "").unwrap_err().to_string();
        assert!(
            said.contains("`base.joints`") && said.contains("without an offset") && said.contains("`base`"),
            "{said}"
        );
    }
}

#[test]
fn a_joint_of_two_parts_is_refused() {
    let toml = "[[other_arm]]\nname = 'second'\njoints = ['pan_joint']\ntool = 'pan'\n";
    let said = mobile(&[], toml).unwrap_err().to_string();
    assert!(said.starts_with("the joint `pan_joint` is of two parts, the arm `second` and [head]"), "{said}");
}

#[test]
fn the_base_drives_where_both_its_joints_and_its_area_allow() {
    let area = |more: &str| mobile(&[], more).unwrap().drive_area();
    assert_eq!(area(""), Some(([[-10.0, 10.0]; 2], None)));
    assert_eq!(area("area = { x = [-2, 30], y = [1, 4.5] }"), Some(([[-2.0, 10.0], [1.0, 4.5]], None)));
    let said = mobile(&[], "area = { x = [11, 12], y = [1, 4.5] }").unwrap_err().to_string();
    assert!(said.contains("`base.area`") && said.contains("`along_x_joint`"), "{said}");
    assert_eq!(read(TOML).unwrap().drive_area(), None);
    let aimm = Robot::aimm().drive_area();
    assert_eq!(aimm, Some(([[-4.5, 4.5]; 2], None)));
}

#[test]
fn a_pipe_in_the_place_of_a_file_is_not_waited_for() {
    let folder = std::env::temp_dir().join(format!("ratn-robot-of-pipes-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let (toml, urdf) = (folder.join("robot.toml"), folder.join("two.urdf"));
    std::fs::write(&toml, TOML).unwrap();
    assert!(std::process::Command::new("mkfifo").arg(&urdf).status().unwrap().success());
    let refused = Robot::from_file(&toml).unwrap_err();
    assert!(
        refused.is_unreadable() && refused.to_string().contains("two.urdf: cannot be read: not a regular file"),
        "{refused}"
    );
    std::fs::remove_dir_all(&folder).unwrap();
}
