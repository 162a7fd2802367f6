//! Depth image → boxes on a supporting plane.
//!
//! Points of the region → the plane by RANSAC → points above it → Euclidean clusters → one upright box per cluster. What is
//! no box (the arm in the image, a cluster that no box explains) is left out.

use crate::camera::{Camera, DepthImage};
use crate::cluster;
use crate::fit::{Fit, Sight};
use crate::plane::Plane;
use crate::vector::Vector;
use ratn_model::pose::Pose;
use std::f64::consts::{FRAC_PI_2, PI};

/// Where to look: a flat surface on which boxes stand.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Region {
    /// The middle of the surface, its z axis up.
    pub pose: Pose,
    /// Its extents along x and y, in metres.
    pub size: [f64; 2],
}

/// A box as seen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BoxEstimate {
    /// Its centre, upright on the surface; x along its longer horizontal side. Turned by less than a quarter turn either way
    /// from the region's x axis: half a turn more would look the same.
    pub pose: Pose,
    /// Edge lengths in metres; the first is not shorter than the second, the third is the height.
    pub size: [f64; 3],
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

/// How far above or below its given pose the surface may be, in metres.
const PLANE_SLACK: f64 = 0.06;
/// Points up to here belong to the plane, in metres above it.
const CLEAR_OF_PLANE: f64 = 0.014;
/// Nothing taller stands on the surface, in metres.
const TALLEST: f64 = 0.25;
/// A box is seen by at least so many pixels.
const MIN_PIXELS: usize = 30;
/// Pixels around a cluster that take part in the fit.
const WINDOW_MARGIN: usize = 6;
/// How much of its cluster a box must explain.
const MIN_EXPLAINED: f64 = 0.7;
/// How far around a known box is looked for it, in metres.
const SEARCH_MARGIN: f64 = 0.15;
/// How far a known box may have moved, in metres.
const MAX_DISPLACEMENT: f64 = 0.08;
/// RANSAC's choices: any number does; the same image gives the same boxes.
const SEED: u64 = 0x5EED;

/// Every box on the surface, those nearest to the camera first.
///
/// # Errors
/// [`DetectionError`] when the surface is not in the image.
pub fn segment(image: &DepthImage, camera: &Camera, region: &Region) -> Result<Vec<BoxEstimate>, DetectionError> {
    let mut boxes = boxes_on(image, camera, region)?;
    let eye = camera.pose.position;
    // To the centimetre, then by y: what noise tells apart is not told apart.
    let key = |b: &BoxEstimate| {
        let [x, y, _] = b.pose.position;
        (((x - eye[0]).hypot(y - eye[1]) * 100.0).round() as i64, (y * 1000.0).round() as i64)
    };
    boxes.sort_by_key(key);
    Ok(boxes)
}

/// The box that was last seen as `prior`: looks around there for the one nearest to it.
///
/// # Errors
/// [`DetectionError`] when the surface below it is not in the image.
pub fn locate(image: &DepthImage, camera: &Camera, prior: &BoxEstimate) -> Result<Option<BoxEstimate>, DetectionError> {
    let reach = prior.size[0].max(prior.size[1]) + 2.0 * SEARCH_MARGIN;
    let below = Pose::at(0.0, 0.0, -prior.size[2] / 2.0);
    let region = Region { pose: prior.pose.compose(&below), size: [reach, reach] };
    let mut boxes = boxes_on(image, camera, &region)?;
    boxes.retain(|b| b.pose.distance(&prior.pose) <= MAX_DISPLACEMENT);
    Ok(boxes.into_iter().min_by(|a, b| a.pose.distance(&prior.pose).total_cmp(&b.pose.distance(&prior.pose))))
}

