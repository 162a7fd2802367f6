//! Depth image → objects on a supporting surface.
//!
//! Points of the region → the plane by RANSAC → points above it, the robot's own body left out → clusters on a k-d tree → to
//! each cluster every model that it could be, from its principal axes → the one that explains it best, refined. What no
//! model explains (a part of an arm, a thing of no known class) is left out.

use crate::camera::{Camera, DepthImage};
use crate::fit::start::Outline;
use crate::fit::{Evidence, Fit};
use crate::mask::Ball;
pub use crate::model::{Model, ObjectClass, Symmetry};
use crate::vector::{length, sub};
use crate::view::View;
use ratn_model::pose::Pose;
use std::f64::consts::{FRAC_PI_2, PI};

/// Where to look: a flat surface on which things stand.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Region {
    /// The middle of the surface, its z axis up.
    pub pose: Pose,
    /// Its extents along x and y, in metres.
    pub size: [f64; 2],
}

/// What was seen before.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Prior {
    /// Its centre.
    pub pose: Pose,
    /// The edges of its bounding box, in metres.
    pub size: [f64; 3],
}

/// An object as seen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Detection {
    /// Its shape, in metres. A box's first edge is not shorter than its second.
    pub model: Model,
    /// The middle of its bounding box, upright on the surface. A box's yaw is within a quarter turn of the region's x axis
    /// (half a turn more looks the same), a fork's x axis points to the tips, what is round has the region's yaw.
    pub pose: Pose,
    /// Of the position in metres² and of a small turn in radians², both along the world's axes: rows and columns x, y, z, and
    /// turns about x, y, z. Of what any turn leaves the same, the yaw's variance is that of an unknown angle.
    pub covariance: [[f64; 6]; 6],
    /// How sure it is that this is an object of this class, 0 to 1: how much of what was measured the model explains, times
    /// how much better it does than the other classes.
    pub confidence: f64,
}

/// Why nothing can be said.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum DetectionError {
    /// The surface is not in the image.
    #[error(
        "no supporting plane in the region: {points} points of it are in the image; look at it, with the arm out of view"
    )]
    NoPlane {
        /// How many points of the region were seen.
        points: usize,
    },
    /// The image and the camera do not fit together.
    #[error("an image of {width} × {height} cannot come from this camera")]
    WrongCamera {
        /// Columns of the image.
        width: usize,
        /// Rows of the image.
        height: usize,
    },
}

/// How much of its cluster a model must explain.
const MIN_EXPLAINED: f64 = 0.7;
/// How badly it may explain what was measured, see `Fit::score`.
const MAX_SCORE: f64 = 0.6;
/// How far apart the middles of two parts of one thing are at the most, in metres.
const MAX_APART: f64 = 0.12;
/// How far around a known object is looked for it, in metres.
const SEARCH_MARGIN: f64 = 0.15;
/// How far a known object may have moved, in metres.
const MAX_DISPLACEMENT: f64 = 0.08;
/// How much the sizes of a known object may differ from what is seen, in metres, and how much of them.
const SIZE_SLACK: (f64, f64) = (0.025, 0.25);
/// A difference of scores by which one class is e times as likely as another.
const SCORE_SCALE: f64 = 0.06;
/// What does not average out over an object's points: noise also decides which of them are told from the surface, and from which
/// side an edge is seen. As a part of one point's deviation along its ray, as measured on random tables.
const COMMON_NOISE: f64 = 0.12;
/// Points, rays beside them, and iterations, to tell what something could be and to say where it is.
const COARSE: (usize, usize, usize) = (140, 60, 8);
const FINE: (usize, usize, usize) = (500, 200, 9);

/// Every object of these classes on the surface, those nearest to the camera first. `body` is where the robot is itself.
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
    let mut found = objects_on(image, camera, region, classes, body)?;
    let eye = camera.pose.position;
    // To the centimetre, then by y: what noise tells apart is not told apart.
    let key = |object: &Detection| {
        let [x, y, _] = object.pose.position;
        (((x - eye[0]).hypot(y - eye[1]) * 100.0).round() as i64, (y * 1000.0).round() as i64)
    };
    found.sort_by_key(key);
    Ok(found)
}

/// What was last seen as `prior`: looks around there for the object of these classes and about that size nearest to it.
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
    let mut found = objects_on(image, camera, &region, classes, body)?;
    found.retain(|object| object.pose.distance(&prior.pose) <= MAX_DISPLACEMENT && alike(prior, object));
    Ok(found.into_iter().min_by(|a, b| a.pose.distance(&prior.pose).total_cmp(&b.pose.distance(&prior.pose))))
}

