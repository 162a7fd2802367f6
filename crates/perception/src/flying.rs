//! Flying pixels: at the edge of an object a camera returns mixtures of near and far, which lie on no surface.
//!
//! They are detected by heights above the surface, not by depths, because depth changes along every surface that is not seen straight
//! on. A pixel flies where one side of it is clearly higher and the opposite side clearly lower. That also holds for an upright wall
//! from pixel to pixel, so this much slack is allowed.

/// How far from a pixel its higher and its lower side may be, in pixels.
const REACH: isize = 2;
/// Standard deviations of a height difference from which a side counts as higher or lower.
const CLEARLY: f64 = 2.5;
/// Row and column steps to one of each pair of opposite neighbours.
const AXES: [(isize, isize); 4] = [(0, 1), (1, 0), (1, 1), (1, -1)];

/// Heights above the surface, in metres, row by row; NaN for no return.
pub(crate) struct Heights<'a> {
    pub(crate) of: &'a [f32],
    pub(crate) width: usize,
    /// Standard deviation of a height, in metres.
    pub(crate) sigma: f64,
}

impl Heights<'_> {
    /// Whether a pixel sees a mixture. `rise` is the height of an upright wall per pixel there, in metres.
    pub(crate) fn is_flying(&self, pixel: usize, rise: f64) -> bool {
        let here = self.of[pixel];
        let noise = CLEARLY * std::f64::consts::SQRT_2 * self.sigma;
        AXES.iter().any(|axis| {
            // Whether either side is higher or lower by more than an upright wall would be.
            let [ahead, behind] = [1, -1].map(|sign| {
                let (mut higher, mut lower) = (false, false);
                for step in 1..=REACH {
                    let off = (here - self.at(pixel, axis, sign * step).unwrap_or(here)) as f64;
                    let clearly = noise + step as f64 * rise;
                    higher |= -off > clearly;
                    lower |= off > clearly;
                }
                (higher, lower)
            });
            (ahead.0 && behind.1) || (ahead.1 && behind.0)
        })
    }

    fn at(&self, pixel: usize, (down, right): &(isize, isize), steps: isize) -> Option<f32> {
        let (width, rows) = (self.width as isize, (self.of.len() / self.width) as isize);
        let (column, row) = (pixel as isize % width + steps * right, pixel as isize / width + steps * down);
        let within = (0..width).contains(&column) && (0..rows).contains(&row);
        within.then(|| self.of[(row * width + column) as usize]).filter(|height| !height.is_nan())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WIDTH: usize = 24;

    /// A block of 10 cm from column 8 on, seen from straight above, with height `between` in column 7.
    fn block(between: f32) -> Vec<f32> {
        let height = |column: usize| match column {
            ..7 => 0.0,
            7 => between,
            _ => 0.1,
        };
        (0..WIDTH * WIDTH).map(|i| height(i % WIDTH)).collect()
    }

    fn flying(heights: &[f32], rise: f64) -> Vec<usize> {
        let heights = Heights { of: heights, width: WIDTH, sigma: 0.001 };
        (0..heights.of.len()).filter(|pixel| heights.is_flying(*pixel, rise)).collect()
    }

    #[test]
    fn what_is_between_high_and_low_flies_and_what_is_on_either_is_not() {
        let found = flying(&block(0.05), 0.003);
        assert_eq!(found, (0..WIDTH).map(|row| row * WIDTH + 7).collect::<Vec<_>>());
        assert!(flying(&block(0.0), 0.003).is_empty() && flying(&block(0.1), 0.003).is_empty());
        assert!(flying(&block(f32::NAN), 0.003).is_empty());
    }

    #[test]
    fn a_wall_that_is_seen_from_above_does_not_fly() {
        // An upright wall with 4 mm per row.
        let wall: Vec<f32> = (0..WIDTH * WIDTH).map(|i| 0.004 * (i / WIDTH) as f32).collect();
        assert!(flying(&wall, 0.004).is_empty());
        assert!(!flying(&wall, 0.0).is_empty());
    }
}
