//! Schedules made from lists: the serial schedule generation scheme for several resources with several units, and double
//! justification.
//!
//! The scheme takes the tasks in the order of a list and begins each as early as its predecessors and the resources allow (Kolisch,
//! Hartmann: Heuristic algorithms for the resource-constrained project scheduling problem, 1999); at least one list gives an optimal
//! schedule. Justification moves all tasks as far to the end as possible, the last first, and then all back to the beginning, the first
//! first. The makespan never grows and often shrinks (Valls, Ballestín, Quintanilla: Justification and RCPSP, 2005).

use super::network::{Demand, Lists};
use super::packed::Lanes;
use super::profile::Profile;
use super::project::Project;
use std::cmp::Reverse;
use std::collections::{BTreeSet, BinaryHeap};

/// Makes schedules; its memory is reused by the next one.
#[derive(Debug, Clone)]
pub(super) struct Scheduler {
    profile: Profile,
    /// By task, its demand as words; empty if it needs nothing.
    wanted: Lists<u64>,
    /// What running tasks leave free, and until when, sorted by time; after the last entry everything is free.
    left: Vec<(u64, Vec<u64>)>,
    all: Vec<u64>,
    /// When each task begins in the schedule made last.
    pub(super) starts: Vec<u64>,
    /// Time from the end: when each task ends.
    mirrored: Vec<u64>,
    parallel: Parallel,
}

/// State of the parallel scheme.
#[derive(Debug, Clone, Default)]
struct Parallel {
    free: Vec<u64>,
    /// By task, the number of predecessors that have not ended.
    open: Vec<u32>,
    /// Tasks that are ready but lack resources, by rank.
    asking: BTreeSet<(u32, u32)>,
    ending: BinaryHeap<Reverse<(u64, Ending)>>,
    ranks: Vec<u32>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Ending {
    /// A running task gives back what it holds.
    Occupied(u32),
    /// The running predecessors of a task have ended.
    Released(u32),
    Task(u32),
}

impl Scheduler {
    pub(super) fn new(project: &Project) -> Scheduler {
        let demands = || (0..project.len() as u32).map(|task| project.demands.of_place(task));
        let occupied = project.occupied.iter().map(|(_, demand)| demand);
        let lanes = Lanes::of(&project.capacity, demands().flatten().chain(occupied));
        let wanted = |demands: &[Demand]| if demands.is_empty() { Vec::new() } else { lanes.wanted(demands) };
        Scheduler {
            wanted: Lists::of(demands().map(wanted)),
            left: left(project, &lanes),
            all: lanes.free(&project.capacity),
            profile: Profile::new(lanes),
            starts: vec![0; project.len()],
            mirrored: vec![0; project.len()],
            parallel: Parallel::default(),
        }
    }

    /// Serial scheme: begins every task as early as possible, in the order of `list`, in which each task comes after its predecessors.
    /// Returns the makespan.
    pub(super) fn forward(&mut self, project: &Project, list: &[u32]) -> u64 {
        self.profile.clear();
        let mut from = 0;
        for (until, free) in &self.left {
            self.profile.then(from, free);
            from = *until;
        }
        self.profile.then(from, &self.all);
        let mut end = project.running_end;
        for task in list {
            let at = *task as usize;
            let ends = |before: &u32| self.starts[*before as usize] + project.durations[*before as usize];
            let ready = project.before.of_place(*task).iter().map(ends).max().unwrap_or(0).max(project.releases[at]);
            let start = self.place(*task, ready, project.durations[at]);
            self.starts[at] = start;
            end = end.max(start + project.durations[at]);
        }
        end
    }

    /// Parallel scheme: begins at each moment whatever can begin then, in the order of `list`, as dispatch does. Returns the makespan.
    pub(super) fn parallel(&mut self, project: &Project, list: &[u32]) -> u64 {
        let Parallel { free, open, asking, ending, ranks } = &mut self.parallel;
        free.clone_from(&project.capacity);
        ending.clear();
        asking.clear();
        ranks.resize(list.len(), 0);
        for (rank, task) in list.iter().enumerate() {
            ranks[*task as usize] = rank as u32;
        }
        for (number, (until, demand)) in project.occupied.iter().enumerate() {
            free[demand.kind as usize] = free[demand.kind as usize].saturating_sub(demand.units);
            ending.push(Reverse((*until, Ending::Occupied(number as u32))));
        }
        open.clear();
        for task in 0..project.len() as u32 {
            let before = project.before.of_place(task).len() as u32;
            // All running predecessors count as one.
            open.push(before + 1);
            ending.push(Reverse((project.releases[task as usize], Ending::Released(task))));
        }
        let mut end = project.running_end;
        while let Some(Reverse((now, first))) = ending.pop() {
            let mut ended = Some(first);
            while let Some(this) = ended {
                match this {
                    Ending::Occupied(number) => {
                        let (_, demand) = project.occupied[number as usize];
                        free[demand.kind as usize] += demand.units;
                    }
                    Ending::Released(task) => {
                        open[task as usize] -= 1;
                        if open[task as usize] == 0 {
                            asking.insert((ranks[task as usize], task));
                        }
                    }
                    Ending::Task(task) => {
                        for demand in project.demands.of_place(task) {
                            free[demand.kind as usize] += demand.units;
                        }
                        for behind in project.behind.of_place(task) {
                            open[*behind as usize] -= 1;
                            if open[*behind as usize] == 0 {
                                asking.insert((ranks[*behind as usize], *behind));
                            }
                        }
                    }
                }
                ended = match ending.peek() {
                    Some(Reverse((then, _))) if *then == now => ending.pop().map(|Reverse((_, next))| next),
                    _ => None,
                };
            }
            asking.retain(|(_, task)| {
                let demands = project.demands.of_place(*task);
                if !demands.iter().all(|demand| free[demand.kind as usize] >= demand.units) {
                    return true;
                }
                for demand in demands {
                    free[demand.kind as usize] -= demand.units;
                }
                self.starts[*task as usize] = now;
                let ends = now + project.durations[*task as usize];
                end = end.max(ends);
                ending.push(Reverse((ends, Ending::Task(*task))));
                false
            });
        }
        end
    }

