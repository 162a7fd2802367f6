//! Every robot that we ship can work in its own workplace: its postures touch nothing, and what stands there can be taken and put down.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use ratn_model::pose::Pose;
use ratn_motion::aimm;
use ratn_motion::arm::{self, line};
use ratn_motion::collision::{CONTACT_TOLERANCE_M, Checker, Contact, PADDING_M};
use ratn_motion::pace::Control;
use ratn_motion::plan::{Goal, Request, plan};
use ratn_motion::reach::Target;
use ratn_motion::robot::{Configuration, Robot};
use ratn_motion::validate::validate_trajectory;
use ratn_motion::workplace::{HOME, Surface, Workplace};
use ratn_world::scene::{Placement, Scene, SceneObject, Shape};
use std::f64::consts::PI;

/// What other tests say more of.
const AIMM: &str = "aimm";

fn cuboid(name: &str, pose: Pose, size: [f64; 3]) -> SceneObject {
    SceneObject { name: name.to_owned(), shape: Shape::Box { size }, placement: Placement::World(pose) }
}

fn table(workplace: &Workplace) -> SceneObject {
    let [x, y, z] = workplace.table.centre;
    cuboid("table", Pose::at(x, y, z), workplace.table.size)
}

fn standing(floor: &Pose, size: [f64; 3]) -> Pose {
    floor.compose(&Pose::at(0.0, 0.0, size[2] / 2.0))
}

/// A scene with the table and boxes of a size on these points of surfaces.
fn scene(workplace: &Workplace, floors: &[Pose], size: [f64; 3]) -> Scene {
    let boxes = floors.iter().enumerate().map(|(i, floor)| cuboid(&format!("box_{i}"), standing(floor, size), size));
    Scene { base: Pose::IDENTITY, objects: boxes.chain([table(workplace)]).collect() }
}

/// Points of the region in which boxes stand.
fn region(workplace: &Workplace, [columns, rows]: [usize; 2], yaw: f64) -> Vec<Pose> {
    let at = |[low, high]: [f64; 2], i: usize, n: usize| low + (high - low) * i as f64 / (n - 1).max(1) as f64;
    let (x, y, z) = (workplace.boxes.x, workplace.boxes.y, workplace.table.top_m());
    let point = |i: usize| Pose::from_rpy([at(x, i % columns, columns), at(y, i / columns, rows), z], 0.0, 0.0, yaw);
    (0..columns * rows).map(point).collect()
}

/// Some way to take the box from above from which the straight line up is free.
fn can_be_taken(robot: &Robot, scene: &Scene, pose: &Pose, size: [f64; 3]) -> Result<(), String> {
    let (reach, home) = (arm::reach(robot), robot.posture(HOME).unwrap());
    let mut checker = Checker::new(robot, scene, &arm::assumed(robot, scene), PADDING_M);
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let mut reasons = Vec::new();
    for grasp in aimm::grasp_poses(pose, size) {
        for posture in reach.solutions(&Target::at(grasp), &home, 12, 40, &mut random) {
            match line(&reach, &posture, [0.0, 0.0, aimm::APPROACH_M]) {
                Err(error) => reasons.push(error.to_string()),
                Ok(postures) => {
                    let contact = Contact::Gripper(CONTACT_TOLERANCE_M);
                    match postures.iter().find_map(|posture| checker.collision(posture, contact)) {
                        None => return Ok(()),
                        Some(collision) => reasons.push(collision.to_string()),
                    }
                }
            }
        }
    }
    Err(format!("{:?} {size:?}: {reasons:?}", pose.position))
}

/// The robots that stand behind a table.
fn on_tables() -> impl Iterator<Item = Robot> {
    Robot::built_in_names().filter(|name| *name != AIMM).map(|name| Robot::built_in(name).unwrap())
}

#[test]
fn the_postures_of_every_robot_touch_nothing_above_a_full_table() {
    for robot in on_tables() {
        let workplace = robot.workplace().unwrap();
        let floors = [region(workplace, [2, 3], 0.0), workplace.places.poses()].concat();
        let scene = scene(workplace, &floors, workplace.boxes.greatest);
        let mut checker = Checker::new(&robot, &scene, &arm::assumed(&robot, &scene), PADDING_M);
        for (name, posture) in robot.postures() {
            let tool = arm::reach(&robot).pose(posture).position;
            assert_eq!(checker.collision(posture, Contact::None), None, "{} {name}, tool at {tool:?}", robot.name());
        }
    }
}

#[test]
fn boxes_anywhere_in_the_region_can_be_taken_from_above() {
    let mut failures = Vec::new();
    for robot in on_tables() {
        let workplace = robot.workplace().unwrap();
        for yaw in 0..4 {
            for floor in region(workplace, [3, 4], f64::from(yaw) * PI / 4.0) {
                for size in [workplace.boxes.least, workplace.boxes.greatest] {
                    let scene = scene(workplace, &[floor], size);
                    failures.extend(can_be_taken(&robot, &scene, &standing(&floor, size), size).err());
                }
            }
        }
    }
    assert!(failures.is_empty(), "{} of 192: {failures:#?}", failures.len());
}

#[test]
fn every_place_can_be_served_from_above_while_all_others_are_full() {
    let mut failures = Vec::new();
    for robot in on_tables() {
        let workplace = robot.workplace().unwrap();
        assert_eq!(workplace.places.on, Surface::Table);
        for size in [workplace.boxes.least, workplace.boxes.greatest] {
            let floors = workplace.places.poses();
            let scene = scene(workplace, &floors, size);
            for floor in &floors {
                failures.extend(can_be_taken(&robot, &scene, &standing(floor, size), size).err());
            }
        }
    }
    assert!(failures.is_empty(), "{failures:#?}");
}

