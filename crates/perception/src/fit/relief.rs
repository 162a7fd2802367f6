//! Fits a fork to the depths of all pixels around it, both those that see the fork and those that see the surface.
//!
//! A fork is hardly higher than the noise of a single frame. Separating its points from the surface first, and fitting to those, loses the
//! information of the others and keeps those that noise has lifted. Here nothing is separated: each pixel is compared with the depth that its ray
//! would have if the fork lay there, or with the surface's depth, or at an edge with the mean of both and the variance of not knowing which. The
//! fit maximizes the likelihood of all depths (a matched filter; Turin 1960), by Gauss and Newton. So the inverse of the normal equations is the
//! covariance.

use super::{Covariance, FIRST_DIMENSION, FIRST_FORM, Fit};
use crate::level;
use crate::model::{ObjectClass, Strip};
use crate::normal::{Blocks, N as MAX_PARAMETERS, Normal};
use crate::vector::Vector;
use std::f64::consts::PI;

/// Depths around a fork, in the frame of the surface.
#[derive(Debug, Clone)]
pub(crate) struct Relief {
    /// Position of the camera.
    pub(crate) eye: Vector,
    /// The measured depths.
    pub(crate) depths: Vec<Depth>,
    /// Standard deviation of a depth, in metres.
    pub(crate) sigma: f64,
    /// Standard deviation of the noise that neighbouring pixels share, in metres.
    pub(crate) shared: f64,
    /// The distance between neighbouring pixels' rays, in metres.
    pub(crate) pitch: f64,
}

/// The measurement of one pixel.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Depth {
    /// The ray's direction; multiplied by the depth, it is the vector from the eye.
    pub(crate) way: Vector,
    /// Along the optical axis, in metres.
    pub(crate) depth: f64,
    /// Its column and row.
    pub(crate) pixel: [i32; 2],
}

/// For each parameter: whether it is fitted, the step of its numeric derivative, and the maximum step of an iteration; in metres, radians, or
/// parts.
const FREE: [(bool, f64, f64); MAX_PARAMETERS] = [
    (true, 5e-4, 0.008),
    (true, 5e-4, 0.008),
    (true, 4e-3, 0.06),
    (true, 5e-4, 0.008),
    (false, 0.0, 0.0),
    (false, 0.0, 0.0),
    (true, 0.02, 0.1),
    (true, 1e-3, 0.004),
    (true, 0.02, 0.1),
];
/// Prior of a fork's length: mean and standard deviation, in metres.
const USUAL_LENGTH: (f64, f64) = (0.19, 0.015);
/// Side of a block of pixels that share noise, in pixels.
const BLOCK: i32 = level::BLOCK as i32;
/// Minimum improvement over the surface alone, as a sum of squared residuals divided by their variance.
const LEAST_GAIN: f64 = 120.0;
/// Factor from the variances of the normal equations to the true ones. Measured on random tables of exact forks, with about the same result from
/// near, from far and with ten frames. The cause: pixels do not see the soft edges that they are compared with.
const EXCESS: f64 = 2.2;
/// Width of an edge, in pixels: edges are wider on the surface than across their rays.
const EDGE: f64 = 1.5;
/// A residual counts at most as this many standard deviations.
const CUT_OFF: f64 = 4.0;
/// A fit has settled when a step is below this, as a part of the maximum step.
const SETTLED: f64 = 0.006;
/// Initial shifts along the fork that are tried, in metres.
const SHIFTS: [f64; 9] = [-0.048, -0.036, -0.024, -0.012, 0.0, 0.012, 0.024, 0.036, 0.048];

impl Relief {
    /// Initial fits near this one, best first: in both directions and shifted along the fork, because the middle of a fork whose ends are lost in
    /// noise is known only roughly.
    pub(crate) fn starts(&self, around: &Fit) -> Vec<Fit> {
        let few = Relief { depths: self.depths.iter().step_by(3).copied().collect(), ..*self };
        let (sin, cos) = around.yaw().sin_cos();
        let mut starts: Vec<(f64, Fit)> = Vec::new();
        for turn in [0.0, PI] {
            for along in SHIFTS {
                for length in [USUAL_LENGTH.0 - USUAL_LENGTH.1, USUAL_LENGTH.0 + USUAL_LENGTH.1] {
                    let mut start = around.turned(turn);
                    start.parameters[0] += along * cos;
                    start.parameters[1] += along * sin;
                    start.parameters[FIRST_DIMENSION] = length;
                    let start = start.bounded();
                    starts.push((few.cost(&start, &few.expected(&start)), start));
                }
            }
        }
        starts.sort_by(|a, b| a.0.total_cmp(&b.0));
        starts.into_iter().map(|(_, start)| start).collect()
    }

