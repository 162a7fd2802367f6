//! The fastest way to follow a path within limits of velocity and acceleration: time-optimal path parameterisation by
//! reachability analysis (Pham and Pham, *A New Approach to Time-Optimal Path Parameterization Based on Reachability Analysis*,
//! IEEE Transactions on Robotics, 2018).
//!
//! On a grid of s the state is x = ṡ² and the control u = s̈, which is constant between two points: x grows by 2 Δ u. A backward
//! sweep finds the greatest x at each point from which rest at the end can be reached; a forward sweep takes the greatest u that
//! stays below. The acceleration limits hold at both ends of every step.

use super::path::Derivatives;

/// The path's derivatives at the points of a grid.
pub(crate) struct Grid<const N: usize> {
    pub(crate) s: Vec<f64>,
    pub(crate) points: Vec<Derivatives<N>>,
}

/// `sign · α u + β x ≤ limit`, as bounds of u that depend on x.
struct Lines<const N: usize> {
    /// α, β and the limit, which holds for both signs.
    rows: Vec<(f64, f64, f64)>,
    greatest: f64,
}

/// A joint that moves less than this part of the others' motion is ignored.
const NEGLIGIBLE: f64 = 1e-9;

/// ṡ² at every point of the grid, zero at both ends; `fastest` is the maximum of ṡ at each point.
pub(crate) fn squares<const N: usize>(
    grid: &Grid<N>,
    fastest: &[f64],
    velocities: &[f64; N],
    accelerations: &[f64; N],
) -> Vec<f64> {
    let last = grid.s.len() - 1;
    let mut steps: Vec<Lines<N>> = (0..last).map(|i| Lines::new(grid, i, velocities, accelerations)).collect();
    for (step, fastest) in steps.iter_mut().zip(fastest) {
        step.greatest = step.greatest.min(fastest.powi(2));
    }
    let mut greatest = vec![0.0; last + 1];
    for i in (0..last).rev() {
        greatest[i] = steps[i].greatest_square(grid.s[i + 1] - grid.s[i], greatest[i + 1]);
    }
    let mut squares = vec![0.0; last + 1];
    for i in 0..last {
        let step = grid.s[i + 1] - grid.s[i];
        let (_, (up, slope)) = steps[i].bounds(squares[i], step, greatest[i + 1]);
        let next = squares[i] + 2.0 * step * (up + slope * squares[i]);
        squares[i + 1] = next.clamp(0.0, greatest[i + 1]);
    }
    squares
}

impl<const N: usize> Lines<N> {
    fn new(grid: &Grid<N>, i: usize, velocities: &[f64; N], accelerations: &[f64; N]) -> Lines<N> {
        let (here, next, step) = (&grid.points[i], &grid.points[i + 1], grid.s[i + 1] - grid.s[i]);
        let mut greatest = f64::INFINITY;
        let mut rows = Vec::with_capacity(2 * N);
        for j in 0..N {
            let fastest = (velocities[j] / here.first[j].abs().max(NEGLIGIBLE)).powi(2);
            greatest = greatest.min(fastest);
            let ends = [(here.first[j], here.second[j]), (next.first[j] + 2.0 * step * next.second[j], next.second[j])];
            for (alpha, beta) in ends {
                if alpha.abs() < NEGLIGIBLE {
                    greatest = greatest.min(accelerations[j] / beta.abs().max(NEGLIGIBLE));
                } else {
                    rows.push((alpha.abs(), beta * alpha.signum(), accelerations[j]));
                }
            }
        }
        Lines { rows, greatest }
    }

    /// The active lower and upper bounds of u at x, each as a line over x: its value at 0 and its slope.
    fn bounds(&self, x: f64, step: f64, next: f64) -> ((f64, f64), (f64, f64)) {
        // 0 ≤ x + 2 Δ u ≤ next
        let slope = -0.5 / step;
        let (mut low, mut high) = ((0.0, slope), (next * 0.5 / step, slope));
        let (mut lower, mut upper) = (slope * x, high.0 + slope * x);
        for (alpha, beta, limit) in &self.rows {
            let slope = -beta / alpha;
            let room = limit / alpha;
            if slope * x - room > lower {
                (lower, low) = (slope * x - room, (-room, slope));
            }
            if slope * x + room < upper {
                (upper, high) = (slope * x + room, (room, slope));
            }
        }
        (low, high)
    }

    /// The greatest x for which a u exists: where the lower bound of u, which is convex, meets the upper one, which is concave.
    fn greatest_square(&self, step: f64, next: f64) -> f64 {
        let mut x = self.greatest;
        for _ in 0..4 * N + 8 {
            let (low, high) = self.bounds(x, step, next);
            if low.0 + low.1 * x <= high.0 + high.1 * x + 1e-12 {
                return x;
            }
            // The two lines that cross here meet at a smaller x; no greater x is feasible.
            x = ((high.0 - low.0) / (low.1 - high.1)).max(0.0);
        }
        x
    }
}