#[test]
fn the_workplace_of_the_mobile_robot_is_the_one_that_its_constants_say() {
    let robot = Robot::aimm();
    let Workplace { table, boxes, places, .. } = robot.workplace().unwrap();
    assert_eq!((table.centre, table.size), (aimm::TABLE_CENTRE, aimm::TABLE_SIZE));
    assert!((table.top_m() - aimm::TABLE_HEIGHT_M).abs() < 1e-12);
    assert_eq!(
        ([boxes.x, boxes.y], boxes.least, boxes.greatest),
        (aimm::BOX_REGION, aimm::BOX_LEAST, aimm::BOX_GREATEST)
    );
    assert_eq!((places.on, places.at.len()), (Surface::Base, aimm::SLOT_COUNT));
    for (place, slot) in places.poses().iter().zip(aimm::slots()) {
        assert!(place.distance(&slot) < 1e-12 && place.angle(&slot) < 1e-7, "{place:?} {slot:?}");
    }
    let postures = [("home", aimm::HOME), ("observation", aimm::OBSERVATION), ("stowed", aimm::STOWED)];
    for (name, posture) in postures {
        assert_eq!(robot.posture(name), Some(posture), "{name}");
    }
    assert_eq!(robot.open_finger_m(), aimm::GRIPPER_OPENING_M / 2.0);
}

#[test]
fn a_workplace_that_is_none_is_refused_with_what_is_wrong() {
    let panda = include_str!("../robots/panda.toml");
    let urdf = include_str!("../robots/panda.urdf");
    let fault = |from: &str, to: &str| {
        assert!(panda.contains(from), "{from}");
        let description = ratn_motion::description::RobotDescription::read(&panda.replace(from, to)).unwrap();
        let no_meshes = &mut |_: &str| unreachable!("there are none");
        Robot::of(description, urdf, None, no_meshes).unwrap_err().to_string()
    };
    let wrong = [
        ("size = [0.80, 1.20, 0.05]", "size = [0.80, -1.20, 0.05]", "[workplace]: `table`"),
        ("x = [0.36, 0.56]", "x = [0.56, 0.36]", "`boxes.x` and `boxes.y`"),
        ("x = [0.36, 0.56]", "x = [0.36, 1.56]", "beyond the table"),
        ("least = [0.05, 0.04, 0.07]", "least = [0.05, 0.07, 0.07]", "`boxes.least`"),
        ("greatest = [0.12, 0.06, 0.12]", "greatest = [0.12, 0.09, 0.12]", "the gripper opens to 0.08 m"),
        ("on = \"table\"", "on = \"base\"", "has no [base]"),
        ("[0.30, 0.16, 0.70]", "[0.30, 0.16, 0.80]", "is not on the table, whose top is at z = 0.7"),
        ("home = [", "rest = [", "add it to [postures]"),
    ];
    for (from, to, expected) in wrong {
        let found = fault(from, to);
        assert!(found.starts_with("[workplace]: ") && found.contains(expected), "{from} → {to}: {found}");
    }
}

#[test]
fn every_built_in_robot_goes_from_posture_to_posture_however_many_joints_it_has() {
    for name in Robot::built_in_names() {
        let robot = Robot::built_in(name).unwrap();
        let scene = scene(robot.workplace().unwrap(), &[], [0.1; 3]);
        let [from, to] = [HOME, "observation"].map(|posture| robot.posture(posture).unwrap());
        let start = Configuration { arm: from, ..arm::assumed(&robot, &scene) };
        let request = Request { improvement_iterations: 20, ..Request::new(start, vec![Goal::Joints(to)]) };
        let plan = plan(&robot, &scene, &request, &mut |_| Control::Continue).unwrap();
        assert_eq!((plan.end, plan.trajectory.joints.len()), (to, robot.arm_joints().len()), "{name}");
        validate_trajectory(&robot, &scene, &start, &plan.trajectory, Contact::None).unwrap();
    }
}

#[test]
fn a_robot_without_a_base_stands_where_its_urdf_puts_it_whatever_is_said_of_a_base() {
    let robot = Robot::built_in("panda").unwrap();
    let workplace = robot.workplace().unwrap();
    let here = scene(workplace, &[], workplace.boxes.greatest);
    let away = Scene { base: Pose::from_rpy([0.3, -0.1, 0.0], 0.0, 0.0, 0.4), ..here.clone() };
    let at = Configuration { arm: robot.posture(HOME).unwrap(), ..arm::assumed(&robot, &here) };
    let seen = |scene: &Scene| format!("{:?}", arm::in_scene(&robot, scene, &at).1);
    assert_eq!(seen(&away), seen(&here));
    assert_eq!(arm::on_floor(&robot, &away.base), Pose::IDENTITY);
    let request = Request::new(at, vec![Goal::Joints(robot.posture("observation").unwrap())]);
    assert!(plan(&robot, &here, &request, &mut |_| Control::Continue).is_ok());
    let refused = plan(&robot, &away, &request, &mut |_| Control::Continue).unwrap_err().to_string();
    for part in ["`at(base)`", "panda has no [base]", "(0.3, -0.1)"] {
        assert!(refused.contains(part), "{refused}");
    }
}
