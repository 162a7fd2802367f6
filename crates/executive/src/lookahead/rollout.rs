//! One simulation of the rest of the window under the executive's dispatch.
//!
//! An instance asks for its resources as soon as its predecessors have ended. The resource manager serves requests by priority; a
//! request that cannot be served reserves what is free of its demand. Endings are handled one at a time: first the tasks that became
//! ready ask, then the ended task gives back its resources. A task that is held back asks once the others have begun. A run allocates
//! no memory, unless it follows a plan. Then each task that could begin earlier than planned is held back; so the run finds the holds
//! with which dispatch leads to the plan.

use super::network::{Holds, Network, Place};
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// The state of a simulation, reused by the next one.
#[derive(Debug, Clone)]
pub(super) struct Rollout {
    waits: Vec<u32>,
    free: Vec<u64>,
    reserved: Vec<u64>,
    /// Tasks that ask for resources, the most urgent first.
    asking: Vec<Place>,
    became_ready: Vec<Place>,
    /// By task, how many tasks must still begin before it is released from its hold.
    held: Vec<u32>,
    /// By task, the tasks that are held back for it.
    holds: Vec<Vec<Place>>,
    has_begun: Vec<bool>,
    /// Ends of running tasks; at the same moment, the one that began first.
    ending: BinaryHeap<Reverse<(u64, u32, Place)>>,
    /// By task, when it began.
    pub(super) began: Vec<u64>,
    /// The tasks in the order in which they began.
    pub(super) sequence: Vec<Place>,
}

impl Rollout {
    pub(super) fn new(network: &Network) -> Rollout {
        let size = network.len();
        Rollout {
            waits: vec![0; size],
            free: vec![0; network.capacity.len()],
            reserved: vec![0; network.capacity.len()],
            asking: Vec::with_capacity(size),
            became_ready: Vec::with_capacity(size),
            held: vec![0; size],
            holds: vec![Vec::new(); size],
            has_begun: vec![false; size],
            ending: BinaryHeap::with_capacity(size),
            began: vec![0; size],
            sequence: Vec::with_capacity(size),
        }
    }

    /// Simulates the dispatch with the priorities `ranks` (smaller first) and the given holds. Returns the moment of the last ending,
    /// in nanoseconds; the greatest number if tasks that are held back wait for each other.
    pub(super) fn run(&mut self, network: &Network, ranks: &[u32], holds: &Holds) -> u64 {
        self.clear(network);
        for (place, held_for) in holds {
            for other in held_for {
                self.held[*place as usize] += 1;
                self.holds[*other as usize].push(*place);
            }
        }
        let end = self.simulate(network, ranks, &mut None);
        if self.sequence.len() == network.len() { end } else { u64::MAX }
    }

    /// Simulates a plan, given by the begin of each task; `ranks` is its order. Returns the holds that lead to it.
    pub(super) fn holds_of_plan(&mut self, network: &Network, ranks: &[u32], plan: &[u64]) -> Holds {
        self.clear(network);
        let mut guide = Some(Guide { plan, holds: Vec::new() });
        self.simulate(network, ranks, &mut guide);
        guide.map(|guide| guide.holds).unwrap_or_default()
    }

    fn clear(&mut self, network: &Network) {
        self.free.copy_from_slice(&network.capacity);
        self.asking.clear();
        self.became_ready.clear();
        self.ending.clear();
        self.sequence.clear();
        self.held.fill(0);
        self.holds.iter_mut().for_each(Vec::clear);
        self.has_begun.fill(false);
        for place in 0..network.len() as Place {
            self.waits[place as usize] = network.before.of_place(place).len() as u32;
        }
    }

    fn simulate(&mut self, network: &Network, ranks: &[u32], guide: &mut Option<Guide<'_>>) -> u64 {
        for place in 0..network.len() as Place {
            if network.is_running[place as usize] {
                self.begin(network, place, 0);
            } else if self.waits[place as usize] == 0 && self.held[place as usize] == 0 {
                self.became_ready.push(place);
            }
        }
        self.ask(network, ranks, 0, guide);
        let mut now = 0;
        while let Some(Reverse((then, _, ended))) = self.ending.pop() {
            now = then;
            for behind in network.behind.of_place(ended) {
                let at = *behind as usize;
                self.waits[at] -= 1;
                if self.waits[at] == 0 && self.held[at] == 0 && !network.is_running[at] {
                    self.became_ready.push(*behind);
                }
            }
            self.ask(network, ranks, now, guide);
            let held = network.demands.of_place(ended);
            if !held.is_empty() {
                held.iter().for_each(|demand| self.free[demand.kind as usize] += demand.units);
                self.serve(network, ranks, now, guide);
                self.ask(network, ranks, now, guide);
            }
        }
        now
    }

