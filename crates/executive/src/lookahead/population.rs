//! A population of activity lists, crossed: the search where a resource has several units.
//!
//! A list is decoded by the serial scheme and doubly justified, and its tasks are then put into the order in which they begin. A child takes a
//! part of its mother's list, then what is missing in its father's order, then in its mother's again (two-point crossover: Hartmann, A
//! competitive genetic algorithm for resource-constrained project scheduling, 1998; with justification: Valls, Ballestín,
//! Quintanilla, A hybrid genetic algorithm for the RCPSP, 2008). When all have become alike, all but the best are drawn anew.

use super::dice::Dice;
use super::project::{Plan, Project};
use super::schedule::Scheduler;

/// Hartmann's population for some thousand schedules.
const SIZE: usize = 40;
/// How likely a task changes places with the next, as in Hartmann's.
const MUTATION: f64 = 0.05;
/// Of so many tasks that could come next in a drawn list the one with the longest remaining path does.
const DRAWN: usize = 3;
/// After so many lists without anything better all but the best are drawn anew.
const PATIENCE: usize = 25 * SIZE;
/// A list is decoded, and justified twice.
const SCHEDULES_PER_LIST: usize = 3;

#[derive(Debug, Clone)]
struct Individual {
    list: Vec<u32>,
    end: u64,
}

/// The lists, and the best schedule found.
#[derive(Debug, Clone)]
pub(super) struct Population {
    project: Project,
    scheduler: Scheduler,
    dice: Dice,
    individuals: Vec<Individual>,
    /// Lists that are still to be decoded, the first last.
    given: Vec<Vec<u32>>,
    /// Lists that were decoded since something was found that is better.
    in_vain: usize,
    child: Vec<u32>,
    taken: Vec<bool>,
    open: Vec<u32>,
    eligible: Vec<u32>,
    best: Vec<u64>,
    best_end: u64,
    /// Of the best that was handed out.
    told_end: u64,
}

impl Population {
    /// Begins with these lists, the best first.
    pub(super) fn new(project: Project, seed: u64, lists: Vec<Vec<u32>>) -> Population {
        let size = project.len();
        Population {
            scheduler: Scheduler::new(&project),
            dice: Dice(seed),
            individuals: Vec::with_capacity(SIZE),
            given: lists.into_iter().take(SIZE).rev().collect(),
            in_vain: 0,
            child: Vec::with_capacity(size),
            taken: vec![false; size],
            open: vec![0; size],
            eligible: Vec::with_capacity(size),
            best: Vec::new(),
            best_end: u64::MAX,
            told_end: u64::MAX,
            project,
        }
    }

    /// The lists, the best first.
    pub(super) fn lists(&self) -> Vec<Vec<u32>> {
        let mut individuals: Vec<&Individual> = self.individuals.iter().collect();
        individuals.sort_by_key(|individual| individual.end);
        let lists = individuals.into_iter().map(|individual| &individual.list);
        lists.chain(self.given.iter().rev()).take(SIZE).cloned().collect()
    }

    /// The project that the lists are of.
    pub(super) fn project(&self) -> &Project {
        &self.project
    }

    /// Makes so many schedules, until one ends at `bound`; the best, if it is better than all before.
    pub(super) fn step(&mut self, schedules: usize, bound: u64) -> Option<Plan> {
        for _ in 0..schedules.div_ceil(SCHEDULES_PER_LIST) {
            if self.best_end <= bound {
                break;
            }
            if self.in_vain >= PATIENCE {
                self.begin_anew();
            }
            let end = if let Some(list) = self.given.pop() {
                self.child = list;
                self.decode()
            } else if self.individuals.len() < SIZE {
                self.draw();
                // One in two by each scheme.
                if self.individuals.len().is_multiple_of(2) { self.decode_in_parallel() } else { self.decode() }
            } else {
                self.cross();
                self.mutate();
                self.decode()
            };
            self.join(end);
        }
        (self.best_end < std::mem::replace(&mut self.told_end, self.best_end)).then(|| self.project.plan_of(&self.best))
    }

