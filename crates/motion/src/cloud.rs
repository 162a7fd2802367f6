//! Point clouds as obstacles: every point is the centre of a sphere, all of one radius.
//!
//! A cloud can be thinned within a given bound, and points on the robot itself can be removed. Points are stored by the cells of a grid, so
//! that those near a shape of the robot are found without visiting all of them.

use crate::exact::Exact;
use crate::inside::Inside;
use crate::mechanism::Mechanism;
use parry3d::math::{Pose as Pose32, Vector};
use parry3d::shape::SharedShape;
use ratn_model::pose::Pose;
use std::collections::BTreeSet;

/// Maximum number of points in a cloud.
pub const MAX_POINTS: usize = 4_000_000;

/// Maximum radius, in metres.
pub const MAX_RADIUS_M: f64 = 1.0;

/// Minimum bound of thinning, in metres: an `f32` resolves only 0.06 mm at a distance of a kilometre.
pub const LEAST_THINNING_M: f64 = 1e-6;

/// Maximum distance of a point from the origin, in metres.
const FARTHEST_M: f32 = 1e3;

/// Approximate maximum number of cells, in total and per point.
const MOST_CELLS: f64 = 262_144.0;
const CELLS_PER_POINT: f64 = 16.0;

/// Why a cloud cannot be made.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CloudError {
    /// Too many points.
    #[error("it has {points} points, at most {MAX_POINTS} are supported: thin it first")]
    TooMany {
        /// Their number.
        points: usize,
    },
    /// A coordinate is not finite or too large.
    #[error("point {point} is not finite or beyond a kilometre: drop such points first")]
    NotFinite {
        /// Index of the point, from 0.
        point: usize,
    },
    /// The radius is out of range.
    #[error("the radius of its points is {radius_m} m: expected more than 0, and at most {MAX_RADIUS_M}")]
    Radius {
        /// In metres.
        radius_m: f64,
    },
    /// The bound of thinning is out of range.
    #[error("the bound of thinning is {bound_m} m: expected 0, or {LEAST_THINNING_M} to {MAX_RADIUS_M}")]
    Thinning {
        /// In metres.
        bound_m: f64,
    },
}

/// Spheres of one radius, in the frame of the robot's first link.
#[derive(Debug, Clone, PartialEq)]
pub struct Cloud {
    /// The name for messages.
    pub name: String,
    radius_m: f64,
    /// Sorted by cell.
    points: Vec<[f32; 3]>,
    least: [f32; 3],
    cell: f32,
    counts: [usize; 3],
    /// For each cell, the index of its first point.
    starts: Vec<u32>,
}

impl Cloud {
    /// Makes spheres with these centres.
    ///
    /// # Errors
    /// [`CloudError`] names the point or the radius.
    pub fn new(name: &str, points: &[[f32; 3]], radius_m: f64) -> Result<Cloud, CloudError> {
        if points.len() > MAX_POINTS {
            return Err(CloudError::TooMany { points: points.len() });
        }
        if !(radius_m > 0.0 && radius_m <= MAX_RADIUS_M) {
            return Err(CloudError::Radius { radius_m });
        }
        let is_wild = |point: &[f32; 3]| point.iter().any(|c| c.is_nan() || c.abs() > FARTHEST_M);
        if let Some(point) = points.iter().position(is_wild) {
            return Err(CloudError::NotFinite { point });
        }
        let side = |i: usize, pick: fn(f32, f32) -> f32| points.iter().map(|p| p[i]).reduce(pick).unwrap_or(0.0);
        let least: [f32; 3] = std::array::from_fn(|i| side(i, f32::min));
        let extents: [f64; 3] = std::array::from_fn(|i| f64::from(side(i, f32::max) - least[i]).max(1e-3));
        let most = MOST_CELLS.min(CELLS_PER_POINT * points.len().max(1) as f64);
        let cell = (extents.iter().product::<f64>() / most).cbrt().max(extents.iter().fold(0.0, |a, b| b.max(a)) / 1e3);
        let counts = extents.map(|e| (e / cell) as usize + 1);
        let cells = counts.iter().product::<usize>();
        let mut cloud = Cloud {
            name: name.to_owned(),
            radius_m,
            points: vec![[0.0; 3]; points.len()],
            least,
            cell: cell as f32,
            counts,
            starts: vec![0; cells + 1],
        };
        for point in points {
            let cell = cloud.index(cloud.slots(point));
            cloud.starts[cell + 1] += 1;
        }
        for cell in 0..cells {
            cloud.starts[cell + 1] += cloud.starts[cell];
        }
        let mut next = cloud.starts.clone();
        for point in points {
            let cell = cloud.index(cloud.slots(point));
            cloud.points[next[cell] as usize] = *point;
            next[cell] += 1;
        }
        Ok(cloud)
    }

    /// The centres of the spheres, in no particular order.
    pub fn points(&self) -> &[[f32; 3]] {
        &self.points
    }

