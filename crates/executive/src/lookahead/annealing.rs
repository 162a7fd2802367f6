//! Simulated annealing over the order in which tasks are served. It is used when some tasks are speculative, because every dispatch
//! serves these last.
//!
//! A schedule made by dispatch is the order in which its tasks begin: dispatched in that order, it comes out the same. So the order
//! is the solution that is searched: a step moves one task to another place in it, simulates the dispatch, and keeps the
//! result if the end is not later, or by chance if it is, with a temperature that falls over some thousand steps and is then
//! raised again (Kirkpatrick, Gelatt, Vecchi: Optimization by simulated annealing, 1983; over dispatched schedules: Kolisch,
//! Hartmann: Heuristic algorithms for the resource-constrained project scheduling problem, 1999).

use super::dice::Dice;
use super::network::Place;

/// Steps from the highest temperature to the lowest; the next cycle begins with the best order.
const CYCLE: u32 = 4_000;
/// At the beginning of a cycle, an end that is later by this share of the total time is accepted with probability 1/e …
const HOT: f64 = 0.01;
/// … and at its end, one that is later by this share.
const COLD: f64 = 0.0005;

/// The order and the state of the annealing.
#[derive(Debug, Clone)]
pub(super) struct Annealing {
    dice: Dice,
    current: Vec<Place>,
    current_end: u64,
    /// Steps in the present cycle.
    steps: u32,
}

impl Annealing {
    pub(super) fn new(seed: u64, order: &[Place], end: u64) -> Annealing {
        Annealing { dice: Dice(seed), current: order.to_vec(), current_end: end, steps: 0 }
    }

    /// Proposes the next order.
    pub(super) fn vary(&mut self, tried: &mut Vec<Place>, best: &[Place], best_end: u64) {
        if self.steps == CYCLE {
            self.steps = 0;
            self.current.copy_from_slice(best);
            self.current_end = best_end;
        }
        let size = self.current.len();
        let (from, to) = (self.dice.below(size), self.dice.below(size));
        tried.clone_from(&self.current);
        if from < to {
            tried[from..=to].rotate_left(1);
        } else {
            tried[to..=from].rotate_right(1);
        }
    }

    /// Accepts or rejects an order, given the simulated sequence and its end.
    pub(super) fn judge(&mut self, sequence: &[Place], end: u64, best_end: u64) {
        let temperature = HOT * (COLD / HOT).powf(f64::from(self.steps) / f64::from(CYCLE)) * best_end as f64;
        self.steps += 1;
        let later = end.saturating_sub(self.current_end) as f64;
        if later == 0.0 || self.dice.share() < (-later / temperature).exp() {
            self.current_end = end;
            self.current.copy_from_slice(sequence);
        }
    }
}
