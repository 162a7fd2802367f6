//! Evenly spread samples: the Halton sequence, shifted by a seed (Cranley and Patterson), one prime base per joint.

use crate::mechanism::MAX_JOINTS;
use crate::space::State;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const PRIMES: [u32; MAX_JOINTS] = [2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37, 41, 43, 47, 53];

/// The first elements of large bases run along a line; they are left out.
const SKIPPED: u32 = 64;

/// Digits of an index in base 2.
const DIGITS: usize = 32;

pub(crate) struct Halton {
    counters: Vec<Counter>,
    shift: [f64; MAX_JOINTS],
}

impl Halton {
    pub(crate) fn new(joints: usize, seed: u64) -> Halton {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let shift = std::array::from_fn(|_| random.random_range(0.0..1.0));
        Halton { counters: PRIMES[..joints].iter().map(|base| Counter::new(*base, SKIPPED)).collect(), shift }
    }

    /// The next sample between the limits.
    pub(crate) fn next(&mut self, lower: &State, upper: &State) -> State {
        let mut state = [0.0; MAX_JOINTS];
        for (j, counter) in self.counters.iter_mut().enumerate() {
            let shifted = counter.next() + self.shift[j];
            let unit = if shifted >= 1.0 { shifted - 1.0 } else { shifted };
            state[j] = lower[j] + (upper[j] - lower[j]) * unit as f32;
        }
        state
    }
}

/// Counts in one base with its digits behind the point in reverse: mostly one digit changes.
struct Counter {
    base: u32,
    /// The lowest first.
    digits: [u32; DIGITS],
    /// What one of each digit is worth.
    worths: [f64; DIGITS],
    /// What all digits above each are worth together.
    rests: [f64; DIGITS],
}

impl Counter {
    fn new(base: u32, mut index: u32) -> Counter {
        let mut counter = Counter { base, digits: [0; DIGITS], worths: [0.0; DIGITS], rests: [0.0; DIGITS] };
        for i in 0..DIGITS {
            counter.digits[i] = index % base;
            index /= base;
            counter.worths[i] = f64::from(base).powi(-1 - i as i32);
        }
        for i in (1..DIGITS).rev() {
            counter.rests[i - 1] = counter.above(i);
        }
        counter
    }

    fn next(&mut self) -> f64 {
        self.digits[0] += 1;
        if self.digits[0] == self.base {
            self.carry();
        }
        self.above(0)
    }

    fn carry(&mut self) {
        let mut place = 0;
        while self.digits[place] == self.base && place + 1 < DIGITS {
            self.digits[place] = 0;
            place += 1;
            self.digits[place] += 1;
        }
        let value = self.above(place);
        self.rests[..place].fill(value);
    }

    /// What the digits from a place upwards are worth.
    fn above(&self, place: usize) -> f64 {
        self.rests[place] + f64::from(self.digits[place]) * self.worths[place]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_counter_gives_the_radical_inverse_of_every_index() {
        for base in PRIMES {
            let mut counter = Counter::new(base, SKIPPED);
            for index in SKIPPED + 1..20_000 {
                let (mut left, mut worth, mut inverse) = (index, 1.0, 0.0);
                while left > 0 {
                    worth /= f64::from(base);
                    inverse += worth * f64::from(left % base);
                    left /= base;
                }
                assert!((counter.next() - inverse).abs() < 1e-12, "index {index} in base {base}");
            }
        }
    }

    #[test]
    fn samples_fill_the_limits_evenly_and_differ_by_seed() {
        let (mut lower, mut upper) = ([0.0; MAX_JOINTS], [0.0; MAX_JOINTS]);
        lower[..7].fill(-1.0);
        upper[..7].fill(3.0);
        let mut halton = Halton::new(7, 5);
        let first = Halton::new(7, 6).next(&lower, &upper);
        assert_ne!(halton.next(&lower, &upper), first);
        let mut halves = [0; 7];
        for _ in 0..4096 {
            let sample = halton.next(&lower, &upper);
            assert!(sample[..7].iter().all(|s| (-1.0..=3.0).contains(s)) && sample[7] == 0.0);
            for (count, position) in halves.iter_mut().zip(sample) {
                *count += i32::from(position < 1.0);
            }
        }
        assert!(halves.iter().all(|count| (count - 2048).abs() < 40), "{halves:?}");
    }
}
