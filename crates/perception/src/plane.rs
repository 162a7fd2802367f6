//! The supporting plane: RANSAC (Fischler and Bolles 1981) over points of the region, then least squares over its inliers.
//!
//! Points are in the region's frame, whose z axis is roughly the plane's normal: the plane is a height field.

use crate::vector::{Vector, cross, length, scale, sub};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ratn_model::pose::Pose;

/// `z = slope_x · x + slope_y · y + height`
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Plane {
    pub(crate) slope_x: f64,
    pub(crate) slope_y: f64,
    pub(crate) height: f64,
}

/// Number of samples of three points.
const ATTEMPTS: usize = 80;
/// Maximum number of points that vote; more are thinned out evenly.
const VOTERS: usize = 1500;
/// Maximum distance of an inlier from the plane, in metres.
const INLIER: f64 = 0.008;
/// Maximum slope of the plane in the region's frame.
const MAX_SLOPE: f64 = 0.1;
/// Standard deviation of that slope: what leads from one surface down to another is steeper.
const SLOPE_DEVIATION: f64 = 0.03;
/// Minimum number of inliers.
const MIN_INLIERS: usize = 40;

impl Plane {
    /// Height of a point above the plane.
    pub(crate) fn above(&self, p: Vector) -> f64 {
        p[2] - self.at(p[0], p[1])
    }

    /// The plane's height at a point.
    pub(crate) fn at(&self, x: f64, y: f64) -> f64 {
        self.slope_x * x + self.slope_y * y + self.height
    }

    /// Its frame: above the origin, z along the normal.
    pub(crate) fn frame(&self) -> Pose {
        let n = scale([-self.slope_x, -self.slope_y, 1.0], 1.0 / self.slope_x.hypot(self.slope_y).hypot(1.0));
        // Half-way between z and the normal, doubled.
        let quaternion = [-n[1], n[0], 0.0, 1.0 + n[2]];
        let norm = quaternion.iter().map(|q| q * q).sum::<f64>().sqrt();
        Pose { position: [0.0, 0.0, self.height], quaternion_xyzw: quaternion.map(|q| q / norm) }
    }

    /// The plane with the most inliers, weighted down the steeper it is and the farther it is from z = 0: by a normal distribution with this
    /// standard deviation, in metres. So of two surfaces the intended one is found, and a single one is found anyway.
    pub(crate) fn find(points: &[Vector], deviation: f64, seed: u64) -> Option<Plane> {
        let stride = points.len().div_ceil(VOTERS).max(1);
        let voters: Vec<Vector> = points.iter().step_by(stride).copied().collect();
        if voters.len() < MIN_INLIERS {
            return None;
        }
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut best: Option<(f64, Plane)> = None;
        // Every other sample is drawn from points near the expected plane, which may be a small part of the view.
        let near: Vec<Vector> = voters.iter().filter(|p| p[2].abs() < 2.0 * deviation).copied().collect();
        for attempt in 0..ATTEMPTS {
            let from = if attempt % 2 == 0 && near.len() >= MIN_INLIERS { &near } else { &voters };
            let mut pick = || from[random.random_range(0..from.len())];
            let Some(plane) = Plane::through(pick(), pick(), pick()) else { continue };
            let votes = voters.iter().filter(|p| plane.above(**p).abs() < INLIER).count();
            let slope = plane.slope_x.hypot(plane.slope_y) / SLOPE_DEVIATION;
            let worth = votes as f64 * (-0.5 * ((plane.height / deviation).powi(2) + slope * slope)).exp();
            if votes >= MIN_INLIERS && best.is_none_or(|(most, _)| worth > most) {
                best = Some((worth, plane));
            }
        }
        let (_, mut plane) = best?;
        for _ in 0..2 {
            let inliers = points.iter().copied().filter(|p| plane.above(*p).abs() < INLIER);
            plane = Plane::least_squares(inliers).unwrap_or(plane);
        }
        Some(plane)
    }

    fn through(a: Vector, b: Vector, c: Vector) -> Option<Plane> {
        let normal = cross(sub(b, a), sub(c, a));
        let area = length(normal);
        if area < 1e-4 {
            return None;
        }
        let n = scale(normal, 1.0 / area);
        if n[2].abs() < 0.5 {
            return None;
        }
        let (slope_x, slope_y) = (-n[0] / n[2], -n[1] / n[2]);
        (slope_x.hypot(slope_y) < MAX_SLOPE).then(|| Plane {
            slope_x,
            slope_y,
            height: a[2] - slope_x * a[0] - slope_y * a[1],
        })
    }

    fn least_squares(points: impl Iterator<Item = Vector> + Clone) -> Option<Plane> {
        let (mut n, mut mean) = (0.0, [0.0; 3]);
        for p in points.clone() {
            n += 1.0;
            for axis in 0..3 {
                mean[axis] += p[axis];
            }
        }
        let mean = scale(mean, 1.0 / n);
        let (mut xx, mut xy, mut yy, mut xz, mut yz) = (0.0, 0.0, 0.0, 0.0, 0.0);
        for p in points {
            let [x, y, z] = sub(p, mean);
            xx += x * x;
            xy += x * y;
            yy += y * y;
            xz += x * z;
            yz += y * z;
        }
        let determinant = xx * yy - xy * xy;
        (determinant > 1e-9).then(|| {
            let slope_x = (xz * yy - yz * xy) / determinant;
            let slope_y = (yz * xx - xz * xy) / determinant;
            Plane { slope_x, slope_y, height: mean[2] - slope_x * mean[0] - slope_y * mean[1] }
        })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    #[test]
    fn a_plane_is_found_among_points_that_are_not_on_it() {
        let truth = Plane { slope_x: 0.01, slope_y: -0.02, height: 0.003 };
        let grid = (0..1600).map(|i| (f64::from(i % 40) / 40.0, f64::from(i / 40) / 40.0));
        let points: Vec<Vector> =
            grid.map(|(x, y)| [x, y, if (x * 7.0 + y * 5.0) % 1.0 < 0.35 { 0.09 } else { truth.at(x, y) }]).collect();
        let found = Plane::find(&points, 0.02, 5).unwrap();
        assert!((found.at(0.5, 0.5) - truth.at(0.5, 0.5)).abs() < 1e-6);
        assert!((found.slope_x - truth.slope_x).abs() < 1e-6);
    }

    #[test]
    fn its_frame_lies_on_it() {
        let plane = Plane { slope_x: 0.03, slope_y: -0.05, height: 0.2 };
        let frame = plane.frame();
        for place in [[0.0, 0.0], [0.5, 0.0], [0.0, 0.5]] {
            assert!(plane.above(frame.transform([place[0], place[1], 0.0])).abs() < 1e-12);
        }
    }

    #[test]
    fn three_points_are_not_a_plane() {
        assert_eq!(Plane::find(&[[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], 0.02, 0), None);
    }

    #[test]
    fn of_two_surfaces_the_one_that_is_meant_is_found_and_one_alone_is_found_anywhere() {
        // A board, 5 cm above the rest, that covers a quarter of the view.
        let grid = (0..1600).map(|i| (f64::from(i % 40) / 40.0, f64::from(i / 40) / 40.0));
        let points: Vec<Vector> = grid.map(|(x, y)| [x, y, if x < 0.25 { 0.0 } else { -0.05 }]).collect();
        assert!(Plane::find(&points, 0.01, 5).unwrap().height.abs() < 1e-6);
        let alone: Vec<Vector> = points.into_iter().filter(|p| p[2] < 0.0).collect();
        assert!((Plane::find(&alone, 0.01, 5).unwrap().height + 0.05).abs() < 1e-6);
    }
}
