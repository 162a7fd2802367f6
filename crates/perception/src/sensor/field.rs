//! Stateless random numbers: hashes, uniform and normal samples from them, and smooth normal fields.

/// The finaliser of SplitMix64 (Steele, Lea, Flood 2014): every input bit affects every output bit.
pub(crate) fn hash(x: u64) -> u64 {
    let x = x.wrapping_add(0x9E37_79B9_7F4A_7C15);
    let x = (x ^ (x >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    let x = (x ^ (x >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    x ^ (x >> 31)
}

/// Uniform in [0, 1).
pub(crate) fn uniform(bits: u64) -> f64 {
    (bits >> 11) as f64 / (1_u64 << 53) as f64
}

/// Standard normal, with its tails (Box and Muller 1958).
pub(crate) fn normal(bits: u64) -> f64 {
    let (a, b) = (uniform(bits), uniform(hash(bits ^ 0xA5A5)));
    (-2.0 * (1.0 - a).ln()).sqrt() * (std::f64::consts::TAU * b).cos()
}

/// A normal field in space with variance 1, smooth over a distance of about 1.
pub(crate) fn in_space(at: [f64; 3]) -> f64 {
    let base = at.map(f64::floor);
    let part: [f64; 3] = std::array::from_fn(|i| smooth(at[i] - base[i]));
    let cell = base.map(|c| c as i64 as u64);
    let (mut sum, mut squares) = (0.0, 0.0);
    for corner in 0..8_usize {
        let mut bits = 0;
        let mut weight = 1.0;
        for axis in 0..3 {
            let up = corner >> axis & 1;
            bits = hash(bits ^ cell[axis].wrapping_add(up as u64));
            weight *= if up == 1 { part[axis] } else { 1.0 - part[axis] };
        }
        sum += weight * cheap_normal(bits);
        squares += weight * weight;
    }
    sum / squares.sqrt()
}

/// A normal field in the plane with variance 1, smooth over a distance of about 1: the values of a row, at `x = start + i · step`.
pub(crate) fn along_row(seed: u64, start: f64, step: f64, count: usize, y: f64) -> Vec<f64> {
    let (below, up) = (y.floor(), smooth(y - y.floor()));
    let knot = |column: i64, row: f64| normal(hash(hash(seed ^ column as u64) ^ row as i64 as u64));
    // The two rows of knots around this row, blended once per column of knots.
    let blended = |column: i64| (1.0 - up) * knot(column, below) + up * knot(column, below + 1.0);
    let spread = ((1.0 - up).powi(2) + up.powi(2)).sqrt();
    let mut at = start.floor() as i64;
    let (mut left, mut right) = (blended(at), blended(at + 1));
    (0..count)
        .map(|i| {
            let x = start + i as f64 * step;
            while x >= (at + 1) as f64 {
                at += 1;
                (left, right) = (right, blended(at + 1));
            }
            let part = smooth(x - at as f64);
            ((1.0 - part) * left + part * right) / (((1.0 - part).powi(2) + part.powi(2)).sqrt() * spread)
        })
        .collect()
}

/// The cumulative standard normal distribution (to 2 %: approximated by a logistic distribution).
pub(crate) fn share_below(value: f64) -> f64 {
    1.0 / (1.0 + (-1.702 * value).exp())
}

/// From 0 to 1 with zero slope at both ends.
fn smooth(part: f64) -> f64 {
    part * part * (3.0 - 2.0 * part)
}

/// About standard normal where tails do not matter: twice the centred sum of three uniforms.
fn cheap_normal(bits: u64) -> f64 {
    let [a, b, c] = [bits, bits >> 21, bits >> 42].map(|b| (b & 0x1F_FFFF) as f64 / f64::from(0x20_0000));
    2.0 * (a + b + c - 1.5)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn moments(values: impl Iterator<Item = f64>) -> (f64, f64) {
        let values: Vec<f64> = values.collect();
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        (mean, values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / values.len() as f64)
    }

    #[test]
    fn normal_samples_have_tails_beyond_three_deviations() {
        let samples = 200_000_u64;
        let (mean, variance) = moments((0..samples).map(|i| normal(hash(i))));
        assert!(mean.abs() < 0.01 && (variance - 1.0).abs() < 0.02, "{mean} {variance}");
        let beyond = (0..samples).filter(|i| normal(hash(*i)).abs() > 3.0).count() as f64 / samples as f64;
        assert!((0.0022..0.0032).contains(&beyond), "{beyond}");
    }

    #[test]
    fn fields_have_variance_one_everywhere_and_are_smooth() {
        for offset in [0.0, 0.25, 0.5] {
            let plane = (0..20_000_u64).map(|i| along_row(hash(i), offset, 1.0, 1, offset)[0]);
            let (mean, variance) = moments(plane);
            assert!(mean.abs() < 0.03 && (variance - 1.0).abs() < 0.05, "{offset}: {mean} {variance}");
            let space = (0..20_000).map(|i| in_space([f64::from(i) * 3.0 + offset, offset, offset]));
            let (mean, variance) = moments(space);
            assert!(mean.abs() < 0.03 && (variance - 1.0).abs() < 0.05, "{offset}: {mean} {variance}");
        }
        let row = along_row(7, -3.3, 0.1, 500, 2.5);
        let step = row.windows(2).map(|pair| (pair[0] - pair[1]).powi(2)).sum::<f64>() / 499.0;
        assert!(step < 0.1, "{step}");
        // Values three lengths apart are uncorrelated, averaged over many rows.
        let product = |seed| {
            let row = along_row(hash(seed), 0.3, 3.0, 2, 2.5);
            row[0] * row[1]
        };
        let apart = (0..4000).map(product).sum::<f64>() / 4000.0;
        assert!(apart.abs() < 0.08, "{apart}");
    }
}
