//! Trajectories to hold against other programs (`scripts/bench-timing`): paths, limits and knots as JSON, a case per line. Corners are rounded where
//! nothing says otherwise. With a SEED the paths are others: of 6 to 14 joints, some of which slide, with limits that differ much from joint to joint,
//! and from a milliradian to several turns long; also followed with a stop at each corner, and curves through many postures.

#![allow(clippy::print_stdout, clippy::unwrap_used, clippy::disallowed_methods, reason = "a measurement")]

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::robot::Joint;
use ratn_motion::timing::{Section, timed};
use serde_json::json;
use std::f64::consts::TAU;
use std::ops::Range;
use std::time::Instant;

/// Random paths per number of joints, and straight motions.
const PATHS: u64 = 12;
const STRAIGHT: u64 = 24;

/// Of the other paths: for each scale.
const OTHERS: u64 = 12;

/// Postures of a curve.
const POSTURES: usize = 60;

/// How far the postures of a path are from zero, in radians, or in metres over [`METRES`].
const SCALES: [f64; 4] = [0.001, 0.03, 1.0, 8.0];
const METRES: f64 = 0.2;

fn joint(velocity: f64, acceleration: f64, jerk: f64) -> Joint {
    Joint { name: "joint".to_owned(), lower: -99.0, upper: 99.0, endless: false, velocity, acceleration, jerk }
}

fn limits(random: &mut ChaCha8Rng, count: usize) -> Vec<Joint> {
    let one = |random: &mut ChaCha8Rng| {
        let acceleration = random.random_range(1.0..15.0);
        let jerk = acceleration / random.random_range(0.03..0.2);
        joint(random.random_range(0.5..3.5), acceleration, jerk)
    };
    (0..count).map(|_| one(random)).collect()
}

/// Evenly in the logarithm.
fn spread(random: &mut ChaCha8Rng, range: Range<f64>) -> f64 {
    random.random_range(range.start.ln()..range.end.ln()).exp()
}

fn case(kind: &str, joints: &[Joint], section: fn(Vec<JointVector>) -> Section, rounds: bool, path: &[Vec<f64>]) {
    let begin = Instant::now();
    let postures = path.iter().map(|q| JointVector::from_fn(q.len(), |j| q[j])).collect();
    let curve = timed(joints, &[section(postures)], 1.0, &mut |_, _| rounds);
    let made_in_us = begin.elapsed().as_micros();
    let knots: Vec<_> = curve.knots().iter().map(|k| json!([k.time_s, k.positions, k.velocities])).collect();
    let of = |limit: fn(&Joint) -> f64| joints.iter().map(limit).collect::<Vec<_>>();
    let jerks: Vec<_> = joints.iter().map(|j| if j.jerk.is_finite() { json!(j.jerk) } else { json!(null) }).collect();
    let line = json!({
        "kind": kind, "velocities": of(|j| j.velocity), "accelerations": of(|j| j.acceleration), "jerks": jerks,
        "path": path, "knots": knots, "made_in_us": made_in_us as u64,
    });
    println!("{line}");
}

/// With and without a limit of jerk.
fn both(kind: &str, joints: &[Joint], section: fn(Vec<JointVector>) -> Section, path: &[Vec<f64>]) {
    case(&format!("{kind}, jerk limited"), joints, section, true, path);
    let joints: Vec<Joint> = joints.iter().map(|j| Joint { jerk: f64::INFINITY, ..j.clone() }).collect();
    case(kind, &joints, section, true, path);
}

fn paths(count: usize) {
    for seed in 0..PATHS {
        let mut random = ChaCha8Rng::seed_from_u64(1000 * count as u64 + seed);
        let joints = limits(&mut random, count);
        let postures = random.random_range(3..7);
        let mut posture = || (0..count).map(|_| random.random_range(-2.0..2.0)).collect();
        let path: Vec<Vec<f64>> = (0..postures).map(|_| posture()).collect();
        both("path", &joints, Section::Blended, &path);
    }
}

fn straight() {
    for seed in 0..STRAIGHT {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let joints = limits(&mut random, 7);
        let reach = if seed % 2 == 0 { 2.0 } else { 0.1 };
        let mut posture = || (0..7).map(|_| random.random_range(-reach..reach)).collect();
        let path: [Vec<f64>; 2] = [posture(), posture()];
        case("straight, jerk limited", &joints, Section::Blended, true, &path);
    }
}

/// Limits that differ much, postures of any scale, and joints that slide.
fn others(seed: u64) {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    for scale in SCALES.iter().flat_map(|scale| std::iter::repeat_n(*scale, OTHERS as usize)) {
        let count = random.random_range(6..15);
        let (mut joints, mut scales) = (Vec::new(), Vec::new());
        for _ in 0..count {
            let unit = if random.random_range(0..4) == 0 { METRES } else { 1.0 };
            let velocity = unit * spread(&mut random, 0.1..8.0);
            let acceleration = velocity / spread(&mut random, 0.03..0.6);
            joints.push(joint(velocity, acceleration, acceleration / spread(&mut random, 0.02..0.3)));
            scales.push(unit * scale);
        }
        let postures = random.random_range(3..10);
        let mut posture = || scales.iter().map(|scale| random.random_range(-scale..*scale)).collect();
        let path: Vec<Vec<f64>> = (0..postures).map(|_| posture()).collect();
        both("path", &joints, Section::Blended, &path);
        case("straight, jerk limited", &joints, Section::Blended, true, &path[..2]);
        case("corners, jerk limited", &joints, Section::Blended, false, &path);
        // Each joint swings around a straight motion, by up to a third of its scale.
        let swing = |q: f64, share: f64, j: usize| scales[j] * q.sin() / 3.0 * (TAU * share + j as f64).sin();
        let at = |share: f64| -> Vec<f64> {
            (0..count).map(|j| path[0][j] + share * (path[1][j] - path[0][j]) + swing(path[2][j], share, j)).collect()
        };
        let curve: Vec<Vec<f64>> = (0..POSTURES).map(|i| at(i as f64 / (POSTURES - 1) as f64)).collect();
        both("curve", &joints, Section::AsGiven, &curve);
    }
}

fn main() {
    if let Some(seed) = std::env::args().nth(1) {
        return others(seed.parse().unwrap());
    }
    [2, 3, 6, 7].into_iter().for_each(paths);
    straight();
}
