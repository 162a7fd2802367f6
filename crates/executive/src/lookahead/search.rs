//! The search for a better plan, and the advice with which the executive's dispatch leads to it.
//!
//! The method depends on the problem: [`Tabu`] where each contested resource serves one task at a time, a [`Population`] of lists where
//! resources have several units, [`Annealing`] of the dispatch order where tasks are speculative. Every plan is simulated under the
//! executive's own dispatch, with the holds that it needs, and counts only if it ends earlier. The search ends early when nothing can
//! be better.

use super::annealing::Annealing;
use super::network::{Holds, NANOSECONDS, Network, Place};
use super::population::Population;
use super::problem::{Problem, ProblemError};
use super::project::{Plan, Project};
use super::rollout::Rollout;
use super::tabu::Tabu;
use ratn_model::id::InstanceId;
use std::cmp::Reverse;
use std::collections::BTreeMap;

/// Two instances that begin at the same moment are advised this far apart, in seconds: the executive's resolution is milliseconds.
const APART_S: f64 = 0.002;
/// The same as a share of the total time, because the executive's urgencies have limited precision.
const APART_SHARE: f64 = 1.0 / 1_000_000.0;

/// A hold ends after this multiple of its planned time, even if the plan has failed.
const GIVES_UP_AFTER: f64 = 2.0;

/// An anytime search: more steps may find better plans.
#[derive(Debug, Clone)]
pub struct Search {
    network: Network,
    instances: Vec<(InstanceId, f64)>,
    rollout: Rollout,
    ranks: Vec<u32>,
    /// The order that is being tried.
    tried: Vec<Place>,
    best: Vec<Place>,
    best_holds: Holds,
    best_end: u64,
    plain_end: u64,
    /// Lower bound: no order ends earlier.
    bound: u64,
    method: Method,
}

#[derive(Debug, Clone)]
enum Method {
    Annealing(Annealing),
    Population(Box<Population>),
    Tabu(Box<Tabu>),
}

/// The best plan found.
#[derive(Debug, Clone, PartialEq)]
pub struct Advice {
    /// When everything has ended with this advice, in seconds from now.
    pub end_s: f64,
    /// When everything has ended without it, in seconds from now.
    pub plain_s: f64,
    /// For [`crate::protocol::Event::Advised`]: the urgency of every task that has not begun.
    pub urgency_s: Vec<(InstanceId, f64)>,
    /// For the same: the instances held back.
    pub held: Vec<Held>,
}

/// A hold: the instance does not ask for resources although it could, so that others get them first.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Held {
    /// The instance.
    pub instance: InstanceId,
    /// The hold ends when these have begun.
    pub until_begun: Vec<InstanceId>,
    /// The hold ends after this time in any case, in seconds.
    pub at_most_s: f64,
}

/// Good orders of the remaining work, with which a later search begins.
#[derive(Debug, Clone, Default)]
pub struct Memory {
    lists: Vec<Vec<InstanceId>>,
}

impl Memory {
    /// The remembered orders of the tasks that still remain, as places.
    fn lists_of(&self, problem: &Problem) -> impl Iterator<Item = Vec<Place>> {
        let places: BTreeMap<InstanceId, Place> =
            problem.tasks.iter().enumerate().map(|(at, task)| (task.instance, at as Place)).collect();
        self.lists.iter().map(move |list| list.iter().filter_map(|id| places.get(id).copied()).collect())
    }
}

impl Search {
    /// A search that starts with the order of the present urgencies and with that of the longest remaining path.
    ///
    /// # Errors
    /// [`ProblemError`] where the problem cannot be simulated.
    pub fn new(problem: &Problem, seed: u64) -> Result<Search, ProblemError> {
        Search::remembering(problem, seed, &Memory::default())
    }

    /// As [`Search::new`], but continues with the results of an earlier search.
    ///
    /// # Errors
    /// As [`Search::new`].
    pub fn remembering(problem: &Problem, seed: u64, memory: &Memory) -> Result<Search, ProblemError> {
        let network = Network::of(problem)?;
        let size = network.len();
        let in_order = |urgency: &dyn Fn(usize) -> i64| {
            let mut order: Vec<Place> = (0..size as Place).collect();
            order.sort_by_key(|place| (Reverse(urgency(*place as usize)), *place));
            order
        };
        let present = in_order(&|at| {
            let task = &problem.tasks[at];
            // The bits of positive floats have the same order: small products of unlikely tasks stay distinguishable.
            i64::from(((task.urgency_s * task.probability).max(0.0) as f32).to_bits())
        });
        let longest = in_order(&|at| i64::try_from(network.remaining[at]).unwrap_or(i64::MAX));
        let project = Project::of(&network);
        let mut search = Search {
            instances: problem.tasks.iter().map(|task| (task.instance, task.probability)).collect(),
            rollout: Rollout::new(&network),
            ranks: vec![0; size],
            tried: present,
            best: Vec::new(),
            best_holds: network.holds.clone(),
            best_end: u64::MAX,
            plain_end: 0,
            bound: network.bound(),
            method: Method::Annealing(Annealing::new(seed, &[], 0)),
            network,
        };
        let holds = search.best_holds.clone();
        search.plain_end = search.simulate(&holds);
        search.best = search.rollout.sequence.clone();
        search.best_end = search.plain_end;
        let mut lists = vec![search.rollout.sequence.clone()];
        search.tried = longest;
        let end = search.simulate(&Holds::new());
        lists.push(search.rollout.sequence.clone());
        if end < search.best_end {
            search.keep(end, Holds::new());
            lists.swap(0, 1);
        }
        search.method = if search.network.is_speculative.contains(&true) {
            Method::Annealing(Annealing::new(seed, &search.best, search.best_end))
        } else {
            // Lists with tasks that never began (their holds wait for each other) are dropped.
            lists.retain(|list| list.len() == size);
            lists.extend(memory.lists_of(problem));
            lists.iter_mut().for_each(|list| *list = project.list_of(list));
            match Tabu::new(project.clone(), seed, &lists) {
                Some(tabu) => Method::Tabu(Box::new(tabu)),
                None => Method::Population(Box::new(Population::new(project, seed, lists))),
            }
        };
        Ok(search)
    }

