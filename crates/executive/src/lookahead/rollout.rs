//! One simulation of the rest of the window under the executive's dispatch.
//!
//! An instance asks for its resources as soon as what it waits for has ended. The resource manager serves requests by priority;
//! a request that cannot be served reserves what is free of what it needs. Endings are handled one at a time: first those that
//! became ready ask, then what has ended gives back what it held. Nothing is allocated while it runs.

use super::network::{Network, Place};
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// The state of a simulation; kept and used again by the next.
#[derive(Debug, Clone)]
pub(super) struct Rollout {
    waits: Vec<u32>,
    free: Vec<u64>,
    reserved: Vec<u64>,
    /// Those that ask, the most urgent first.
    asking: Vec<Place>,
    became_ready: Vec<Place>,
    /// When which ends; of the same moment, what began first.
    ending: BinaryHeap<Reverse<(u64, u32, Place)>>,
    /// When it began.
    pub(super) began: Vec<u64>,
    /// In the order in which they began.
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
            ending: BinaryHeap::with_capacity(size),
            began: vec![0; size],
            sequence: Vec::with_capacity(size),
        }
    }

    /// Simulates; `ranks` says by task who is served before whom, smaller first. The moment of the last ending, in nanoseconds.
    pub(super) fn run(&mut self, network: &Network, ranks: &[u32]) -> u64 {
        self.free.copy_from_slice(&network.capacity);
        self.asking.clear();
        self.became_ready.clear();
        self.ending.clear();
        self.sequence.clear();
        for place in 0..network.len() as Place {
            let at = place as usize;
            self.waits[at] = network.before.of_place(place).len() as u32;
            if network.is_running[at] {
                self.begin(network, place, 0);
            } else if self.waits[at] == 0 {
                self.became_ready.push(place);
            }
        }
        self.ask(network, ranks, 0);
        let mut now = 0;
        while let Some(Reverse((then, _, ended))) = self.ending.pop() {
            now = then;
            for behind in network.behind.of_place(ended) {
                let waits = &mut self.waits[*behind as usize];
                *waits -= 1;
                if *waits == 0 && !network.is_running[*behind as usize] {
                    self.became_ready.push(*behind);
                }
            }
            self.ask(network, ranks, now);
            let held = network.demands.of_place(ended);
            if !held.is_empty() {
                held.iter().for_each(|demand| self.free[demand.kind as usize] += demand.units);
                self.serve(network, now);
            }
        }
        now
    }

    /// What became ready asks, the most urgent first.
    fn ask(&mut self, network: &Network, ranks: &[u32], now: u64) {
        if self.became_ready.is_empty() {
            return;
        }
        let mut added = false;
        for at in 0..self.became_ready.len() {
            let place = self.became_ready[at];
            if network.demands.of_place(place).is_empty() {
                self.begin(network, place, now);
                continue;
            }
            let rank = ranks[place as usize];
            let behind = self.asking.partition_point(|other| ranks[*other as usize] < rank);
            self.asking.insert(behind, place);
            added = true;
        }
        self.became_ready.clear();
        if added {
            self.serve(network, now);
        }
    }

    /// Who can be served is; who cannot reserves what there is of what it needs.
    fn serve(&mut self, network: &Network, now: u64) {
        self.reserved.fill(0);
        let mut kept = 0;
        for at in 0..self.asking.len() {
            let place = self.asking[at];
            let demands = network.demands.of_place(place);
            let left = |free: &[u64], reserved: &[u64], kind: u32| free[kind as usize] - reserved[kind as usize];
            if demands.iter().all(|d| d.units <= left(&self.free, &self.reserved, d.kind)) {
                self.begin(network, place, now);
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

    fn begin(&mut self, network: &Network, place: Place, now: u64) {
        let at = place as usize;
        for demand in network.demands.of_place(place) {
            let free = &mut self.free[demand.kind as usize];
            *free = free.saturating_sub(demand.units);
        }
        self.began[at] = now;
        let number = self.sequence.len() as u32;
        self.sequence.push(place);
        self.ending.push(Reverse((now + network.durations[at], number, place)));
    }
}
