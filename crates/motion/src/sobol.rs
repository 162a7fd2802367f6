//! Evenly spread samples: the Sobol' sequence in Gray code order (Antonov and Saleev 1979), with the direction numbers of Joe and Kuo (2008) and a
//! random digital shift by a seed. One sample takes one exclusive or for all joints together.

use crate::mechanism::MAX_JOINTS;
use crate::space::State;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Binary digits of a coordinate.
const DIGITS: usize = 32;

/// For each joint from the second on: the degree of its primitive polynomial, the polynomial's inner coefficients as bits, and the first direction
/// numbers.
const POLYNOMIALS: [(usize, u32, [u32; 6]); MAX_JOINTS - 1] = [
    (1, 0, [1, 0, 0, 0, 0, 0]),
    (2, 1, [1, 3, 0, 0, 0, 0]),
    (3, 1, [1, 3, 1, 0, 0, 0]),
    (3, 2, [1, 1, 1, 0, 0, 0]),
    (4, 1, [1, 1, 3, 3, 0, 0]),
    (4, 4, [1, 3, 5, 13, 0, 0]),
    (5, 2, [1, 1, 5, 5, 17, 0]),
    (5, 4, [1, 1, 5, 5, 5, 0]),
    (5, 7, [1, 1, 7, 11, 19, 0]),
    (5, 11, [1, 1, 5, 1, 1, 0]),
    (5, 13, [1, 1, 1, 3, 11, 0]),
    (5, 14, [1, 3, 5, 5, 31, 0]),
    (6, 1, [1, 3, 3, 9, 7, 49]),
    (6, 13, [1, 1, 1, 15, 21, 21]),
    (6, 16, [1, 3, 1, 13, 27, 49]),
];

/// Factor that converts the upper 24 digits of a coordinate to a number below 1.
const WORTH: f32 = 1.0 / (1 << 24) as f32;

/// For each digit of the counter, what it changes in the coordinates.
static DIRECTIONS: [[u32; MAX_JOINTS]; DIGITS] = directions();

const fn directions() -> [[u32; MAX_JOINTS]; DIGITS] {
    let mut all = [[0; MAX_JOINTS]; DIGITS];
    let mut i = 0;
    while i < DIGITS {
        all[i][0] = 1 << (DIGITS - 1 - i);
        i += 1;
    }
    let mut joint = 1;
    while joint < MAX_JOINTS {
        let (degree, coefficients, first) = POLYNOMIALS[joint - 1];
        let mut i = 0;
        while i < DIGITS {
            all[i][joint] = if i < degree {
                first[i] << (DIGITS - 1 - i)
            } else {
                let before = all[i - degree][joint];
                let mut direction = before ^ (before >> degree);
                let mut k = 1;
                while k < degree {
                    if (coefficients >> (degree - 1 - k)) & 1 == 1 {
                        direction ^= all[i - k][joint];
                    }
                    k += 1;
                }
                direction
            };
            i += 1;
        }
        joint += 1;
    }
    all
}

pub(crate) struct Sobol {
    index: u32,
    digits: [u32; MAX_JOINTS],
}

impl Sobol {
    pub(crate) fn new(seed: u64) -> Sobol {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        Sobol { index: 0, digits: std::array::from_fn(|_| random.random_range(0..=u32::MAX)) }
    }

    /// The next sample, within the limits.
    #[inline]
    pub(crate) fn next(&mut self, lower: &State, upper: &State) -> State {
        let mut state = [0.0; MAX_JOINTS];
        for (j, position) in state.iter_mut().enumerate() {
            let unit = (self.digits[j] >> 8) as i32 as f32 * WORTH;
            *position = lower[j] + (upper[j] - lower[j]) * unit;
        }
        self.change();
        self.index = self.index.wrapping_add(1);
        state
    }

    /// Takes back the last `count` samples, which come next again.
    pub(crate) fn take_back(&mut self, count: usize) {
        for _ in 0..count {
            self.index = self.index.wrapping_sub(1);
            self.change();
        }
    }

    /// Applies the difference between the sample of this index and the next one.
    #[inline]
    fn change(&mut self) {
        // After 2^32 samples the sequence begins anew.
        let changed = self.index.trailing_ones() as usize % DIGITS;
        for (digits, direction) in self.digits.iter_mut().zip(&DIRECTIONS[changed]) {
            *digits ^= direction;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_that_are_taken_back_come_again() {
        let (lower, upper) = ([0.0; MAX_JOINTS], [1.0; MAX_JOINTS]);
        let mut sobol = Sobol::new(5);
        let first: Vec<State> = (0..100).map(|_| sobol.next(&lower, &upper)).collect();
        for count in [100, 1, 37, 64] {
            sobol.take_back(count);
            for (at, sample) in first.iter().enumerate().skip(100 - count) {
                assert_eq!(sobol.next(&lower, &upper), *sample, "sample {at} after {count} were taken back");
            }
        }
    }

    #[test]
    fn every_power_of_two_of_samples_has_one_in_each_part_of_every_joint() {
        let (lower, upper) = ([0.0; MAX_JOINTS], [1.0; MAX_JOINTS]);
        for seed in 0..4 {
            let mut sobol = Sobol::new(seed);
            for count in [64, 64, 128, 256] {
                let mut seen = vec![[0; MAX_JOINTS]; count];
                for _ in 0..count {
                    let sample = sobol.next(&lower, &upper);
                    for (j, position) in sample.iter().enumerate() {
                        seen[(position * count as f32) as usize][j] += 1;
                    }
                }
                assert!(seen.iter().flatten().all(|n| *n == 1), "{count}");
            }
        }
    }

    #[test]
    fn pairs_of_joints_are_filled_evenly() {
        let (lower, upper) = ([0.0; MAX_JOINTS], [1.0; MAX_JOINTS]);
        let mut sobol = Sobol::new(3);
        let samples: Vec<State> = (0..4096).map(|_| sobol.next(&lower, &upper)).collect();
        for a in 0..MAX_JOINTS {
            for b in 0..a {
                let mut seen = [[0; 8]; 8];
                for sample in &samples {
                    seen[(sample[a] * 8.0) as usize][(sample[b] * 8.0) as usize] += 1;
                }
                assert!(seen.iter().flatten().all(|n| (1..=128).contains(n)), "{a} {b}: {seen:?}");
            }
        }
    }

    #[test]
    fn samples_fill_the_limits_and_differ_by_seed() {
        let (mut lower, mut upper) = ([0.0; MAX_JOINTS], [0.0; MAX_JOINTS]);
        lower[..7].fill(-1.0);
        upper[..7].fill(3.0);
        let mut sobol = Sobol::new(5);
        assert_ne!(sobol.next(&lower, &upper), Sobol::new(6).next(&lower, &upper));
        for _ in 0..4096 {
            let sample = sobol.next(&lower, &upper);
            assert!(sample[..7].iter().all(|s| (-1.0..=3.0).contains(s)) && sample[7] == 0.0);
        }
    }
}
