//! Two populations of activity lists, crossed in turn: the search where a resource has several units.
//!
//! One population's schedules begin everything as early as possible, the other's end everything as late as possible. The children of one are
//! scheduled in the other's way and join it (Debels, Vanhoucke: A bi-population based genetic algorithm for the resource-constrained
//! project scheduling problem, 2005): each generation justifies the one before, for one schedule per child where double
//! justification takes two more. A child takes the place of the one that is where its mother is, unless that is better. When
//! nothing better comes of them, all are drawn anew but the best.

use super::project::{Plan, Project};
use super::schedule::Scheduler;
use super::variation::{Direction, Variation};

/// How many each population has: up to 60 tasks as many as Hartmann's has for some thousand schedules, of more two for each three of them up to the
/// second number. Measured on PSPLIB: with 3,000 schedules twice as many are worse for 120 tasks, with 30,000 a little better.
const SIZES: [usize; 2] = [40, 80];
/// After so many schedules for each of a population without anything better all but the best are drawn anew.
const PATIENCE: usize = 75;
/// A list that is given is scheduled, and its schedule justified to the end and back.
const SCHEDULES_OF_GIVEN: usize = 3;

/// A schedule.
#[derive(Debug, Clone)]
struct Individual {
    /// Its tasks in the order in which the schedule has them from the side on which the other population begins.
    list: Vec<u32>,
    /// How long it takes.
    takes: u64,
}

/// The populations, and the best schedule found.
#[derive(Debug, Clone)]
pub(super) struct Population {
    project: Project,
    scheduler: Scheduler,
    variation: Variation,
    /// How many are in each.
    size: usize,
    /// Those that were scheduled forward.
    early: Vec<Individual>,
    /// Those that were scheduled backward.
    late: Vec<Individual>,
    /// In which direction the present generation of children is scheduled.
    direction: Direction,
    /// The next mother.
    mother: usize,
    /// Lists that are still to be scheduled, the first last.
    given: Vec<Vec<u32>>,
    /// Schedules that were made since something was found that is better.
    in_vain: usize,
    child: Vec<u32>,
    /// When each task begins in the best schedule.
    best: Vec<u64>,
    best_list: Vec<u32>,
    best_end: u64,
    /// Of the best that was handed out.
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

    /// The lists, the best first.
    pub(super) fn lists(&self) -> Vec<Vec<u32>> {
        let mut early: Vec<&Individual> = self.early.iter().collect();
        early.sort_by_key(|individual| individual.takes);
        // What is in the order of the ends, the last first, is backwards in an order in which it could begin.
        let early = early.into_iter().map(|individual| individual.list.iter().rev().copied().collect());
        let best = (!self.best_list.is_empty()).then(|| self.best_list.clone());
        best.into_iter().chain(early).chain(self.given.iter().rev().cloned()).take(self.size).collect()
    }

    /// The project that the lists are of.
    pub(super) fn project(&self) -> &Project {
        &self.project
    }

    /// Makes so many schedules or a few more, until one ends at `bound`; the best, if it is better than all before.
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

    /// A given list joins the early ones; how many schedules that took.
    fn take(&mut self, list: Vec<u32>) -> usize {
        self.child = list;
        let end = self.scheduler.forward(&self.project, &self.child);
        let end = self.scheduler.justify(&self.project, &mut self.child, end);
        self.note(end);
        self.join_early(end);
        SCHEDULES_OF_GIVEN
    }

    /// A drawn list joins the early ones, one in two by each scheme; how many schedules that took.
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

    /// A child of the next mother and the better of two others joins the other population; how many schedules that took.
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

    /// Keeps the schedule made last, of the child, if it is better.
    fn note(&mut self, end: u64) {
        if end < self.best_end {
            self.best_end = end;
            self.best.clone_from(&self.scheduler.starts);
            self.best_list.clone_from(&self.child);
            self.scheduler.sort(&mut self.best_list);
            self.in_vain = 0;
        }
    }

    /// Nothing better comes of them any more: the best stays.
    fn begin_anew(&mut self) {
        self.early.clear();
        self.late.clear();
        (self.direction, self.mother) = (Direction::Backward, 0);
        self.given.push(self.best_list.clone());
        self.in_vain = 0;
    }
}
