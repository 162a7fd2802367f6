//! The cubic spline through given positions at given times, from rest to rest: position, velocity and acceleration are
//! continuous, velocity and acceleration are zero at both ends, jerk is constant from knot to knot.
//!
//! Two positions may deviate: at the second and the last but one the spline passes where it needs to.

use crate::trajectory::Knot;

/// The knots of the spline; there have to be at least six.
pub(crate) fn through<const N: usize>(times: &[f64], positions: &[[f64; N]]) -> Vec<Knot<[f64; N]>> {
    let n = times.len() - 1;
    let h: Vec<f64> = times.windows(2).map(|pair| pair[1] - pair[0]).collect();
    let (first, last) = (h[0], h[n - 1]);
    // A tridiagonal system for the accelerations at the knots 1 to n − 1.
    let mut below = vec![0.0; n + 1];
    let mut on = vec![0.0; n + 1];
    let mut above = vec![0.0; n + 1];
    let mut right = vec![[0.0; N]; n + 1];
    for i in 1..n {
        below[i] = h[i - 1] / 6.0;
        on[i] = (h[i - 1] + h[i]) / 3.0;
        above[i] = h[i] / 6.0;
    }
    // q₁ = q₀ + h² a₁ / 6 from rest, and the same at the end.
    on[1] += first * first / (6.0 * h[1]) + first / 6.0;
    below[2] -= first * first / (6.0 * h[1]);
    on[n - 1] += last * last / (6.0 * h[n - 2]) + last / 6.0;
    above[n - 2] -= last * last / (6.0 * h[n - 2]);
    // The two free positions are replaced by the ends beside them.
    let fixed = |i: usize| match i {
        1 => &positions[0],
        i if i == n - 1 => &positions[n],
        i => &positions[i],
    };
    let slope = |i: usize, j: usize| (fixed(i + 1)[j] - fixed(i)[j]) / h[i];
    for (i, right) in right.iter_mut().enumerate().take(n).skip(1) {
        *right = std::array::from_fn(|j| {
            let ahead = if i == n - 1 { 0.0 } else { slope(i, j) };
            let behind = if i == 1 { 0.0 } else { slope(i - 1, j) };
            ahead - behind
        });
    }
    for i in 2..n {
        let factor = below[i] / on[i - 1];
        on[i] -= factor * above[i - 1];
        right[i] = std::array::from_fn(|j| right[i][j] - factor * right[i - 1][j]);
    }
    let mut accelerations = vec![[0.0; N]; n + 1];
    for i in (1..n).rev() {
        accelerations[i] = std::array::from_fn(|j| (right[i][j] - above[i] * accelerations[i + 1][j]) / on[i]);
    }
    let mut positions = positions.to_vec();
    for j in 0..N {
        positions[1][j] = positions[0][j] + first * first * accelerations[1][j] / 6.0;
        positions[n - 1][j] = positions[n][j] + last * last * accelerations[n - 1][j] / 6.0;
    }
    let velocity = |i: usize, j: usize| match i {
        i if i == 0 || i == n => 0.0,
        i => {
            let mean = (positions[i + 1][j] - positions[i][j]) / h[i];
            mean - h[i] * (2.0 * accelerations[i][j] + accelerations[i + 1][j]) / 6.0
        }
    };
    let knot = |i: usize| Knot {
        time_s: times[i],
        positions: positions[i],
        velocities: std::array::from_fn(|j| velocity(i, j)),
    };
    (0..=n).map(knot).collect()
}
