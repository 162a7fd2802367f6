//! Mean heights of pixels and those around them: noise falls by the window's side, so that what is flat is told from the
//! surface it lies on. What is clearly above or below is left out of a mean, or it would spread over its edges.

/// Rows and columns of the window.
pub(crate) const SIDE: usize = 3;

/// The mean around each pixel of heights that are within `limit` of the surface; not a number is no height. 0 where there is none.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mean_is_of_the_window_and_leaves_out_what_is_clear_and_what_is_missing() {
        let heights = [1.0, 2.0, 3.0, 4.0, 5.0, f32::NAN, 7.0, 90.0, -90.0];
        let means = means(&heights, 3, 10.0);
        assert_eq!(means[0], (1.0 + 2.0 + 4.0 + 5.0) / 4.0);
        assert_eq!(means[4], (1.0 + 2.0 + 3.0 + 4.0 + 5.0 + 7.0) / 6.0);
        assert_eq!(means[8], 5.0);
    }

    #[test]
    fn a_step_does_not_spread() {
        let heights: Vec<f32> = (0..36).map(|i| if i % 6 < 3 { 0.0 } else { 0.1 }).collect();
        assert!(means(&heights, 6, 0.01).iter().all(|mean| *mean == 0.0));
    }
}
