//! Random tables, seen by the camera of the mast, through the whole of detection: every box found, and how well.

#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    clippy::disallowed_methods,
    reason = "a test may panic, print and measure time"
)]

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ratn_model::pose::Pose;
use ratn_perception::camera::{Camera, DepthImage, Intrinsics};
use ratn_perception::detection::{BoxEstimate, DetectionError, Region, locate, segment};
use ratn_perception::noise::{Noise, observe};
use ratn_perception::render::{Body, render};
use ratn_world::scene::Shape;

const TABLE: [f64; 3] = [0.80, 0.0, 0.70];

/// A camera where the robot's mast holds it, that looks at the table's middle.
fn camera() -> Camera {
    let (eye, target) = ([-0.62, 0.0, 1.88], TABLE);
    let pitch = f64::atan2(eye[2] - target[2], target[0] - eye[0]);
    // Optical axis = x of the pitched head; x right = -y of it.
    let head = Pose::from_rpy(eye, 0.0, pitch, 0.0);
    let optical = Pose { position: [0.0; 3], quaternion_xyzw: [-0.5, 0.5, -0.5, 0.5] };
    Camera { intrinsics: Intrinsics::DEFAULT, pose: head.compose(&optical) }
}

fn table() -> Region {
    Region { pose: Pose::at(TABLE[0], TABLE[1], TABLE[2]), size: [0.6, 1.2] }
}

/// Boxes at random, at least 5 cm apart.
fn random_boxes(seed: u64, count: usize) -> Vec<BoxEstimate> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    'table: loop {
        let mut boxes: Vec<BoxEstimate> = Vec::new();
        for _ in 0..count {
            let placed = (0..500).find_map(|_| {
                let width = random.random_range(0.06..0.09);
                let size = [random.random_range(width..0.16), width, random.random_range(0.08..0.12)];
                let position =
                    [random.random_range(0.58..1.02), random.random_range(-0.5..0.5), TABLE[2] + size[2] / 2.0];
                let yaw = random.random_range(-1.57..1.57);
                let new = BoxEstimate { pose: Pose::from_rpy(position, 0.0, 0.0, yaw), size };
                let radius = |b: &BoxEstimate| b.size[0].hypot(b.size[1]) / 2.0;
                let apart = |b: &BoxEstimate| {
                    let [dx, dy] = [0, 1].map(|i| b.pose.position[i] - new.pose.position[i]);
                    dx.hypot(dy) > radius(b) + radius(&new) + 0.03
                };
                boxes.iter().all(apart).then_some(new)
            });
            match placed {
                Some(new) => boxes.push(new),
                None => continue 'table,
            }
        }
        return boxes;
    }
}

fn picture(boxes: &[BoxEstimate], seed: u64, frames: u32) -> DepthImage {
    let mut bodies: Vec<Body> = boxes.iter().map(|b| Body::new(&Shape::Box { size: b.size }, &b.pose)).collect();
    bodies.push(Body::new(&Shape::Box { size: [0.6, 1.2, 0.05] }, &Pose::at(0.8, 0.0, 0.675)));
    bodies.push(Body::new(&Shape::Box { size: [10.0, 10.0, 0.1] }, &Pose::at(0.0, 0.0, -0.05)));
    bodies.push(Body::new(&Shape::Box { size: [0.9, 0.6, 0.6] }, &Pose::at(-0.1, 0.0, 0.3)));
    observe(&render(&camera(), &bodies), &Noise::DEFAULT, seed, 0, frames)
}

/// Half a turn more is the same box, and so is a quarter turn of a nearly square one.
fn yaw_error(truth: &BoxEstimate, found: &BoxEstimate) -> f64 {
    let turn = |b: &BoxEstimate| {
        let x = b.pose.rotate([1.0, 0.0, 0.0]);
        x[1].atan2(x[0])
    };
    let symmetry = if truth.size[0] - truth.size[1] < 0.01 { 0.5 } else { 1.0 } * std::f64::consts::PI;
    let off = (turn(truth) - turn(found)).rem_euclid(symmetry);
    off.min(symmetry - off)
}

struct Errors {
    position: Vec<f64>,
    angle: Vec<f64>,
    size: Vec<f64>,
}

impl Errors {
    fn add(&mut self, truth: &BoxEstimate, found: &BoxEstimate) {
        self.position.push(truth.pose.distance(&found.pose));
        self.angle.push(yaw_error(truth, found).to_degrees());
        self.size.push((0..3).map(|i| (truth.size[i] - found.size[i]).abs()).fold(0.0, f64::max));
    }

