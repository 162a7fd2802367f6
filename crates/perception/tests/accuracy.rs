//! Random tables, seen by the camera of the mast, through the whole of detection. `scripts/bench-perception` measures more of them.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_model::pose::Pose;
use ratn_perception::camera::{Camera, DepthImage, Intrinsics};
use ratn_perception::detection::{Detection, DetectionError, ObjectClass, Prior, locate, segment};
use ratn_perception::mask::Ball;
use ratn_perception::noise::Noise;
use ratn_perception::render::{Body, render};
use ratn_perception::sensor::Sensor;
use ratn_perception::trial::{
    self, OPTICS, Placed, compare, mast_camera, random_table, random_things, region, table_image, things_image,
};
use ratn_world::scene::Shape;

/// Tables of 1 to 8 objects.
const TABLES: u64 = 40;
/// Frames of a picture: a second of the camera.
const FRAMES: u32 = 10;

fn detect(table: &[Placed], camera: &Camera, seed: u64) -> Vec<Detection> {
    let image = table_image(table, camera, &Noise::DEFAULT, seed, FRAMES);
    segment(&image, camera, &region(), &ObjectClass::ALL, &[]).unwrap()
}

#[test]
fn objects_of_all_classes_are_found_where_they_stand_and_nothing_else() {
    are_found(FRAMES, 0.5);
}

#[test]
fn a_single_frame_from_the_mast_shows_where_they_stand_forks_too() {
    are_found(1, 0.3);
}

/// At least 98 %, at most 1 % that is not there, and covariances that hold. These are exact models, and no thing is one: covariances are those
/// of things, so that they may be too large here, but not too small.
fn are_found(frames: u32, least_confidence: f64) {
    let camera = mast_camera(OPTICS);
    let (mut objects, mut good, mut phantoms) = (0, 0, 0);
    let mut squares = Vec::new();
    for seed in 0..TABLES {
        let table = random_table(seed, 1 + seed as usize % 8, &camera);
        let image = table_image(&table, &camera, &Noise::DEFAULT, seed, frames);
        let found = segment(&image, &camera, &region(), &ObjectClass::ALL, &[]).unwrap();
        let (matches, phantom) = compare(&table, &found);
        for m in matches.iter().filter(|m| !m.is_good()) {
            println!("seed {seed}: {m:?}");
        }
        objects += matches.len();
        good += matches.iter().filter(|m| m.is_good()).count();
        phantoms += phantom.len();
        for m in matches.iter().filter(|m| m.is_good()) {
            let found = m.found.unwrap();
            assert!(found.confidence > least_confidence && found.confidence <= 1.0, "seed {seed}: {m:?}");
            squares.extend(m.normalised_square());
        }
    }
    assert!(good as f64 >= 0.98 * f64::from(objects as u32), "{good} of {objects}");
    assert!(phantoms as f64 <= 0.01 * objects as f64, "{phantoms} of {objects}");
    // 1 in the mean where covariances are true.
    let consistency = squares.iter().sum::<f64>() / squares.len() as f64;
    assert!(consistency < 1.5, "{consistency}");
}

#[test]
fn things_that_no_model_is_exactly_are_found_by_a_sensor_with_flying_pixels_too() {
    let camera = mast_camera(OPTICS);
    let (mut objects, mut good, mut phantoms) = (0, 0, 0);
    let (mut squares, mut inside) = (Vec::new(), 0);
    for seed in 500..516 {
        let table = random_things(seed, 1 + seed as usize % 8, &camera);
        let image = things_image(&table, &camera, &Sensor::DEFAULT, seed, FRAMES);
        let found = segment(&image, &camera, &region(), &ObjectClass::ALL, &[]).unwrap();
        let (matches, phantom) = compare(&table, &found);
        objects += matches.len();
        good += matches.iter().filter(|m| m.is_good()).count();
        phantoms += phantom.len();
        squares.extend(matches.iter().filter(|m| m.is_good()).filter_map(trial::Match::normalised_square));
        inside += matches.iter().filter(|m| m.is_inside() == Some(true)).count();
    }
    // Covariances hold for what is no exact model: 1 in the mean, and 95 % inside, where they are true.
    let consistency = squares.iter().sum::<f64>() / squares.len() as f64;
    assert!((0.5..1.5).contains(&consistency), "{consistency}");
    assert!(inside as f64 >= 0.85 * objects as f64, "{inside} of {objects}");
    assert!(good as f64 >= 0.9 * objects as f64 && phantoms == 0, "{good} of {objects}, {phantoms} false");
}

