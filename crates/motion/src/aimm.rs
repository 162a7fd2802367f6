//! The dimensions of our cell: positions of the table, the places on the base and the boxes, and the named postures of tasks.
//!
//! World frame: metres, floor at z = 0, the robot's base at the origin looking along x. The base's body is 1.10 × 0.60 × 0.60,
//! centred at x = -0.20; the arm stands on it at x = 0.20, turned by 90° so that its first joint's dead sector points to the
//! right; the mast stands at x = -0.68, and the camera hangs at (-0.49, 0, 1.88) looking ahead. The tests of this file show that
//! every place below can be reached from above, with a straight approach of [`APPROACH_M`].

use crate::joint_vector::JointVector;
pub use crate::top_grasp::{APPROACH_M, GRASP_DEPTH_M, grasp_poses};
use ratn_model::pose::Pose;
use std::f64::consts::FRAC_PI_2;

/// Height of the base's top, which is its load deck, in metres.
pub const DECK_HEIGHT_M: f64 = 0.60;

/// Height of the table's top, in metres.
pub const TABLE_HEIGHT_M: f64 = 0.70;

/// The table's top slab: its centre.
pub const TABLE_CENTRE: [f64; 3] = [0.80, 0.0, 0.675];

/// The table's top slab: its edges.
pub const TABLE_SIZE: [f64; 3] = [0.60, 1.20, 0.05];

/// Where the centres of boxes may stand on the table: minimum and maximum x, minimum and maximum y. Any yaw.
pub const BOX_REGION: [[f64; 2]; 2] = [[0.62, 0.84], [-0.38, 0.38]];

/// Minimum edges of a box (longer horizontal, shorter horizontal, height) that the gripper can take.
pub const BOX_LEAST: [f64; 3] = [0.06, 0.06, 0.08];

/// Maximum edges of a box.
pub const BOX_GREATEST: [f64; 3] = [0.16, 0.09, 0.12];

/// The maximum opening of the fingers, in metres.
pub const GRIPPER_OPENING_M: f64 = 0.11;

/// Number of places for boxes on the deck.
pub const SLOT_COUNT: usize = 9;

/// Arm at rest in front of the base, tool downwards above the table.
pub const HOME: JointVector = JointVector::of([-FRAC_PI_2, -0.35, 0.0, 1.40, 0.0, -1.391_592_653_589_793, 0.0]);

/// Arm above the deck, out of the camera's view of the table.
pub const OBSERVATION: JointVector = JointVector::of([0.9, -1.2, 0.0, 0.9, 0.0, -0.6, 0.0]);

/// Arm folded within the base's outline, for driving; the camera sees the whole deck.
pub const STOWED: JointVector = JointVector::of([FRAC_PI_2, 0.3, 0.0, 2.05, 0.0, -0.8, 0.0]);

