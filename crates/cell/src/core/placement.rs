//! Lays a random scene in which the task is feasible: objects stand apart from each other and within reach, and each can be grasped from above while
//! all others are still there. The same seed gives the same scene.

use super::demands::{self, Unmet};
use super::environment::{Furniture, Kind, Model};
use super::grasping::Pads;
use super::objects::Placed;
use super::tableware;
use crate::config::{CellConfig, Goods, Setting};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ratn_model::grasp;
use ratn_model::pose::Pose;
use ratn_motion::arm;
use ratn_motion::arm::line;
use ratn_motion::collision::{CONTACT_TOLERANCE_M, Checker, Contact, PADDING_M};
use ratn_motion::description::DescriptionError;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::robot::Robot;
use ratn_motion::top_grasp::{APPROACH_M, grasp_poses};
use ratn_motion::workplace::{Boxes, HOME, Slab, Workplace};
use ratn_world::scene::{Placement, Scene, SceneObject, Shape};
use std::f64::consts::FRAC_PI_2;
use std::ops::Range;

/// Why no scene was laid.
#[derive(Debug, thiserror::Error)]
pub enum PlacementError {
    /// No scene was found in which the task is feasible.
    #[error("{}", no_scene(*count, *seed))]
    Crowded {
        /// Number of objects.
        count: usize,
        /// The seed.
        seed: u64,
    },
    /// There are not enough places for delivered boxes.
    #[error(
        "{count} boxes: the [workplace] of `{robot}` has places for {places}: say so many (`--boxes`, or `boxes` in [cell] of the config), or \
         give the workplace more"
    )]
    Places {
        /// Number of boxes.
        count: usize,
        /// Number of places.
        places: usize,
        /// The robot.
        robot: String,
    },
    /// The robot's description is invalid.
    #[error(transparent)]
    Robot(#[from] DescriptionError),
    /// The gripper cannot open as far as the config says, or not wide enough for every box.
    #[error("`gripper.opening_m` of the cell is {opening_m}: {reason}")]
    Opening {
        /// The opening in the config, in metres.
        opening_m: f64,
        /// The rule that it violates.
        reason: String,
    },
    /// The robot does not meet the requirements of a cell.
    #[error("the robot `{robot}` cannot stand in a cell: {}", unmet.iter().map(Unmet::to_string).collect::<Vec<_>>().join("; and "))]
    Unfit {
        /// The robot.
        robot: String,
        /// The requirements that it does not meet, and what to do about each.
        unmet: Vec<Unmet>,
    },
}

/// The message that no scene was found.
pub(crate) fn no_scene(count: usize, seed: u64) -> String {
    format!(
        "no scene with {count} objects was found from seed {seed} in {MAX_TABLES} tries: they have to stand apart on the [workplace] of the robot, and \
         the arm has to reach each from above between the others. Take fewer objects, another seed, or a workplace with more room; \
         `ratn robot check` says what the arm reaches"
    )
}

/// Number of tables that are tried.
const MAX_TABLES: usize = 3000;
/// Number of places that are tried for one box.
const MAX_PLACES: usize = 60;
/// Minimum distance between two boxes, in metres: the detector needs it to separate them.
const GAP_M: f64 = 0.045;
/// Room for the fingers at a box because of detection errors, in metres: across the box in addition to half their opening and their thickness, along
/// it in addition to half their width.
const FINGER_ROOM_M: f64 = 0.02;
const FINGER_ROOM_ALONG_M: f64 = 0.0205;
/// The table's name.
pub const TABLE: &str = "table";

/// The movable objects of a new scene.
///
/// # Errors
/// [`PlacementError`] if no feasible scene was found.
pub fn objects(robot: &Robot, setting: Setting, goods: Goods, seed: u64) -> Result<Vec<Placed>, PlacementError> {
    match setting {
        Setting::Boxes => boxes(robot, goods.boxes, seed),
        Setting::Table => dishes(robot, goods, seed),
    }
}

/// Tableware on the rack.
fn dishes(robot: &Robot, goods: Goods, seed: u64) -> Result<Vec<Placed>, PlacementError> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let workplace = workplace(robot);
    let mut tables = (0..MAX_TABLES).map(|_| tableware::lay(workplace, goods, &mut random));
    let feasible = tables.find(|placed| tableware::are_apart(placed) && all_graspable(robot, Setting::Table, placed));
    feasible.ok_or(PlacementError::Crowded { count: goods.count(Setting::Table), seed })
}

