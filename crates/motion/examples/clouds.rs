//! Measures search and simplification among clouds of points that lie on the obstacles of a file of problems, beside the obstacles themselves:
//! `cargo run --release -p ratn-motion --example clouds -- URDF SRDF PROBLEMS [POINTS [RADIUS_MM [REPEAT [CLASS]]]]`.
//!
//! Each line: class, index, processor time of the build in ms; search and simplification in µs (the least of all repetitions) among shapes and
//! among points, samples drawn in both; a last line per class with the medians, and of the ratios.

#![allow(clippy::print_stdout, clippy::unwrap_used, clippy::disallowed_methods, reason = "a measurement")]

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ratn_motion::cloud::Cloud;
use ratn_motion::connect::Budget;
use ratn_motion::geometry::Geometry;
use ratn_motion::mechanism::Mechanism;
use ratn_motion::problems::Problems;
use ratn_motion::space::{Obstacle, Space};
use ratn_motion::trial::{self, Settings};
use std::time::Instant;

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let read = |i: usize| std::fs::read_to_string(&arguments[i]).unwrap();
    let number = |i: usize, other: f64| arguments.get(i).map_or(other, |text| text.parse().unwrap());
    let problems = Problems::parse(&read(2)).unwrap();
    let mechanism = Mechanism::read(&read(0), Some(&read(1)), &problems.joints).unwrap();
    let settings = Settings {
        budget: Budget { iterations: 100_000, seed: 1 },
        repetitions: number(5, 15.0) as usize,
        limit: f64::INFINITY,
    };
    let only = arguments.get(6);
    let (count, radius_m) = (number(3, 1e5) as usize, number(4, 2.5) * 1e-3);
    let begin = Instant::now();
    let mut clock = || begin.elapsed().as_secs_f64() * 1e6;
    for (class, list) in problems.classes.iter().filter(|(class, _)| only.is_none_or(|only| only == *class)) {
        let (mut shapes, mut points, mut ratios, mut builds) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        for problem in list {
            let mut among = problem.clone();
            among.obstacles.clear();
            among.clouds = vec![Cloud::new("cloud", &sampled(&problem.obstacles, count), radius_m).unwrap()];
            let mut build = f64::INFINITY;
            for _ in 0..3 {
                let before = processor_ms();
                let space = Space::new(&mechanism, among.surroundings());
                build = build.min(processor_ms() - before);
                drop(space);
            }
            let [shape, cloud] = [problem, &among].map(|p| trial::run(&mechanism, p, settings, &mut clock));
            let (Ok(first), Ok(second)) = (&shape.outcome, &cloud.outcome) else {
                let [first, second] = [&shape, &cloud].map(|t| t.outcome.as_ref().err().map(ToString::to_string));
                println!("{class} {} {first:?} {second:?} {:?}", problem.index, cloud.diagnosis);
                continue;
            };
            let (of_shapes, of_points) = (shape.plan + shape.simplify, cloud.plan + cloud.simplify);
            let touch = second.touch.as_ref().map_or_else(String::new, ToString::to_string);
            println!(
                "{class} {} build {build:.1} shapes {:.1} {:.1} {} points {:.1} {:.1} {} {touch}",
                problem.index,
                shape.plan,
                shape.simplify,
                first.iterations,
                cloud.plan,
                cloud.simplify,
                second.iterations
            );
            shapes.push(of_shapes);
            points.push(of_points);
            ratios.push(of_points / of_shapes);
            builds.push(build);
        }
        let [shapes, points, ratios, builds] = [shapes, points, ratios, builds].map(median);
        let of_medians = points / shapes;
        println!(
            "{class}: shapes {shapes:.1}, points {points:.1} ({of_medians:.2}); ratio {ratios:.2}; build {builds:.1} ms"
        );
    }
}

/// How long this thread has been on a processor.
fn processor_ms() -> f64 {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").unwrap();
    text.split_whitespace().next().unwrap().parse::<f64>().unwrap() * 1e-6
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}

/// So many points on the surfaces, evenly by area.
fn sampled(obstacles: &[Obstacle], count: usize) -> Vec<[f32; 3]> {
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let areas: Vec<f64> = obstacles.iter().map(|o| sides(&o.geometry).iter().sum()).collect();
    let whole: f64 = areas.iter().sum();
    let mut points = Vec::with_capacity(count);
    for (obstacle, area) in obstacles.iter().zip(&areas) {
        for _ in 0..(count as f64 * area / whole) as usize {
            let mut share = || random.random_range(0.0..1.0);
            let local = on_surface(&obstacle.geometry, &mut share);
            points.push(obstacle.pose.transform(local).map(|c| c as f32));
        }
    }
    points
}

/// Areas of the parts of a surface: sides across x, y, z, or of the mantle and both ends.
fn sides(geometry: &Geometry) -> [f64; 3] {
    let turn = std::f64::consts::TAU;
    match *geometry {
        Geometry::Box { half: [x, y, z] } => [8.0 * y * z, 8.0 * x * z, 8.0 * x * y],
        Geometry::Cylinder { radius, half_length } => [turn * radius * 2.0 * half_length, turn * radius * radius, 0.0],
        Geometry::Capsule { radius, half_length } => {
            [turn * radius * 2.0 * half_length, 2.0 * turn * radius * radius, 0.0]
        }
        Geometry::Sphere { radius } => [0.0, 2.0 * turn * radius * radius, 0.0],
    }
}

fn on_surface(geometry: &Geometry, share: &mut dyn FnMut() -> f64) -> [f64; 3] {
    let areas = sides(geometry);
    let mut pick = share() * areas.iter().sum::<f64>();
    let mut is_picked = |area: &f64| {
        pick -= area;
        pick < 0.0
    };
    let side = areas.iter().position(&mut is_picked).unwrap_or(0);
    let angle = share() * std::f64::consts::TAU;
    let mut along = |half: f64| (share() * 2.0 - 1.0) * half;
    let ball = |radius: f64, half_length: f64, z: f64| {
        let flat = (1.0 - z * z).sqrt() * radius;
        [flat * angle.cos(), flat * angle.sin(), z * radius + half_length.copysign(z)]
    };
    match *geometry {
        Geometry::Box { half } => {
            let mut at = half.map(&mut along);
            at[side] = half[side].copysign(at[side]);
            at
        }
        Geometry::Cylinder { radius, half_length } | Geometry::Capsule { radius, half_length } if side == 0 => {
            [radius * angle.cos(), radius * angle.sin(), along(half_length)]
        }
        Geometry::Cylinder { radius, half_length } => {
            let (end, out) = (along(1.0), along(1.0).abs().sqrt() * radius);
            [out * angle.cos(), out * angle.sin(), half_length.copysign(end)]
        }
        Geometry::Capsule { radius, half_length } => ball(radius, half_length, along(1.0)),
        Geometry::Sphere { radius } => ball(radius, 0.0, along(1.0)),
    }
}
