//! Tabu search over machine orders, used when each contested resource serves one task at a time.
//!
//! A critical path is cut into blocks of tasks on one machine. The makespan can shrink only by moving a task behind the last or before the first of
//! its block, or one of these two into the block (N6: Balas, Vazacopoulos, Guided local search with shifting bottleneck for job shop scheduling, 1998;
//! Zhang, Li, Guan, Rao, 2007). The search makes the best move, by an estimate of the longest path through the moved tasks, that reverses no pair of
//! tasks reversed recently. After long without improvement it goes back to one of the best schedules, slightly disturbed (as in Nowicki, Smutnicki, A
//! fast taboo search algorithm for the job shop problem, 1996).

use super::dice::Dice;
use super::disjunctive::{Disjunctive, NONE};
use super::project::{Plan, Project};

/// Limit of remembered pairs.
const MAX_PAIRS: usize = 1 << 21;
/// Number of the best orders that are kept to go back to.
const ELITE: usize = 8;
/// Moves per task without improvement before it goes back.
const PATIENCE_PER_TASK: usize = 10;
/// Limit of random moves that disturb a schedule after going back to it.
const MAX_DISTURBANCE: usize = 12;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Move {
    machine: u32,
    from: u32,
    to: u32,
}

/// The search, and the best schedule found.
#[derive(Debug, Clone)]
pub(super) struct Tabu {
    graph: Disjunctive,
    dice: Dice,
    /// By machine, where its pairs begin in `forbidden`.
    offsets: Vec<usize>,
    /// By task, its number among those of its machine.
    local: Vec<u32>,
    /// By pair of tasks of a machine: the move number until which the first must not be put before the second.
    forbidden: Vec<u32>,
    tenure: u32,
    moves: u32,
    in_vain: usize,
    path: Vec<u32>,
    candidates: Vec<Move>,
    heads: Vec<u64>,
    moved: Vec<u32>,
    /// The best orders, and their makespans.
    elite: Vec<(u64, Vec<Vec<u32>>)>,
    best: Vec<u64>,
    best_end: u64,
    /// Makespan of the best schedule that was handed out.
    told_end: u64,
}

impl Tabu {
    /// Begins with the best of these lists, and keeps the others to go back to. `None` if this search does not apply; see [`Disjunctive::of`].
    pub(super) fn new(project: Project, seed: u64, lists: &[Vec<u32>]) -> Option<Tabu> {
        let mut graph = Disjunctive::of(project)?;
        let mut elite: Vec<(u64, Vec<Vec<u32>>)> = Vec::new();
        for list in lists {
            graph.order_by(list);
            elite.push((graph.end, graph.orders.clone()));
        }
        // The best stands last.
        elite.sort_by_key(|(end, _)| std::cmp::Reverse(*end));
        elite.drain(..elite.len().saturating_sub(ELITE));
        graph.order_as(&elite.last()?.1);
        let mut offsets = Vec::new();
        let mut pairs = 0_usize;
        let mut local = vec![0; graph.project.len()];
        for order in &graph.orders {
            offsets.push(pairs);
            pairs += order.len() * order.len();
            for (number, task) in order.iter().enumerate() {
                local[*task as usize] = number as u32;
            }
        }
        if pairs > MAX_PAIRS {
            return None;
        }
        // Tabu tenure after Zhang et al.: 10 and the jobs per machine, where the jobs are the tasks of a machine.
        let machines = graph.orders.iter().filter(|order| !order.is_empty()).count().max(1);
        let jobs = graph.orders.iter().map(Vec::len).sum::<usize>() / machines;
        let mut tabu = Tabu {
            dice: Dice(seed),
            offsets,
            local,
            forbidden: vec![0; pairs],
            tenure: 10 + (jobs / machines) as u32,
            moves: 0,
            in_vain: 0,
            path: Vec::new(),
            candidates: Vec::new(),
            heads: Vec::new(),
            moved: Vec::new(),
            elite,
            best: Vec::new(),
            best_end: u64::MAX,
            told_end: u64::MAX,
            graph,
        };
        tabu.best_end = tabu.graph.end;
        tabu.best.clone_from(&tabu.graph.heads);
        Some(tabu)
    }

    /// The best schedules as lists, the best first.
    pub(super) fn lists(&mut self) -> Vec<Vec<u32>> {
        let mut lists = Vec::new();
        for (_, orders) in self.elite.iter().rev() {
            self.graph.order_as(orders);
            let mut list: Vec<u32> = (0..self.graph.project.len() as u32).collect();
            list.sort_by_key(|task| (self.graph.heads[*task as usize], *task));
            lists.push(list);
        }
        self.forbidden.fill(0);
        self.moves = 0;
        if let Some((_, best)) = self.elite.last() {
            self.graph.order_as(best);
        }
        lists
    }

