//! The tasks that are left to schedule: those that have not begun, with the resources that running tasks leave free.
//!
//! Schedule generation and the disjunctive graph work on this. What never constrains is left out: kinds with enough for all tasks at
//! once, and the running tasks themselves, which become release times and resources in use at the beginning.

use super::network::{Demand, Lists, Network, Place};
use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};

/// Tasks are numbered from 0 here, each after its predecessors.
#[derive(Debug, Clone)]
pub(super) struct Project {
    /// The task's place in the network.
    pub(super) places: Vec<Place>,
    pub(super) durations: Vec<u64>,
    /// Release times: when the running tasks that a task waits for end.
    pub(super) releases: Vec<u64>,
    pub(super) before: Lists<u32>,
    pub(super) behind: Lists<u32>,
    /// Demands for contested kinds only.
    pub(super) demands: Lists<Demand>,
    /// Capacity by contested kind.
    pub(super) capacity: Vec<u64>,
    /// What running tasks hold, and until when.
    pub(super) occupied: Vec<(u64, Demand)>,
    /// When the last running task ends.
    pub(super) running_end: u64,
    /// The longest path from a task's beginning to the end.
    pub(super) remaining: Vec<u64>,
    /// How many tasks the network has, running ones included.
    network_size: usize,
}

/// A schedule.
#[derive(Debug, Clone)]
pub(super) struct Plan {
    /// The tasks that have not begun, in the order in which they begin.
    pub(super) order: Vec<Place>,
    /// By place, when each begins; running ones at 0.
    pub(super) begins: Vec<u64>,
}

impl Project {
    pub(super) fn of(network: &Network) -> Project {
        let size = network.len();
        let is_pending = |place: &Place| !network.is_running[*place as usize];
        let (contested, capacity) = contested(network);
        let places: Vec<Place> = network.order.iter().copied().filter(is_pending).collect();
        let mut numbers = vec![u32::MAX; size];
        for (number, place) in places.iter().enumerate() {
            numbers[*place as usize] = number as u32;
        }
        let demands_of = |place: &Place| -> Vec<Demand> {
            let known = |demand: &Demand| Some(Demand { kind: contested[demand.kind as usize]?, units: demand.units });
            network.demands.of_place(*place).iter().filter_map(known).filter(|demand| demand.units > 0).collect()
        };
        let numbered = |list: &[Place]| -> Vec<u32> {
            let mut list: Vec<u32> =
                list.iter().filter(|p| is_pending(p)).map(|place| numbers[*place as usize]).collect();
            list.sort_unstable();
            list.dedup();
            list
        };
        let running: Vec<Place> = (0..size as Place).filter(|place| !is_pending(place)).collect();
        let release = |place: &Place| {
            let running = network.before.of_place(*place).iter().filter(|before| !is_pending(before));
            running.map(|before| network.durations[*before as usize]).max().unwrap_or(0)
        };
        let ends = |place: &Place| network.durations[*place as usize];
        Project {
            durations: places.iter().map(ends).collect(),
            releases: places.iter().map(release).collect(),
            before: Lists::of(places.iter().map(|place| numbered(network.before.of_place(*place)))),
            behind: Lists::of(places.iter().map(|place| numbered(network.behind.of_place(*place)))),
            demands: Lists::of(places.iter().map(demands_of)),
            occupied: running.iter().flat_map(|p| demands_of(p).into_iter().map(move |d| (ends(p), d))).collect(),
            running_end: running.iter().map(ends).max().unwrap_or(0),
            remaining: places.iter().map(|place| network.remaining[*place as usize]).collect(),
            network_size: size,
            capacity,
            places,
        }
    }

    /// The tasks in the order of a list of places, as far as precedences allow; tasks that are not in the list come last.
    pub(super) fn list_of(&self, places: &[Place]) -> Vec<u32> {
        let ranks: BTreeMap<Place, usize> = places.iter().enumerate().map(|(rank, place)| (*place, rank)).collect();
        let rank = |task: u32| ranks.get(&self.places[task as usize]).copied().unwrap_or(usize::MAX);
        let mut open: Vec<usize> = (0..self.len() as u32).map(|task| self.before.of_place(task).len()).collect();
        let ready = (0..self.len() as u32).filter(|task| open[*task as usize] == 0);
        let mut next: BinaryHeap<Reverse<(usize, u32)>> = ready.map(|task| Reverse((rank(task), task))).collect();
        let mut list = Vec::with_capacity(self.len());
        while let Some(Reverse((_, task))) = next.pop() {
            list.push(task);
            for behind in self.behind.of_place(task) {
                open[*behind as usize] -= 1;
                if open[*behind as usize] == 0 {
                    next.push(Reverse((rank(*behind), *behind)));
                }
            }
        }
        list
    }

    /// Converts the start times of tasks into a plan by places.
    pub(super) fn plan_of(&self, starts: &[u64]) -> Plan {
        let mut begins = vec![0; self.network_size];
        for (place, start) in self.places.iter().zip(starts) {
            begins[*place as usize] = *start;
        }
        let mut order: Vec<u32> = (0..self.len() as u32).collect();
        order.sort_by_key(|task| (starts[*task as usize], *task));
        Plan { order: order.into_iter().map(|task| self.places[task as usize]).collect(), begins }
    }

    pub(super) fn len(&self) -> usize {
        self.places.len()
    }
}

/// By kind, its number among the contested kinds (those without enough for all tasks at once), and the capacities of these.
fn contested(network: &Network) -> (Vec<Option<u32>>, Vec<u64>) {
    let mut wanted = vec![0_u128; network.capacity.len()];
    for demand in (0..network.len() as Place).flat_map(|place| network.demands.of_place(place)) {
        wanted[demand.kind as usize] += u128::from(demand.units);
    }
    let mut capacity = Vec::new();
    let numbers = network.capacity.iter().zip(wanted).map(|(there_is, wanted)| {
        let is_contested = wanted > u128::from(*there_is);
        is_contested.then(|| {
            capacity.push(*there_is);
            capacity.len() as u32 - 1
        })
    });
    (numbers.collect(), capacity)
}
