//! Robots described by a `robot.toml` that have two arms, or links that are meshes.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ratn_model::pose::Pose;
use ratn_motion::arm;
use ratn_motion::collision::{Checker, Contact};
use ratn_motion::description::RobotDescription;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::mesh::MeshError;
use ratn_motion::pace::{Control, Progress};
use ratn_motion::plan::{Goal, PlanError, Request, plan};
use ratn_motion::robot::{Configuration, Robot, RobotFault};
use ratn_motion::space::state;
use ratn_world::scene::{Placement, Scene, SceneObject, Shape};

/// Two arms of three joints on one stand, 0.5 m apart; the shape of a hand is put in.
fn urdf(hand: &str) -> String {
    let mut urdf = "<robot name='two'><link name='stand'/>".to_owned();
    for (side, y) in [("left", 0.25), ("right", -0.25)] {
        let boxed = "<collision><origin xyz='0 0 0.2'/><geometry><box size='0.06 0.06 0.3'/></geometry></collision>";
        for (i, (parent, axis, z)) in [
            ("stand".to_owned(), "0 0 1", 0.1),
            (format!("{side}_1"), "1 0 0", 0.1),
            (format!("{side}_2"), "1 0 0", 0.4),
        ]
        .into_iter()
        .enumerate()
        {
            let shape = [String::new(), boxed.to_owned(), hand.to_owned()][i].clone();
            let (n, y) = (i + 1, if i == 0 { y } else { 0.0 });
            urdf += &format!(
                "<link name='{side}_{n}'>{shape}</link><joint name='{side}_joint_{n}' type='revolute'><origin xyz='0 {y} {z}'/>\
                 <parent link='{parent}'/><child link='{side}_{n}'/><axis xyz='{axis}'/>\
                 <limit lower='-2.5' upper='2.5' effort='1' velocity='2'/></joint>"
            );
        }
    }
    urdf + "</robot>"
}

const HAND: &str = "<collision><origin xyz='0 0 0.15'/><geometry><box size='0.06 0.06 0.2'/></geometry></collision>";

const DESCRIPTION: &str = r#"
name = "two"
urdf = "two.urdf"

[arm]
name = "left"
joints = ["left_joint_1", "left_joint_2", "left_joint_3"]
tool = "left_3"

[postures]
home = [0, 0.3, 0]

[[other_arm]]
name = "right"
joints = ["right_joint_1", "right_joint_2", "right_joint_3"]
tool = "right_3"
postures = { home = [0, -0.4, 0] }
"#;

fn robot(description: &str, hand: &str) -> Result<Robot, RobotFault> {
    let read = RobotDescription::read(description).unwrap();
    Robot::of(read, &urdf(hand), None, &mut |name| match name {
        "hand.stl" => Ok(stl()),
        _ => Err(MeshError::Read { reason: "there is none".to_owned() }),
    })
}

/// The hand as a mesh: the same box, its middle where the link is.
fn stl() -> Vec<u8> {
    let corner =
        |i: usize| [0, 1, 2].map(|k| if i >> k & 1 == 1 { [0.03, 0.03, 0.1][k] } else { -[0.03, 0.03, 0.1][k] });
    let faces = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let mut text = "solid hand\n".to_owned();
    for [a, b, c, d] in faces {
        for triangle in [[a, b, c], [a, c, d]] {
            let corners = triangle
                .map(|i| {
                    let [x, y, z] = corner(i);
                    format!("vertex {x} {y} {z}\n")
                })
                .concat();
            text += &format!("facet normal 0 0 0\nouter loop\n{corners}endloop\nendfacet\n");
        }
    }
    (text + "endsolid hand\n").into_bytes()
}

fn nothing() -> Scene {
    Scene { base: Pose::IDENTITY, objects: Vec::new() }
}

fn touches(robot: &Robot, posture: &JointVector, scene: &Scene) -> bool {
    let here = Configuration { arm: *posture, ..robot.at_zero() };
    let exact = Checker::new(robot, scene, &here, 0.0).collision(posture, Contact::None).is_some();
    let (mechanism, obstacles) = arm::in_scene(robot, scene, &here);
    let by_spheres = !arm::space(&mechanism, &obstacles).is_free(&state(posture));
    // Spheres hold the shapes, so that they see what the exact check sees.
    assert!(by_spheres || !exact, "{posture:?}");
    exact
}