    /// The project that the lists are of.
    pub(super) fn project(&self) -> &Project {
        &self.graph.project
    }

    /// Makes so many moves, unless a schedule reaches `bound`; returns the best schedule if it is new.
    pub(super) fn step(&mut self, moves: usize, bound: u64) -> Option<Plan> {
        for _ in 0..moves {
            if self.best_end <= bound {
                break;
            }
            if self.in_vain > PATIENCE_PER_TASK * self.graph.project.len() {
                self.go_back();
            }
            self.find_moves();
            match self.choose() {
                Some(chosen) => {
                    self.make(chosen);
                    self.note();
                }
                // No move can shorten this schedule; another schedule may have such a move.
                None if self.elite.len() > 1 => self.go_back(),
                None => break,
            }
        }
        let is_better = self.best_end < std::mem::replace(&mut self.told_end, self.best_end);
        is_better.then(|| self.graph.project.plan_of(&self.best))
    }

    /// Keeps the schedule if it is the best so far.
    fn note(&mut self) {
        self.in_vain += 1;
        if self.graph.end < self.best_end {
            self.best_end = self.graph.end;
            self.best.clone_from(&self.graph.heads);
            self.in_vain = 0;
            if self.elite.len() == ELITE {
                self.elite.remove(0);
            }
            self.elite.push((self.graph.end, self.graph.orders.clone()));
        }
    }

    /// Goes back to one of the best schedules.
    fn go_back(&mut self) {
        let Some(last) = self.elite.len().checked_sub(1) else { return };
        // Half of the time it goes back to the best.
        let chosen = if self.dice.below(2) == 0 { last } else { self.dice.below(last + 1) };
        self.graph.order_as(&self.elite[chosen].1);
        self.forbidden.fill(0);
        self.moves = 0;
        self.in_vain = 0;
        for _ in 0..=self.dice.below(MAX_DISTURBANCE) {
            self.find_moves();
            if self.candidates.is_empty() {
                break;
            }
            let chosen = self.candidates[self.dice.below(self.candidates.len())];
            self.make(chosen);
        }
    }

    /// All moves on one critical path.
    fn find_moves(&mut self) {
        self.candidates.clear();
        self.find_path();
        let mut from = 0;
        while from < self.path.len() {
            let machine = self.graph.machine[self.path[from] as usize];
            let mut to = from;
            while to + 1 < self.path.len()
                && machine != NONE
                && self.graph.machine_behind(self.path[to]) == self.path[to + 1]
            {
                to += 1;
            }
            if to > from {
                self.find_moves_in(machine, from, to);
            }
            from = to + 1;
        }
    }

    /// A critical path, chosen at random where there are several.
    fn find_path(&mut self) {
        let Tabu { graph, path, dice, .. } = self;
        path.clear();
        let is_critical =
            |task: u32| graph.heads[task as usize] + graph.duration(task) + graph.tails[task as usize] == graph.end;
        let starts = |task: &u32| graph.heads[*task as usize] == graph.releases[*task as usize] && is_critical(*task);
        let begins = (0..graph.project.len() as u32).filter(starts);
        let mut current = one_of(begins, dice);
        while let Some(task) = current {
            path.push(task);
            let end = graph.heads[task as usize] + graph.duration(task);
            let behind = graph.machine_behind(task);
            let next = graph.project.behind.of_place(task).iter().copied().chain((behind != NONE).then_some(behind));
            let critical = next.filter(|next| graph.heads[*next as usize] == end && is_critical(*next));
            current = one_of(critical, dice);
        }
    }

    /// The moves within the block between two places of the path.
    fn find_moves_in(&mut self, machine: u32, from: usize, to: usize) {
        let (is_first, is_last) = (from == 0, to + 1 == self.path.len());
        let (first, last) = (self.path[from], self.path[to]);
        let place = |tabu: &Tabu, task: u32| tabu.graph.position[task as usize];
        for at in from..=to {
            let task = self.path[at];
            // Behind the last; at the very end of the path that gains nothing. The first task may also move into the block.
            if task != last && !is_last && self.may_follow(task, last) {
                self.add(machine, place(self, task), place(self, last));
            }
            if task != first && !is_first && self.may_precede(task, first) {
                self.add(machine, place(self, task), place(self, first));
            }
            if at > from && at < to {
                if !is_first && self.may_follow(first, task) {
                    self.add(machine, place(self, first), place(self, task));
                }
                if !is_last && self.may_precede(last, task) {
                    self.add(machine, place(self, last), place(self, task));
                }
            }
        }
    }

    fn add(&mut self, machine: u32, from: u32, to: u32) {
        let new = Move { machine, from, to };
        if !self.candidates.contains(&new) {
            self.candidates.push(new);
        }
    }

