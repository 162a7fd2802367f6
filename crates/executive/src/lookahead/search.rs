//! The search for a better order: simulated annealing over the order in which tasks are served.
//!
//! A schedule made by dispatch is the order in which its tasks begin: dispatched in that order, it comes out the same. So the order
//! is the solution that is searched: a step moves one task to another place in it, simulates the dispatch, and keeps the
//! result if the end is not later, or by chance if it is, with a temperature that falls over some thousand steps and is then
//! raised again (Kirkpatrick, Gelatt, Vecchi: Optimization by simulated annealing, 1983; over dispatched schedules: Kolisch,
//! Hartmann: Heuristic algorithms for the resource-constrained project scheduling problem, 1999). It is over early when
//! nothing can be better.

use super::dice::Dice;
use super::network::{NANOSECONDS, Network, Place};
use super::problem::{Problem, ProblemError};
use super::rollout::Rollout;
use ratn_model::id::InstanceId;
use std::cmp::Reverse;

/// From the highest temperature to the lowest in so many steps; the next cycle begins with the best order.
const CYCLE: u32 = 4_000;
/// An end that is later by this share of the whole is kept with probability 1/e at the beginning of a cycle …
const HOT: f64 = 0.01;
/// … and this one at its end.
const COLD: f64 = 0.0005;

/// Two instances that begin at the same moment are advised this far apart, in seconds: the executive counts milliseconds.
const APART_S: f64 = 0.002;
/// The same as a share of the whole, for what the executive's numbers can tell apart.
const APART_SHARE: f64 = 1.0 / 1_000_000.0;

/// A search that goes on as long as it is let.
#[derive(Debug, Clone)]
pub struct Search {
    network: Network,
    instances: Vec<(InstanceId, f64)>,
    dice: Dice,
    rollout: Rollout,
    ranks: Vec<u32>,
    /// The order that is tried.
    tried: Vec<Place>,
    current: Vec<Place>,
    current_end: u64,
    best: Vec<Place>,
    best_end: u64,
    plain_end: u64,
    /// No order ends earlier than this.
    bound: u64,
    /// In the present cycle.
    steps: u32,
}

/// The best order found.
#[derive(Debug, Clone, PartialEq)]
pub struct Advice {
    /// When everything has ended, in seconds from now, if it is served so.
    pub end_s: f64,
    /// When it has ended as it is served now.
    pub plain_s: f64,
    /// For [`crate::protocol::Event::Advised`]: every task that has not begun.
    pub urgency_s: Vec<(InstanceId, f64)>,
}

impl Search {
    /// A search that knows the order of the present urgencies and that of the longest remaining path.
    ///
    /// # Errors
    /// [`ProblemError`] where the problem cannot be simulated.
    pub fn new(problem: &Problem, seed: u64) -> Result<Search, ProblemError> {
        let network = Network::of(problem)?;
        let size = network.len();
        let in_order = |urgency: &dyn Fn(usize) -> i64| {
            let mut order: Vec<Place> = (0..size as Place).collect();
            order.sort_by_key(|place| (Reverse(urgency(*place as usize)), *place));
            order
        };
        let present = in_order(&|at| {
            let task = &problem.tasks[at];
            // The bits of a positive float are in its order: what is unlikely is small and still tells itself from another.
            i64::from(((task.urgency_s * task.probability).max(0.0) as f32).to_bits())
        });
        let longest = in_order(&|at| i64::try_from(network.remaining[at]).unwrap_or(i64::MAX));
        let mut search = Search {
            instances: problem.tasks.iter().map(|task| (task.instance, task.probability)).collect(),
            dice: Dice(seed),
            rollout: Rollout::new(&network),
            ranks: vec![0; size],
            tried: present,
            current: Vec::new(),
            current_end: 0,
            best: Vec::new(),
            best_end: 0,
            plain_end: 0,
            bound: network.bound(),
            steps: 0,
            network,
        };
        search.plain_end = search.simulate();
        search.best_end = search.plain_end;
        search.best = search.rollout.sequence.clone();
        search.tried = longest;
        let end = search.simulate();
        if end < search.best_end {
            search.best_end = end;
            search.best.clone_from(&search.rollout.sequence);
        }
        search.current.clone_from(&search.best);
        search.current_end = search.best_end;
        Ok(search)
    }

    /// Simulates so many orders; whether one of them ends earlier than everything before.
    pub fn step(&mut self, orders: usize) -> bool {
        let before = self.best_end;
        let size = self.current.len();
        for _ in 0..orders {
            if self.is_over() {
                break;
            }
            if self.steps == CYCLE {
                self.steps = 0;
                self.current.copy_from_slice(&self.best);
                self.current_end = self.best_end;
            }
            let (from, to) = (self.dice.below(size), self.dice.below(size));
            self.tried.copy_from_slice(&self.current);
            if from < to {
                self.tried[from..=to].rotate_left(1);
            } else {
                self.tried[to..=from].rotate_right(1);
            }
            let end = self.simulate();
            let temperature = HOT * (COLD / HOT).powf(f64::from(self.steps) / f64::from(CYCLE)) * self.best_end as f64;
            self.steps += 1;
            let later = end.saturating_sub(self.current_end) as f64;
            if later == 0.0 || self.dice.share() < (-later / temperature).exp() {
                self.current_end = end;
                self.current.copy_from_slice(&self.rollout.sequence);
                if end < self.best_end {
                    self.best_end = end;
                    self.best.copy_from_slice(&self.rollout.sequence);
                }
            }
        }
        self.best_end < before
    }

    /// Whether nothing better can be found.
    pub fn is_over(&self) -> bool {
        self.best_end <= self.bound || self.current.len() < 2
    }

    /// The best order so far.
    pub fn best(&mut self) -> Advice {
        self.tried.copy_from_slice(&self.best);
        self.simulate();
        let end_s = self.best_end as f64 / NANOSECONDS;
        let apart_s = APART_S.max(end_s * APART_SHARE);
        let mut urgency_s = Vec::with_capacity(self.best.len());
        let mut least_s = 0.0_f64;
        for place in self.best.iter().rev() {
            let at = *place as usize;
            if self.network.is_running[at] {
                continue;
            }
            let before_end_s = end_s - self.rollout.began[at] as f64 / NANOSECONDS;
            let seconds = before_end_s.max(least_s);
            least_s = seconds + apart_s;
            // The executive weighs what is speculative by its probability.
            let (instance, probability) = self.instances[at];
            urgency_s.push((instance, seconds / probability));
        }
        Advice { end_s, plain_s: self.plain_end as f64 / NANOSECONDS, urgency_s }
    }

    /// When everything has ended that is served in the tried order.
    fn simulate(&mut self) -> u64 {
        let late = self.network.len() as u32;
        for (rank, place) in self.tried.iter().enumerate() {
            let speculative = if self.network.is_speculative[*place as usize] { late } else { 0 };
            self.ranks[*place as usize] = speculative + rank as u32;
        }
        self.rollout.run(&self.network, &self.ranks)
    }
}
