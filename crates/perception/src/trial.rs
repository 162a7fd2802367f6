//! Random tables, and how well detection does on them: shared by tests and measurements.
//!
//! One to eight objects of all classes and of random dimensions stand on a table as seen from the robot's mast, at least [`GAP_M`] apart,
//! and so that most of each object is visible: an object behind another one is found when the robot looks from elsewhere, which is not what
//! these trials measure.

use crate::calibration::Calibration;
use crate::camera::{Camera, DepthImage, Intrinsics};
use crate::detection::{Detection, Model, ObjectClass, Region, Symmetry};
use crate::noise::{Noise, observe};
use crate::render::{Body, Surface, render, scan};
use crate::sensor::field::{hash, normal};
use crate::sensor::{Sensor, sense};
use crate::shapes::{HANDLE_M, Individual, drawn};
use crate::vector::{cross, dot};
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ratn_model::pose::Pose;
use ratn_world::scene::Shape;
use std::f64::consts::{FRAC_PI_2, PI};

/// A structured-light camera of 640 × 480 pixels, 52° × 40°.
pub const OPTICS: Intrinsics = Intrinsics { width: 640, height: 480, fx: 660.0, fy: 660.0, cx: 319.5, cy: 239.5 };
/// The centre of the table's top, in metres.
pub const TABLE: [f64; 3] = [0.80, 0.0, 0.70];
/// The size of the table's top, in metres.
pub const TABLE_SIZE: [f64; 2] = [0.6, 1.2];
/// Gap between the circles around two objects (or around parts of a fork), in metres.
pub const GAP_M: f64 = 0.03;
/// Minimum visible part of an object, compared with the object alone.
pub const LEAST_VISIBLE: f64 = 0.75;
/// Tolerances of a detection: metres and radians.
pub const TOLERANCE: (f64, f64) = (0.005, 3.0 * PI / 180.0);
/// A detection farther than this from every object is false, in metres.
const ASSIGNED: f64 = 0.05;
/// Boxes whose edges differ by less than this look the same after a quarter turn, in metres.
const SQUARE: f64 = 0.01;

/// An object with its pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Placed {
    /// Its model.
    pub model: Model,
    /// The centre of its bounding box, in the world.
    pub pose: Pose,
}

/// The detection of one object.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Match {
    /// The object.
    pub truth: Placed,
    /// Its detection, if any.
    pub found: Option<Detection>,
    /// Distance between the centres, in metres.
    pub position: f64,
    /// Angle between the axes, modulo the symmetry, in radians.
    pub angle: f64,
}

impl Match {
    /// Whether the class is right and the errors are within the tolerance.
    pub fn is_good(&self) -> bool {
        let right = self.found.is_some_and(|f| f.model.class() == self.truth.model.class());
        right && self.position <= TOLERANCE.0 && self.angle <= TOLERANCE.1
    }

    /// Whether the position is within the 95 % ellipsoid of its covariance.
    pub fn is_inside(&self) -> Option<bool> {
        // The 95 % quantile of a χ² distribution with three degrees of freedom.
        self.normalised_square().map(|square| 3.0 * square <= 7.815)
    }

    /// The squared position error weighted by the inverse covariance, divided by its three dimensions: 1 on average where covariances are
    /// right, less where they are too large (the normalised estimation error squared; Bar-Shalom, Li and Kirubarajan 2001, section 5.4).
    pub fn normalised_square(&self) -> Option<f64> {
        let found = self.found?;
        let e: [f64; 3] = std::array::from_fn(|i| found.pose.position[i] - self.truth.pose.position[i]);
        let [a, b, c]: [[f64; 3]; 3] = std::array::from_fn(|i| std::array::from_fn(|j| found.covariance[i][j]));
        // By Cramer's rule: the matrix is symmetric, so rows are columns.
        let determinant = |a, b, c| dot(a, cross(b, c));
        let solution = [determinant(e, b, c), determinant(a, e, c), determinant(a, b, e)];
        Some(dot(solution, e) / determinant(a, b, c) / 3.0)
    }
}

/// A camera on the robot's mast that looks at the table's centre from 1.85 m.
pub fn mast_camera(intrinsics: Intrinsics) -> Camera {
    Camera::looking([-0.62, 0.0, 1.88], TABLE, intrinsics)
}

/// The true camera where the robot believes it to be at `believed`: displaced along and rotated about the axes of its optical frame by
/// random errors with the variances of its calibration. The same seed gives the same error.
pub fn miscalibrated(believed: &Camera, calibration: &Calibration, seed: u64) -> Camera {
    let off = |axis: usize| calibration[axis].sqrt() * normal(hash(hash(seed ^ 0xCA11) ^ axis as u64));
    let error = Pose::from_rpy([off(0), off(1), off(2)], off(3), off(4), off(5));
    Camera { pose: believed.pose.compose(&error), ..*believed }
}

/// The table as a region.
pub fn region() -> Region {
    Region { pose: Pose::at(TABLE[0], TABLE[1], TABLE[2]), size: TABLE_SIZE }
}

