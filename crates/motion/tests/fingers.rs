//! Where the pads of fingers are, and how thick fingers are, follows from the URDF, however hand, finger and tool are mounted; and a
//! configuration says where several arms with their fingers are.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_model::pose::Pose;
use ratn_motion::arm;
use ratn_motion::collision::{Checker, Contact};
use ratn_motion::description::RobotDescription;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::robot::{ArmPosition, Configuration, Robot, UNSAID};
use ratn_world::scene::{Placement, Scene, SceneObject, Shape};

/// A hand whose fingers slide along the hand's x axis; the tool is turned so that they close along its y. A finger is a bracket and a pad.
fn urdf(arms: &[&str]) -> String {
    let mut urdf = "<robot name='r'><link name='stand'/>".to_owned();
    for (i, arm) in arms.iter().enumerate() {
        let boxed = |xyz: &str, size: &str| {
            format!("<collision><origin xyz='{xyz}'/><geometry><box size='{size}'/></geometry></collision>")
        };
        urdf += &format!(
            "<link name='{arm}_hand'/><joint name='{arm}_turn' type='revolute'><origin xyz='0 {i} 1' rpy='0.3 0.2 0.1'/><parent link='stand'/>\
             <child link='{arm}_hand'/><axis xyz='0 0 1'/><limit lower='-1' upper='2' velocity='1' effort='1'/></joint>\
             <link name='{arm}_tool'/><joint name='{arm}_fixed' type='fixed'><origin xyz='0 0 0.2' rpy='0 0 -1.5707963267948966'/>\
             <parent link='{arm}_hand'/><child link='{arm}_tool'/></joint>\
             <link name='{arm}_a'>{}{}</link><joint name='{arm}_finger' type='prismatic'><origin xyz='0.01 0 0.1'/><parent link='{arm}_hand'/>\
             <child link='{arm}_a'/><axis xyz='1 0 0'/><limit lower='0' upper='0.04' velocity='1' effort='1'/></joint>\
             <link name='{arm}_b'/><joint name='{arm}_other' type='prismatic'><parent link='{arm}_hand'/><child link='{arm}_b'/>\
             <axis xyz='-1 0 0'/><limit lower='0' upper='0.04' velocity='1' effort='1'/><mimic joint='{arm}_finger'/></joint>",
            boxed("0.03 0 0", "0.05 0.02 0.02"),
            boxed("-0.004 0.005 0.1", "0.012 0.03 0.06"),
        );
    }
    urdf + "</robot>"
}

fn robot(arms: &[&str]) -> Robot {
    let mut text = "name = 'r'\nurdf = 'r'\n".to_owned();
    for (i, arm) in arms.iter().enumerate() {
        let gripper = if i == 0 { "[gripper]" } else { "[other_arm.gripper]" };
        text += if i == 0 { "[arm]\n" } else { "[[other_arm]]\n" };
        text += &format!("name = '{arm}'\njoints = ['{arm}_turn']\ntool = '{arm}_tool'\n");
        text += &format!("{gripper}\njoint = '{arm}_finger'\nhand = '{arm}_hand'\nfinger = '{arm}_a'\n");
    }
    let read = RobotDescription::read(&text).unwrap();
    Robot::of(read, &urdf(arms), None, &mut |_| unreachable!("it has no meshes")).unwrap()
}

#[test]
fn the_shapes_of_a_finger_are_told_along_the_axes_of_the_tool() {
    let parts = robot(&["one"]).finger_parts();
    let near = |a: [f64; 3], b: [f64; 3]| (0..3).all(|i| (a[i] - b[i]).abs() < 1e-9);
    let [bracket, pad] = parts[..] else { panic!("{parts:?}") };
    assert!(bracket.is_flat && pad.is_flat);
    // The tool's y is the hand's x, its x the hand's -y.
    assert!(near(pad.half, [0.015, 0.006, 0.03]), "{pad:?}");
    assert!(near(pad.middle, [-0.005, 0.006, 0.0]), "where the fingers meet the pad's face is in the middle: {pad:?}");
    assert!(near(bracket.half, [0.01, 0.025, 0.01]), "{bracket:?}");
}

#[test]
fn the_fingers_of_the_built_in_robots_are_as_thick_as_their_urdf_says() {
    for (name, half) in
        [("aimm", [0.0125, 0.007, 0.035]), ("panda", [0.01, 0.007, 0.027]), ("ur5", [0.0125, 0.007, 0.035])]
    {
        let parts = Robot::built_in(name).unwrap().finger_parts();
        assert!(parts.len() == 1 && parts[0].is_flat && parts[0].half == half, "{name}: {parts:?}");
        assert!((parts[0].middle[1] - 0.007).abs() < 1e-12, "{name}: {parts:?}");
    }
}