    /// Whether no path leads from the successors of `task` to `last`, a later task of its machine.
    fn may_follow(&self, task: u32, last: u32) -> bool {
        let graph = &self.graph;
        let reach = graph.tails[last as usize] + graph.duration(last);
        graph.project.behind.of_place(task).iter().all(|behind| {
            let rest = graph.tails[*behind as usize] + graph.duration(*behind);
            *behind != last && (reach > rest || (reach == rest && graph.duration(*behind) > 0))
        })
    }

    /// Whether no path leads from `first`, an earlier task of its machine, to the predecessors of `task`.
    fn may_precede(&self, task: u32, first: u32) -> bool {
        let graph = &self.graph;
        let end = graph.heads[first as usize] + graph.duration(first);
        graph.project.before.of_place(task).iter().all(|before| {
            let ready = graph.heads[*before as usize] + graph.duration(*before);
            *before != first && (end > ready || (end == ready && graph.duration(*before) > 0))
        })
    }

    /// The best move that is not tabu, or that leads to a new best; if all are tabu, any move.
    fn choose(&mut self) -> Option<Move> {
        let mut best: Option<(u64, Move)> = None;
        let mut alike = 0;
        for at in 0..self.candidates.len() {
            let candidate = self.candidates[at];
            let end = self.estimate(candidate);
            if end >= self.best_end && self.is_forbidden(candidate) {
                continue;
            }
            match best {
                Some((least, _)) if end > least => {}
                Some((least, _)) if end == least => {
                    alike += 1;
                    if self.dice.below(alike) == 0 {
                        best = Some((end, candidate));
                    }
                }
                _ => {
                    alike = 1;
                    best = Some((end, candidate));
                }
            }
        }
        if best.is_none() && !self.candidates.is_empty() {
            return Some(self.candidates[self.dice.below(self.candidates.len())]);
        }
        best.map(|(_, chosen)| chosen)
    }

    /// The longest path through the moved tasks, with heads and tails of all others unchanged.
    fn estimate(&mut self, Move { machine, from, to }: Move) -> u64 {
        let (low, high) = (from.min(to) as usize, from.max(to) as usize);
        let Tabu { graph, moved, heads, .. } = self;
        let order = &graph.orders[machine as usize];
        moved.clear();
        moved.extend_from_slice(&order[low..=high]);
        if from < to {
            moved.rotate_left(1)
        } else {
            moved.rotate_right(1)
        }
        let ends = |task: u32| graph.heads[task as usize] + graph.duration(task);
        let mut free = low.checked_sub(1).map_or(0, |before| ends(order[before]));
        heads.clear();
        for task in moved.iter() {
            let head = free.max(graph.ready(*task));
            heads.push(head);
            free = head + graph.duration(*task);
        }
        let rest = |task: &u32| graph.tails[*task as usize] + graph.duration(*task);
        let mut tail = order.get(high + 1).map_or(0, rest);
        let mut longest = 0;
        for (task, head) in moved.iter().zip(heads.iter()).rev() {
            let own = tail.max(graph.rest(*task));
            longest = longest.max(head + graph.duration(*task) + own);
            tail = own + graph.duration(*task);
        }
        longest
    }

    /// Whether a move is tabu: it reverses a pair of tasks that was reversed recently.
    fn is_forbidden(&self, Move { machine, from, to }: Move) -> bool {
        let order = &self.graph.orders[machine as usize];
        let task = order[from as usize];
        if from < to {
            let passed = &order[from as usize + 1..=to as usize];
            passed.iter().any(|other| self.forbidden[self.pair(machine, *other, task)] > self.moves)
        } else {
            let passed = &order[to as usize..from as usize];
            passed.iter().any(|other| self.forbidden[self.pair(machine, task, *other)] > self.moves)
        }
    }

    fn pair(&self, machine: u32, before: u32, behind: u32) -> usize {
        let size = self.graph.orders[machine as usize].len();
        self.offsets[machine as usize]
            + self.local[before as usize] as usize * size
            + self.local[behind as usize] as usize
    }

    /// Makes a move, and makes its reversal tabu for a while.
    fn make(&mut self, Move { machine, from, to }: Move) {
        self.moves += 1;
        let until = self.moves + self.tenure + self.dice.below(self.tenure as usize / 2 + 1) as u32;
        let task = self.graph.orders[machine as usize][from as usize];
        for at in from.min(to)..=from.max(to) {
            let other = self.graph.orders[machine as usize][at as usize];
            if other != task {
                let pair = if from < to { self.pair(machine, task, other) } else { self.pair(machine, other, task) };
                self.forbidden[pair] = until;
            }
        }
        self.graph.shift(machine, from as usize, to as usize);
    }
}

/// One of several, each with the same probability.
fn one_of(several: impl Iterator<Item = u32>, dice: &mut Dice) -> Option<u32> {
    let mut chosen = None;
    for (number, one) in several.enumerate() {
        if dice.below(number + 1) == 0 {
            chosen = Some(one);
        }
    }
    chosen
}