/// Boxes on the table: `count` for each arm that has a share of the workplace, the first arm's first.
fn boxes(robot: &Robot, count: usize, seed: u64) -> Result<Vec<Placed>, PlacementError> {
    let workplace = workplace(robot);
    let places = workplace.shares().map(|(_, places)| places.at.len()).min().unwrap_or(0);
    if count > places {
        return Err(PlacementError::Places { count, places, robot: robot.name().to_owned() });
    }
    // Every share names an arm of the robot: the description was checked.
    let others = workplace.others.iter().filter_map(|share| robot.with_arm(&share.arm).ok());
    let views: Vec<Robot> = std::iter::once(robot.clone()).chain(others).collect();
    let grounds = workplace.shares().zip(&views).map(|((boxes, _), view)| Ground::of(view, boxes));
    let shares: Vec<(&Robot, Ground)> = views.iter().zip(grounds).collect();
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    for table in 0..MAX_TABLES {
        // The fuller the table and the more tries have failed, the rarer are long boxes.
        let crowding = (count as f64 / 9.0).powi(2) * 0.6 + 0.4 * table as f64 / MAX_TABLES as f64;
        let mut footprints = Vec::with_capacity(count * shares.len());
        if !shares.iter().all(|(_, ground)| add(&mut footprints, &mut random, ground, count, crowding.min(1.0))) {
            continue;
        }
        let placed: Vec<Placed> =
            footprints.iter().enumerate().map(|(i, f)| f.as_box(workplace.table.top_m(), i)).collect();
        let of_share = |share: usize| share * count..(share + 1) * count;
        if (0..shares.len()).all(|i| graspable(robot, shares[i].0, Setting::Boxes, &placed, of_share(i))) {
            return Ok(placed);
        }
    }
    Err(PlacementError::Crowded { count: count * shares.len(), seed })
}

/// The workplace of a cell's robot.
///
/// # Panics
/// If the robot has no workplace: [`fit`] refuses it before a cell is created.
pub fn workplace(robot: &Robot) -> &Workplace {
    match robot.workplace() {
        Some(workplace) => workplace,
        None => unreachable!("the robot `{}` was taken for a cell without a workplace", robot.name()),
    }
}

/// The pads of a robot that can stand in a cell of this config.
///
/// # Errors
/// [`PlacementError::Unfit`] lists the unmet requirements, [`PlacementError::Opening`] says what is wrong with the opening.
pub fn fit(robot: &Robot, config: &CellConfig) -> Result<Pads, PlacementError> {
    let unmet = demands::unmet(robot, config.scene);
    match Pads::of(robot).filter(|_| unmet.is_empty()) {
        Some(pads) => check_opening(robot, config).map(|()| pads),
        None => Err(PlacementError::Unfit { robot: robot.name().to_owned(), unmet }),
    }
}

/// Checks that the gripper can open as far as the config says, and that every box then fits between the fingers.
fn check_opening(robot: &Robot, config: &CellConfig) -> Result<(), PlacementError> {
    let Some(opening_m) = config.gripper.opening_m else { return Ok(()) };
    let (most, name, widest) = (2.0 * robot.open_finger_m(), robot.name(), widest(workplace(robot)));
    let reason = if opening_m > most {
        format!("the gripper of `{name}` opens to {most} m")
    } else if config.scene == Setting::Boxes && opening_m <= widest {
        format!(
            "the boxes of the [workplace] of `{name}` are up to {widest} m across; leave it out, or make them smaller"
        )
    } else {
        return Ok(());
    };
    Err(PlacementError::Opening { opening_m, reason })
}

/// Width of the widest box across the fingers.
fn widest(workplace: &Workplace) -> f64 {
    workplace.shares().map(|(boxes, _)| boxes.greatest[1]).fold(0.0, f64::max)
}

/// The furniture, as objects of the scene.
pub fn fixed(robot: &Robot, setting: Setting) -> impl Iterator<Item = SceneObject> {
    let parts = |piece: Furniture| {
        let name = piece.name;
        piece.parts.into_iter().map(move |(pose, size)| SceneObject {
            name: name.clone(),
            shape: Shape::Box { size },
            placement: Placement::World(pose),
        })
    };
    furniture(robot, setting).into_iter().flat_map(parts)
}

/// The furniture: everything that never moves.
pub fn furniture(robot: &Robot, setting: Setting) -> Vec<Furniture> {
    let Slab { centre: [x, y, z], size } = workplace(robot).table;
    let table = Furniture { name: TABLE.to_owned(), parts: vec![(Pose::at(x, y, z), size)] };
    match setting {
        Setting::Boxes => vec![table],
        Setting::Table => std::iter::once(table).chain(tableware::rack(workplace(robot))).collect(),
    }
}

#[derive(Debug, Clone, Copy)]
struct Footprint {
    centre: [f64; 2],
    yaw: f64,
    size: [f64; 3],
}

/// A rectangle in the plane.
#[derive(Debug, Clone, Copy)]
struct Rectangle {
    centre: [f64; 2],
    yaw: f64,
    half: [f64; 2],
}

