//! Samples postures through which a path of a given length between two postures can lead: an ellipsoid with the two as foci (Gammell, Srinivasa,
//! Barfoot: *Informed RRT\**, IROS 2014), sampled directly instead of by rejection.

use crate::space::{State, difference, distance};
use rand::{Rng, RngExt};

/// Number of draws before one outside of the limits is clamped.
const MAX_DRAWS: usize = 16;

/// A posture within the limits on some path from `from` to `to` that is not longer than `length`.
pub(crate) fn draw(
    from: &State,
    to: &State,
    length: f32,
    (lower, upper): (&State, &State),
    joints: usize,
    random: &mut impl Rng,
) -> State {
    let between = distance(from, to);
    let along = difference(to, from);
    // Half of the long axis, and of all other axes.
    let (long, short) = (length / 2.0, (length * length - between * between).max(0.0).sqrt() / 2.0);
    let mut state = *from;
    for _ in 0..MAX_DRAWS {
        let ball = in_unit_ball(joints, random);
        // The reflection that takes the first axis to the direction between the foci (Householder).
        let mut normal: State = std::array::from_fn(|j| along[j] / between.max(f32::MIN_POSITIVE));
        normal[0] -= 1.0;
        let square: f32 = normal.iter().map(|n| n * n).sum();
        let stretched: State = std::array::from_fn(|j| ball[j] * if j == 0 { long } else { short });
        let dot: f32 = (0..joints).map(|j| normal[j] * stretched[j]).sum();
        let factor = if square > 1e-12 { 2.0 * dot / square } else { 0.0 };
        for j in 0..joints {
            state[j] = from[j] + along[j] / 2.0 + stretched[j] - factor * normal[j];
        }
        if (0..joints).all(|j| lower[j] <= state[j] && state[j] <= upper[j]) {
            return state;
        }
    }
    for j in 0..joints {
        state[j] = state[j].clamp(lower[j], upper[j]);
    }
    state
}

/// A uniform sample of the unit ball.
fn in_unit_ball(joints: usize, random: &mut impl Rng) -> State {
    let mut point = State::default();
    let mut square = 0.0;
    for value in &mut point[..joints] {
        // The sum of twelve uniform samples is close enough to normal to prefer no direction.
        *value = (0..12).map(|_| random.random_range(-0.5_f32..0.5)).sum();
        square += *value * *value;
    }
    let radius = random.random_range(0.0_f32..1.0).powf(1.0 / joints as f32) / square.sqrt().max(f32::MIN_POSITIVE);
    point.map(|value| value * radius)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    fn posture(values: [f32; 5]) -> State {
        std::array::from_fn(|j| values.get(j).copied().unwrap_or(0.0))
    }

    #[test]
    fn what_is_drawn_lies_on_paths_that_are_short_enough_and_fills_them() {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let (from, to) = (posture([0.3, -0.2, 0.9, 0.0, -1.0]), posture([-0.5, 0.4, 0.1, 0.7, 0.2]));
        let length = distance(&from, &to) * 1.3;
        let (lower, upper) = ([-9.0; 16], [9.0; 16]);
        let mut sums: Vec<f32> = (0..4000)
            .map(|_| {
                let state = draw(&from, &to, length, (&lower, &upper), 5, &mut random);
                distance(&from, &state) + distance(&state, &to)
            })
            .collect();
        sums.sort_by(f32::total_cmp);
        assert!(sums[3999] <= length * 1.000_1, "{} of {length}", sums[3999]);
        assert!(sums[3999] > length * 0.999 && sums[0] < length * 0.9, "{} {}", sums[0], sums[3999]);
    }

    #[test]
    fn what_is_drawn_keeps_within_the_limits() {
        let mut random = ChaCha8Rng::seed_from_u64(2);
        let (from, to) = (posture([0.0; 5]), posture([1.0, 0.0, 0.0, 0.0, 0.0]));
        let (mut lower, mut upper) = ([-0.1; 16], [1.0; 16]);
        lower[5..].fill(0.0);
        upper[5..].fill(0.0);
        for _ in 0..500 {
            let state = draw(&from, &to, 2.0, (&lower, &upper), 5, &mut random);
            assert!((0..16).all(|j| lower[j] <= state[j] && state[j] <= upper[j]), "{state:?}");
        }
    }
}