/// The places `slot_1`..`slot_9` on the deck, in the base's frame: on the deck's surface, x along a box's longer edge, which is across the base.
/// Three rows behind the arm, nearest first, each from right to left.
pub fn slots() -> [Pose; SLOT_COUNT] {
    std::array::from_fn(|i| {
        let (row, column) = ((i / 3) as f64, (i % 3) as f64);
        Pose::from_rpy([-0.22 - 0.15 * row, -0.20 + 0.20 * column, DECK_HEIGHT_M], 0.0, 0.0, FRAC_PI_2)
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]

    use super::*;
    use crate::arm;
    use crate::arm::line;
    use crate::collision::{Checker, Contact, PADDING_M};
    use crate::reach::Target;
    use crate::robot::{Configuration, Robot};
    use parry3d::math::Vector;
    use parry3d::query::Ray;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use ratn_world::scene::{Placement, Scene, SceneObject, Shape};
    use std::f64::consts::PI;

    fn table() -> SceneObject {
        let [x, y, z] = TABLE_CENTRE;
        let shape = Shape::Box { size: TABLE_SIZE };
        SceneObject { name: "table".into(), shape, placement: Placement::World(Pose::at(x, y, z)) }
    }

    fn standing(name: &str, floor: &Pose, size: [f64; 3]) -> SceneObject {
        let placement = Placement::World(floor.compose(&Pose::at(0.0, 0.0, size[2] / 2.0)));
        SceneObject { name: name.into(), shape: Shape::Box { size }, placement }
    }

    /// Checks that some solution at a grasp has a free straight line up.
    fn reachable(robot: &Robot, scene: &Scene, pose: &Pose, size: [f64; 3]) -> Result<(), String> {
        let reach = arm::reach(robot);
        let mut checker = Checker::new(robot, scene, &arm::assumed(robot, scene), PADDING_M);
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let mut reasons = Vec::new();
        for grasp in grasp_poses(pose, size) {
            for posture in reach.solutions(&Target::at(grasp), &HOME, 12, 40, &mut random) {
                match line(&reach, &posture, [0.0, 0.0, APPROACH_M]) {
                    Err(error) => reasons.push(error.to_string()),
                    Ok(postures) => {
                        let contact = Contact::Gripper(crate::collision::CONTACT_TOLERANCE_M);
                        match postures.iter().find_map(|p| checker.collision(p, contact)) {
                            None => return Ok(()),
                            Some(collision) => reasons.push(collision.to_string()),
                        }
                    }
                }
            }
        }
        Err(format!("{pose:?} {size:?}: {reasons:?}"))
    }

    #[test]
    fn boxes_anywhere_in_the_region_can_be_grasped_from_above() {
        let robot = Robot::aimm();
        let mut failures = Vec::new();
        for x in 0..3 {
            for y in 0..5 {
                for yaw in 0..4 {
                    for size in [BOX_LEAST, BOX_GREATEST] {
                        let at =
                            |[low, high]: [f64; 2], i: i32, n: i32| low + (high - low) * f64::from(i) / f64::from(n);
                        let position = [at(BOX_REGION[0], x, 2), at(BOX_REGION[1], y, 4), TABLE_HEIGHT_M];
                        let floor = Pose::from_rpy(position, 0.0, 0.0, f64::from(yaw) * PI / 4.0);
                        let standing = standing("box_1", &floor, size);
                        let Placement::World(pose) = standing.placement else { unreachable!() };
                        let scene = Scene { base: Pose::IDENTITY, objects: vec![standing, table()] };
                        failures.extend(reachable(&robot, &scene, &pose, size).err());
                    }
                }
            }
        }
        assert!(failures.is_empty(), "{} of 120: {failures:#?}", failures.len());
    }

    #[test]
    fn every_slot_can_be_served_from_above_while_all_others_are_full() {
        let robot = Robot::aimm();
        let mut failures = Vec::new();
        for size in [BOX_LEAST, BOX_GREATEST] {
            for slot in slots() {
                let objects = slots().into_iter().enumerate().map(|(i, s)| standing(&format!("box_{i}"), &s, size));
                let scene = Scene { base: Pose::IDENTITY, objects: objects.chain([table()]).collect() };
                let pose = slot.compose(&Pose::at(0.0, 0.0, size[2] / 2.0));
                failures.extend(reachable(&robot, &scene, &pose, size).err());
            }
        }
        assert!(failures.is_empty(), "{failures:#?}");
    }

    #[test]
    fn the_named_postures_touch_nothing_above_a_full_table_and_a_full_deck() {
        let robot = Robot::aimm();
        let rows = [0.62, 0.84].into_iter().flat_map(|x| [-0.38, -0.19, 0.0, 0.19, 0.38].map(|y| (x, y)));
        let on_table = rows.map(|(x, y)| Pose::from_rpy([x, y, TABLE_HEIGHT_M], 0.0, 0.0, FRAC_PI_2));
        let objects = on_table.chain(slots()).enumerate().map(|(i, p)| standing(&format!("box_{i}"), &p, BOX_GREATEST));
        let scene = Scene { base: Pose::IDENTITY, objects: objects.chain([table()]).collect() };
        let mut checker = Checker::new(&robot, &scene, &arm::assumed(&robot, &scene), PADDING_M);
        for (name, posture) in [("HOME", HOME), ("OBSERVATION", OBSERVATION), ("STOWED", STOWED)] {
            let tool = arm::reach(&robot).pose(&posture);
            assert_eq!(robot.clamp(&posture), posture, "{name} is within limits");
            assert_eq!(checker.collision(&posture, Contact::None), None, "{name}, tool at {:?}", tool.position);
        }
    }

    /// The points of a patch of floor, and at a box's height above it, that the robot hides from the camera looking at `target`.
    fn hidden(arm: JointVector, target: [f64; 3], [x_low, x_high]: [f64; 2], [y_low, y_high]: [f64; 2]) -> Vec<String> {
        let robot = Robot::aimm();
        let (pan, tilt) = robot.look_at(&robot.at_zero(), target);
        let configuration = Configuration { arm, pan, tilt, finger: GRIPPER_OPENING_M / 2.0, ..robot.at_zero() };
        let eye = robot.camera_pose(&configuration).unwrap().position;
        // The base carries the deck: when the camera looks at the deck, the base is no obstacle.
        let body = robot.link("base").unwrap();
        let shapes: Vec<_> = robot.shapes(&configuration).into_iter().filter(|(link, ..)| *link != body).collect();
        let mut hidden = Vec::new();
        for (x, y) in (0..=12).flat_map(|x| (0..=20).map(move |y| (f64::from(x) / 12.0, f64::from(y) / 20.0))) {
            let (x, y) = (x_low + (x_high - x_low) * x, y_low + (y_high - y_low) * y);
            for z in [target[2], target[2] + BOX_GREATEST[2]] {
                let way = [x - eye[0], y - eye[1], z - eye[2]].map(|c| c as f32);
                let ray = Ray::new(Vector::from_array(eye.map(|c| c as f32)), Vector::from_array(way));
                let meets = shapes.iter().filter(|(_, pose, shape)| shape.cast_ray(pose, &ray, 1.0, true).is_some());
                for (link, ..) in meets.filter(|(link, ..)| robot.model.links[*link].name != "tilt") {
                    hidden.push(format!("({x:.2}, {y:.2}, {z:.2}) behind {}", robot.model.links[*link].name));
                }
            }
        }
        hidden
    }

    #[test]
    fn in_the_observation_posture_the_camera_sees_every_box_on_the_table() {
        let target = [TABLE_CENTRE[0], TABLE_CENTRE[1], TABLE_HEIGHT_M];
        let [x, y] = BOX_REGION.map(|[low, high]| [low - 0.08, high + 0.08]);
        assert_eq!(hidden(OBSERVATION, target, x, y), Vec::<String>::new());
        assert!(!hidden(HOME, target, x, y).is_empty(), "at home the arm stands in the way");
    }

    #[test]
    fn in_the_stowed_posture_the_camera_sees_the_whole_deck_behind_the_arm() {
        let target = [-0.37, 0.0, DECK_HEIGHT_M];
        assert_eq!(hidden(STOWED, target, [-0.58, -0.16], [-0.28, 0.28]), Vec::<String>::new());
    }
}