/// The area for boxes, and the room that fingers need there.
#[derive(Debug, Clone, Copy)]
struct Ground {
    boxes: Boxes,
    /// Room for the fingers across a box, from its middle.
    finger_reach_m: f64,
    /// Room for the fingers along a box, from its middle.
    finger_half_width_m: f64,
}

/// Adds `count` boxes to the placed ones, all of them apart from each other; returns whether there was room.
fn add(placed: &mut Vec<Footprint>, random: &mut ChaCha8Rng, ground: &Ground, count: usize, crowding: f64) -> bool {
    let Boxes { x, y, least, greatest } = ground.boxes;
    for _ in 0..count {
        let new = (0..MAX_PLACES).find_map(|_| {
            let [longest, widest, highest] = greatest;
            let longest = longest + (widest - longest) * crowding;
            let width = random.random_range(least[1]..=widest);
            let length = random.random_range(width..=longest.max(width));
            let height = random.random_range(least[2]..=highest);
            let [[x_low, x_high], [y_low, y_high]] = [x, y];
            let new = Footprint {
                centre: [random.random_range(x_low..=x_high), random.random_range(y_low..=y_high)],
                yaw: random.random_range(-FRAC_PI_2..FRAC_PI_2),
                size: [length, width, height],
            };
            placed.iter().all(|other| new.clear_of(other, ground) && other.clear_of(&new, ground)).then_some(new)
        });
        let Some(new) = new else { return false };
        placed.push(new);
    }
    true
}

impl Ground {
    /// The area for the boxes of the arm from which `view` sees the robot.
    fn of(view: &Robot, boxes: &Boxes) -> Ground {
        let (thick, half_width) = Pads::of(view).map_or((0.0, 0.0), |pads| (pads.thick, (pads.x[1] - pads.x[0]) / 2.0));
        Ground {
            boxes: *boxes,
            finger_reach_m: view.open_finger_m() + thick + FINGER_ROOM_M,
            finger_half_width_m: half_width + FINGER_ROOM_ALONG_M,
        }
    }
}

impl Footprint {
    fn base(&self) -> Rectangle {
        Rectangle { centre: self.centre, yaw: self.yaw, half: [self.size[0] / 2.0, self.size[1] / 2.0] }
    }

    /// Whether this box keeps its distance from the other and can be grasped beside it.
    fn clear_of(&self, other: &Footprint, ground: &Ground) -> bool {
        let grown = Rectangle { half: self.base().half.map(|h| h + GAP_M), ..self.base() };
        let fingers = Rectangle { half: [ground.finger_half_width_m, ground.finger_reach_m], ..self.base() };
        !grown.overlaps(&other.base()) && !fingers.overlaps(&other.base())
    }

    fn as_box(&self, height_m: f64, index: usize) -> Placed {
        let model = Model { kind: Kind::Box, size: self.size };
        let [x, y] = self.centre;
        let pose = Pose::from_rpy([x, y, height_m + self.size[2] / 2.0], 0.0, 0.0, self.yaw);
        Placed { id: format!("slc_{}", index + 1), model, pose }
    }
}

impl Rectangle {
    /// Whether no axis of either separates the two.
    fn overlaps(&self, other: &Rectangle) -> bool {
        let separated = |a: &Rectangle, b: &Rectangle| {
            let (sin, cos) = a.yaw.sin_cos();
            [[cos, sin], [-sin, cos]].iter().zip(a.half).any(|(axis, half)| {
                let distance: f64 = (0..2).map(|i| axis[i] * (b.centre[i] - a.centre[i])).sum();
                let (sin, cos) = b.yaw.sin_cos();
                let reach = (axis[0] * cos + axis[1] * sin).abs() * b.half[0]
                    + (axis[1] * cos - axis[0] * sin).abs() * b.half[1];
                distance.abs() > half + reach
            })
        };
        !separated(self, other) && !separated(other, self)
    }
}

/// Whether each object that can be grasped from above at all can be grasped while all of them are there.
fn all_graspable(robot: &Robot, setting: Setting, placed: &[Placed]) -> bool {
    graspable(robot, robot, setting, placed, 0..placed.len())
}

/// The same for some of the objects, with the arm from which `view` sees the robot.
fn graspable(robot: &Robot, view: &Robot, setting: Setting, placed: &[Placed], which: Range<usize>) -> bool {
    let parts = placed.iter().flat_map(|object| {
        object.model.parts().into_iter().map(|(part, shape)| SceneObject {
            name: object.id.clone(),
            shape,
            placement: Placement::World(object.pose.compose(&part)),
        })
    });
    let scene = Scene { base: Pose::IDENTITY, objects: parts.chain(fixed(robot, setting)).collect() };
    let mut checker = Checker::new(view, &scene, &arm::assumed(view, &scene), PADDING_M);
    let (reach, home) = (arm::reach(view), home(view));
    let mut random = ChaCha8Rng::seed_from_u64(0);
    placed[which].iter().filter(|object| object.model.slips_off().is_none()).all(|object| {
        grasps(object).iter().any(|grasp| {
            reach.solutions(&reach.target(*grasp), &home, 6, 20, &mut random).iter().any(|posture| {
                line(&reach, posture, [0.0, 0.0, APPROACH_M]).is_ok_and(|postures| {
                    postures.iter().all(|p| checker.is_free(p, Contact::Gripper(CONTACT_TOLERANCE_M)))
                })
            })
        })
    })
}