fn boxes_on(image: &DepthImage, camera: &Camera, region: &Region) -> Result<Vec<BoxEstimate>, DetectionError> {
    let (width, height) = (image.width, image.height);
    if (width, height) != (camera.intrinsics.width, camera.intrinsics.height) || image.depth.len() != width * height {
        return Err(DetectionError::WrongCamera { width, height });
    }
    let view = View::new(image, camera, region);
    let inside =
        |p: &Vector| p[0].abs() <= region.size[0] / 2.0 && p[1].abs() <= region.size[1] / 2.0 && p[2] < TALLEST;
    let points: Vec<Option<Vector>> = (0..width * height).map(|i| view.point(i).filter(inside)).collect();
    let near: Vec<Vector> = points.iter().flatten().filter(|p| p[2].abs() < PLANE_SLACK).copied().collect();
    let plane = Plane::find(&near, SEED).ok_or(DetectionError::NoPlane { points: near.len() })?;
    let above: Vec<Option<Vector>> =
        points.iter().map(|p| p.filter(|p| (CLEAR_OF_PLANE..TALLEST).contains(&plane.above(*p)))).collect();
    let (clusters, labels) = cluster::clusters(width, height, &above, MIN_PIXELS);
    // Large clusters first: a steep side face can come apart from its top, and must not make a second box in the same place.
    let mut largest_first: Vec<(usize, &Vec<usize>)> = clusters.iter().enumerate().collect();
    largest_first.sort_by_key(|(label, pixels)| (std::cmp::Reverse(pixels.len()), *label));
    let mut fits: Vec<Fit> = Vec::new();
    for (label, pixels) in largest_first {
        let cloud: Vec<Vector> = pixels.iter().filter_map(|i| above[*i]).collect();
        let Some(start) = Fit::of_top_face(&cloud, &plane) else { continue };
        let fit = start.refined(view.eye, &plane, &view.window(pixels, label as u32, &labels));
        let own: Vec<Sight> = pixels.iter().filter_map(|i| view.sight(*i)).collect();
        if fit.explains(view.eye, &own) >= MIN_EXPLAINED && !fits.iter().any(|other| other.covers(fit.centre)) {
            fits.push(fit);
        }
    }
    Ok(fits.iter().map(|fit| estimate(fit, region)).collect())
}

/// The image as seen from the region's frame.
struct View<'a> {
    image: &'a DepthImage,
    camera: &'a Camera,
    /// The camera's optical frame in the region's.
    pose: Pose,
    eye: Vector,
}

impl<'a> View<'a> {
    fn new(image: &'a DepthImage, camera: &'a Camera, region: &Region) -> View<'a> {
        let pose = region.pose.inverse().compose(&camera.pose);
        View { image, camera, eye: pose.position, pose }
    }

    fn direction(&self, pixel: usize) -> Vector {
        self.pose.rotate(self.camera.intrinsics.ray(pixel % self.image.width, pixel / self.image.width))
    }

    fn sight(&self, pixel: usize) -> Option<Sight> {
        let depth = self.image.at(pixel % self.image.width, pixel / self.image.width)?;
        Some(Sight { direction: self.direction(pixel), depth })
    }

    fn point(&self, pixel: usize) -> Option<Vector> {
        let Sight { direction, depth } = self.sight(pixel)?;
        Some([0, 1, 2].map(|axis| self.eye[axis] + direction[axis] * depth))
    }

    /// What is measured around a cluster, without what belongs to another one.
    fn window(&self, pixels: &[usize], label: u32, labels: &[u32]) -> Vec<Sight> {
        let (width, height) = (self.image.width, self.image.height);
        let (mut columns, mut rows) = ((usize::MAX, 0), (usize::MAX, 0));
        for pixel in pixels {
            let (column, row) = (pixel % width, pixel / width);
            columns = (columns.0.min(column), columns.1.max(column));
            rows = (rows.0.min(row), rows.1.max(row));
        }
        let mut window = Vec::new();
        for row in rows.0.saturating_sub(WINDOW_MARGIN)..(rows.1 + WINDOW_MARGIN + 1).min(height) {
            for column in columns.0.saturating_sub(WINDOW_MARGIN)..(columns.1 + WINDOW_MARGIN + 1).min(width) {
                let pixel = row * width + column;
                if labels[pixel] == label || labels[pixel] == cluster::NONE {
                    window.extend(self.sight(pixel));
                }
            }
        }
        window
    }
}

fn estimate(fit: &Fit, region: &Region) -> BoxEstimate {
    let (mut yaw, mut size) = (fit.yaw, fit.size);
    if size[0] < size[1] {
        size.swap(0, 1);
        yaw += FRAC_PI_2;
    }
    yaw = (yaw + FRAC_PI_2).rem_euclid(PI) - FRAC_PI_2;
    let centre = [fit.centre[0], fit.centre[1], fit.base + fit.height / 2.0];
    BoxEstimate {
        pose: region.pose.compose(&Pose::from_rpy(centre, 0.0, 0.0, yaw)),
        size: [size[0], size[1], fit.height],
    }
}