    /// Tasks that became ready ask, the most urgent first; then those that these begins release from a hold.
    fn ask(&mut self, network: &Network, ranks: &[u32], now: u64, guide: &mut Option<Guide<'_>>) {
        while !self.became_ready.is_empty() {
            let mut added = false;
            let mut at = 0;
            while let Some(place) = self.became_ready.get(at).copied() {
                at += 1;
                if network.demands.of_place(place).is_empty() {
                    self.begin(network, place, now);
                    continue;
                }
                let rank = ranks[place as usize];
                let before = self.asking.partition_point(|other| ranks[*other as usize] < rank);
                self.asking.insert(before, place);
                added = true;
            }
            self.became_ready.clear();
            if added {
                self.serve(network, ranks, now, guide);
            }
        }
    }

    /// Serves the requests that can be served; the others reserve what is free of their demand.
    fn serve(&mut self, network: &Network, ranks: &[u32], now: u64, guide: &mut Option<Guide<'_>>) {
        self.reserved.fill(0);
        let mut kept = 0;
        for at in 0..self.asking.len() {
            let place = self.asking[at];
            let demands = network.demands.of_place(place);
            let left = |free: &[u64], reserved: &[u64], kind: u32| free[kind as usize] - reserved[kind as usize];
            if demands.iter().all(|d| d.units <= left(&self.free, &self.reserved, d.kind)) {
                if guide.as_mut().is_none_or(|guide| !self.holds_back(network, ranks, guide, place, now)) {
                    self.begin(network, place, now);
                }
            } else {
                for demand in demands {
                    let there = left(&self.free, &self.reserved, demand.kind);
                    self.reserved[demand.kind as usize] += there.min(demand.units);
                }
                self.asking[kept] = place;
                kept += 1;
            }
        }
        self.asking.truncate(kept);
    }

    /// Whether a task that could begin is planned for later, and another task is to begin before it: then it is held back.
    fn holds_back(&mut self, network: &Network, ranks: &[u32], guide: &mut Guide<'_>, place: Place, now: u64) -> bool {
        let at = place as usize;
        if guide.plan[at] <= now {
            return false;
        }
        let demands = network.demands.of_place(place);
        let shares = |other: Place| {
            network.demands.of_place(other).iter().any(|theirs| demands.iter().any(|own| own.kind == theirs.kind))
        };
        let is_before = |other: &Place| ranks[*other as usize] < ranks[at] && !self.has_begun[*other as usize];
        let held_for: Vec<Place> =
            (0..network.len() as Place).filter(|other| is_before(other) && shares(*other)).collect();
        if held_for.is_empty() {
            return false;
        }
        self.held[at] = held_for.len() as u32;
        held_for.iter().for_each(|other| self.holds[*other as usize].push(place));
        guide.holds.push((place, held_for));
        true
    }

    fn begin(&mut self, network: &Network, place: Place, now: u64) {
        let at = place as usize;
        for demand in network.demands.of_place(place) {
            let free = &mut self.free[demand.kind as usize];
            *free = free.saturating_sub(demand.units);
        }
        self.began[at] = now;
        self.has_begun[at] = true;
        for number in 0..self.holds[at].len() {
            let held = self.holds[at][number] as usize;
            self.held[held] -= 1;
            if self.held[held] == 0 && self.waits[held] == 0 && !self.has_begun[held] {
                self.became_ready.push(held as Place);
            }
        }
        let number = self.sequence.len() as u32;
        self.sequence.push(place);
        self.ending.push(Reverse((now + network.durations[at], number, place)));
    }
}

/// The plan to follow.
struct Guide<'a> {
    plan: &'a [u64],
    holds: Holds,
}