#[test]
fn an_object_that_was_seen_before_is_located_again_and_one_that_was_taken_away_is_not() {
    let camera = mast_camera(OPTICS);
    for seed in 100..104 {
        let table = random_table(seed, 4, &camera);
        let image = table_image(&table[1..], &camera, &Noise::DEFAULT, seed, FRAMES);
        let again = |truth: &Placed| {
            let pose = Pose::at(0.02, -0.01, 0.004).compose(&truth.pose);
            let prior = Prior { pose, size: truth.model.size() };
            locate(&image, &camera, &prior, &[truth.model.class()], &[]).unwrap()
        };
        for truth in &table[1..] {
            let found = again(truth).unwrap_or_else(|| panic!("seed {seed}: {truth:?} not found"));
            assert!(found.pose.distance(&truth.pose) < 0.008, "seed {seed}: {truth:?} as {found:?}");
        }
        assert_eq!(again(&table[0]), None, "seed {seed}");
    }
}

#[test]
fn boxes_seen_by_a_coarse_camera_from_the_mast_are_found_one_by_one() {
    let camera = mast_camera(Intrinsics::DEFAULT);
    for seed in 300..306 {
        let all = random_table(seed, 8, &camera);
        let boxes: Vec<Placed> = all.into_iter().filter(|t| t.model.class() == ObjectClass::Box).collect();
        let look = |frames| table_image(&boxes, &camera, &Noise::DEFAULT, seed, frames);
        let image = look(60);
        let found = segment(&image, &camera, &region(), &[ObjectClass::Box], &[]).unwrap();
        let (matches, phantoms) = compare(&boxes, &found);
        assert!(
            matches.iter().all(trial::Match::is_good) && phantoms.is_empty(),
            "seed {seed}: {matches:?} {phantoms:?}"
        );
        for seen in &found {
            let prior = Prior { pose: seen.pose, size: seen.model.size() };
            let again = locate(&look(8), &camera, &prior, &[ObjectClass::Box], &[]).unwrap().unwrap();
            assert!(again.pose.distance(&seen.pose) < 0.005, "seed {seed}: {seen:?} as {again:?}");
        }
    }
}

#[test]
fn only_the_classes_that_are_looked_for_are_found() {
    let camera = mast_camera(OPTICS);
    let table = random_table(200, 8, &camera);
    let image = table_image(&table, &camera, &Noise::DEFAULT, 200, FRAMES);
    for class in ObjectClass::ALL {
        let found = segment(&image, &camera, &region(), &[class], &[]).unwrap();
        assert!(found.iter().all(|f| f.model.class() == class));
        assert!(found.len() >= table.iter().filter(|t| t.model.class() == class).count(), "{class:?}");
    }
    assert!(segment(&image, &camera, &region(), &[], &[]).unwrap().is_empty());
}

#[test]
fn the_robots_own_hand_above_the_table_is_no_object() {
    let camera = mast_camera(OPTICS);
    // A finger with the shape of a box that stands on the table.
    let finger = (Pose::at(0.8, 0.1, 0.75), [0.06, 0.06, 0.10]);
    let bodies = [
        Body::new(&Shape::Box { size: finger.1 }, &finger.0),
        Body::new(&Shape::Box { size: [0.6, 1.2, 0.05] }, &Pose::at(0.8, 0.0, 0.675)),
    ];
    let image = render(&camera, &bodies);
    let find = |body: &[Ball]| segment(&image, &camera, &region(), &ObjectClass::ALL, body).unwrap();
    assert_eq!(find(&[]).len(), 1);
    let cover = [-0.03, 0.03].map(|z| Ball { centre: [0.8, 0.1, 0.75 + z], radius: 0.055 });
    assert_eq!(find(&cover), vec![]);
}

#[test]
fn without_a_surface_in_the_image_nothing_is_said() {
    let camera = mast_camera(Intrinsics::DEFAULT);
    let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
    let nothing = DepthImage { width, height, depth: vec![0.0; width * height] };
    let look = |image: &DepthImage| segment(image, &camera, &region(), &ObjectClass::ALL, &[]);
    assert_eq!(look(&nothing), Err(DetectionError::NoPlane { points: 0 }));
    let another = DepthImage { width: 1, height: 1, depth: vec![1.0] };
    assert_eq!(look(&another), Err(DetectionError::WrongCamera { width: 1, height: 1 }));
}

#[test]
fn the_same_seed_gives_the_same_table_and_the_same_image_the_same_objects() {
    let camera = mast_camera(OPTICS);
    let table = random_table(5, 6, &camera);
    assert_eq!(table, random_table(5, 6, &camera));
    assert_ne!(table, random_table(6, 6, &camera));
    assert_eq!(detect(&table, &camera, 5), detect(&table, &camera, 5));
}

#[test]
fn an_empty_table_shows_nothing() {
    let camera = Camera::looking([-0.62, 0.3, 1.88], trial::TABLE, OPTICS);
    for seed in 0..3 {
        assert_eq!(detect(&[], &camera, seed), vec![]);
    }
}
