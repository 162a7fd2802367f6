//! Normal equations of small least-squares problems, solved by Cholesky decomposition.

use std::collections::BTreeMap;

/// Maximum number of unknowns.
pub(crate) const N: usize = 9;

/// Blocks of neighbouring residuals that share an error of known variance in addition to their own. For each block: the sum of the weights,
/// and the weighted sums of slopes and residuals.
#[derive(Debug, Clone, Default)]
pub(crate) struct Blocks {
    sums: BTreeMap<[i32; 3], Shared>,
}

#[derive(Debug, Clone, Default)]
struct Shared {
    weight: f64,
    residual: f64,
    slope: [f64; N],
}

impl Blocks {
    pub(crate) fn add(&mut self, block: [i32; 3], slope: &[f64; N], residual: f64, weight: f64) {
        let sums = self.sums.entry(block).or_default();
        sums.weight += weight;
        sums.residual += weight * residual;
        for (sum, slope) in sums.slope.iter_mut().zip(slope) {
            *sum += weight * slope;
        }
    }

    /// The decrease of the sum of squares if the blocks' shared errors have this variance.
    pub(crate) fn relief(&self, variance: f64) -> f64 {
        self.sums.values().map(|block| block.residual.powi(2) * block.gain(variance)).sum()
    }
}

impl Shared {
    /// The inverse of `1 / variance + Σ w`: the part of a block's sums that is its shared error (Sherman and Morrison 1950).
    fn gain(&self, variance: f64) -> f64 {
        variance / (1.0 + variance * self.weight)
    }
}

/// `Jᵀ W J` and `Jᵀ W r`.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Normal {
    matrix: [[f64; N]; N],
    right: [f64; N],
}

impl Normal {
    /// Adds a residual with its derivatives.
    pub(crate) fn add(&mut self, slope: &[f64; N], residual: f64, weight: f64) {
        for (row, entries) in self.matrix.iter_mut().enumerate() {
            let weighted = weight * slope[row];
            for (entry, other) in entries.iter_mut().zip(slope).take(row + 1) {
                *entry += weighted * other;
            }
            self.right[row] += weighted * residual;
        }
    }

    /// Accounts for shared errors of this variance in blocks of the residuals.
    pub(crate) fn with_shared(mut self, blocks: &Blocks, variance: f64) -> Normal {
        for block in blocks.sums.values() {
            let gain = block.gain(variance);
            self.add(&block.slope, block.residual, -gain);
        }
        self
    }

    /// Adds a prior to an unknown; `residual` is the unknown minus its expected value.
    pub(crate) fn expect(&mut self, unknown: usize, residual: f64, weight: f64) {
        self.matrix[unknown][unknown] += weight;
        self.right[unknown] += weight * residual;
    }

    /// The step to subtract, with the diagonal increased by a part of itself (Marquardt 1963). `None` where the equations are singular.
    pub(crate) fn step(&self, fixed: &[bool; N], damping: f64) -> Option<[f64; N]> {
        let factor = self.factor(fixed, damping)?;
        let mut right = self.right;
        for (value, fixed) in right.iter_mut().zip(fixed) {
            if *fixed {
                *value = 0.0;
            }
        }
        Some(solve(&factor, right))
    }

    /// The inverse of the matrix; rows and columns of fixed unknowns are those of the identity.
    pub(crate) fn inverse(&self, fixed: &[bool; N]) -> Option<[[f64; N]; N]> {
        let factor = self.factor(fixed, 1e-9)?;
        Some(std::array::from_fn(|i| solve(&factor, std::array::from_fn(|j| f64::from(u8::from(i == j))))))
    }

    fn factor(&self, fixed: &[bool; N], damping: f64) -> Option<[[f64; N]; N]> {
        let mut factor = [[0.0; N]; N];
        for row in 0..N {
            for column in 0..=row {
                let entry = if fixed[row] || fixed[column] {
                    f64::from(u8::from(row == column))
                } else if row == column {
                    self.matrix[row][row] * (1.0 + damping) + f64::MIN_POSITIVE
                } else {
                    self.matrix[row][column]
                };
                let sum = entry - (0..column).map(|k| factor[row][k] * factor[column][k]).sum::<f64>();
                if row == column {
                    if sum.is_nan() || sum <= 0.0 {
                        return None;
                    }
                    factor[row][row] = sum.sqrt();
                } else {
                    factor[row][column] = sum / factor[column][column];
                }
            }
        }
        Some(factor)
    }
}

fn solve(factor: &[[f64; N]; N], mut x: [f64; N]) -> [f64; N] {
    for row in 0..N {
        for k in 0..row {
            x[row] -= factor[row][k] * x[k];
        }
        x[row] /= factor[row][row];
    }
    for row in (0..N).rev() {
        for k in row + 1..N {
            x[row] -= factor[k][row] * x[k];
        }
        x[row] /= factor[row][row];
    }
    x
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    #[test]
    fn an_error_that_a_block_shares_is_no_measurement_of_each_of_its_residuals() {
        // Twenty residuals of one unknown, all in one block: the variance is that of the shared error, plus that of the mean of their own
        // errors.
        let (mut normal, mut blocks) = (Normal::default(), Blocks::default());
        let slope: [f64; N] = std::array::from_fn(|i| f64::from(u8::from(i == 0)));
        for i in 0..20 {
            normal.add(&slope, 0.1 * f64::from(i), 4.0);
            blocks.add([0; 3], &slope, 0.1 * f64::from(i), 4.0);
        }
        let fixed = std::array::from_fn(|i| i != 0);
        let variance = |shared: f64| normal.with_shared(&blocks, shared).inverse(&fixed).unwrap()[0][0];
        assert!((variance(0.0) - 1.0 / 80.0).abs() < 1e-9 && (variance(0.5) - 0.5 - 1.0 / 80.0).abs() < 1e-9);
        // Nothing separates the shared error from the unknown, so the solution is still the mean.
        let step = normal.with_shared(&blocks, 0.5).step(&fixed, 0.0).unwrap();
        assert!((step[0] - 0.95).abs() < 1e-9, "{step:?}");
    }

    #[test]
    fn a_linear_problem_is_solved_in_one_step_and_fixed_unknowns_stay() {
        let truth = [1.0, -2.0, 0.0, 0.5, 3.0, 0.0, -1.0, 2.0, 0.25];
        let fixed = [false, false, true, false, false, true, false, false, false];
        let mut normal = Normal::default();
        for i in 0..40 {
            let slope: [f64; N] = std::array::from_fn(|k| ((i * (k + 2)) as f64 * 0.37).sin());
            let residual: f64 = slope.iter().zip(truth).map(|(s, t)| s * t).sum();
            normal.add(&slope, residual, 2.0);
        }
        let step = normal.step(&fixed, 0.0).unwrap();
        assert!(step.iter().zip(truth).all(|(s, t)| (s - t).abs() < 1e-9), "{step:?}");
        let inverse = normal.inverse(&fixed).unwrap();
        assert!((inverse[2][2] - 1.0).abs() < 1e-9 && inverse[0][2].abs() < 1e-12);
        assert!(Normal::default().step(&fixed, 1e-3).is_none() || Normal::default().right == [0.0; N]);
    }
}
