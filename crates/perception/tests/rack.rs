//! A known object on a rack is located again wherever it stands there: also at the rack's edge, below which the table begins.
//! `RACKS` and `FIRST` in the environment choose how many racks and the first one's seed.
//!
//! The rack is like that of the cell's second scene, a board of 5 cm on a table, seen by the cell's camera from the mast.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ratn_model::pose::Pose;
use ratn_perception::camera::{Camera, DepthImage, Intrinsics};
use ratn_perception::detection::{Model, ObjectClass, Prior, locate};
use ratn_perception::noise::{Noise, observe};
use ratn_perception::render::{Body, render};
use ratn_perception::trial::Placed;
use ratn_world::scene::Shape;
use std::f64::consts::PI;

/// The rack's top and the table's.
const RACK_M: f64 = 0.75;
const TABLE_M: f64 = 0.70;
/// Frames of a picture, as the detector asks for by itself.
const FRAMES: u32 = 8;
/// What a task says of a bowl's and a fork's size that it has not measured.
const ABOUT: [(ObjectClass, [f64; 3]); 2] =
    [(ObjectClass::Bowl, [0.125, 0.125, 0.05]), (ObjectClass::Fork, [0.18, 0.023, 0.016])];

fn camera() -> Camera {
    Camera::looking([-0.49, 0.0, 1.88], [0.72, -0.25, RACK_M], Intrinsics::DEFAULT)
}

/// Three bowls and three forks, each on the rack where it was laid, or already at its place on the table.
fn laid(seed: u64) -> Vec<Placed> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut objects = Vec::new();
    for i in 0..3 {
        for class in [ObjectClass::Bowl, ObjectClass::Fork] {
            let mut within = |low: f64, high: f64| random.random_range(low..=high);
            let (x, dimensions) = match class {
                ObjectClass::Bowl => (0.83, vec![within(0.058, 0.066), within(0.046, 0.056)]),
                _ => (0.62, vec![within(0.17, 0.19)]),
            };
            let model = class.model(&dimensions);
            let mut off = || within(-0.008, 0.008);
            let (x, y) = (x + off(), off());
            let set = within(0.0, 1.0) < 0.3;
            let (row, top) =
                if set { (0.10 + 0.19 * f64::from(i), TABLE_M) } else { (-0.06 - 0.19 * f64::from(i), RACK_M) };
            let at = [x, y + row, top + model.size()[2] / 2.0];
            objects.push(Placed { model, pose: Pose::from_rpy(at, 0.0, 0.0, within(-0.25, 0.25)) });
        }
    }
    objects
}

fn picture(objects: &[Placed], seed: u64) -> DepthImage {
    let block = |size, at: [f64; 3]| Body::new(&Shape::Box { size }, &Pose::at(at[0], at[1], at[2]));
    let mut bodies: Vec<Body> = objects.iter().map(Placed::body).collect();
    bodies.push(block([0.44, 0.54, 0.05], [0.72, -0.25, RACK_M - 0.025]));
    bodies.push(block([0.60, 1.20, 0.05], [0.80, 0.0, TABLE_M - 0.025]));
    bodies.push(block([12.0, 12.0, 0.1], [0.0, 0.0, -0.05]));
    bodies.push(block([0.9, 0.6, 0.6], [-0.1, 0.0, 0.3]));
    observe(&render(&camera(), &bodies), &Intrinsics::DEFAULT, &Noise::DEFAULT, seed, 0, FRAMES)
}

/// A bowl and a fork wherever there is room for both on the rack, up to its edges.
fn strewn(seed: u64) -> Vec<Placed> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut within = |low: f64, high: f64| random.random_range(low..=high);
    loop {
        let bowl = ObjectClass::Bowl.model(&[within(0.058, 0.066), within(0.046, 0.056)]);
        let fork = ObjectClass::Fork.model(&[within(0.17, 0.19)]);
        let turn = within(-PI, PI);
        let mut anywhere = |model: Model, yaw: f64| {
            let [length, width, height] = model.size();
            let (sin, cos) = (yaw.sin().abs(), yaw.cos().abs());
            // From the middle of the rack to where nothing of it hangs over.
            let room = if model.class() == ObjectClass::Bowl {
                [0.22 - length / 2.0, 0.27 - length / 2.0]
            } else {
                [0.22 - (cos * length + sin * width) / 2.0, 0.27 - (sin * length + cos * width) / 2.0]
            };
            let at = [0.72 + within(-room[0], room[0]), -0.25 + within(-room[1], room[1]), RACK_M + height / 2.0];
            Placed { model, pose: Pose::from_rpy(at, 0.0, 0.0, yaw) }
        };
        let placed = [anywhere(bowl, 0.0), anywhere(fork, turn)];
        if placed[0].pose.distance(&placed[1].pose) > 0.20 {
            return placed.to_vec();
        }
    }
}

/// How many were asked for, and what was lost or found more than 5 mm off.
fn searched(racks: impl Iterator<Item = (u64, Vec<Placed>)>) -> (usize, Vec<String>) {
    let (mut asked, mut wrong) = (0, Vec::new());
    for (seed, objects) in racks {
        let image = picture(&objects, seed);
        for truth in objects.iter().filter(|o| o.pose.position[2] > RACK_M) {
            let class = truth.model.class();
            let size = ABOUT.iter().find(|(known, _)| *known == class).unwrap().1;
            // As the first look gave it, a little off.
            let prior = Prior { pose: Pose::at(0.002, -0.001, 0.001).compose(&truth.pose), size };
            asked += 1;
            let off = match locate(&image, &camera(), &prior, &[class], &[]) {
                Ok(Some(found)) => found.pose.distance(&truth.pose),
                Ok(None) => f64::INFINITY,
                Err(reason) => panic!("seed {seed}: {reason}"),
            };
            if off > 0.005 {
                wrong.push(format!("seed {seed}: {class:?} at {:.3?}: {:.1} mm off", truth.pose.position, 1e3 * off));
            }
        }
    }
    (asked, wrong)
}

/// Racks, and the first one's seed: more of them, or others, by environment variables.
fn seeds() -> std::ops::Range<u64> {
    let named = |name: &str, usual: u64| std::env::var(name).ok().and_then(|n| n.parse().ok()).unwrap_or(usual);
    let first = named("FIRST", 0);
    first..first + named("RACKS", 60)
}

#[test]
fn what_stands_on_a_rack_in_its_place_is_located_again() {
    let (asked, wrong) = searched(seeds().map(|seed| (seed, laid(seed))));
    println!("{} of {asked} wrong", wrong.len());
    assert!(wrong.is_empty(), "of {asked}: {wrong:#?}");
}

#[test]
fn what_stands_anywhere_on_a_rack_up_to_its_edges_is_located_again() {
    let (asked, wrong) = searched(seeds().map(|seed| (seed, strewn(seed))));
    println!("{} of {asked} wrong", wrong.len());
    assert!(wrong.is_empty(), "of {asked}: {wrong:#?}");
}