/// The initial posture of a robot.
pub fn home(robot: &Robot) -> JointVector {
    robot.posture(HOME).unwrap_or_else(|| robot.at_zero().arm)
}

/// The grasps of an object from above.
fn grasps(object: &Placed) -> Vec<Pose> {
    match object.model.kind {
        Kind::Bowl | Kind::Plate => grasp::at_rim(&object.pose, object.model.size),
        Kind::Box => grasp_poses(&object.pose, object.model.size).to_vec(),
        Kind::Cup => grasp::around(&object.pose, object.model.size),
        Kind::Fork => grasp::from_above(&object.pose, object.model.size).to_vec(),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    #[test]
    fn every_number_of_boxes_finds_room_and_the_same_seed_gives_the_same_table() {
        let robot = Robot::aimm();
        for count in 1..=9 {
            for seed in 0..3 {
                let table = boxes(&robot, count, seed).unwrap();
                assert_eq!(table.len(), count);
                assert_eq!(table, boxes(&robot, count, seed).unwrap());
            }
            assert_ne!(boxes(&robot, count, 1).unwrap(), boxes(&robot, count, 2).unwrap());
        }
    }

    #[test]
    fn every_rack_is_laid_and_the_same_seed_lays_the_same() {
        let robot = Robot::aimm();
        for (bowls, forks, cups, plates) in
            [(0, 1, 0, 0), (1, 0, 0, 0), (2, 2, 0, 0), (3, 3, 0, 0), (0, 0, 1, 0), (3, 3, 3, 3)]
        {
            let goods = Goods { bowls, forks, cups, plates, ..Goods::default() };
            let rack = |seed| objects(&robot, Setting::Table, goods, seed).unwrap();
            for seed in 0..20 {
                assert_eq!(rack(seed).len(), bowls + forks + cups + plates);
            }
            assert_eq!(rack(1), rack(1));
            assert_ne!(rack(1), rack(2));
        }
    }

    #[test]
    fn every_place_on_the_table_can_be_served_from_above_while_all_others_are_full() {
        let robot = Robot::aimm();
        let goods = Goods { bowls: 3, forks: 3, cups: 3, plates: 3, ..Goods::default() };
        let mut placed = objects(&robot, Setting::Table, goods, 1).unwrap();
        for (i, object) in placed.iter_mut().enumerate() {
            let place = tableware::places(workplace(&robot), object.model.kind)[i % 3];
            object.pose = place.compose(&Pose::at(0.0, 0.0, object.model.size[2] / 2.0));
            assert!(tableware::is_in_place(workplace(&robot), object.model.kind, &object.pose));
        }
        assert!(all_graspable(&robot, Setting::Table, &placed));
    }

    #[test]
    fn rectangles_overlap_unless_an_axis_separates_them() {
        let one = Rectangle { centre: [0.0, 0.0], yaw: 0.0, half: [0.1, 0.05] };
        assert!(one.overlaps(&Rectangle { centre: [0.12, 0.08], yaw: 0.8, half: [0.1, 0.05] }));
        assert!(!one.overlaps(&Rectangle { centre: [0.18, 0.12], yaw: -0.8, half: [0.1, 0.05] }));
    }

    #[test]
    fn the_gripper_opens_as_the_robot_does_unless_the_config_says_less() {
        let config = |text: &str| toml::from_str::<CellConfig>(text).unwrap();
        let fits = |text: &str| {
            let config = config(text);
            fit(&Robot::named_or_file(&config.robot).unwrap(), &config).map(drop).map_err(|error| error.to_string())
        };
        assert_eq!(fits("robot = \"panda\""), Ok(()));
        assert_eq!(fits("robot = \"panda\"\ngripper.opening_m = 0.07"), Ok(()));
        let beyond = fits("robot = \"panda\"\ngripper.opening_m = 0.11").unwrap_err();
        assert!(beyond.contains("0.11") && beyond.contains("`panda` opens to 0.08 m"), "{beyond}");
        let narrow = fits("robot = \"panda\"\ngripper.opening_m = 0.06").unwrap_err();
        assert!(narrow.contains("0.06") && narrow.contains("up to 0.06 m across"), "{narrow}");
        assert!(
            config("gripper.opening_m = 0.0").check().is_err() && config("gripper.opening_m = 0.2").check().is_ok()
        );
    }
}
