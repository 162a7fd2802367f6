//! The second scene: bowls and forks on a rack, and the places on the table where they shall stand.
//!
//! The rack is a board on the right half of the table. On it, as on the left half, there is a row of bowls and, nearer to the robot, a
//! row of forks that point away from it. The places are known; where on them things stand is random, and so are their sizes. The same
//! seed lays the same.

use super::boxes::Placed;
use super::environment::{Furniture, Kind, Model};
use crate::config::{Goods, MAX_TABLEWARE};
use rand::seq::SliceRandom;
use rand::{Rng, RngExt};
use ratn_model::pose::Pose;
use ratn_motion::aimm;
use ratn_perception::model::Model as Seen;

/// The rack's name.
pub const RACK: &str = "rack";
/// The height of its top, in metres.
pub const RACK_HEIGHT_M: f64 = 0.75;
/// The rack: a board, its middle and its edges.
const RACK_CENTRE: [f64; 3] = [0.72, -0.25, 0.725];
const RACK_SIZE: [f64; 3] = [0.44, 0.54, 0.05];
/// Where somebody puts what is moved on the rack: least and greatest x, least and greatest y.
pub const RACK_REGION: [[f64; 2]; 2] = [[0.62, 0.84], [-0.40, -0.10]];

/// Where the rows are, along x, on the rack and on the table.
const BOWLS_X: f64 = 0.83;
const FORKS_X: f64 = 0.62;
/// Where a row begins on the rack, from where it goes on to the right, and on the table, to the left: an open finger fits between two
/// bowls.
const RACK_FIRST_Y: f64 = -0.06;
const TABLE_FIRST_Y: f64 = 0.10;
const BETWEEN_M: f64 = 0.19;

/// How far from its place on the rack something stands at the most, in metres, and how far a fork is turned, in radians.
const SPREAD_M: f64 = 0.008;
const SPREAD_RAD: f64 = 0.25;
/// Least and greatest radius and height of bowls, and length of forks, in metres.
const BOWL_RADIUS: [f64; 2] = [0.058, 0.066];
const BOWL_HEIGHT: [f64; 2] = [0.046, 0.056];
const FORK_LENGTH: [f64; 2] = [0.17, 0.19];

/// How far from its place something that was set stands at the most, in metres.
const MAX_OFF_PLACE_M: f64 = 0.02;
/// How far it may lean, and how far a fork may be turned, in radians.
const MAX_LEAN_RAD: f64 = 0.1;
const MAX_TURNED_RAD: f64 = 0.15;

/// The rack as something that stands there.
pub fn rack() -> Furniture {
    let [x, y, z] = RACK_CENTRE;
    Furniture { name: RACK.to_owned(), parts: vec![(Pose::at(x, y, z), RACK_SIZE)] }
}

/// The places on the table for things of a kind, on its surface; a fork's x axis points to its tips.
pub fn places(kind: Kind) -> [Pose; MAX_TABLEWARE] {
    std::array::from_fn(|i| Pose::at(row(kind), TABLE_FIRST_Y + BETWEEN_M * i as f64, aimm::TABLE_HEIGHT_M))
}

/// Whether something stands, or lies, at a place of its kind on the table.
pub fn is_in_place(kind: Kind, pose: &Pose) -> bool {
    let upright = pose.rotate([0.0, 0.0, 1.0])[2] >= MAX_LEAN_RAD.cos();
    let ahead = pose.rotate([1.0, 0.0, 0.0])[0] >= MAX_TURNED_RAD.cos();
    let off = |place: &Pose| (place.position[0] - pose.position[0]).hypot(place.position[1] - pose.position[1]);
    upright && (ahead || kind != Kind::Fork) && places(kind).iter().any(|place| off(place) <= MAX_OFF_PLACE_M)
}

/// A random rack.
pub(super) fn lay(goods: Goods, random: &mut impl Rng) -> Vec<Placed> {
    let mut placed = Vec::new();
    for (kind, count) in [(Kind::Bowl, goods.bowls), (Kind::Fork, goods.forks)] {
        let mut places: [f64; MAX_TABLEWARE] = std::array::from_fn(|i| RACK_FIRST_Y - BETWEEN_M * i as f64);
        places.shuffle(random);
        for (i, y) in places.into_iter().take(count).enumerate() {
            let (model, name) = match kind {
                Kind::Fork => (fork(within(FORK_LENGTH, random)), "fork"),
                _ => (bowl(within(BOWL_RADIUS, random), within(BOWL_HEIGHT, random)), "bowl"),
            };
            let mut off = || random.random_range(-SPREAD_M..=SPREAD_M);
            let at = [row(kind) + off(), y + off(), RACK_HEIGHT_M + model.size[2] / 2.0];
            let yaw = random.random_range(-SPREAD_RAD..=SPREAD_RAD);
            placed.push(Placed { id: format!("{name}_{}", i + 1), model, pose: Pose::from_rpy(at, 0.0, 0.0, yaw) });
        }
    }
    placed
}

fn row(kind: Kind) -> f64 {
    if kind == Kind::Fork { FORKS_X } else { BOWLS_X }
}

fn within([low, high]: [f64; 2], random: &mut impl Rng) -> f64 {
    random.random_range(low..=high)
}

fn bowl(radius: f64, height: f64) -> Model {
    Model { kind: Kind::Bowl, size: [2.0 * radius, 2.0 * radius, height] }
}

fn fork(length: f64) -> Model {
    Model { kind: Kind::Fork, size: Seen::Fork { length }.size() }
}
