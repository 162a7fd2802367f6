//! Evenly spread samples: the Halton sequence, shifted by a seed (Cranley and Patterson), one prime base per joint.

use crate::mechanism::MAX_JOINTS;
use crate::space::State;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const PRIMES: [u32; MAX_JOINTS] = [2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37, 41, 43, 47, 53];

/// The first elements of large bases run along a line; they are left out.
const SKIPPED: u32 = 64;

pub(crate) struct Halton {
    index: u32,
    shift: [f64; MAX_JOINTS],
    joints: usize,
}

impl Halton {
    pub(crate) fn new(joints: usize, seed: u64) -> Halton {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        Halton { index: SKIPPED, shift: std::array::from_fn(|_| random.random_range(0.0..1.0)), joints }
    }

    /// The next sample between the limits.
    pub(crate) fn next(&mut self, lower: &State, upper: &State) -> State {
        self.index = self.index.wrapping_add(1);
        let mut state = [0.0; MAX_JOINTS];
        for j in 0..self.joints {
            let unit = (radical_inverse(self.index, PRIMES[j]) + self.shift[j]).fract();
            state[j] = lower[j] + (upper[j] - lower[j]) * unit as f32;
        }
        state
    }
}

fn radical_inverse(mut index: u32, base: u32) -> f64 {
    let (mut reversed, mut scale) = (0_u64, 1_u64);
    while index > 0 {
        reversed = reversed * u64::from(base) + u64::from(index % base);
        scale *= u64::from(base);
        index /= base;
    }
    reversed as f64 / scale as f64
}
