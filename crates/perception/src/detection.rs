//! From a depth image to the objects on a supporting surface.
//!
//! The steps: points of the region → the plane by RANSAC → points above it, without the robot's own body → clusters with a k-d tree →
//! for each cluster every model that is possible by its principal axes → the model that explains the cluster best, refined. A cluster
//! that no model explains (part of an arm, an object of no known class) is left out.

use crate::camera::{Camera, DepthImage};
use crate::fit::start::Outline;
use crate::fit::{Covariance, Evidence, Fit};
use crate::mask::Ball;
pub use crate::model::{Model, ObjectClass, Symmetry};
use crate::vector::{Vector, length, scale, sub};
use crate::view::View;
use ratn_model::pose::Pose;
use std::f64::consts::{FRAC_PI_2, PI};

/// Where to look: a flat surface on which objects stand.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Region {
    /// The centre of the surface, its z axis up.
    pub pose: Pose,
    /// Its extents along x and y, in metres.
    pub size: [f64; 2],
}

/// An object as detected before.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Prior {
    /// Its centre.
    pub pose: Pose,
    /// The edges of its bounding box, in metres.
    pub size: [f64; 3],
}

/// A detected object.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Detection {
    /// Its shape, in metres. A box's first edge is not shorter than its second.
    pub model: Model,
    /// The centre of its bounding box, upright on the surface. A box's yaw is within a quarter turn of the region's x axis (half a
    /// turn more looks the same), a fork's x axis points to the tips, round objects have the region's yaw.
    pub pose: Pose,
    /// Covariance of the position in metres² and of a small rotation in radians², both along the world's axes: rows and columns are x,
    /// y, z, and rotations about x, y, z. For round objects the yaw's variance is that of an unknown angle.
    pub covariance: [[f64; 6]; 6],
    /// Confidence that this is an object of this class, 0 to 1: the part of the points that the model explains, reduced by how well
    /// other classes explain them.
    pub confidence: f64,
}

/// Why there is no result.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum DetectionError {
    /// The surface is not in the image.
    #[error(
        "no supporting plane in the region: {points} points of it are in the image; look at it, with the arm out of view"
    )]
    NoPlane {
        /// Number of points of the region in the image.
        points: usize,
    },
    /// The size of the image differs from the camera's.
    #[error("an image of {width} × {height} cannot come from this camera")]
    WrongCamera {
        /// Columns of the image.
        width: usize,
        /// Rows of the image.
        height: usize,
    },
}

/// Minimum part of its cluster that a model must explain.
const MIN_EXPLAINED: f64 = 0.7;
/// Maximum score of a model, see `Fit::score`.
const MAX_SCORE: f64 = 0.6;
/// Maximum distance between the centroids of two parts of one object, in metres.
const MAX_APART: f64 = 0.12;
/// Margin of the search around a known object, in metres.
const SEARCH_MARGIN: f64 = 0.15;
/// Maximum displacement of a known object, in metres.
const MAX_DISPLACEMENT: f64 = 0.08;
/// Standard deviation of the surface's height about a region's pose, and about the underside of a known object, in metres.
const REGION_DEVIATION: f64 = 0.02;
const PRIOR_DEVIATION: f64 = 0.01;
/// Allowed difference of a known object's dimensions from the measured ones: in metres, and as a part of them; the larger counts.
const SIZE_SLACK: (f64, f64) = (0.025, 0.25);
/// The difference of scores by which one class is e times as likely as another.
const SCORE_SCALE: f64 = 0.06;
/// Classes whose scores differ by less are compared again with more points.
const CLOSE: f64 = 0.15;
/// Scores that differ by less are considered equal.
const ALIKE: f64 = 0.05;
/// Noise that does not average out over an object's points, because noise also decides which points are separated from the surface and
/// from which side an edge is seen. As a part of one point's standard deviation along its ray; measured on random tables.
const COMMON_NOISE: f64 = 0.12;
/// Numbers of points, free rays and edges, and iterations: to classify a cluster, and to locate the object.
const COARSE: ([usize; 3], usize) = ([140, 50, 30], 8);
const FINE: ([usize; 3], usize) = ([500, 120, 100], 9);