#[test]
fn one_arm_moves_and_the_other_is_in_its_way_where_it_stands() {
    let left = robot(DESCRIPTION, HAND).unwrap();
    assert_eq!((left.arm_name(), left.other_arms().collect::<Vec<_>>()), ("left", vec!["right"]));
    let right = left.with_arm("right").unwrap();
    assert_eq!((right.arm_name(), right.other_arms().collect::<Vec<_>>()), ("right", vec!["left"]));
    assert_eq!(
        (right.posture("home"), left.posture("home")),
        (Some([0.0, -0.4, 0.0].into()), Some([0.0, 0.3, 0.0].into()))
    );
    assert_eq!(right.with_arm("left").unwrap().arm_joints(), left.arm_joints());

    // Leaning towards each other they meet; away from the other one each is free.
    let leaning = |q: f64| JointVector::of([0.0, q, 0.0]);
    let mut met = 0;
    let mut random = ChaCha8Rng::seed_from_u64(1);
    for _ in 0..60 {
        let (a, b) = (random.random_range(-1.2..1.2), random.random_range(-1.2..1.2));
        let from_left = left.clone().with_other_arm_at("right", &leaning(b)).unwrap();
        let from_right = right.clone().with_other_arm_at("left", &leaning(a)).unwrap();
        let meet = touches(&from_left, &leaning(a), &nothing());
        assert_eq!(meet, touches(&from_right, &leaning(b), &nothing()), "left at {a}, right at {b}");
        met += usize::from(meet);
        if a < 0.0 && b > 0.0 {
            assert!(!meet, "left at {a}, right at {b}");
        }
    }
    assert!((5..55).contains(&met), "{met}");
}

#[test]
fn a_plan_goes_around_the_arm_that_stands_and_refuses_a_goal_in_it() {
    let left = robot(DESCRIPTION, HAND).unwrap();
    let start = Configuration { arm: [0.0, 0.0, 0.0].into(), ..left.at_zero() };
    let goal = JointVector::of([0.0, 1.0, 0.0]);
    let go_on = &mut |_: Progress| Control::Continue;
    let request = Request::new(start, vec![Goal::Joints(goal)]);
    let away = left.clone().with_other_arm_at("right", &[0.0, 1.2, 0.0]).unwrap();
    let planned = plan(&away, &nothing(), &request, go_on).unwrap();
    assert_eq!(planned.end, goal);
    let upright = left.with_other_arm_at("right", &[0.0, 0.0, 0.0]).unwrap();
    let refused: PlanError = plan(&upright, &nothing(), &request, go_on).unwrap_err();
    assert!(refused.to_string().contains("right_"), "{refused}");
}

#[test]
fn what_is_wrong_with_an_arm_is_said() {
    let said = |from: &str, to: &str| robot(&DESCRIPTION.replace(from, to), HAND).unwrap_err().to_string();
    assert_eq!(said("name = \"right\"", "name = \"left\""), "two arms are called `left`");
    let shared = said("\"right_joint_1\"", "\"left_joint_1\"");
    assert!(
        shared.starts_with("the joint `left_joint_1` is of two parts, the arm `left` and the arm `right`"),
        "{shared}"
    );
    let posture = said("home = [0, -0.4, 0]", "home = [0, -0.4]");
    assert_eq!(posture, "the posture `home` has 2 positions: the arm has 3 joints");
    let beside = said("tool = \"right_3\"", "tool = \"left_3\"");
    assert!(beside.contains("right_joint_1"), "{beside}");
    let two = robot(DESCRIPTION, HAND).unwrap();
    let none = two.with_arm("middle").unwrap_err().to_string();
    assert_eq!(none, "two has no arm `middle` for this: its arms are left, right");
    assert!(two.clone().with_other_arm_at("left", &[0.0; 3]).is_err(), "it is the one that moves");
    let twice = RobotDescription::read(&DESCRIPTION.replace(
        "tool = \"left_3\"",
        "tool = \"left_3\"\npostures = {}\n[arm.gripper]\njoint = \"x\"\nhand = \"x\"\nfinger = \"x\"",
    ));
    assert!(twice.unwrap_err().contains("`[gripper]`"));
}

#[test]
fn a_hand_that_is_a_mesh_is_in_the_way_like_one_that_is_a_box() {
    let mesh = "<collision><origin xyz='0 0 0.15'/><geometry><mesh filename='hand.stl'/></geometry></collision>";
    let (boxed, meshed) = (robot(DESCRIPTION, HAND).unwrap(), robot(DESCRIPTION, mesh).unwrap());
    let mut random = ChaCha8Rng::seed_from_u64(2);
    let (mut touching, mut differ) = (0, 0);
    for _ in 0..100 {
        let posture = JointVector::from_fn(3, |_| random.random_range(-1.0..1.0));
        let at = boxed.tool_pose(&Configuration { arm: posture, ..boxed.at_zero() }).transform([0.0, 0.0, 0.2]);
        let beside = Pose::at(at[0] + random.random_range(-0.12..0.12), at[1], at[2]);
        let shape = Shape::Box { size: [0.05; 3] };
        let object = SceneObject { name: "box".into(), shape, placement: Placement::World(beside) };
        let scene = Scene { base: Pose::IDENTITY, objects: vec![object] };
        let (by_box, by_mesh) = (touches(&boxed, &posture, &scene), touches(&meshed, &posture, &scene));
        // The spheres of a mesh hold all of it, and a little more.
        assert!(by_mesh || !by_box, "{posture:?}");
        touching += usize::from(by_box);
        differ += usize::from(by_mesh && !by_box);
    }
    assert!(touching > 20 && differ < 25, "{touching} touch, {differ} by the mesh alone");
}
