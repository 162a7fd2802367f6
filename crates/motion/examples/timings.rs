//! Trajectories to hold against other programs (`scripts/bench-timing`): paths, limits and knots as JSON, a case per line.

#![allow(clippy::print_stdout, clippy::unwrap_used, clippy::disallowed_methods, reason = "a measurement")]

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::robot::Joint;
use ratn_motion::timing::{Section, timed};
use serde_json::json;
use std::time::Instant;

/// Random paths per number of joints, and straight motions.
const PATHS: u64 = 12;
const STRAIGHT: u64 = 24;

fn limits<const N: usize>(random: &mut ChaCha8Rng) -> Vec<Joint> {
    let one = |random: &mut ChaCha8Rng| {
        let acceleration = random.random_range(1.0..15.0);
        let jerk = acceleration / random.random_range(0.03..0.2);
        let velocity = random.random_range(0.5..3.5);
        Joint { name: "joint".to_owned(), lower: -9.0, upper: 9.0, endless: false, velocity, acceleration, jerk }
    };
    (0..N).map(|_| one(random)).collect()
}

fn case<const N: usize>(kind: &str, joints: &[Joint], path: &[[f64; N]]) {
    let begin = Instant::now();
    let path = path.iter().map(|q| JointVector::of(*q)).collect();
    let curve = timed(joints, &[Section::Blended(path)], 1.0, &mut |_, _| true);
    let made_in_us = begin.elapsed().as_micros();
    let knots: Vec<_> = curve.knots().iter().map(|k| json!([k.time_s, k.positions, k.velocities])).collect();
    let of = |limit: fn(&Joint) -> f64| joints.iter().map(limit).collect::<Vec<_>>();
    let jerks: Vec<_> = joints.iter().map(|j| if j.jerk.is_finite() { json!(j.jerk) } else { json!(null) }).collect();
    let line = json!({
        "kind": kind, "velocities": of(|j| j.velocity), "accelerations": of(|j| j.acceleration), "jerks": jerks,
        "knots": knots, "made_in_us": made_in_us as u64,
    });
    println!("{line}");
}

fn paths<const N: usize>() {
    for seed in 0..PATHS {
        let mut random = ChaCha8Rng::seed_from_u64(1000 * N as u64 + seed);
        let joints = limits::<N>(&mut random);
        let postures = random.random_range(3..7);
        let path: Vec<[f64; N]> =
            (0..postures).map(|_| std::array::from_fn(|_| random.random_range(-2.0..2.0))).collect();
        case("path, jerk limited", &joints, &path);
        let joints: Vec<Joint> = joints.into_iter().map(|j| Joint { jerk: f64::INFINITY, ..j }).collect();
        case("path", &joints, &path);
    }
}

fn main() {
    paths::<2>();
    paths::<3>();
    paths::<6>();
    paths::<7>();
    for seed in 0..STRAIGHT {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let joints = limits::<7>(&mut random);
        let reach = if seed % 2 == 0 { 2.0 } else { 0.1 };
        let mut posture = || std::array::from_fn(|_| random.random_range(-reach..reach));
        let path: [[f64; 7]; 2] = [posture(), posture()];
        case("straight, jerk limited", &joints, &path);
    }
}