    /// The most likely fork near this one, its cost (the sum of squared residuals divided by their variance, plus that variance's logarithm), and
    /// its covariance.
    pub(crate) fn refined(&self, start: Fit, iterations: usize) -> (Fit, f64, Covariance) {
        debug_assert_eq!(start.class, ObjectClass::Fork);
        let (mut here, mut damping) = (start, 1e-3);
        let mut expected = self.expected(&here);
        let mut cost = self.cost(&here, &expected);
        let shared = self.shared.powi(2);
        let mut normal = self.normal(&here, &expected, shared);
        let fixed = FREE.map(|(free, ..)| !free);
        for _ in 0..iterations {
            let Some(step) = normal.step(&fixed, damping) else { break };
            let mut next = here.clone();
            for ((parameter, step), (_, _, longest)) in next.parameters.iter_mut().zip(step).zip(FREE) {
                *parameter -= step.clamp(-longest, longest);
            }
            let next = next.bounded();
            let next_expected = self.expected(&next);
            let next_cost = self.cost(&next, &next_expected);
            if next_cost < cost {
                let gained = cost - next_cost;
                let moved = here.parameters.iter().zip(next.parameters).zip(FREE).filter(|(_, (free, ..))| *free);
                let moved = moved.map(|((a, b), (.., longest))| (a - b).abs() / longest).fold(0.0, f64::max);
                (here, expected, cost) = (next, next_expected, next_cost);
                normal = self.normal(&here, &expected, shared);
                damping = (damping * 0.2_f64).max(1e-6);
                if moved < SETTLED || gained < 0.01 {
                    break;
                }
            } else {
                damping = (damping * 10.0).max(1e-2);
                if damping > 1e4 {
                    break;
                }
            }
        }
        let unknown = std::array::from_fn(|i| std::array::from_fn(|j| if i == j { super::UNKNOWN } else { 0.0 }));
        // Scatter beyond the noise is the fork's deviation from the model, which neighbouring pixels share.
        let unlike = (self.scatter(&expected) - 1.0).max(0.0) * self.sigma.powi(2);
        let normal = self.normal(&here, &expected, self.shared.powi(2) + unlike);
        let covariance = normal.inverse(&fixed).map_or(unknown, |inverse| inverse.map(|row| row.map(|c| EXCESS * c)));
        let pose = std::array::from_fn(|row| std::array::from_fn(|column| covariance[row][column]));
        // Its height is proportional to its length.
        let grows = here.model().size()[2] / here.parameters[FIRST_DIMENSION];
        let height = covariance[FIRST_DIMENSION][FIRST_DIMENSION] * grows * grows;
        (here, cost, Covariance { pose, height })
    }

    /// The mean squared residual divided by its variance.
    fn scatter(&self, expected: &[(f64, f64)]) -> f64 {
        let squares = self
            .depths
            .iter()
            .zip(expected)
            .map(|(depth, (mean, variance))| ((depth.depth - mean).powi(2) / variance).min(CUT_OFF * CUT_OFF));
        squares.sum::<f64>() / self.depths.len().max(1) as f64
    }

    /// Whether a fork with this cost explains the depths better than the surface alone.
    pub(crate) fn shows(&self, cost: f64) -> bool {
        let mut blocks = Blocks::default();
        let square = |depth: &Depth| {
            let residual = depth.depth + self.eye[2] / depth.way[2];
            let square = (residual / self.sigma).powi(2);
            if square < CUT_OFF * CUT_OFF {
                blocks.add(depth.block(), &[0.0; MAX_PARAMETERS], residual, self.sigma.powi(-2));
            }
            square.min(CUT_OFF * CUT_OFF)
        };
        let squares: f64 = self.depths.iter().map(square).sum();
        squares - blocks.relief(self.shared.powi(2)) - cost > LEAST_GAIN
    }