/// For a fork: number of starts that are refined to find its direction, iterations for that, and iterations for the final pose.
const RELIEF: (usize, usize, usize) = (4, 4, 12);

/// All objects of these classes on the surface, nearest to the camera first. `body` is the robot's own body.
///
/// # Errors
/// [`DetectionError`] when the surface is not in the image.
pub fn segment(
    image: &DepthImage,
    camera: &Camera,
    region: &Region,
    classes: &[ObjectClass],
    body: &[Ball],
) -> Result<Vec<Detection>, DetectionError> {
    let mut found = objects_on(image, camera, region, classes, body, REGION_DEVIATION)?;
    let eye = camera.pose.position;
    // Rounded to centimetres, then sorted by y, so that noise does not change the order.
    let key = |object: &Detection| {
        let [x, y, _] = object.pose.position;
        (((x - eye[0]).hypot(y - eye[1]) * 100.0).round() as i64, (y * 1000.0).round() as i64)
    };
    found.sort_by_key(key);
    Ok(found)
}

/// Locates the object that was last seen as `prior`: the nearest object there of these classes and of about that size.
///
/// # Errors
/// [`DetectionError`] when the surface below it is not in the image.
pub fn locate(
    image: &DepthImage,
    camera: &Camera,
    prior: &Prior,
    classes: &[ObjectClass],
    body: &[Ball],
) -> Result<Option<Detection>, DetectionError> {
    let reach = prior.size[0].hypot(prior.size[1]) + 2.0 * SEARCH_MARGIN;
    let below = Pose::at(0.0, 0.0, -prior.size[2] / 2.0);
    let region = Region { pose: prior.pose.compose(&below), size: [reach, reach] };
    let nearest_on = |deviation: f64| -> Result<Option<Detection>, DetectionError> {
        let mut found = objects_on(image, camera, &region, classes, body, deviation)?;
        found.retain(|object| object.pose.distance(&prior.pose) <= MAX_DISPLACEMENT && alike(prior, object));
        Ok(found.into_iter().min_by(|a, b| a.pose.distance(&prior.pose).total_cmp(&b.pose.distance(&prior.pose))))
    };
    // On the surface on which it stood; else on the surface that most points lie on, where it may have fallen.
    match nearest_on(PRIOR_DEVIATION)? {
        Some(found) => Ok(Some(found)),
        None => nearest_on(f64::INFINITY),
    }
}

/// Whether an object could be the one seen before, by its dimensions.
fn alike(prior: &Prior, object: &Detection) -> bool {
    let sorted = |[x, y, z]: [f64; 3]| [x.max(y), x.min(y), z];
    let (before, now) = (sorted(prior.size), sorted(object.model.size()));
    (0..3).all(|i| (before[i] - now[i]).abs() <= SIZE_SLACK.0.max(SIZE_SLACK.1 * before[i]))
}

fn objects_on(
    image: &DepthImage,
    camera: &Camera,
    region: &Region,
    classes: &[ObjectClass],
    body: &[Ball],
    deviation: f64,
) -> Result<Vec<Detection>, DetectionError> {
    let mut view = View::new(image, camera, region, body, deviation)?;
    let mut found: Vec<Explained> = Vec::new();
    // Large clusters first: a steep side can be separated from its top, and must not become a second object in the same place.
    let mut fragments = Vec::new();
    for cluster in 0..view.clusters.len() {
        match explanation(&view, cluster, classes) {
            Some(explained) if !explained.is_taken(&found) => found.push(explained),
            _ => fragments.push(cluster),
        }
    }
    // A hollow object falls into parts where its far side is seen over its near one. One part may look like a smaller object.
    let mut parts = Vec::new();
    for fragment in fragments {
        let whole = found.iter().enumerate().find_map(|(i, part)| {
            let whole = view.joined(part.cluster, fragment, MAX_APART)?;
            let whole = explanation(&view, whole, classes)?;
            (whole.score <= part.score + ALIKE).then_some((i, whole))
        });
        match whole {
            Some((i, whole)) => found[i] = whole,
            None => parts.push(fragment),
        }
    }
    for (i, a) in parts.iter().enumerate() {
        for b in &parts[i + 1..] {
            let Some(whole) = view.joined(*a, *b, MAX_APART) else { continue };
            if let Some(explained) = explanation(&view, whole, classes)
                && !explained.is_taken(&found)
            {
                found.push(explained);
            }
        }
    }
    Ok(found.into_iter().map(|explained| explained.object).collect())
}

