//! Two populations of activity lists, crossed in turn: the search where a resource has several units.
//!
//! The schedules of one population begin everything as early as possible, those of the other end everything as late as possible. The children of
//! one population are scheduled in the direction of the other and join it (Debels, Vanhoucke: A bi-population based genetic algorithm for the
//! resource-constrained project scheduling problem, 2005). So each generation justifies the one before it with one schedule per child, where double
//! justification needs two more. A child replaces the individual at its mother's position in that population, unless that one is better. When there
//! is no improvement for long, all but the best are replaced by random ones.

use super::project::{Plan, Project};
use super::schedule::Scheduler;
use super::variation::{Direction, Variation};

/// Size of each population: for up to 60 tasks as many as Hartmann's for some thousand schedules; for more tasks two for each three of them, up to
/// the second number. Measured on PSPLIB: with 3,000 schedules twice as many are worse for 120 tasks, with 30,000 a little better.
const SIZES: [usize; 2] = [40, 80];
/// After this many schedules per individual without an improvement, all but the best are replaced by random ones.
const PATIENCE: usize = 75;
/// A given list costs three schedules: its own, and its justification to the end and back.
const SCHEDULES_OF_GIVEN: usize = 3;

/// One schedule of a population.
#[derive(Debug, Clone)]
struct Individual {
    /// Its tasks, in the order of the schedule seen from the side on which the other population begins.
    list: Vec<u32>,
    /// Makespan.
    takes: u64,
}

/// The populations, and the best schedule found.
#[derive(Debug, Clone)]
pub(super) struct Population {
    project: Project,
    scheduler: Scheduler,
    variation: Variation,
    /// Number of individuals in each.
    size: usize,
    /// Individuals that were scheduled forward.
    early: Vec<Individual>,
    /// Individuals that were scheduled backward.
    late: Vec<Individual>,
    /// In which direction the present generation of children is scheduled.
    direction: Direction,
    /// The next mother.
    mother: usize,
    /// Given lists that are still to be scheduled; the first one stands last.
    given: Vec<Vec<u32>>,
    /// Schedules since the last improvement.
    in_vain: usize,
    child: Vec<u32>,
    /// When each task begins in the best schedule.
    best: Vec<u64>,
    best_list: Vec<u32>,
    best_end: u64,
    /// Makespan of the best schedule that was handed out.
    told_end: u64,
}

impl Population {
    /// Begins with these lists, the best first.
    pub(super) fn new(project: Project, seed: u64, lists: Vec<Vec<u32>>) -> Population {
        let tasks = project.len();
        let [least, most] = SIZES;
        let size = (2 * tasks / 3).clamp(least, most);
        Population {
            size,
            scheduler: Scheduler::new(&project),
            variation: Variation::new(tasks, seed),
            early: Vec::with_capacity(size),
            late: Vec::with_capacity(size),
            direction: Direction::Backward,
            mother: 0,
            given: lists.into_iter().take(size).rev().collect(),
            in_vain: 0,
            child: Vec::with_capacity(tasks),
            best: Vec::new(),
            best_list: Vec::new(),
            best_end: u64::MAX,
            told_end: u64::MAX,
            project,
        }
    }

    /// The lists of both populations, the best first.
    pub(super) fn lists(&self) -> Vec<Vec<u32>> {
        let mut early: Vec<&Individual> = self.early.iter().collect();
        early.sort_by_key(|individual| individual.takes);
        // A list sorted by ends, the last first, becomes a possible order of begins when it is reversed.
        let early = early.into_iter().map(|individual| individual.list.iter().rev().copied().collect());
        let best = (!self.best_list.is_empty()).then(|| self.best_list.clone());
        best.into_iter().chain(early).chain(self.given.iter().rev().cloned()).take(self.size).collect()
    }

    /// The project that the lists are of.
    pub(super) fn project(&self) -> &Project {
        &self.project
    }