    /// The expected depth of each pixel and its variance, for this fork.
    fn expected(&self, fit: &Fit) -> Vec<(f64, f64)> {
        let (strip, length) = (Strip::new(fit.form()), fit.parameters[FIRST_DIMENSION]);
        let (sin, cos) = fit.yaw().sin_cos();
        let turned =
            |p: Vector| [(cos * p[0] + sin * p[1]) / length, (cos * p[1] - sin * p[0]) / length, p[2] / length];
        let [x, y] = fit.at();
        let eye = turned([self.eye[0] - x, self.eye[1] - y, self.eye[2]]);
        let variance = self.sigma * self.sigma;
        let of = |depth: &Depth| {
            let surface = -self.eye[2] / depth.way[2];
            match strip.met(eye, turned(depth.way), EDGE * self.pitch / length) {
                Some((covered, fork)) => {
                    let mean = surface + covered * (fork - surface);
                    (mean, variance + covered * (1.0 - covered) * (fork - surface).powi(2))
                }
                None => (surface, variance),
            }
        };
        self.depths.iter().map(of).collect()
    }

    fn cost(&self, fit: &Fit, expected: &[(f64, f64)]) -> f64 {
        let mut blocks = Blocks::default();
        let square = |(depth, (mean, variance)): (&Depth, &(f64, f64))| {
            let residual = depth.depth - mean;
            if residual * residual < CUT_OFF * CUT_OFF * variance {
                blocks.add(depth.block(), &[0.0; MAX_PARAMETERS], residual, 1.0 / variance);
            }
            (residual.powi(2) / variance).min(CUT_OFF * CUT_OFF) + (variance / (self.sigma * self.sigma)).ln()
        };
        let squares: f64 = self.depths.iter().zip(expected).map(square).sum();
        let unusual = usual(fit).map(|(_, off, deviation)| (off / deviation).powi(2));
        squares - blocks.relief(self.shared.powi(2)) + unusual.sum::<f64>()
    }

    fn normal(&self, here: &Fit, expected: &[(f64, f64)], shared: f64) -> Normal {
        let slopes: Vec<Option<Vec<f64>>> = (0..MAX_PARAMETERS)
            .map(|i| {
                let (free, step, _) = FREE[i];
                let mut next = here.clone();
                next.parameters[i] += step;
                let along = |there: Vec<(f64, f64)>| {
                    there.iter().zip(expected).map(|(there, here)| (there.0 - here.0) / step).collect()
                };
                free.then(|| along(self.expected(&next)))
            })
            .collect();
        let (mut normal, mut blocks) = (Normal::default(), Blocks::default());
        for (i, (depth, (mean, variance))) in self.depths.iter().zip(expected).enumerate() {
            let residual = mean - depth.depth;
            if residual * residual > CUT_OFF * CUT_OFF * variance {
                continue;
            }
            let slope = std::array::from_fn(|k| slopes[k].as_ref().map_or(0.0, |slopes| slopes[i]));
            if slope != [0.0; MAX_PARAMETERS] {
                normal.add(&slope, residual, 1.0 / variance);
            }
            blocks.add(depth.block(), &slope, residual, 1.0 / variance);
        }
        let mut normal = normal.with_shared(&blocks, shared);
        for (i, off, deviation) in usual(here) {
            normal.expect(i, off, deviation.powi(-2));
        }
        normal
    }
}

impl Depth {
    /// The block of pixels that shares its noise.
    fn block(&self) -> [i32; 3] {
        [self.pixel[0] / BLOCK, self.pixel[1] / BLOCK, 0]
    }
}

/// Parameters with a prior: index, deviation from the mean, and standard deviation.
fn usual(fit: &Fit) -> impl Iterator<Item = (usize, f64, f64)> {
    let length = (FIRST_DIMENSION, fit.parameters[FIRST_DIMENSION] - USUAL_LENGTH.0, USUAL_LENGTH.1);
    let form = fit.form();
    let of_form = ObjectClass::Fork.usual().iter().enumerate();
    of_form.map(move |(i, usual)| (FIRST_FORM + i, form[i] - usual.mean, usual.deviation)).chain([length])
}
