//! The second scene: bowls, forks and cups on a rack, and their places on the table.
//!
//! ```text
//!      left: the table             right: the rack
//!   plates    O     O     O
//!   bowls     o     o     o   |  o     o     o
//!   cups        .     .     . |     .     .     .
//!   forks     |     |     |   |  |     |     |       (the robot is below)
//! ```
//! The rack is a board on the right half of the table. On it, as on the left half, there is a row of bowls and, nearer to the robot, a row of forks
//! that point away from it, with cups in between. Plates lie behind the bowls' places from the beginning: their rims are too flat to be grasped from
//! above ([`Model::slips_off`]). The robot's description defines the rack and the rows (`[workplace.tableware]`). The places are fixed; the objects'
//! offsets from them and their sizes are random. The same seed gives the same scene.

use super::environment::{Furniture, Kind, Model};
use super::objects::Placed;
use crate::config::{Goods, MAX_TABLEWARE};
use rand::seq::SliceRandom;
use rand::{Rng, RngExt};
use ratn_model::pose::Pose;
use ratn_motion::tableware::{Rows, Tableware};
use ratn_motion::workplace::{Slab, Workplace};
use ratn_perception::model::Model as Seen;

/// The rack's name.
pub const RACK: &str = "rack";

/// Maximum distance of an object from its place on the rack, in metres, and maximum rotation of a fork, in radians.
const SPREAD_M: f64 = 0.008;
const SPREAD_RAD: f64 = 0.25;
/// The same for plates, for which the table has little room.
const PLATE_SPREAD_M: f64 = 0.002;
/// Minimum distance of objects on the rack, and of plates, in metres: the detector needs it to find one of them again in a picture of few frames, and
/// all of them in one of many.
const APART_M: f64 = 0.03;
const PLATES_APART_M: f64 = 0.018;
/// Minimum and maximum radius and height of bowls, cups and plates, and length of forks, in metres.
const BOWL_RADIUS: [f64; 2] = [0.058, 0.066];
const BOWL_HEIGHT: [f64; 2] = [0.046, 0.056];
const FORK_LENGTH: [f64; 2] = [0.17, 0.19];
const CUP_RADIUS: [f64; 2] = [0.032, 0.035];
const CUP_HEIGHT: [f64; 2] = [0.075, 0.09];
const PLATE_RADIUS: [f64; 2] = [0.085, 0.086];
const PLATE_HEIGHT: [f64; 2] = [0.022, 0.026];

/// Maximum distance of a set object from its place, in metres.
const MAX_OFF_PLACE_M: f64 = 0.02;
/// Maximum lean, and maximum rotation of a fork, in radians.
const MAX_LEAN_RAD: f64 = 0.1;
const MAX_TURNED_RAD: f64 = 0.15;

/// The rack as furniture; `None` if the workplace has none.
pub fn rack(workplace: &Workplace) -> Option<Furniture> {
    let Slab { centre: [x, y, z], size } = workplace.tableware.as_ref()?.rack;
    Some(Furniture { name: RACK.to_owned(), parts: vec![(Pose::at(x, y, z), size)] })
}

/// The height of an upper face, in metres: rounded, because it is the sum of decimal numbers with fewer digits.
pub fn top_m(slab: &Slab) -> f64 {
    (slab.top_m() * 1e9).round() / 1e9
}

/// The places on the table for objects of a kind, on its surface; a fork's x axis points to its tips. Empty if the workplace has no tableware.
pub fn places(workplace: &Workplace, kind: Kind) -> Vec<Pose> {
    let Some(tableware) = &workplace.tableware else { return Vec::new() };
    let (first, between) = match rows(tableware, kind) {
        Some(rows) => (rows.table, tableware.between),
        None => (tableware.plates.table, tableware.plates.between),
    };
    row(first, between, top_m(&workplace.table))
}

/// Whether an object stands, or lies, at a place for its kind on the table.
pub fn is_in_place(workplace: &Workplace, kind: Kind, pose: &Pose) -> bool {
    let upright = pose.rotate([0.0, 0.0, 1.0])[2] >= MAX_LEAN_RAD.cos();
    let ahead = pose.rotate([1.0, 0.0, 0.0])[0] >= MAX_TURNED_RAD.cos();
    let off = |place: &Pose| (place.position[0] - pose.position[0]).hypot(place.position[1] - pose.position[1]);
    upright
        && (ahead || kind != Kind::Fork)
        && places(workplace, kind).iter().any(|place| off(place) <= MAX_OFF_PLACE_M)
}