    /// Makes so many schedules; true if one of them ends earlier than all before.
    pub fn step(&mut self, orders: usize) -> bool {
        let before = self.best_end;
        if self.is_over() {
            return false;
        }
        let found = match &mut self.method {
            Method::Annealing(_) => {
                for _ in 0..orders {
                    self.anneal();
                    if self.is_over() {
                        break;
                    }
                }
                None
            }
            Method::Population(population) => population.step(orders, self.bound),
            Method::Tabu(tabu) => tabu.step(orders, self.bound),
        };
        if let Some(plan) = found {
            self.confirm(&plan);
        }
        self.best_end < before
    }

    /// The orders with which a later search goes on.
    pub fn memory(&mut self) -> Memory {
        let (lists, project) = match &mut self.method {
            Method::Annealing(_) => return Memory::default(),
            Method::Population(population) => (population.lists(), population.project()),
            Method::Tabu(tabu) => (tabu.lists(), tabu.project()),
        };
        let instance = |task: &u32| self.instances[project.places[*task as usize] as usize].0;
        Memory { lists: lists.iter().map(|list| list.iter().map(instance).collect()).collect() }
    }

    /// Whether nothing better can be found.
    pub fn is_over(&self) -> bool {
        self.best_end <= self.bound || self.best.len() < 2
    }

    /// When everything has ended with the present urgencies, in seconds from now.
    pub fn plain_s(&self) -> f64 {
        self.plain_end as f64 / NANOSECONDS
    }

    /// Lower bound, in seconds from now: no order ends earlier.
    pub fn bound_s(&self) -> f64 {
        self.bound as f64 / NANOSECONDS
    }

    /// The best plan so far.
    pub fn best(&mut self) -> Advice {
        self.tried.copy_from_slice(&self.best);
        let holds = self.best_holds.clone();
        self.simulate(&holds);
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
            // The executive multiplies the urgency of a speculative task by its probability.
            let (instance, probability) = self.instances[at];
            urgency_s.push((instance, seconds / probability));
        }
        let instance = |place: &Place| self.instances[*place as usize].0;
        let held = holds.iter().map(|(place, held_for)| Held {
            instance: instance(place),
            until_begun: held_for.iter().map(instance).collect(),
            at_most_s: GIVES_UP_AFTER * self.rollout.began[*place as usize] as f64 / NANOSECONDS,
        });
        let held = held.collect();
        Advice { end_s, plain_s: self.plain_s(), urgency_s, held }
    }

    /// Simulates another order; keeps it if it ends earlier.
    fn anneal(&mut self) {
        let Method::Annealing(annealing) = &mut self.method else { return };
        annealing.vary(&mut self.tried, &self.best, self.best_end);
        let end = self.simulate(&Holds::new());
        if let Method::Annealing(annealing) = &mut self.method {
            annealing.judge(&self.rollout.sequence, end, self.best_end);
        }
        if end < self.best_end {
            self.keep(end, Holds::new());
        }
    }

    /// Simulates the dispatch that leads to a plan; keeps it if it ends earlier.
    fn confirm(&mut self, plan: &Plan) {
        self.tried.clear();
        self.tried.extend((0..self.network.len() as Place).filter(|place| self.network.is_running[*place as usize]));
        self.tried.extend_from_slice(&plan.order);
        self.ranks_of_tried();
        let holds = self.rollout.holds_of_plan(&self.network, &self.ranks, &plan.begins);
        let end = self.rollout.run(&self.network, &self.ranks, &holds);
        if end < self.best_end {
            self.keep(end, holds);
        }
    }

    /// Makes the last simulation the best.
    fn keep(&mut self, end: u64, holds: Holds) {
        self.best_end = end;
        self.best.clone_from(&self.rollout.sequence);
        self.best_holds = holds;
    }

    /// The makespan when tasks are served in the tried order.
    fn simulate(&mut self, holds: &Holds) -> u64 {
        self.ranks_of_tried();
        self.rollout.run(&self.network, &self.ranks, holds)
    }

    fn ranks_of_tried(&mut self) {
        let late = self.network.len() as u32;
        for (rank, place) in self.tried.iter().enumerate() {
            let speculative = if self.network.is_speculative[*place as usize] { late } else { 0 };
            self.ranks[*place as usize] = speculative + rank as u32;
        }
    }
}