/// A random model of a class: dimensions in the middle of the class's ranges.
pub fn random_model(class: ObjectClass, random: &mut impl Rng) -> Model {
    let dimensions: Vec<f64> = match class {
        ObjectClass::Box => {
            let width = random.random_range(0.05..0.10);
            vec![random.random_range(width..0.18), width, random.random_range(0.04..0.14)]
        }
        ObjectClass::Can => vec![random.random_range(0.028..0.045), random.random_range(0.07..0.14)],
        ObjectClass::Cup => vec![random.random_range(0.035..0.045), random.random_range(0.07..0.11)],
        ObjectClass::Bowl => vec![random.random_range(0.06..0.09), random.random_range(0.045..0.07)],
        ObjectClass::Plate => vec![random.random_range(0.09..0.13), random.random_range(0.018..0.028)],
        ObjectClass::Fork => vec![random.random_range(0.17..0.21)],
    };
    class.model(&dimensions)
}

/// A table with `count` objects, each exactly its model. The same seed gives the same table.
pub fn random_table(seed: u64, count: usize, camera: &Camera) -> Vec<Placed> {
    laid(seed, count, camera, Drawn::Models)
}

/// The same with room for the handles of cups, and visible as [`things_image`] shows it.
pub fn random_things(seed: u64, count: usize, camera: &Camera) -> Vec<Placed> {
    laid(seed, count, camera, Drawn::Things)
}

/// How objects are drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Drawn {
    /// As the detector's own model.
    Models,
    /// With the details of [`crate::shapes`].
    Things,
}

fn laid(seed: u64, count: usize, camera: &Camera, drawn: Drawn) -> Vec<Placed> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut table: Vec<Placed> = Vec::new();
    // A table so full that nothing more fits is laid again.
    let mut failures = 0;
    while table.len() < count {
        let class = ObjectClass::ALL[random.random_range(0..ObjectClass::ALL.len())];
        let model = random_model(class, &mut random);
        let [length, width, height] = model.size();
        let margin = length.hypot(width) / 2.0 + 0.01;
        let mut along = |axis: usize| {
            let half = TABLE_SIZE[axis] / 2.0 - margin;
            TABLE[axis] + random.random_range(-half..half)
        };
        let at = [along(0), along(1), TABLE[2] + height / 2.0];
        let pose = Pose::from_rpy(at, 0.0, 0.0, random.random_range(-PI..PI));
        table.push(Placed { model, pose });
        if !is_clear(&table, drawn) || !all_visible(&table, camera, drawn) {
            table.pop();
            failures += 1;
            if failures % 400 == 0 {
                table.clear();
            }
        }
    }
    table
}

/// The camera's image of a table, averaged over frames, with the table, the floor and the robot's base.
pub fn table_image(table: &[Placed], camera: &Camera, noise: &Noise, seed: u64, frames: u32) -> DepthImage {
    let bodies: Vec<Body> = table.iter().map(Placed::body).chain(surroundings()).collect();
    observe(&render(camera, &bodies), &camera.intrinsics, noise, seed, 0, frames)
}

/// The same with objects drawn by [`crate::shapes`], as a real sensor would see them.
pub fn things_image(table: &[Placed], camera: &Camera, sensor: &Sensor, seed: u64, frames: u32) -> DepthImage {
    let surroundings = surroundings().map(|body| (body, Surface::MATT));
    let bodies: Vec<(Body, Surface)> = table.iter().map(Placed::thing).chain(surroundings).collect();
    sense(&scan(camera, &bodies), &camera.intrinsics, sensor, seed, 0, frames)
}

/// The table, the floor and the robot's base.
fn surroundings() -> impl Iterator<Item = Body> {
    let [x, y, z] = TABLE;
    [
        ([TABLE_SIZE[0], TABLE_SIZE[1], 0.05], Pose::at(x, y, z - 0.025)),
        ([10.0, 10.0, 0.1], Pose::at(0.0, 0.0, -0.05)),
        ([0.9, 0.6, 0.6], Pose::at(-0.1, 0.0, 0.3)),
    ]
    .into_iter()
    .map(|(size, pose)| Body::new(&Shape::Box { size }, &pose))
}

/// Matches objects and detections, nearest pairs first; returns the matches, and the false detections.
pub fn compare(table: &[Placed], found: &[Detection]) -> (Vec<Match>, Vec<Detection>) {
    let mut pairs: Vec<(usize, usize, f64)> = (0..table.len())
        .flat_map(|t| (0..found.len()).map(move |f| (t, f, table[t].pose.distance(&found[f].pose))))
        .filter(|(_, _, distance)| *distance < ASSIGNED)
        .collect();
    pairs.sort_by(|a, b| a.2.total_cmp(&b.2));
    let (mut of_truth, mut taken) = (vec![None; table.len()], vec![false; found.len()]);
    for (t, f, _) in pairs {
        if of_truth[t].is_none() && !taken[f] {
            of_truth[t] = Some(f);
            taken[f] = true;
        }
    }
    let matches = table.iter().zip(of_truth).map(|(truth, f)| match f.map(|f| found[f]) {
        Some(found) => {
            let (position, angle) = (truth.pose.distance(&found.pose), angle(truth, &found.pose));
            Match { truth: *truth, found: Some(found), position, angle }
        }
        None => Match { truth: *truth, found: None, position: f64::INFINITY, angle: f64::INFINITY },
    });
    let matches = matches.collect();
    (matches, found.iter().zip(taken).filter(|(_, taken)| !taken).map(|(f, _)| *f).collect())
}