/// Whether the camera can separate the objects: every round one from all others.
pub(super) fn are_apart(placed: &[Placed]) -> bool {
    let apart = |round: &Placed, other: &Placed| {
        let [x, y, _] = other.pose.inverse().compose(&round.pose).position;
        let (between, reach) = match other.model.kind {
            // From the centre of the round object to the nearest point of the fork's centre line.
            Kind::Fork => {
                let [length, width, _] = other.model.size;
                ((x.abs() - length / 2.0).max(0.0).hypot(y), width / 2.0)
            }
            _ => (x.hypot(y), other.model.size[0] / 2.0),
        };
        let least = if round.model.kind == Kind::Plate { PLATES_APART_M } else { APART_M };
        between >= round.model.size[0] / 2.0 + reach + least
    };
    let mut round = placed.iter().filter(|object| object.model.is_round());
    round.all(|a| placed.iter().filter(|b| b.id != a.id).all(|b| apart(a, b)))
}

/// A random rack, and plates on the table.
pub(super) fn lay(workplace: &Workplace, goods: Goods, random: &mut impl Rng) -> Vec<Placed> {
    let mut placed = Vec::new();
    let kinds =
        [(Kind::Bowl, goods.bowls), (Kind::Fork, goods.forks), (Kind::Cup, goods.cups), (Kind::Plate, goods.plates)];
    for (kind, count) in kinds.into_iter().filter(|(_, count)| *count > 0) {
        let mut places = if kind == Kind::Plate { places(workplace, kind) } else { on_rack(workplace, kind) };
        places.shuffle(random);
        for (i, place) in places.into_iter().take(count).enumerate() {
            let model = model(kind, random);
            let spread = if kind == Kind::Plate { PLATE_SPREAD_M } else { SPREAD_M };
            let [x, y, top] = place.position;
            let at = [x, y].map(|c| c + random.random_range(-spread..=spread));
            let yaw = random.random_range(-SPREAD_RAD..=SPREAD_RAD);
            let pose = Pose::from_rpy([at[0], at[1], top + model.size[2] / 2.0], 0.0, 0.0, yaw);
            placed.push(Placed { id: format!("{}_{}", kind.name(), i + 1), model, pose });
        }
    }
    placed
}

/// The places on the rack for objects of a kind, on its surface.
fn on_rack(workplace: &Workplace, kind: Kind) -> Vec<Pose> {
    let Some(tableware) = &workplace.tableware else { return Vec::new() };
    let first = rows(tableware, kind).map(|rows| rows.rack);
    first.map_or_else(Vec::new, |first| row(first, -tableware.between, top_m(&tableware.rack)))
}

fn row([x, y]: [f64; 2], between: f64, height: f64) -> Vec<Pose> {
    (0..MAX_TABLEWARE).map(|i| Pose::at(x, y + between * i as f64, height)).collect()
}

/// The rows of a kind; `None` for plates, which have only a row on the table.
fn rows(tableware: &Tableware, kind: Kind) -> Option<Rows> {
    match kind {
        Kind::Fork => Some(tableware.forks),
        Kind::Cup => Some(tableware.cups),
        Kind::Plate => None,
        Kind::Bowl | Kind::Box => Some(tableware.bowls),
    }
}

/// A model of random size.
fn model(kind: Kind, random: &mut impl Rng) -> Model {
    let (radius, height) = match kind {
        Kind::Fork => return Model { kind, size: Seen::Fork { length: within(FORK_LENGTH, random) }.size() },
        Kind::Cup => (CUP_RADIUS, CUP_HEIGHT),
        Kind::Plate => (PLATE_RADIUS, PLATE_HEIGHT),
        Kind::Bowl | Kind::Box => (BOWL_RADIUS, BOWL_HEIGHT),
    };
    let width = 2.0 * within(radius, random);
    Model { kind, size: [width, width, within(height, random)] }
}

fn within([low, high]: [f64; 2], random: &mut impl Rng) -> f64 {
    random.random_range(low..=high)
}
