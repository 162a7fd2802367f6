//! A fork fitted to the depths of all pixels around it, those that see it and those that see the surface alike.
//!
//! A fork is hardly higher than the noise of a single frame. To tell its points from the surface first, and fit to those, gives
//! away what the rest say and keeps what noise has lifted. Here nothing is told apart: each pixel has the depth that its ray
//! would have if the fork lay there, or the surface's, or at an edge the mean of both with the variance of not knowing which;
//! the fork is where all of them together are likeliest (a matched filter; Turin 1960), by Gauss and Newton. So the inverse of
//! the normal equations is the covariance.

use super::{Covariance, FIRST_DIMENSION, Fit, MAX_PARAMETERS, YAW};
use crate::model::{ObjectClass, Strip};
use crate::normal::Normal;
use crate::vector::Vector;
use std::f64::consts::PI;

/// Depths around a fork, in the frame of the surface.
#[derive(Debug, Clone)]
pub(crate) struct Relief {
    /// Where the camera is.
    pub(crate) eye: Vector,
    /// What was measured.
    pub(crate) depths: Vec<Depth>,
    /// Standard deviation of a depth, in metres.
    pub(crate) sigma: f64,
    /// The distance between neighbouring pixels' rays, in metres.
    pub(crate) pitch: f64,
}

/// What one pixel measured.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Depth {
    /// The ray's direction; times the depth it is the way from the eye.
    pub(crate) way: Vector,
    /// Along the optical axis, in metres.
    pub(crate) depth: f64,
}

/// The steps of numeric derivatives: of place and length in metres, of yaw in radians.
const DIFFERENCE: f64 = 5e-4;
const TURN: f64 = 4e-3;
/// How wide an edge is, in pixels: they are longer on the surface than across their rays.
const EDGE: f64 = 1.5;
/// How much larger variances are than the normal equations say, as measured on random tables, much the same from near, from far and
/// with ten frames: pixels do not see the soft edges that they are compared with.
const EXCESS: f64 = 2.2;
/// A residual beyond so many deviations counts no more than this.
const CUT_OFF: f64 = 4.0;
/// Steps below which it has settled, in metres and radians.
const SETTLED: f64 = 5e-5;
/// The longest step, in metres and radians.
const LONGEST: (f64, f64) = (0.008, 0.06);
/// Where along a fork, and how much longer than it, is tried to begin with; metres, and parts.
const SHIFTS: [f64; 7] = [-0.030, -0.020, -0.010, 0.0, 0.010, 0.020, 0.030];
const LONGER: [f64; 2] = [1.0, 1.12];
/// Place, yaw and length.
const FREE: [bool; MAX_PARAMETERS] = [true, true, true, true, false, false];

impl Relief {
    /// Forks near this one to begin with, the likeliest first: either way round, and along it, since of a fork whose ends are lost in
    /// noise the middle is known badly.
    pub(crate) fn starts(&self, around: &Fit) -> Vec<Fit> {
        let strip = Strip::new();
        let few = Relief { depths: self.depths.iter().step_by(3).copied().collect(), ..*self };
        let (sin, cos) = around.yaw().sin_cos();
        let mut starts: Vec<(f64, Fit)> = Vec::new();
        for turn in [0.0, PI] {
            for along in SHIFTS {
                for longer in LONGER {
                    let mut start = around.turned(turn);
                    start.parameters[0] += along * cos;
                    start.parameters[1] += along * sin;
                    start.parameters[FIRST_DIMENSION] *= longer;
                    let start = start.bounded();
                    starts.push((few.cost(&few.expected(&strip, &start)), start));
                }
            }
        }
        starts.sort_by(|a, b| a.0.total_cmp(&b.0));
        starts.into_iter().map(|(_, start)| start).collect()
    }

    /// The fork near this one that is likeliest, how badly it explains the depths (the mean square of their residuals by their
    /// variance, and that variance's logarithm), and how uncertain it is.
    pub(crate) fn refined(&self, start: Fit, iterations: usize) -> (Fit, f64, Covariance) {
        debug_assert_eq!(start.class, ObjectClass::Fork);
        let strip = Strip::new();
        let (mut here, mut damping) = (start, 1e-3);
        let mut expected = self.expected(&strip, &here);
        let mut cost = self.cost(&expected);
        let mut normal = self.normal(&strip, &here, &expected);
        for _ in 0..iterations {
            let Some(step) = normal.step(&FREE.map(|free| !free), damping) else { break };
            let mut next = here.clone();
            for (i, (parameter, step)) in next.parameters.iter_mut().zip(step).enumerate() {
                let longest = if i == YAW { LONGEST.1 } else { LONGEST.0 };
                *parameter -= step.clamp(-longest, longest);
            }
            let next = next.bounded();
            let next_expected = self.expected(&strip, &next);
            let next_cost = self.cost(&next_expected);
            if next_cost < cost {
                let gained = cost - next_cost;
                let moved = here.parameters.iter().zip(next.parameters).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
                (here, expected, cost) = (next, next_expected, next_cost);
                normal = self.normal(&strip, &here, &expected);
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
        let inverse = normal.inverse(&FREE.map(|free| !free)).unwrap_or(unknown);
        let pose = std::array::from_fn(|row| std::array::from_fn(|column| EXCESS * inverse[row][column]));
        // Its height follows its length.
        let grows = here.model().size()[2] / here.parameters[FIRST_DIMENSION];
        let height = EXCESS * inverse[FIRST_DIMENSION][FIRST_DIMENSION] * grows * grows;
        (here, cost / self.depths.len().max(1) as f64, Covariance { pose, height })
    }

    /// The depth of each pixel and its variance, if the fork lay so.
    fn expected(&self, strip: &Strip, fit: &Fit) -> Vec<(f64, f64)> {
        let length = fit.parameters[FIRST_DIMENSION];
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

    fn cost(&self, expected: &[(f64, f64)]) -> f64 {
        let square = |(depth, (mean, variance)): (&Depth, &(f64, f64))| {
            ((depth.depth - mean).powi(2) / variance).min(CUT_OFF * CUT_OFF)
                + (variance / (self.sigma * self.sigma)).ln()
        };
        self.depths.iter().zip(expected).map(square).sum()
    }

    fn normal(&self, strip: &Strip, here: &Fit, expected: &[(f64, f64)]) -> Normal {
        let slopes: Vec<Vec<f64>> = (0..=FIRST_DIMENSION)
            .map(|i| {
                let step = if i == YAW { TURN } else { DIFFERENCE };
                let mut next = here.clone();
                next.parameters[i] += step;
                self.expected(strip, &next)
                    .iter()
                    .zip(expected)
                    .map(|(there, here)| (there.0 - here.0) / step)
                    .collect()
            })
            .collect();
        let mut normal = Normal::default();
        for (i, (depth, (mean, variance))) in self.depths.iter().zip(expected).enumerate() {
            let residual = mean - depth.depth;
            if residual * residual > CUT_OFF * CUT_OFF * variance {
                continue;
            }
            let slope = std::array::from_fn(|k| slopes.get(k).map_or(0.0, |slopes| slopes[i]));
            if slope != [0.0; MAX_PARAMETERS] {
                normal.add(&slope, residual, 1.0 / variance);
            }
        }
        normal
    }
}
