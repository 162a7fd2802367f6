//! A problem as numbers, for the inner loop of look-ahead.

use super::problem::{Problem, ProblemError};
use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};

/// A task, as its place in [`Problem::tasks`].
pub(super) type Place = u32;

pub(super) const NANOSECONDS: f64 = 1e9;
/// Upper limit of a duration: the durations of a hundred years add up without overflow.
const LONGEST_S: f64 = 1e8;

/// One list of numbers per task, all in one vector.
#[derive(Debug, Clone, Default)]
pub(super) struct Lists<T> {
    bounds: Vec<u32>,
    items: Vec<T>,
}

impl<T> Lists<T> {
    pub(super) fn of(lists: impl Iterator<Item = Vec<T>>) -> Lists<T> {
        let (mut bounds, mut items) = (vec![0], Vec::new());
        for list in lists {
            items.extend(list);
            bounds.push(items.len() as u32);
        }
        Lists { bounds, items }
    }

    /// The list of a task.
    pub(super) fn of_place(&self, place: Place) -> &[T] {
        let at = place as usize;
        &self.items[self.bounds[at] as usize..self.bounds[at + 1] as usize]
    }
}

/// Tasks that are held back: each with the tasks that must begin before it asks.
pub(super) type Holds = Vec<(Place, Vec<Place>)>;

/// A task's demand for one resource kind.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Demand {
    /// The kind, as an index.
    pub(super) kind: u32,
    /// In thousandths of a unit, as all amounts here.
    pub(super) units: u64,
}

/// A compiled problem.
#[derive(Debug, Clone)]
pub(super) struct Network {
    /// In nanoseconds.
    pub(super) durations: Vec<u64>,
    pub(super) is_running: Vec<bool>,
    pub(super) is_speculative: Vec<bool>,
    pub(super) demands: Lists<Demand>,
    pub(super) before: Lists<Place>,
    pub(super) behind: Lists<Place>,
    /// A topological order, else program order.
    pub(super) order: Vec<Place>,
    /// The holds that are in force now.
    pub(super) holds: Holds,
    /// By kind, in thousandths of a unit.
    pub(super) capacity: Vec<u64>,
    /// Longest remaining path in nanoseconds, including the task; priority of plain dispatch.
    pub(super) remaining: Vec<u64>,
}

impl Network {
    pub(super) fn of(problem: &Problem) -> Result<Network, ProblemError> {
        let size = problem.tasks.len();
        let mut kinds: BTreeMap<&str, u32> = BTreeMap::new();
        for (number, kind) in problem.capacity.keys().enumerate() {
            kinds.insert(kind, number as u32);
        }
        let capacity: Vec<u64> = problem.capacity.values().map(|amount| amount.thousandths()).collect();
        let mut behind = vec![Vec::new(); size];
        for (place, task) in problem.tasks.iter().enumerate() {
            let (instance, duration_s, probability) = (task.instance, task.duration_s, task.probability);
            let is_number = (0.0..=LONGEST_S).contains(&duration_s) && probability > 0.0 && probability <= 1.0;
            if !is_number {
                return Err(ProblemError::Number { instance, duration_s, probability });
            }
            for after in &task.after {
                let Some(list) = behind.get_mut(*after) else {
                    return Err(ProblemError::Unknown { instance, after: *after, tasks: size });
                };
                list.push(place as Place);
            }
            if let Some(held_for) = task.held_for.iter().find(|held_for| **held_for >= size) {
                return Err(ProblemError::Unknown { instance, after: *held_for, tasks: size });
            }
        }
        let held = problem
            .tasks
            .iter()
            .enumerate()
            .filter(|(_, task)| !task.held_for.is_empty() && !task.is_running && !task.demands.is_empty());
        let demands = |task: &super::problem::Task| {
            let mut units: BTreeMap<u32, u64> = BTreeMap::new();
            for (kind, count) in &task.demands {
                if let Some(kind) = kinds.get(kind.as_str()) {
                    *units.entry(*kind).or_default() += count.thousandths();
                }
            }
            // A demand above the capacity is never granted; the resource manager tells the executive so.
            units.into_iter().map(|(kind, units)| Demand { kind, units: units.min(capacity[kind as usize]) }).collect()
        };
        let places = |list: &[usize]| list.iter().map(|at| *at as Place).collect::<Vec<Place>>();
        let mut network = Network {
            durations: problem.tasks.iter().map(|task| (task.duration_s * NANOSECONDS).round() as u64).collect(),
            is_running: problem.tasks.iter().map(|task| task.is_running).collect(),
            is_speculative: problem.tasks.iter().map(|task| task.is_speculative).collect(),
            demands: Lists::of(problem.tasks.iter().map(demands)),
            before: Lists::of(problem.tasks.iter().map(|task| places(&task.after))),
            behind: Lists::of(behind.into_iter()),
            holds: held.map(|(at, task)| (at as Place, places(&task.held_for))).collect(),
            order: Vec::with_capacity(size),
            remaining: vec![0; size],
            capacity,
        };
        match network.measure() {
            Some(in_a_circle) => Err(ProblemError::Circular { instance: problem.tasks[in_a_circle as usize].instance }),
            None => Ok(network),
        }
    }