    /// The radius of the spheres, in metres.
    pub fn radius_m(&self) -> f64 {
        self.radius_m
    }

    /// Fewer and larger spheres that contain all of these and protrude by at most `bound_m` metres: one point is kept in each cell of a grid.
    /// A bound of 0 changes nothing.
    ///
    /// # Errors
    /// [`CloudError::Thinning`] where the bound is out of range, [`CloudError::Radius`] where the spheres become too large.
    pub fn thinned(&self, bound_m: f64) -> Result<Cloud, CloudError> {
        if bound_m == 0.0 {
            return Ok(self.clone());
        }
        if !(LEAST_THINNING_M..=MAX_RADIUS_M).contains(&bound_m) {
            return Err(CloudError::Thinning { bound_m });
        }
        let side = bound_m / 3_f64.sqrt();
        let mut taken = BTreeSet::new();
        let is_first = |point: &&[f32; 3]| taken.insert(point.map(|c| (f64::from(c) / side).floor() as i64));
        let points: Vec<[f32; 3]> = self.points.iter().filter(is_first).copied().collect();
        // A little more than the diagonal of a cell, because of rounding.
        Cloud::new(&self.name, &points, self.radius_m + bound_m * 1.001)
    }

    /// Removes the spheres within `margin_m` metres of the robot in a posture: what a camera saw of the robot itself.
    ///
    /// # Errors
    /// No errors beyond those of [`Cloud::new`].
    pub fn without_robot(&self, mechanism: &Mechanism, positions: &[f64], margin_m: f64) -> Result<Cloud, CloudError> {
        let own = Exact::new(mechanism, &[]).points_near(positions, self, margin_m);
        let points: Vec<[f32; 3]> =
            self.points.iter().enumerate().filter(|(i, _)| !own.contains(i)).map(|(_, point)| *point).collect();
        Cloud::new(&self.name, &points, self.radius_m)
    }

    /// Moves the cloud by a pose.
    ///
    /// # Errors
    /// [`CloudError::NotFinite`] where points are moved too far.
    pub fn moved(&self, pose: &Pose) -> Result<Cloud, CloudError> {
        let moved = |p: &[f32; 3]| pose.transform(p.map(f64::from)).map(|c| c as f32);
        let points: Vec<[f32; 3]> = self.points.iter().map(moved).collect();
        Cloud::new(&self.name, &points, self.radius_m)
    }

    /// Passes the index and position of each point in a box to `wants_more`, until that returns false.
    fn visit(&self, least: [f32; 3], greatest: [f32; 3], wants_more: &mut dyn FnMut(usize, [f32; 3]) -> bool) {
        let beyond = |i: usize| {
            let end = self.least[i] + self.counts[i] as f32 * self.cell;
            greatest[i] < self.least[i] || least[i] > end
        };
        if self.points.is_empty() || (0..3).any(beyond) {
            return;
        }
        let (from, to) = (self.slots(&least), self.slots(&greatest));
        for x in from[0]..=to[0] {
            for y in from[1]..=to[1] {
                let first = self.starts[self.index([x, y, from[2]])] as usize;
                let end = self.starts[self.index([x, y, to[2]]) + 1] as usize;
                for (i, point) in self.points[first..end].iter().enumerate() {
                    let is_in = (0..3).all(|i| least[i] <= point[i] && point[i] <= greatest[i]);
                    if is_in && !wants_more(first + i, *point) {
                        return;
                    }
                }
            }
        }
    }

    /// Passes the index of each point nearer than `within` metres to a shape in its pose, and its signed distance from the surface (negative
    /// inside), to `wants_more`, until that returns false. For a mesh, `inside` tells what is inside; other shapes know it themselves.
    pub(crate) fn visit_near(
        &self,
        pose: &Pose32,
        shape: &SharedShape,
        inside: Option<&Inside>,
        within: f32,
        wants_more: &mut dyn FnMut(usize, f32) -> bool,
    ) {
        let around = shape.compute_aabb(pose);
        let reach = Vector::splat(within.max(0.0));
        self.visit((around.mins - reach).into(), (around.maxs + reach).into(), &mut |point, [x, y, z]| {
            let at = pose.inverse_transform_point(Vector::new(x, y, z));
            let projection = shape.project_local_point(at, false);
            let is_inside = match inside {
                Some(inside) => inside.contains([at.x, at.y, at.z].map(f64::from)),
                None => projection.is_inside,
            };
            let gap = (projection.point - at).length() * if is_inside { -1.0 } else { 1.0 };
            gap >= within || wants_more(point, gap)
        });
    }

    fn slots(&self, point: &[f32; 3]) -> [usize; 3] {
        std::array::from_fn(|i| (((point[i] - self.least[i]) / self.cell).max(0.0) as usize).min(self.counts[i] - 1))
    }

    fn index(&self, [x, y, z]: [usize; 3]) -> usize {
        (x * self.counts[1] + y) * self.counts[2] + z
    }
}