/// Whether an object could be the one seen before, by its size.
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
) -> Result<Vec<Detection>, DetectionError> {
    let mut view = View::new(image, camera, region, body)?;
    let mut found: Vec<(Fit, Detection)> = Vec::new();
    // Large clusters first: a steep side can come apart from its top, and must not make a second object in the same place.
    let mut fragments = Vec::new();
    for cluster in 0..view.clusters.len() {
        match explanation(&view, cluster, classes) {
            Some((fit, object)) => {
                if !is_taken(&found, &fit) {
                    found.push((fit, object));
                }
            }
            None => fragments.push(cluster),
        }
    }
    // What is hollow comes apart where its far side is seen over its near one.
    for (i, a) in fragments.iter().enumerate() {
        for b in &fragments[i + 1..] {
            let Some(whole) = view.joined(*a, *b, MAX_APART) else { continue };
            if let Some((fit, object)) = explanation(&view, whole, classes)
                && !is_taken(&found, &fit)
            {
                found.push((fit, object));
            }
        }
    }
    Ok(found.into_iter().map(|(_, object)| object).collect())
}

/// Whether something stands there already.
fn is_taken(found: &[(Fit, Detection)], fit: &Fit) -> bool {
    found.iter().any(|(other, _)| other.covers(fit.at()) || fit.covers(other.at()))
}

/// What a cluster is, if a model explains it.
fn explanation(view: &View<'_>, cluster: usize, classes: &[ObjectClass]) -> Option<(Fit, Detection)> {
    let (fit, share) = classify(view, cluster, classes)?;
    let evidence = view.evidence(cluster, FINE.0, FINE.1);
    let fit = fit.refined(&evidence, FINE.2);
    let explained = fit.explains(&evidence);
    if explained < MIN_EXPLAINED || fit.score(&evidence) > MAX_SCORE {
        return None;
    }
    let object = detection(view, &fit, &evidence, explained * share);
    Some((fit, object))
}

/// The model that explains a cluster best, and how likely its class is among those tried.
fn classify(view: &View<'_>, cluster: usize, classes: &[ObjectClass]) -> Option<(Fit, f64)> {
    let evidence = view.evidence(cluster, COARSE.0, COARSE.1);
    let starts = Outline::of(&evidence.points)?.starts(&evidence.points, classes);
    let tried: Vec<(Fit, f64)> = starts
        .into_iter()
        .map(|start| {
            let fit = start.refined(&evidence, COARSE.2);
            let score = fit.score(&evidence);
            (fit, score)
        })
        .collect();
    let (best, score) = tried.iter().min_by(|a, b| a.1.total_cmp(&b.1))?.clone();
    // Of each other class its best fit.
    let rivals: f64 = ObjectClass::ALL
        .into_iter()
        .filter(|class| *class != best.class)
        .filter_map(|class| tried.iter().filter(|(fit, _)| fit.class == class).map(|(_, s)| *s).min_by(f64::total_cmp))
        .map(|rival| ((score - rival) / SCORE_SCALE).exp())
        .sum();
    Some((best, 1.0 / (1.0 + rivals)))
}

fn detection(view: &View<'_>, fit: &Fit, evidence: &Evidence, confidence: f64) -> Detection {
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
    Detection { model, pose: view.frame.compose(&standing), covariance: covariance(view, fit, evidence), confidence }
}

/// The fit's covariance and the plane's together, turned into the world.
fn covariance(view: &View<'_>, fit: &Fit, evidence: &Evidence) -> [[f64; 6]; 6] {
    let planar = fit.covariance(evidence);
    let mut local = [[0.0; 6]; 6];
    // x, y and yaw are the fit's, height and slopes the plane's; half of the height's error is the centre's.
    for (i, row) in [0, 1, 5].into_iter().enumerate() {
        for (j, column) in [0, 1, 5].into_iter().enumerate() {
            local[row][column] = planar.pose[i][j];
        }
    }
    local[2][2] = view.plane_variance[0] + planar.height / 4.0;
    local[3][3] = view.plane_variance[1];
    local[4][4] = view.plane_variance[1];
    let [x, y] = fit.at();
    let away = sub([x, y, 0.0], evidence.eye);
    let common = COMMON_NOISE * evidence.sigma / length(away);
    for (i, row) in local.iter_mut().take(3).enumerate() {
        for (j, entry) in row.iter_mut().take(3).enumerate() {
            *entry += common * common * away[i] * away[j];
        }
    }
    if fit.class.symmetry() == Symmetry::Round {
        // Of an angle of which nothing is known.
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