#[test]
fn a_configuration_says_where_every_arm_is_and_is_seen_from_each_of_them() {
    let robot = robot(&["one", "two", "three"]);
    assert_eq!(robot.arm_names().collect::<Vec<_>>(), ["one", "two", "three"]);
    let at = |q: f64, finger: f64| Some(ArmPosition { joints: JointVector::of([q]), finger });
    let others = [at(0.2, 0.02), at(0.3, 0.03), None];
    let here = Configuration { arm: JointVector::of([0.1]), finger: 0.01, others, ..robot.at_zero() };
    let two = robot.with_arm("two").unwrap();
    let seen = robot.seen_from(1, &here);
    assert_eq!((seen.arm, seen.finger), (JointVector::of([0.2]), 0.02));
    assert_eq!(seen.others, [at(0.1, 0.01), at(0.3, 0.03), None]);
    assert_eq!(two.poses(&seen), robot.poses(&here), "the same robot stands there");

    let values = here.values();
    assert_eq!(values.len(), 7 + 2 + 2);
    assert_eq!(robot.configuration(&values), Some(here));
    assert_eq!(robot.configuration(&values[..7]), Some(Configuration { others: UNSAID, ..here }));
    assert_eq!(robot.configuration(&values[..8]), None);

    // Not said, another arm is where the robot has it, its fingers open.
    let all = robot.with_all_arms(&robot.at_zero());
    assert_eq!(all.others, [at(0.0, 0.04), at(0.0, 0.04), None]);
    assert_eq!(robot.poses(&all), robot.poses(&robot.at_zero()));
    assert_eq!(robot.finger_links_of(2).len(), 2);
    assert_eq!((robot.joints_of(1)[0].name.as_str(), robot.joints_of(3).len()), ("two_turn", 0));
}

#[test]
fn a_robot_is_the_same_by_what_moves_and_collides_and_its_parts_not_by_its_file() {
    let one = Robot::aimm().identity();
    assert_eq!(one, Robot::aimm().identity());
    assert_ne!(one, Robot::built_in("ur5").unwrap().identity());
    assert_ne!(robot(&["one", "two"]).identity(), robot(&["one"]).identity());
    let two = robot(&["one", "two"]);
    assert_ne!(two.with_arm("two").unwrap().identity(), two.identity(), "another arm is the first");
}

/// The paper's robot with a plate fixed beside one of its links, 6 cm from the middle of the hand; `to` is the link and the place on it.
fn with_plate(link: &str, xyz: &str) -> Robot {
    let read =
        |ending: &str| std::fs::read_to_string(format!("{}/robots/aimm.{ending}", env!("CARGO_MANIFEST_DIR"))).unwrap();
    let plate = format!(
        "<link name='plate'><collision><geometry><box size='0.02 0.02 0.02'/></geometry></collision></link>\
         <joint name='plate_mount' type='fixed'><parent link='{link}'/><child link='plate'/><origin xyz='{xyz}'/></joint></robot>"
    );
    let srdf =
        read("srdf").replace("</robot>", "<disable_collisions link1='hand' link2='plate' reason='Adjacent'/></robot>");
    let description = RobotDescription::read(&read("toml")).unwrap();
    Robot::of(description, &read("urdf").replace("</robot>", &plate), Some(&srdf), &mut |_| unreachable!()).unwrap()
}

#[test]
fn what_is_fixed_to_the_hand_presses_nothing_and_what_is_fixed_to_a_finger_may() {
    let pressed = |link: &str, xyz: &str| {
        let robot = with_plate(link, xyz);
        let home = robot.posture("home").unwrap();
        let empty = Scene { base: Pose::IDENTITY, objects: Vec::new() };
        let here = Configuration { arm: home, ..arm::assumed(&robot, &empty) };
        // A ball that is 5 mm deep in the plate, from the side.
        let plate = robot.poses(&here)[robot.link("plate").unwrap()];
        let ball = SceneObject {
            name: "ball".to_owned(),
            shape: Shape::Cylinder { radius: 0.01, length: 0.02 },
            placement: Placement::World(plate.compose(&Pose::at(0.015, 0.0, 0.0))),
        };
        let scene = Scene { base: Pose::IDENTITY, objects: vec![ball] };
        let mut checker = Checker::new(&robot, &scene, &arm::assumed(&robot, &scene), 0.0);
        assert!(checker.collision(&home, Contact::None).is_some());
        checker.collision(&home, Contact::Gripper(0.006)).map(|touch| touch.to_string())
    };
    let bracket = pressed("hand", "0.08 0 0.05").unwrap();
    assert!(bracket.contains("plate") && bracket.contains("ball"), "{bracket}");
    assert_eq!(pressed("finger_left", "0.06 0 0.03"), None);
}

