//! Anytime improvement: as long as there is time, the path gets shorter.
//!
//! Five ways, chosen at random: shortcuts between two points of the path; corners moved towards where the path would rather be;
//! other ends that the path can turn to on its way; a new search where a shorter path could run at all (the ellipsoids
//! between the start and the ends); and a tree of shortest ways that grows there from step to step (`rrt_star`), takes in the path
//! whenever that has become shorter, and gives back what is shorter still. The best path is never lost. Its motions are as
//! certain as the space checks them.

use crate::connect::{ConnectError, grow};
use crate::ellipsoid;
use crate::pace::Control;
use crate::rrt_star::RrtStar;
use crate::simplify::{path_length, shortened};
use crate::space::{Space, State, between, distance};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// A step must gain at least this much, in radians.
const LEAST_GAIN: f32 = 1e-4;

/// Iterations of one new search.
const SEARCH_ITERATIONS: usize = 200;

/// How far a corner is moved off its way at most, in radians, and as a share of the sides next to it.
const STRAY: f32 = 0.1;
const STRAY_SHARE: f32 = 0.25;

/// Samples of the tree in one step.
const TREE_SAMPLES: usize = 8;

/// How often each way is chosen, of the sum of all.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shares {
    /// Shortcuts between two points of the path.
    pub shortcut: u32,
    /// Corners moved.
    pub corner: u32,
    /// Other ends.
    pub turn: u32,
    /// New searches.
    pub search: u32,
    /// Samples of the tree.
    pub tree: u32,
}

impl Shares {
    /// For arms: with seven joints new searches find more than the tree does (docs/performance.md).
    pub const MIXED: Shares = Shares { shortcut: 42, corner: 38, turn: 8, search: 11, tree: 1 };
}

/// Where a path may end.
#[derive(Debug, Clone, PartialEq)]
pub struct End {
    /// Free.
    pub state: State,
    /// Length of what follows there, in radians.
    pub rest: f32,
}

/// A path that becomes shorter.
#[derive(Debug)]
pub struct Refinement {
    path: Vec<State>,
    /// Which end the path leads to.
    end: usize,
    ends: Vec<End>,
    random: ChaCha8Rng,
    shares: Shares,
    tree: Option<RrtStar>,
    /// What the tree has taken in last.
    adopted: Vec<State>,
}

impl Refinement {
    /// Begins with a path that leads to the end with the index `end`.
    pub fn new(path: Vec<State>, end: usize, ends: Vec<End>, seed: u64) -> Refinement {
        let random = ChaCha8Rng::seed_from_u64(seed);
        Refinement { path, end, ends, random, shares: Shares::MIXED, tree: None, adopted: Vec::new() }
    }

    /// With other shares; their sum is not zero.
    #[must_use]
    pub fn with_shares(self, shares: Shares) -> Refinement {
        Refinement { shares, ..self }
    }

    /// The shortest path so far.
    pub fn path(&self) -> &[State] {
        &self.path
    }

    /// The index of its end.
    pub fn end(&self) -> usize {
        self.end
    }

    /// Where it may end.
    pub fn ends(&self) -> &[End] {
        &self.ends
    }

    /// Allows for one more end.
    pub fn add(&mut self, end: End) {
        self.ends.push(end);
    }

    /// The length of the path and of what follows it, in radians.
    pub fn length(&self) -> f32 {
        path_length(&self.path) + self.ends[self.end].rest
    }

    /// Tries one way to make the path shorter; some hundreds of microseconds at the most, unless `control` ends it before.
    ///
    /// # Errors
    /// What `control` said, when that was not to go on; the path is whole all the same.
    pub fn step(&mut self, space: &mut Space, control: &mut dyn FnMut(usize) -> Control) -> Result<(), Control> {
        let Shares { shortcut, corner, turn, search, tree } = self.shares;
        let mut drawn = self.random.random_range(0..shortcut + corner + turn + search + tree);
        let mut is = |share: u32| {
            let here = drawn < share;
            drawn = drawn.wrapping_sub(share);
            here
        };
        if is(shortcut) {
            self.shortcut(space);
        } else if is(corner) {
            self.move_corner(space);
        } else if is(turn) {
            self.turn(space);
        } else if is(search) {
            return self.search_again(space, control);
        } else {
            return self.grow_tree(space, control);
        }
        Ok(())
    }

    /// A point of the path so far along it, and the index of the posture that follows it.
    pub fn point(&self, along: f32) -> (State, usize) {
        let mut left = along;
        for (i, pair) in self.path.windows(2).enumerate() {
            let step = distance(&pair[0], &pair[1]);
            if left <= step && step > 0.0 {
                return (between(&pair[0], &pair[1], left / step), i + 1);
            }
            left -= step;
        }
        let last = self.path.len() - 1;
        (self.path[last], last)
    }