    /// Lower bound of the makespan, in nanoseconds: by the longest path, and by the work of each kind with the shortest way to and
    /// from it.
    pub(super) fn bound(&self) -> u64 {
        let places = || 0..self.len() as Place;
        let heads = self.heads();
        let path = places().map(|place| heads[place as usize] + self.remaining[place as usize]).max().unwrap_or(0);
        let (mut work, mut head, mut tail) = (
            vec![0_u128; self.capacity.len()],
            vec![u64::MAX; self.capacity.len()],
            vec![u64::MAX; self.capacity.len()],
        );
        for place in places() {
            let at = place as usize;
            for demand in self.demands.of_place(place) {
                let kind = demand.kind as usize;
                work[kind] += u128::from(self.durations[at]) * u128::from(demand.units);
                head[kind] = head[kind].min(heads[at]);
                tail[kind] = tail[kind].min(self.remaining[at] - self.durations[at]);
            }
        }
        let loads = (0..self.capacity.len()).filter(|kind| work[*kind] > 0).map(|kind| {
            let busy = work[kind].div_ceil(u128::from(self.capacity[kind].max(1)));
            u64::try_from(busy).unwrap_or(u64::MAX).saturating_add(head[kind]).saturating_add(tail[kind])
        });
        loads.max().unwrap_or(0).max(path)
    }

    /// The longest path to each task, without its own duration.
    fn heads(&self) -> Vec<u64> {
        let mut heads = vec![0; self.len()];
        for place in &self.order {
            let end = heads[*place as usize] + self.durations[*place as usize];
            for behind in self.behind.of_place(*place) {
                heads[*behind as usize] = heads[*behind as usize].max(end);
            }
        }
        heads
    }

    pub(super) fn len(&self) -> usize {
        self.durations.len()
    }

    /// Computes the order and the remaining paths; returns a task that waits for itself, if there is one.
    fn measure(&mut self) -> Option<Place> {
        let size = self.len();
        let mut open: Vec<u32> = (0..size).map(|at| self.before.of_place(at as Place).len() as u32).collect();
        let ready = (0..size as Place).filter(|place| open[*place as usize] == 0);
        let mut next: BinaryHeap<Reverse<Place>> = ready.map(Reverse).collect();
        while let Some(Reverse(place)) = next.pop() {
            self.order.push(place);
            for behind in self.behind.of_place(place) {
                open[*behind as usize] -= 1;
                if open[*behind as usize] == 0 {
                    next.push(Reverse(*behind));
                }
            }
        }
        for place in self.order.iter().rev() {
            let behind = self.behind.of_place(*place).iter().map(|after| self.remaining[*after as usize]);
            self.remaining[*place as usize] = self.durations[*place as usize] + behind.max().unwrap_or(0);
        }
        if self.order.len() == size { None } else { (0..size as Place).find(|place| open[*place as usize] > 0) }
    }
}