    fn report(&mut self, what: &str) {
        for (name, unit, values) in [
            ("position", "mm", &mut self.position.iter().map(|e| e * 1e3).collect::<Vec<_>>()),
            ("yaw", "°", &mut self.angle.clone()),
            ("edge", "mm", &mut self.size.iter().map(|e| e * 1e3).collect::<Vec<_>>()),
        ] {
            values.sort_by(f64::total_cmp);
            let at = |q: f64| values[((values.len() - 1) as f64 * q) as usize];
            println!(
                "{what}: {name} error median {:.1} {unit}, 95 % {:.1}, 99 % {:.1}, worst {:.1} ({} boxes)",
                at(0.5),
                at(0.95),
                at(0.99),
                at(1.0),
                values.len()
            );
        }
    }
}

#[test]
fn every_box_of_every_random_table_is_found_where_it_stands() {
    let mut errors = Errors { position: vec![], angle: vec![], size: vec![] };
    let mut elapsed = std::time::Duration::ZERO;
    for seed in 0..90 {
        let count = 1 + seed as usize % 9;
        let boxes = random_boxes(seed, count);
        let image = picture(&boxes, seed, 10);
        let start = std::time::Instant::now();
        let found = segment(&image, &camera(), &table()).unwrap();
        elapsed += start.elapsed();
        assert_eq!(found.len(), count, "seed {seed}: {boxes:#?} {found:#?}");
        for truth in &boxes {
            let nearest = found
                .iter()
                .min_by(|a, b| truth.pose.distance(&a.pose).total_cmp(&truth.pose.distance(&b.pose)))
                .unwrap();
            assert!(truth.pose.distance(&nearest.pose) < 0.015, "seed {seed}: {truth:?} found as {nearest:?}");
            errors.add(truth, nearest);
        }
    }
    println!("segment: {:.1} ms a table of 5", elapsed.as_secs_f64() * 1e3 / 90.0);
    errors.report("segment, 10 frames");
    let typical = |values: &mut Vec<f64>| {
        values.sort_by(f64::total_cmp);
        values[values.len() * 95 / 100]
    };
    assert!(typical(&mut errors.position) < 0.008 && typical(&mut errors.angle) < 4.0);
}

#[test]
fn a_box_that_was_seen_before_is_located_again() {
    let mut errors = Errors { position: vec![], angle: vec![], size: vec![] };
    for seed in 0..40 {
        let boxes = random_boxes(1000 + seed, 1 + seed as usize % 9);
        let image = picture(&boxes, seed, 10);
        for truth in &boxes {
            let displaced = Pose::at(0.02, -0.01, 0.004).compose(&truth.pose);
            let found = locate(&image, &camera(), &BoxEstimate { pose: displaced, size: truth.size }).unwrap();
            let found = found.unwrap_or_else(|| panic!("seed {seed}: {truth:?} not found"));
            assert!(truth.pose.distance(&found.pose) < 0.015, "seed {seed}: {truth:?} found as {found:?}");
            errors.add(truth, &found);
        }
    }
    errors.report("locate, 10 frames");
}

#[test]
fn a_box_that_was_taken_away_is_not_located() {
    let boxes = random_boxes(3, 4);
    let image = picture(&boxes[1..], 3, 10);
    assert_eq!(locate(&image, &camera(), &boxes[0]), Ok(None));
}

#[test]
fn without_a_surface_in_the_image_nothing_is_said() {
    let nothing = DepthImage { width: 320, height: 240, depth: vec![0.0; 76_800] };
    assert_eq!(segment(&nothing, &camera(), &table()), Err(DetectionError::NoPlane { points: 0 }));
    assert!(matches!(
        segment(&DepthImage { width: 1, height: 1, depth: vec![1.0] }, &camera(), &table()),
        Err(DetectionError::WrongCamera { .. })
    ));
}

#[test]
fn the_same_image_gives_the_same_boxes() {
    let image = picture(&random_boxes(5, 6), 5, 1);
    assert_eq!(segment(&image, &camera(), &table()), segment(&image, &camera(), &table()));
}

#[test]
fn a_frame_of_the_whole_scene_is_rendered_in_milliseconds() {
    let boxes = random_boxes(8, 9);
    let start = std::time::Instant::now();
    for seed in 0..10 {
        picture(&boxes, seed, 1);
    }
    let each = start.elapsed().as_secs_f64() / 10.0;
    println!("render and noise: {:.1} ms a frame", each * 1e3);
    assert!(each < 0.5, "{each} s");
}