    /// Double justification of the last schedule: to the end and back to the beginning. Sorts `list` by begin. Returns the makespan.
    pub(super) fn justify(&mut self, project: &Project, list: &mut [u32], end: u64) -> u64 {
        self.sort_from_end(project, list);
        let end = self.backward(project, list, end);
        self.sort_from_begin(project, list, end);
        let end = self.forward(project, list);
        self.sort(list);
        end
    }

    /// Ends every task as late as possible before `end`, in the order of `list`, in which each task comes before its predecessors. Returns
    /// the length of the schedule.
    pub(super) fn backward(&mut self, project: &Project, list: &[u32], end: u64) -> u64 {
        self.profile.clear();
        let mut from = 0;
        let mut free = &self.all;
        for (until, left) in self.left.iter().rev() {
            if from < end.saturating_sub(*until) {
                self.profile.then(from, free);
            }
            (from, free) = (end.saturating_sub(*until), left);
        }
        self.profile.then(from, free);
        if from < end && !self.left.is_empty() {
            self.profile.then(end, &self.all);
        }
        let mut takes = 0;
        for task in list {
            let at = *task as usize;
            let begins = |behind: &u32| self.mirrored[*behind as usize] + project.durations[*behind as usize];
            let ready = project.behind.of_place(*task).iter().map(begins).max().unwrap_or(0);
            let from_end = self.place(*task, ready, project.durations[at]);
            self.mirrored[at] = from_end;
            takes = takes.max(from_end + project.durations[at]);
        }
        takes
    }

    /// Sorts a list by the ends of the last schedule, the last end first.
    pub(super) fn sort_from_end(&self, project: &Project, list: &mut [u32]) {
        // Predecessors have smaller numbers, which decides among tasks of zero duration.
        let (starts, durations) = (&self.starts, &project.durations);
        list.sort_unstable_by_key(|task| {
            let at = *task as usize;
            Reverse((starts[at] + durations[at], *task))
        });
    }

    /// Sorts a list by the begins of the last backward schedule, whose length is `takes`.
    pub(super) fn sort_from_begin(&self, project: &Project, list: &mut [u32], takes: u64) {
        let (mirrored, durations) = (&self.mirrored, &project.durations);
        list.sort_unstable_by_key(|task| {
            let at = *task as usize;
            (takes.saturating_sub(mirrored[at] + durations[at]), *task)
        });
    }

    /// Places a task at the earliest possible moment from `ready` on, and takes its resources.
    fn place(&mut self, task: u32, ready: u64, duration: u64) -> u64 {
        let wanted = self.wanted.of_place(task);
        if wanted.is_empty() {
            return ready;
        }
        self.profile.take(wanted, ready, duration)
    }

    /// Sorts a list by the begins of the last schedule.
    pub(super) fn sort(&self, list: &mut [u32]) {
        list.sort_unstable_by_key(|task| (self.starts[*task as usize], *task));
    }
}

/// What running tasks leave free, and until when.
fn left(project: &Project, lanes: &Lanes) -> Vec<(u64, Vec<u64>)> {
    let mut ends: Vec<u64> = project.occupied.iter().map(|(until, _)| *until).filter(|until| *until > 0).collect();
    ends.sort_unstable();
    ends.dedup();
    let until = |end: u64| {
        let mut free = project.capacity.clone();
        for (_, demand) in project.occupied.iter().filter(|(until, _)| *until >= end) {
            // The capacity may have shrunk since the grant.
            free[demand.kind as usize] = free[demand.kind as usize].saturating_sub(demand.units);
        }
        (end, lanes.free(&free))
    };
    ends.into_iter().map(until).collect()
}
