//! The disjunctive graph of a project in which each contested resource serves one task at a time: per resource (machine) the order
//! of its tasks, and the longest paths that follow from the orders.
//!
//! Machine orders, heads and tails as in the job shop (Balas 1969); a task may have several predecessors.

use super::project::Project;

/// No neighbour.
pub(super) const NONE: u32 = u32::MAX;

/// The machine orders, and the paths that follow from them.
#[derive(Debug, Clone)]
pub(super) struct Disjunctive {
    pub(super) project: Project,
    /// By task, its machine; [`NONE`] if it needs no contested resource.
    pub(super) machine: Vec<u32>,
    /// By machine, its tasks in order.
    pub(super) orders: Vec<Vec<u32>>,
    /// By task, its place in the order of its machine.
    pub(super) position: Vec<u32>,
    /// By task, its earliest start, whatever the orders.
    pub(super) releases: Vec<u64>,
    /// By task, the longest path to it.
    pub(super) heads: Vec<u64>,
    /// By task, the longest path from its end on.
    pub(super) tails: Vec<u64>,
    sorted: Vec<u32>,
    open: Vec<u32>,
    /// Makespan: when everything has ended.
    pub(super) end: u64,
}

impl Disjunctive {
    /// `None` if a resource can serve two tasks at a time, or if a task needs two contested resources.
    pub(super) fn of(project: Project) -> Option<Disjunctive> {
        let size = project.len();
        let mut least = project.capacity.clone();
        let each = (0..size as u32).flat_map(|task| project.demands.of_place(task));
        for demand in each.chain(project.occupied.iter().map(|(_, demand)| demand)) {
            let least = &mut least[demand.kind as usize];
            *least = demand.units.min(*least);
        }
        let is_single = least.iter().zip(&project.capacity).all(|(least, all)| least.saturating_mul(2) > *all);
        let is_one_each = (0..size as u32).all(|task| project.demands.of_place(task).len() <= 1);
        if !is_single || !is_one_each {
            return None;
        }
        let machine: Vec<u32> = (0..size as u32)
            .map(|task| project.demands.of_place(task).first().map_or(NONE, |demand| demand.kind))
            .collect();
        let mut free = vec![0; project.capacity.len()];
        for (until, demand) in &project.occupied {
            free[demand.kind as usize] = (*until).max(free[demand.kind as usize]);
        }
        let release = |(task, machine): (usize, &u32)| {
            let own = project.releases[task];
            if *machine == NONE { own } else { own.max(free[*machine as usize]) }
        };
        Some(Disjunctive {
            releases: machine.iter().enumerate().map(release).collect(),
            orders: vec![Vec::new(); project.capacity.len()],
            machine,
            position: vec![0; size],
            heads: vec![0; size],
            tails: vec![0; size],
            sorted: Vec::with_capacity(size),
            open: vec![0; size],
            end: 0,
            project,
        })
    }

    /// Orders the tasks of each machine as in `list`, in which each task comes after its predecessors.
    pub(super) fn order_by(&mut self, list: &[u32]) {
        self.orders.iter_mut().for_each(Vec::clear);
        for task in list {
            if let Some(order) = self.orders.get_mut(self.machine[*task as usize] as usize) {
                self.position[*task as usize] = order.len() as u32;
                order.push(*task);
            }
        }
        self.measure();
    }

    /// Restores earlier machine orders.
    pub(super) fn order_as(&mut self, orders: &[Vec<u32>]) {
        for (order, kept) in self.orders.iter_mut().zip(orders) {
            order.clone_from(kept);
            for (at, task) in order.iter().enumerate() {
                self.position[*task as usize] = at as u32;
            }
        }
        self.measure();
    }

    pub(super) fn machine_before(&self, task: u32) -> u32 {
        let (machine, position) = (self.machine[task as usize], self.position[task as usize]);
        if machine == NONE || position == 0 { NONE } else { self.orders[machine as usize][position as usize - 1] }
    }

    pub(super) fn machine_behind(&self, task: u32) -> u32 {
        let (machine, position) = (self.machine[task as usize], self.position[task as usize]);
        let order = if machine == NONE { None } else { self.orders.get(machine as usize) };
        order.and_then(|order| order.get(position as usize + 1)).copied().unwrap_or(NONE)
    }

    pub(super) fn duration(&self, task: u32) -> u64 {
        self.project.durations[task as usize]
    }

    /// When the predecessors of a task have ended, whatever its machine does.
    pub(super) fn ready(&self, task: u32) -> u64 {
        let before = self.project.before.of_place(task).iter();
        let ends = before.map(|before| self.heads[*before as usize] + self.duration(*before));
        ends.max().unwrap_or(0).max(self.releases[task as usize])
    }

    /// The longest path through the successors of a task, whatever its machine does.
    pub(super) fn rest(&self, task: u32) -> u64 {
        let behind = self.project.behind.of_place(task).iter();
        behind.map(|behind| self.tails[*behind as usize] + self.duration(*behind)).max().unwrap_or(0)
    }

    /// Moves a task of a machine to another place in its order.
    pub(super) fn shift(&mut self, machine: u32, from: usize, to: usize) {
        let order = &mut self.orders[machine as usize];
        if from < to {
            order[from..=to].rotate_left(1);
        } else {
            order[to..=from].rotate_right(1);
        }
        for (at, task) in order.iter().enumerate().take(from.max(to) + 1).skip(from.min(to)) {
            self.position[*task as usize] = at as u32;
        }
        self.measure();
    }

    /// Computes heads, tails and the end. The orders must not contradict the precedences.
    pub(super) fn measure(&mut self) {
        self.sorted.clear();
        for task in 0..self.project.len() as u32 {
            let on_machine = u32::from(self.machine_before(task) != NONE);
            let open = self.project.before.of_place(task).len() as u32 + on_machine;
            self.open[task as usize] = open;
            if open == 0 {
                self.sorted.push(task);
            }
        }
        let mut next = 0;
        self.end = self.project.running_end;
        while let Some(task) = self.sorted.get(next).copied() {
            next += 1;
            let before = self.machine_before(task);
            let machine_free = if before == NONE { 0 } else { self.heads[before as usize] + self.duration(before) };
            let head = self.ready(task).max(machine_free);
            self.heads[task as usize] = head;
            self.end = self.end.max(head + self.duration(task));
            let behind = self.machine_behind(task);
            let machine_next = (behind != NONE).then_some(behind);
            for behind in self.project.behind.of_place(task).iter().copied().chain(machine_next) {
                let open = &mut self.open[behind as usize];
                *open -= 1;
                if *open == 0 {
                    self.sorted.push(behind);
                }
            }
        }
        debug_assert_eq!(self.sorted.len(), self.project.len(), "the orders contradict what waits for what");
        for at in (0..self.sorted.len()).rev() {
            let task = self.sorted[at];
            let behind = self.machine_behind(task);
            let machine_rest = if behind == NONE { 0 } else { self.tails[behind as usize] + self.duration(behind) };
            self.tails[task as usize] = self.rest(task).max(machine_rest);
        }
    }
}
