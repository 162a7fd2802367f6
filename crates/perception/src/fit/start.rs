//! Initial values of a fit: the cluster's principal axes seen from above, and its height.

use super::Fit;
use crate::model::ObjectClass;
use crate::quantile::{median, quantile};
use crate::rectangle;
use crate::vector::Vector;
use std::f64::consts::PI;

/// Summary of a cluster, in metres.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Outline {
    /// The centre of its extents along the principal axes.
    middle: [f64; 2],
    /// The direction of the longer axis.
    yaw: f64,
    /// Extents along the longer and the shorter axis.
    extent: [f64; 2],
    /// Its height.
    height: f64,
}

/// Part of the points left out at each end of an extent, as outliers.
const TAIL: f64 = 0.005;
/// Tolerance of a visible extent against its class's range, as a part of it: objects may be partly hidden or blurred.
const SLACK: f64 = 0.25;
/// Points of the top face are within this of its height, in metres.
const TOP: f64 = 0.010;

/// Minimum visible part of a fork's length.
const FORK_IN_PARTS: f64 = 0.65;
/// Upper part of a round object that has no handle, as a part of its height.
const RING: f64 = 0.15;
/// A handle shifts the centre of the extents by more than this, in metres.
const HANDLE: f64 = 0.006;

impl Outline {
    /// The principal axes of the points seen from above (Pearson 1901), in closed form for two dimensions.
    pub(crate) fn of(points: &[Vector]) -> Option<Outline> {
        let count = points.len() as f64;
        let mean = [0, 1].map(|axis| points.iter().map(|p| p[axis]).sum::<f64>() / count);
        let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
        for p in points {
            let (x, y) = (p[0] - mean[0], p[1] - mean[1]);
            xx += x * x;
            xy += x * y;
            yy += y * y;
        }
        let yaw = 0.5 * (2.0 * xy).atan2(xx - yy);
        let (sin, cos) = yaw.sin_cos();
        let mut along: Vec<f64> = points.iter().map(|p| cos * p[0] + sin * p[1]).collect();
        let mut across: Vec<f64> = points.iter().map(|p| cos * p[1] - sin * p[0]).collect();
        let span = |values: &mut Vec<f64>| Some((quantile(values, TAIL)?, quantile(values, 1.0 - TAIL)?));
        let (a, b) = (span(&mut along)?, span(&mut across)?);
        let (u, v) = ((a.0 + a.1) / 2.0, (b.0 + b.1) / 2.0);
        let mut heights: Vec<f64> = points.iter().map(|p| p[2]).collect();
        Some(Outline {
            middle: [cos * u - sin * v, sin * u + cos * v],
            yaw,
            extent: [a.1 - a.0, b.1 - b.0],
            height: quantile(&mut heights, 0.97)?,
        })
    }

    /// Initial fits of the classes that are possible for this outline.
    pub(crate) fn starts(&self, points: &[Vector], classes: &[ObjectClass]) -> Vec<Fit> {
        classes.iter().filter(|class| self.could_be(**class)).flat_map(|class| self.starts_of(*class, points)).collect()
    }

    fn could_be(&self, class: ObjectClass) -> bool {
        let ranges = class.ranges();
        let within = |value: f64, low: f64, high: f64| value > low * (1.0 - SLACK) && value < high * (1.0 + SLACK);
        let [long, short] = self.extent;
        match class {
            ObjectClass::Box => within(self.height, *ranges[2].start(), *ranges[2].end()) && long > *ranges[0].start(),
            ObjectClass::Fork => {
                // The head and the handle may be separated where the bow is as low as the noise.
                within(long, FORK_IN_PARTS * ranges[0].start(), *ranges[0].end())
                    && short < 0.4 * long
                    && self.height < 0.035
            }
            _ => {
                within(long, 2.0 * ranges[0].start(), 2.0 * ranges[0].end())
                    && within(self.height, *ranges[1].start(), *ranges[1].end())
            }
        }
    }

    fn starts_of(&self, class: ObjectClass, points: &[Vector]) -> Vec<Fit> {
        let [long, short] = self.extent;
        match class {
            ObjectClass::Box => {
                let by_axes = Fit::new(class, self.middle, self.yaw, &[long, short, self.height]);
                [self.top_rectangle(points), Some(by_axes)].into_iter().flatten().collect()
            }
            ObjectClass::Fork => [0.0, PI].map(|turn| Fit::new(class, self.middle, self.yaw + turn, &[long])).to_vec(),
            _ => {
                let by_axes = Fit::new(class, self.middle, 0.0, &[long / 2.0, self.height]);
                let by_top = self.top_ring(points).filter(|(at, _)| {
                    (at[0] - self.middle[0]).hypot(at[1] - self.middle[1]) > HANDLE || class == ObjectClass::Cup
                });
                let by_top = by_top.map(|(at, radius)| Fit::new(class, at, 0.0, &[radius, self.height]));
                [Some(by_axes), by_top].into_iter().flatten().collect()
            }
        }
    }

    /// The circle at the top of a round object: the centre of the extents there, and half of them. A handle is lower.
    fn top_ring(&self, points: &[Vector]) -> Option<([f64; 2], f64)> {
        let top = points.iter().filter(|p| p[2] > (1.0 - RING) * self.height);
        let along = |axis: usize| {
            let mut at: Vec<f64> = top.clone().map(|p| p[axis]).collect();
            Some((quantile(&mut at, TAIL)?, quantile(&mut at, 1.0 - TAIL)?))
        };
        let (x, y) = (along(0)?, along(1)?);
        Some(([(x.0 + x.1) / 2.0, (y.0 + y.1) / 2.0], (x.1 - x.0).max(y.1 - y.0) / 2.0))
    }

    /// The rectangle of least area around a box's top face: for a square face the principal axes do not determine the
    /// yaw.
    fn top_rectangle(&self, points: &[Vector]) -> Option<Fit> {
        let mut upper: Vec<f64> = points.iter().map(|p| p[2]).filter(|h| *h > self.height - TOP).collect();
        let height = median(&mut upper)?;
        let top: Vec<[f64; 2]> = points.iter().filter(|p| (p[2] - height).abs() < TOP).map(|p| [p[0], p[1]]).collect();
        let rectangle = rectangle::least_area(&top)?;
        let [a, b] = rectangle.size;
        Some(Fit::new(ObjectClass::Box, rectangle.centre, rectangle.yaw, &[a, b, height]))
    }
}