    /// A list at random, of tasks with long remaining paths first.
    fn draw(&mut self) {
        let Population { project, dice, child, open, eligible, .. } = self;
        child.clear();
        eligible.clear();
        for task in 0..project.len() as u32 {
            open[task as usize] = project.before.of_place(task).len() as u32;
            if open[task as usize] == 0 {
                eligible.push(task);
            }
        }
        while !eligible.is_empty() {
            let drawn = (0..DRAWN).map(|_| dice.below(eligible.len()));
            let remaining = |at: &usize| project.remaining[eligible[*at] as usize];
            let Some(chosen) = drawn.max_by_key(remaining) else { break };
            let task = eligible.swap_remove(chosen);
            child.push(task);
            for behind in project.behind.of_place(task) {
                let open = &mut open[*behind as usize];
                *open -= 1;
                if *open == 0 {
                    eligible.push(*behind);
                }
            }
        }
    }

    /// A child of two, each the better of two drawn.
    fn cross(&mut self) {
        let Population { individuals, dice, child, taken, .. } = self;
        let mut chosen = || {
            let (one, other) = (dice.below(individuals.len()), dice.below(individuals.len()));
            if individuals[one].end <= individuals[other].end { one } else { other }
        };
        let (mother, father) = (chosen(), chosen());
        let (mother, father) = (&individuals[mother].list, &individuals[father].list);
        let size = mother.len();
        let (one, other) = (dice.below(size + 1), dice.below(size + 1));
        let (from, to) = (one.min(other), one.max(other));
        child.clear();
        taken.fill(false);
        let sources = [(mother, from), (father, to), (mother, size)];
        for (list, until) in sources {
            for task in list {
                if child.len() == until {
                    break;
                }
                if !std::mem::replace(&mut taken[*task as usize], true) {
                    child.push(*task);
                }
            }
        }
    }

    fn mutate(&mut self) {
        for at in 1..self.child.len() {
            if self.dice.share() < MUTATION {
                let (one, next) = (self.child[at - 1], self.child[at]);
                if !self.project.before.of_place(next).contains(&one) {
                    self.child.swap(at - 1, at);
                }
            }
        }
    }

    /// Makes the child's schedule, and its list the order in which that begins; when everything has ended.
    fn decode(&mut self) -> u64 {
        let end = self.scheduler.forward(&self.project, &self.child);
        self.justify(end)
    }

    /// The same by the other scheme.
    fn decode_in_parallel(&mut self) -> u64 {
        let end = self.scheduler.parallel(&self.project, &self.child);
        self.justify(end)
    }

    fn justify(&mut self, end: u64) -> u64 {
        let end = self.scheduler.justify(&self.project, &mut self.child, end);
        self.scheduler.sort(&mut self.child);
        self.in_vain += 1;
        if end < self.best_end {
            self.best_end = end;
            self.best.clone_from(&self.scheduler.starts);
            self.in_vain = 0;
        }
        end
    }

    /// The child takes the place of the worst, unless that is better or the child is there already.
    fn join(&mut self, end: u64) {
        if self.individuals.len() < SIZE {
            return self.individuals.push(Individual { list: self.child.clone(), end });
        }
        if self.individuals.iter().any(|other| other.end == end && other.list == self.child) {
            return;
        }
        if let Some(worst) = self.individuals.iter_mut().max_by_key(|individual| individual.end)
            && end <= worst.end
        {
            worst.list.copy_from_slice(&self.child);
            worst.end = end;
        }
    }

    /// Nothing better comes of them any more: the best stays.
    fn begin_anew(&mut self) {
        self.individuals.sort_by_key(|individual| individual.end);
        self.individuals.truncate(1);
        self.in_vain = 0;
    }
}
