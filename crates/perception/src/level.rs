//! Mean heights over a window around each pixel: noise falls with the window's side, so that flat objects can be separated from the surface.
//! Heights clearly above or below are left out of a mean, because they would spread over their edges.

use crate::quantile::median;

/// Side of the window, in pixels.
pub(crate) const SIDE: usize = 3;

/// The mean around each pixel of the heights within `limit` of the surface; NaN is no height. 0 where there is none.
pub(crate) fn means(heights: &[f32], width: usize, limit: f32) -> Vec<f32> {
    let near = |z: f32| if z.abs() < limit { (z, 1.0) } else { (0.0, 0.0) };
    // Sums along rows, then along columns.
    let mut along: Vec<(f32, f32)> = Vec::with_capacity(heights.len());
    for row in heights.chunks(width) {
        let at = |column: usize| row.get(column).map_or((0.0, 0.0), |z| near(*z));
        let mut left = (0.0, 0.0);
        let mut here = at(0);
        for column in 0..row.len() {
            let right = at(column + 1);
            along.push((left.0 + here.0 + right.0, left.1 + here.1 + right.1));
            (left, here) = (here, right);
        }
    }
    let none = vec![(0.0, 0.0); width];
    let rows: Vec<&[(f32, f32)]> = along.chunks(width).collect();
    let mut means = Vec::with_capacity(heights.len());
    for (i, here) in rows.iter().enumerate() {
        let before = i.checked_sub(1).map_or(&none[..], |i| rows[i]);
        let after = rows.get(i + 1).copied().unwrap_or(&none);
        means.extend(
            here.iter().zip(before).zip(after).map(|((a, b), c)| (a.0 + b.0 + c.0) / (a.1 + b.1 + c.1).max(1.0)),
        );
    }
    means
}

/// Side of a block of pixels that share noise, where a camera's noise is smooth.
pub(crate) const BLOCK: usize = 8;
/// Minimum number of pairs of blocks for an estimate.
const LEAST_PAIRS: usize = 24;

/// The standard deviation of the noise that heights share in a block, apart from their own noise `sigma`. Estimated from the means of blocks
/// that lie on the surface entirely, two blocks apart so that slopes and errors of the surface hardly count. 0 where there are too few.
pub(crate) fn shared(heights: &[f32], width: usize, limit: f32, sigma: f64) -> f64 {
    let columns = width / BLOCK;
    let mean = |row: usize, column: usize| -> Option<f32> {
        let mut sum = 0.0;
        for line in 0..BLOCK {
            let start = (row * BLOCK + line) * width + column * BLOCK;
            for height in &heights[start..start + BLOCK] {
                if height.is_nan() || height.abs() >= limit {
                    return None;
                }
                sum += height;
            }
        }
        Some(sum / (BLOCK * BLOCK) as f32)
    };
    let mut apart = Vec::new();
    for row in 0..heights.len() / width / BLOCK {
        let means: Vec<Option<f32>> = (0..columns).map(|column| mean(row, column)).collect();
        for pair in means.windows(3) {
            if let [Some(left), _, Some(right)] = pair {
                apart.push(f64::from((left - right).abs()));
            }
        }
    }
    if apart.len() < LEAST_PAIRS {
        return 0.0;
    }
    // 1.4826 times the median is a normal distribution's standard deviation.
    let variance = (1.4826 * median(&mut apart).unwrap_or(0.0)).powi(2) / 2.0;
    (variance - sigma * sigma / (BLOCK * BLOCK) as f64).max(0.0).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensor::field::{hash, normal};

    #[test]
    fn a_mean_is_of_the_window_and_leaves_out_what_is_clear_and_what_is_missing() {
        let heights = [1.0, 2.0, 3.0, 4.0, 5.0, f32::NAN, 7.0, 90.0, -90.0];
        let means = means(&heights, 3, 10.0);
        assert_eq!(means[0], (1.0 + 2.0 + 4.0 + 5.0) / 4.0);
        assert_eq!(means[4], (1.0 + 2.0 + 3.0 + 4.0 + 5.0 + 7.0) / 6.0);
        assert_eq!(means[8], 5.0);
    }

    #[test]
    fn what_a_block_shares_is_told_from_what_each_height_has_of_its_own() {
        const WIDE: usize = 320;
        let normal = |i: usize| normal(hash(i as u64));
        let of = |own: f64, common: f64| -> Vec<f32> {
            let block = |i: usize| (i / WIDE / BLOCK) * (WIDE / BLOCK) + (i % WIDE) / BLOCK;
            (0..WIDE * 240).map(|i| (own * normal(i) + common * normal(1_000_000 + 31 * block(i))) as f32).collect()
        };
        let told = |own: f64, common: f64| shared(&of(own, common), WIDE, 0.1, own);
        assert!(told(0.003, 0.0) < 0.0003, "{}", told(0.003, 0.0));
        assert!((told(0.003, 0.002) / 0.002 - 1.0).abs() < 0.12, "{}", told(0.003, 0.002));
        assert_eq!(shared(&[0.0; 64], 8, 0.1, 0.0), 0.0);
    }

    #[test]
    fn a_step_does_not_spread() {
        let heights: Vec<f32> = (0..36).map(|i| if i % 6 < 3 { 0.0 } else { 0.1 }).collect();
        assert!(means(&heights, 6, 0.01).iter().all(|mean| *mean == 0.0));
    }
}