/// The least rotation from the detected pose to one that looks like the true pose.
fn angle(truth: &Placed, found: &Pose) -> f64 {
    let turned = |yaw: f64| truth.pose.compose(&Pose::from_rpy([0.0; 3], 0.0, 0.0, yaw)).angle(found);
    let least = |turns: &[f64]| turns.iter().map(|yaw| turned(*yaw)).fold(f64::INFINITY, f64::min);
    match (truth.model.class().symmetry(), truth.model) {
        (Symmetry::None, _) => turned(0.0),
        (Symmetry::HalfTurn, Model::Box { size }) if (size[0] - size[1]).abs() < SQUARE => {
            least(&[0.0, FRAC_PI_2, PI, -FRAC_PI_2])
        }
        (Symmetry::HalfTurn, _) => least(&[0.0, PI]),
        (Symmetry::Round, _) => {
            let up = |pose: &Pose| pose.rotate([0.0, 0.0, 1.0]);
            let (a, b) = (up(&truth.pose), up(found));
            (0..3).map(|i| a[i] * b[i]).sum::<f64>().clamp(-1.0, 1.0).acos()
        }
    }
}

impl Placed {
    /// The object with its individual details, and its surface.
    pub fn thing(&self) -> (Body, Surface) {
        let (shape, surface) = drawn(&self.model, Individual::of(&self.model));
        (Body { shape, pose: crate::render::parry_pose(&self.pose) }, surface)
    }

    /// The object's model as a body.
    pub fn body(&self) -> Body {
        Body { shape: self.model.solid(), pose: crate::render::parry_pose(&self.pose) }
    }

    /// Circles that enclose it, seen from above: one, or four along a slender object.
    fn circles(&self, drawn: Drawn) -> Vec<([f64; 2], f64)> {
        let [length, width, _] = self.model.size();
        let pieces = if length > 3.0 * width { 4 } else { 1 };
        let part = length / f64::from(pieces);
        let circle = |i: i32| {
            let centre = self.pose.transform([part * (f64::from(i) + 0.5) - length / 2.0, 0.0, 0.0]);
            let round = self.model.class().symmetry() == Symmetry::Round;
            let has_handle = drawn == Drawn::Things && Individual::of(&self.model).has_handle;
            let handle = if has_handle { HANDLE_M } else { 0.0 };
            ([centre[0], centre[1]], if round { width / 2.0 + handle } else { part.hypot(width) / 2.0 })
        };
        (0..pieces).map(circle).collect()
    }
}

/// Whether the last object has enough distance from the others.
fn is_clear(table: &[Placed], drawn: Drawn) -> bool {
    let Some((last, others)) = table.split_last() else { return true };
    let apart = |a: &([f64; 2], f64), b: &([f64; 2], f64)| (a.0[0] - b.0[0]).hypot(a.0[1] - b.0[1]) > a.1 + b.1 + GAP_M;
    let own = last.circles(drawn);
    others.iter().flat_map(|other| other.circles(drawn)).all(|other| own.iter().all(|circle| apart(circle, &other)))
}

/// Whether every object is visible enough, in a coarse image.
fn all_visible(table: &[Placed], camera: &Camera, drawn: Drawn) -> bool {
    let optics = camera.intrinsics;
    let scale = 4.0;
    let coarse = Intrinsics {
        width: optics.width / 4,
        height: optics.height / 4,
        fx: optics.fx / scale,
        fy: optics.fy / scale,
        cx: (optics.cx - 1.5) / scale,
        cy: (optics.cy - 1.5) / scale,
    };
    let camera = Camera { intrinsics: coarse, pose: camera.pose };
    let body = |object: &Placed| match drawn {
        Drawn::Models => object.body(),
        Drawn::Things => object.thing().0,
    };
    let alone: Vec<DepthImage> = table.iter().map(|object| render(&camera, &[body(object)])).collect();
    let nearest =
        |pixel: usize| alone.iter().map(|image| image.depth[pixel]).filter(|d| *d > 0.0).fold(f32::MAX, f32::min);
    alone.iter().all(|image| {
        let own: Vec<usize> = (0..image.depth.len()).filter(|pixel| image.depth[*pixel] > 0.0).collect();
        let seen = own.iter().filter(|pixel| image.depth[**pixel] <= nearest(**pixel)).count();
        let cut_off = own.iter().any(|pixel| {
            let (column, row) = (pixel % coarse.width, pixel / coarse.width);
            column == 0 || row == 0 || column + 1 == coarse.width || row + 1 == coarse.height
        });
        !own.is_empty() && !cut_off && seen as f64 >= LEAST_VISIBLE * own.len() as f64
    })
}
