//! New activity lists: drawn, crossed from two, and changed a little.

use super::dice::Dice;
use super::project::Project;

/// Of so many tasks that could come next in a drawn list the one with the longest remaining path does.
const DRAWN: usize = 3;
/// How likely a task changes places with the next (Hartmann, 1998).
const MUTATION: f64 = 0.05;

/// Which way a list is scheduled: from the beginning on, or from the end back.
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

    /// The tasks that come before a task in every list that is scheduled this way.
    fn before(self, project: &Project, task: u32) -> &[u32] {
        match self {
            Direction::Forward => project.before.of_place(task),
            Direction::Backward => project.behind.of_place(task),
        }
    }
}

/// Makes lists; its memory is used again for the next.
#[derive(Debug, Clone)]
pub(super) struct Variation {
    dice: Dice,
    /// By task, whether the list has it already.
    taken: Vec<bool>,
    /// By task, of how many it comes behind that the list does not have yet.
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

    /// A list at random, of tasks with long remaining paths first; it is scheduled forward.
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

    /// A child of two lists that are scheduled in the direction: one keeps a piece of a quarter to three quarters of its length together and
    /// in its place, and the other says in which order the rest is before and behind that.
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

    /// Some tasks change places with the next.
    pub(super) fn mutate(&mut self, project: &Project, direction: Direction, list: &mut [u32]) {
        for at in 1..list.len() {
            if self.dice.share() < MUTATION && !direction.before(project, list[at]).contains(&list[at - 1]) {
                list.swap(at - 1, at);
            }
        }
    }

    /// The order as far as what waits for what allows: what a task comes behind goes right before it, if it is not there yet.
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