    /// Makes at least `schedules` schedules, unless one reaches `bound`; returns the best schedule if it is new.
    pub(super) fn step(&mut self, schedules: usize, bound: u64) -> Option<Plan> {
        let mut made = 0;
        while made < schedules && self.best_end > bound {
            if self.in_vain >= PATIENCE * self.size {
                self.begin_anew();
            }
            let more = if let Some(list) = self.given.pop() {
                self.take(list)
            } else if self.early.len() < self.size {
                self.draw()
            } else {
                self.bear()
            };
            made += more;
            self.in_vain += more;
        }
        (self.best_end < std::mem::replace(&mut self.told_end, self.best_end)).then(|| self.project.plan_of(&self.best))
    }

    /// A given list joins the early population; returns the number of schedules made.
    fn take(&mut self, list: Vec<u32>) -> usize {
        self.child = list;
        let end = self.scheduler.forward(&self.project, &self.child);
        let end = self.scheduler.justify(&self.project, &mut self.child, end);
        self.note(end);
        self.join_early(end);
        SCHEDULES_OF_GIVEN
    }

    /// A random list joins the early population, half of them by each scheme; returns the number of schedules made.
    fn draw(&mut self) -> usize {
        self.variation.draw(&self.project, &mut self.child);
        let is_parallel = self.early.len().is_multiple_of(2);
        let scheme = if is_parallel { Scheduler::parallel } else { Scheduler::forward };
        let end = scheme(&mut self.scheduler, &self.project, &self.child);
        self.note(end);
        self.join_early(end);
        1
    }

    fn join_early(&mut self, takes: u64) {
        self.scheduler.sort_from_end(&self.project, &mut self.child);
        self.early.push(Individual { list: self.child.clone(), takes });
    }

    /// A child of the next mother and of the better of two others joins the other population; returns the number of schedules made.
    fn bear(&mut self) -> usize {
        let Population { project, variation, child, direction, .. } = self;
        let (parents, number) = match direction {
            Direction::Forward => (&self.late, self.mother),
            Direction::Backward => (&self.early, self.mother),
        };
        let (one, other) = (variation.below(parents.len()), variation.below(parents.len()));
        let father = if parents[one].takes <= parents[other].takes { one } else { other };
        let mother = &parents[number];
        variation.cross(project, *direction, [&mother.list, &parents[father].list], child);
        variation.mutate(project, *direction, child);
        self.mother += 1;
        let is_last = self.mother == parents.len();
        let (takes, made) = match self.direction {
            Direction::Forward => {
                let end = self.scheduler.forward(&self.project, &self.child);
                self.note(end);
                self.scheduler.sort_from_end(&self.project, &mut self.child);
                (end, 1)
            }
            Direction::Backward => {
                let end = mother.takes;
                let takes = self.scheduler.backward(&self.project, &self.child, end);
                self.scheduler.sort_from_begin(&self.project, &mut self.child, takes);
                let is_better = takes < self.best_end;
                if is_better {
                    let end = self.scheduler.forward(&self.project, &self.child);
                    self.note(end);
                }
                (takes, 1 + usize::from(is_better))
            }
        };
        let children = match self.direction {
            Direction::Forward => &mut self.early,
            Direction::Backward => &mut self.late,
        };
        match children.get_mut(number) {
            None => children.push(Individual { list: self.child.clone(), takes }),
            Some(there) if takes <= there.takes => {
                there.list.clone_from(&self.child);
                there.takes = takes;
            }
            Some(_) => {}
        }
        if is_last {
            self.mother = 0;
            self.direction = self.direction.other();
        }
        made
    }

    /// Keeps the child's schedule, made last, if it is better than the best.
    fn note(&mut self, end: u64) {
        if end < self.best_end {
            self.best_end = end;
            self.best.clone_from(&self.scheduler.starts);
            self.best_list.clone_from(&self.child);
            self.scheduler.sort(&mut self.best_list);
            self.in_vain = 0;
        }
    }

    /// No more improvement: replaces all but the best by random ones.
    fn begin_anew(&mut self) {
        self.early.clear();
        self.late.clear();
        (self.direction, self.mother) = (Direction::Backward, 0);
        self.given.push(self.best_list.clone());
        self.in_vain = 0;
    }
}