/// The explanation of a cluster.
struct Explained {
    cluster: usize,
    fit: Fit,
    /// The score of its fit.
    score: f64,
    object: Detection,
}

impl Explained {
    /// Whether an object already stands there.
    fn is_taken(&self, found: &[Explained]) -> bool {
        found.iter().any(|other| other.fit.covers(self.fit.at()) || self.fit.covers(other.fit.at()))
    }
}

/// The explanation of a cluster, if a model explains it.
fn explanation(view: &View<'_>, cluster: usize, classes: &[ObjectClass]) -> Option<Explained> {
    let tried = likeliest(view, cluster, classes);
    let best = tried.first()?.1;
    let evidence = view.evidence(cluster, FINE.0);
    // Models with close scores are compared with more points.
    let close = tried.iter().filter(|(_, score)| score - best < CLOSE);
    let mut close: Vec<(Fit, f64)> =
        close.map(|(fit, _)| fit.clone().refined(&evidence, FINE.1).scored(&evidence)).collect();
    close.sort_by(|a, b| a.1.total_cmp(&b.1));
    let (fit, score) = close.swap_remove(0);
    let explained = fit.explains(&evidence);
    // A fork is confirmed by the depths of all pixels around it instead.
    if fit.class != ObjectClass::Fork && (explained < MIN_EXPLAINED || score > MAX_SCORE) {
        return None;
    }
    let far = tried.iter().filter(|(_, score)| score - best >= CLOSE).map(|(_, rival)| best - rival);
    let rivals: f64 = close.iter().map(|(_, rival)| score - rival).chain(far).map(|d| (d / SCORE_SCALE).exp()).sum();
    let confidence = explained / (1.0 + rivals);
    let (fit, covariance, common) = if fit.class == ObjectClass::Fork {
        let (fit, covariance) = lying(view, &fit)?;
        (fit, covariance, [0.0; 3])
    } else {
        let covariance = fit.covariance(&evidence);
        let common = common(&fit, &evidence);
        (fit, covariance, common)
    };
    // A poorly determined object is kept, with a covariance that says so; a fit with undefined numbers is dropped.
    let is_fitted = (0..2).all(|i| covariance.pose[i][i].is_finite()) && covariance.height.is_finite();
    if !is_fitted {
        return None;
    }
    let object = detection(view, &fit, &covariance, common, confidence);
    Some(Explained { cluster, fit, score, object })
}

/// The pose of a fork by the depths around it, in the better of both directions. `None` where the surface alone explains the depths as
/// well.
fn lying(view: &View<'_>, fit: &Fit) -> Option<(Fit, Covariance)> {
    let relief = view.relief(fit);
    let starts = relief.starts(fit).into_iter().take(RELIEF.0);
    let refined = starts.map(|start| relief.refined(start, RELIEF.1)).min_by(|a, b| a.1.total_cmp(&b.1));
    let (near, ..) = refined.unwrap_or_else(|| relief.refined(fit.clone(), RELIEF.1));
    let relief = view.relief(&near);
    let (fit, cost, covariance) = relief.refined(near, RELIEF.2);
    relief.shows(cost).then_some((fit, covariance))
}

/// The displacement by common noise of an object's points: a shift along the ray.
fn common(fit: &Fit, evidence: &Evidence) -> Vector {
    let [x, y] = fit.at();
    let away = sub([x, y, 0.0], evidence.eye);
    scale(away, COMMON_NOISE * evidence.sigma / length(away))
}