#[test]
fn fingers_are_around_what_they_hold_however_it_lies_in_them() {
    let robot = Robot::aimm();
    let held = |shape: Shape, turned_rad: f64| {
        let placement = Placement::Gripper(Pose::from_rpy([0.0; 3], turned_rad, 0.0, 0.0));
        let objects = vec![SceneObject { name: "can".to_owned(), shape, placement }];
        arm::assumed(&robot, &Scene { base: Pose::IDENTITY, objects }).finger
    };
    let can = Shape::Cylinder { radius: 0.02, length: 0.1 };
    let quarter = std::f64::consts::FRAC_PI_2;
    for (shape, turned_rad, finger) in
        [(can, 0.0, 0.02), (can, quarter, 0.05), (Shape::Box { size: [0.03, 0.04, 0.1] }, quarter, 0.05)]
    {
        assert!((held(shape, turned_rad) - finger).abs() < 1e-9, "{turned_rad}");
    }
}

#[test]
fn five_arms_are_too_many() {
    let text =
        ["a", "b", "c", "d", "e"].map(|arm| format!("name = '{arm}'\njoints = ['{arm}_turn']\ntool = '{arm}_tool'\n"));
    let text = format!("name = 'r'\nurdf = 'r'\n[arm]\n{}", text.join("[[other_arm]]\n"));
    let read = RobotDescription::read(&text).unwrap();
    let made = Robot::of(read, &urdf(&["a", "b", "c", "d", "e"]), None, &mut |_| unreachable!("it has no meshes"));
    assert_eq!(made.unwrap_err().to_string(), "5 arms: at most 4 are supported");
}

/// A prism along z over an outline in x and y that turns to the left, whose faces are cut into these triangles, as an STL.
fn prism(outline: &[[f64; 2]], faces: &[[usize; 3]], [from, to]: [f64; 2]) -> Vec<u8> {
    let at = |i: usize, z: f64| [outline[i][0], outline[i][1], z];
    let face =
        |[a, b, c]: &[usize; 3]| [[at(*a, from), at(*c, from), at(*b, from)], [at(*a, to), at(*b, to), at(*c, to)]];
    let side = |i: usize| {
        let next = (i + 1) % outline.len();
        let [a, b, c, d] = [at(i, from), at(next, from), at(next, to), at(i, to)];
        [[a, b, c], [a, c, d]]
    };
    let triangles = faces.iter().flat_map(face).chain((0..outline.len()).flat_map(side));
    let facet = |triangle: [[f64; 3]; 3]| {
        let corners: String = triangle.iter().map(|[x, y, z]| format!("vertex {x} {y} {z}\n")).collect();
        format!("facet normal 0 0 0\nouter loop\n{corners}endloop\nendfacet\n")
    };
    format!("solid s\n{}endsolid s\n", triangles.map(facet).collect::<String>()).into_bytes()
}

#[test]
fn the_pad_of_a_mesh_is_what_is_flat_of_it_where_it_is_nearest_to_the_other_finger() {
    // Along the hand's x: a pad 3 cm wide from 0 to 12 mm, from which a wedge widens to 5 cm at 40 mm.
    let outline = [[0.0, 0.03], [0.0, 0.0], [0.012, 0.0], [0.04, -0.01], [0.04, 0.04], [0.012, 0.03]];
    let stl = prism(&outline, &[[0, 1, 2], [0, 2, 5], [2, 3, 4], [2, 4, 5]], [-0.03, 0.03]);
    let pad =
        "<collision><origin xyz='-0.004 0.005 0.1'/><geometry><box size='0.012 0.03 0.06'/></geometry></collision>";
    let meshed =
        "<collision><origin xyz='-0.01 -0.01 0.1'/><geometry><mesh filename='pad.stl'/></geometry></collision>";
    let urdf = urdf(&["one"]);
    assert!(urdf.contains(pad));
    let text = "name = 'r'\nurdf = 'r'\n[arm]\njoints = ['one_turn']\ntool = 'one_tool'\n\
                [gripper]\njoint = 'one_finger'\nhand = 'one_hand'\nfinger = 'one_a'\n";
    let read = RobotDescription::read(text).unwrap();
    let robot = Robot::of(read, &urdf.replace(pad, meshed), None, &mut |_| Ok(stl.clone())).unwrap();
    let near = |a: [f64; 3], b: [f64; 3]| (0..3).all(|i| (a[i] - b[i]).abs() < 1e-9);
    let [_, pad] = robot.finger_parts()[..] else { panic!("{:?}", robot.finger_parts()) };
    // It is as wide as it is within the 2 mm that pads give way, and as thick as the whole.
    assert!(pad.is_flat && near(pad.half, [0.015, 0.02, 0.03]), "{pad:?}");
    assert!(near(pad.middle, [-0.005, 0.02, 0.0]), "{pad:?}");
}