    /// Replaces a random part of the path by a straight motion.
    fn shortcut(&mut self, space: &mut Space) {
        if self.path.len() < 3 {
            return;
        }
        let whole = path_length(&self.path);
        let (a, b) = (self.random.random_range(0.0..=1.0) * whole, self.random.random_range(0.0..=1.0) * whole);
        let (low, high) = (a.min(b), a.max(b));
        let ((from, after_from), (to, after_to)) = (self.point(low), self.point(high));
        let gains = after_from != after_to && distance(&from, &to) < high - low - LEAST_GAIN;
        if gains && space.is_free_motion(&from, &to) {
            self.path.splice(after_from..after_to, [from, to]);
            self.path.dedup();
        }
    }

    /// Moves a random corner towards a straight motion past it.
    fn move_corner(&mut self, space: &mut Space) {
        if self.path.len() < 3 {
            return;
        }
        let i = self.random.random_range(1..self.path.len() - 1);
        let (before, here, after) = (self.path[i - 1], self.path[i], self.path[i + 1]);
        let sides = distance(&before, &here) + distance(&here, &after);
        let middle = between(&before, &after, self.random.random_range(0.0..=1.0));
        let mut moved = between(&here, &middle, self.random.random_range(0.0..0.6));
        let stray = STRAY.min(sides * STRAY_SHARE);
        let (lower, upper) = space.limits();
        for j in 0..space.joints() {
            moved[j] = (moved[j] + stray * self.random.random_range(-1.0..1.0)).clamp(lower[j], upper[j]);
        }
        let gain = sides - distance(&before, &moved) - distance(&moved, &after);
        if gain > LEAST_GAIN && space.is_free_motion(&before, &moved) && space.is_free_motion(&moved, &after) {
            self.path[i] = moved;
        }
    }

    /// Leaves the path somewhere for another end.
    fn turn(&mut self, space: &mut Space) {
        let other = self.random.random_range(0..self.ends.len());
        let along = self.random.random_range(0.0..=1.0) * path_length(&self.path);
        if other == self.end {
            return;
        }
        let (from, after) = self.point(along);
        let End { state, rest } = self.ends[other];
        let shorter = along + distance(&from, &state) + rest < self.length() - LEAST_GAIN;
        if shorter && space.is_free_motion(&from, &state) {
            self.path.truncate(after);
            self.path.extend([from, state]);
            self.path.dedup();
            self.end = other;
        }
    }

    /// Searches from scratch where a shorter path could run.
    fn search_again(&mut self, space: &mut Space, control: &mut dyn FnMut(usize) -> Control) -> Result<(), Control> {
        let bound = self.length();
        let start = self.path[0];
        let room = |end: &End| bound - LEAST_GAIN - end.rest - distance(&start, &end.state);
        let useful: Vec<usize> = (0..self.ends.len()).filter(|i| room(&self.ends[*i]) > 0.0).collect();
        if useful.is_empty() {
            return Ok(());
        }
        let states: Vec<State> = useful.iter().map(|i| self.ends[*i].state).collect();
        let (lower, upper, joints) = (*space.limits().0, *space.limits().1, space.joints());
        let (random, ends) = (&mut self.random, &self.ends);
        let sample = || {
            let end = &ends[useful[random.random_range(0..useful.len())]];
            ellipsoid::draw(&start, &end.state, bound - end.rest, (&lower, &upper), joints, random)
        };
        let path = match grow(space, &start, &states, SEARCH_ITERATIONS, sample, control) {
            Ok((path, _)) => shortened(space, &path, control),
            Err(error) => Err(error),
        };
        match path {
            Ok(path) => {
                let last = path[path.len() - 1];
                let end = useful.into_iter().find(|i| self.ends[*i].state == last).unwrap_or(self.end);
                if path_length(&path) + self.ends[end].rest < bound {
                    (self.path, self.end) = (path, end);
                }
                Ok(())
            }
            Err(ConnectError::TimeUp { .. }) => Err(Control::TimeUp),
            Err(ConnectError::Cancelled) => Err(Control::Cancelled),
            Err(_) => Ok(()),
        }
    }

    /// Grows the tree of shortest ways, and follows it where it knows a shorter one.
    fn grow_tree(&mut self, space: &mut Space, control: &mut dyn FnMut(usize) -> Control) -> Result<(), Control> {
        let bound = self.length();
        let tree = self.tree.get_or_insert_with(|| RrtStar::new(&self.path[0], space.joints()));
        if self.adopted != self.path {
            tree.adopt(&self.path, &self.ends, self.end);
            self.adopted.clone_from(&self.path);
        }
        let grown = tree.grow(space, &self.ends, bound, TREE_SAMPLES, &mut self.random, control);
        if let Some((end, length)) = tree.best(&self.ends)
            && length < bound - LEAST_GAIN
            && let Some(path) = tree.path(end)
        {
            (self.path, self.end) = (path, end);
        }
        grown
    }
}
