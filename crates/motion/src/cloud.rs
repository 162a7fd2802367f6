//! Clouds of points as obstacles: every point is the centre of a ball, all of one radius.
//!
//! A cloud can be thinned within a bound that is given, and what a camera saw of the robot itself can be left out. Its points are kept by the
//! cells of a grid, so that what is near a shape of the robot is found without looking at all of them.

use crate::exact::Exact;
use crate::inside::Inside;
use crate::mechanism::Mechanism;
use parry3d::math::{Pose as Pose32, Vector};
use parry3d::shape::SharedShape;
use ratn_model::pose::Pose;
use std::collections::BTreeSet;

/// The most points of a cloud.
pub const MAX_POINTS: usize = 4_000_000;

/// The largest radius, in metres.
pub const MAX_RADIUS_M: f64 = 1.0;

/// The least bound of thinning, in metres: `f32` holds what is a kilometre away no better than by 0.06 mm.
pub const LEAST_THINNING_M: f64 = 1e-6;

/// How far from the origin a point may be, in metres.
const FARTHEST_M: f32 = 1e3;

/// Cells at the most, about, and for each point.
const MOST_CELLS: f64 = 262_144.0;
const CELLS_PER_POINT: f64 = 16.0;

/// Why there is no cloud.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CloudError {
    /// Too many.
    #[error("it has {points} points, at most {MAX_POINTS} are supported: thin it first")]
    TooMany {
        /// How many.
        points: usize,
    },
    /// A coordinate that cannot be.
    #[error("point {point} is not finite or beyond a kilometre: drop such points first")]
    NotFinite {
        /// Counted from 0.
        point: usize,
    },
    /// No radius of a ball.
    #[error("the radius of its points is {radius_m} m: expected more than 0, and at most {MAX_RADIUS_M}")]
    Radius {
        /// In metres.
        radius_m: f64,
    },
    /// A cloud cannot be thinned so.
    #[error("the bound of thinning is {bound_m} m: expected 0, or {LEAST_THINNING_M} to {MAX_RADIUS_M}")]
    Thinning {
        /// In metres.
        bound_m: f64,
    },
}

/// Balls of one radius, in the frame of the robot's first link.
#[derive(Debug, Clone, PartialEq)]
pub struct Cloud {
    /// For messages.
    pub name: String,
    radius_m: f64,
    /// By cells.
    points: Vec<[f32; 3]>,
    least: [f32; 3],
    cell: f32,
    counts: [usize; 3],
    /// Per cell, where its points begin.
    starts: Vec<u32>,
}

impl Cloud {
    /// Balls about `points`.
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

    /// The centres of the balls, in an order of its own.
    pub fn points(&self) -> &[[f32; 3]] {
        &self.points
    }

    /// The radius of the balls, in metres.
    pub fn radius_m(&self) -> f64 {
        self.radius_m
    }

    /// Fewer and larger balls that hold all of these and stand out of them by at most `bound_m` metres: of all points in one cell of a grid
    /// one is left. A bound of 0 changes nothing.
    ///
    /// # Errors
    /// [`CloudError::Thinning`] where the bound is no such length, [`CloudError::Radius`] where the balls become too large.
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
        // A little more than the diagonal of a cell, for rounding.
        Cloud::new(&self.name, &points, self.radius_m + bound_m * 1.001)
    }

    /// Without the balls that come within `margin_m` metres of the robot in a posture: what a camera saw of the robot itself.
    ///
    /// # Errors
    /// None that the cloud does not have already.
    pub fn without_robot(&self, mechanism: &Mechanism, positions: &[f64], margin_m: f64) -> Result<Cloud, CloudError> {
        let own = Exact::new(mechanism, &[]).points_near(positions, self, margin_m);
        let points: Vec<[f32; 3]> =
            self.points.iter().enumerate().filter(|(i, _)| !own.contains(i)).map(|(_, point)| *point).collect();
        Cloud::new(&self.name, &points, self.radius_m)
    }

    /// Moved.
    ///
    /// # Errors
    /// [`CloudError::NotFinite`] where points are moved too far.
    pub fn moved(&self, pose: &Pose) -> Result<Cloud, CloudError> {
        let moved = |p: &[f32; 3]| pose.transform(p.map(f64::from)).map(|c| c as f32);
        let points: Vec<[f32; 3]> = self.points.iter().map(moved).collect();
        Cloud::new(&self.name, &points, self.radius_m)
    }

    /// Shows the numbers and places of the points in a box, until it hears that no more are wanted.
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

    /// Shows the points nearer than `within` metres to a shape in its pose, by number, and how far each is from its surface, negative inside,
    /// until it hears that no more are wanted. What is inside a mesh says `inside`; other shapes know it by themselves.
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