/// For each possible class of a cluster, the best fit to a sample of its points with its score, best first.
fn likeliest(view: &View<'_>, cluster: usize, classes: &[ObjectClass]) -> Vec<(Fit, f64)> {
    let evidence = view.evidence(cluster, COARSE.0);
    let Some(outline) = Outline::of(&evidence.points) else { return Vec::new() };
    let mut tried: Vec<(Fit, f64)> = Vec::new();
    for start in outline.starts(&evidence.points, classes) {
        let (fit, score) = start.refined(&evidence, COARSE.1).scored(&evidence);
        match tried.iter_mut().find(|(other, _)| other.class == fit.class) {
            Some(other) if other.1 > score => *other = (fit, score),
            Some(_) => {}
            None => tried.push((fit, score)),
        }
    }
    tried.sort_by(|a, b| a.1.total_cmp(&b.1));
    tried
}

fn detection(view: &View<'_>, fit: &Fit, planar: &Covariance, common: Vector, confidence: f64) -> Detection {
    let (mut model, mut yaw) = (fit.model(), fit.yaw());
    if let Model::Box { size } = &mut model
        && size[0] < size[1]
    {
        size.swap(0, 1);
        yaw += FRAC_PI_2;
    }
    match model.class().symmetry() {
        Symmetry::HalfTurn => yaw = (yaw + FRAC_PI_2).rem_euclid(PI) - FRAC_PI_2,
        Symmetry::None => yaw = (yaw + PI).rem_euclid(2.0 * PI) - PI,
        Symmetry::Round => yaw = 0.0,
    }
    let [x, y] = fit.at();
    let standing = Pose::from_rpy([x, y, model.size()[2] / 2.0], 0.0, 0.0, yaw);
    Detection {
        model,
        pose: view.frame.compose(&standing),
        covariance: covariance(view, fit, planar, common),
        confidence,
    }
}

/// The covariances of the fit and of the plane, plus the errors that the fit does not know; rotated into the world.
fn covariance(view: &View<'_>, fit: &Fit, planar: &Covariance, common: Vector) -> [[f64; 6]; 6] {
    let mut local = [[0.0; 6]; 6];
    // x, y and yaw come from the fit, height and slopes from the plane; half of the height's error is the centre's.
    for (i, row) in [0, 1, 5].into_iter().enumerate() {
        for (j, column) in [0, 1, 5].into_iter().enumerate() {
            local[row][column] = planar.pose[i][j];
        }
    }
    local[2][2] = view.plane_variance[0] + planar.height / 4.0;
    let [along, across, up] = fit.class.off_beyond_fit().map(|deviation| deviation * deviation);
    let (sin, cos) = fit.yaw().sin_cos();
    local[0][0] += along * cos * cos + across * sin * sin;
    local[1][1] += along * sin * sin + across * cos * cos;
    local[0][1] += (along - across) * sin * cos;
    local[1][0] += (along - across) * sin * cos;
    local[2][2] += up;
    local[3][3] = view.plane_variance[1];
    local[4][4] = view.plane_variance[1];
    for (i, row) in local.iter_mut().take(3).enumerate() {
        for (j, entry) in row.iter_mut().take(3).enumerate() {
            *entry += common[i] * common[j];
        }
    }
    if fit.class.symmetry() == Symmetry::Round {
        // The variance of an unknown angle.
        local[5][5] = PI * PI / 3.0;
    }
    let axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]].map(|axis| view.frame.rotate(axis));
    let turn = |row: usize, column: usize| if row / 3 == column / 3 { axes[column % 3][row % 3] } else { 0.0 };
    let product = |a: &dyn Fn(usize, usize) -> f64, b: &dyn Fn(usize, usize) -> f64| -> [[f64; 6]; 6] {
        std::array::from_fn(|i| std::array::from_fn(|j| (0..6).map(|k| a(i, k) * b(k, j)).sum()))
    };
    let half = product(&turn, &|i, j| local[i][j]);
    product(&|i, j| half[i][j], &|i, j| turn(j, i))
}
