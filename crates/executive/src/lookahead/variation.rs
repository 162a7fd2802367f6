//! New activity lists: random ones, children of two lists, and mutations.

use super::dice::Dice;
use super::project::Project;

/// A random list draws this many candidates for the next task and takes the one with the longest remaining path.
const DRAWN: usize = 3;
/// Probability that a task changes places with the next one (Hartmann, 1998).
const MUTATION: f64 = 0.05;

/// The direction in which a list is scheduled: from the beginning on, or from the end back.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Direction {
    Forward,
    Backward,
}

impl Direction {
    pub(super) fn other(self) -> Direction {
        match self {
            Direction::Forward => Direction::Backward,
            Direction::Backward => Direction::Forward,
        }
    }

    /// The predecessors of a task in this direction.
    fn before(self, project: &Project, task: u32) -> &[u32] {
        match self {
            Direction::Forward => project.before.of_place(task),
            Direction::Backward => project.behind.of_place(task),
        }
    }
}

/// Makes lists; its memory is reused for the next one.
#[derive(Debug, Clone)]
pub(super) struct Variation {
    dice: Dice,
    /// By task, whether the list already contains it.
    taken: Vec<bool>,
    /// By task, the number of its predecessors that are not in the list yet.
    open: Vec<u32>,
    eligible: Vec<u32>,
    order: Vec<u32>,
}

impl Variation {
    pub(super) fn new(tasks: usize, seed: u64) -> Variation {
        Variation {
            dice: Dice(seed),
            taken: vec![false; tasks],
            open: vec![0; tasks],
            eligible: Vec::with_capacity(tasks),
            order: Vec::with_capacity(tasks),
        }
    }

    /// A random choice below `bound`, which is not 0.
    pub(super) fn below(&mut self, bound: usize) -> usize {
        self.dice.below(bound)
    }

    /// A random list for forward scheduling that prefers tasks with long remaining paths.
    pub(super) fn draw(&mut self, project: &Project, list: &mut Vec<u32>) {
        let Variation { dice, open, eligible, .. } = self;
        list.clear();
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
            list.push(task);
            for behind in project.behind.of_place(task) {
                let open = &mut open[*behind as usize];
                *open -= 1;
                if *open == 0 {
                    eligible.push(*behind);
                }
            }
        }
    }

    /// Crossover of two lists for the same direction: the child keeps a piece of one list, a quarter to three quarters of its length, in
    /// place; the other list gives the order of the remaining tasks.
    pub(super) fn cross(&mut self, project: &Project, direction: Direction, of: [&[u32]; 2], list: &mut Vec<u32>) {
        let tasks = project.len();
        let [mother, father] = if self.dice.below(2) == 0 { of } else { [of[1], of[0]] };
        let length = (tasks as f64 * (0.25 + 0.5 * self.dice.share())) as usize;
        let begin = self.dice.below(tasks - length + 1);
        let piece = &father[begin..begin + length];
        self.taken.fill(false);
        piece.iter().for_each(|task| self.taken[*task as usize] = true);
        self.order.clear();
        self.order.extend(mother.iter().filter(|task| !self.taken[**task as usize]));
        self.order.splice(begin..begin, piece.iter().copied());
        self.allow(project, direction, list);
    }

    /// Swaps some tasks with their neighbours.
    pub(super) fn mutate(&mut self, project: &Project, direction: Direction, list: &mut [u32]) {
        for at in 1..list.len() {
            if self.dice.share() < MUTATION && !direction.before(project, list[at]).contains(&list[at - 1]) {
                list.swap(at - 1, at);
            }
        }
    }

    /// Repairs the order: missing predecessors are put right before a task.
    fn allow(&mut self, project: &Project, direction: Direction, list: &mut Vec<u32>) {
        list.clear();
        self.taken.fill(false);
        let open = &mut self.eligible;
        for task in &self.order {
            open.push(*task);
            while let Some(next) = open.last().copied() {
                let before = direction.before(project, next).iter();
                let missing = before.copied().find(|before| !self.taken[*before as usize]);
                match missing {
                    Some(missing) => open.push(missing),
                    None => {
                        open.pop();
                        if !std::mem::replace(&mut self.taken[next as usize], true) {
                            list.push(next);
                        }
                    }
                }
            }
        }
    }
}
