//! Anytime improvement: the path gets better as long as there is time.
//!
//! Better means quicker by an estimate of the duration (`timing::rough`), or shorter, as the caller measures. Each step chooses one of five ways
//! at random: a shortcut between two points of the path; a corner moved to where the path would be better; a turn to another end on the way; a new
//! search where a shorter path could run at all (the ellipsoids between the start and the ends); or growth of an RRT* tree there (`rrt_star`),
//! which is kept from step to step, adopts the path whenever that has become better, and returns better ones. The best path is never lost. Its
//! motions are as certain as the space's checks. A path under a constraint uses the first three, along the constraint.

use crate::connect::{ConnectError, grow};
use crate::constrained::{Constraint, walk};
use crate::ellipsoid;
use crate::pace::Control;
use crate::rrt_star::RrtStar;
use crate::simplify::{path_length, shortened};
use crate::space::{Space, State, between, distance};
use crate::timing::rough::Rough;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// A step must gain at least this much, in radians or seconds.
const LEAST_GAIN: f32 = 1e-4;

/// How much longer than the path a quicker one may be, as a fraction of its length.
const LONGER: f32 = 0.2;

/// Number of iterations of one new search.
const SEARCH_ITERATIONS: usize = 200;

/// Maximum offset of a moved corner, in radians, and as a fraction of the sides next to it.
const STRAY: f32 = 0.1;
const STRAY_SHARE: f32 = 0.25;

/// Number of samples of the tree in one step.
const TREE_SAMPLES: usize = 8;

/// The weight of each way; it is chosen with this share of the sum.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shares {
    /// Shortcuts between two points of the path.
    pub shortcut: u32,
    /// Moved corners.
    pub corner: u32,
    /// Turns to other ends.
    pub turn: u32,
    /// New searches.
    pub search: u32,
    /// Growth of the tree.
    pub tree: u32,
}

impl Shares {
    /// For arms: with seven joints new searches find more than the tree does (docs/performance.md).
    pub const MIXED: Shares = Shares { shortcut: 42, corner: 38, turn: 8, search: 11, tree: 1 };

    /// For paths under a constraint.
    const CONSTRAINED: Shares = Shares { shortcut: 45, corner: 45, turn: 10, search: 0, tree: 0 };
}

/// The measure of a path.
#[derive(Debug, Clone)]
pub enum Measure {
    /// Its length, in radians.
    Length,
    /// Its duration, in seconds.
    Duration(Box<Rough>),
}

/// A possible end of a path.
#[derive(Debug, Clone, PartialEq)]
pub struct End {
    /// The posture, which is free.
    pub state: State,
    /// Length of the motion that follows, in radians.
    pub rest: f32,
    /// Duration of the motion that follows, in seconds.
    pub rest_s: f32,
}

/// A path under improvement.
#[derive(Debug)]
pub struct Refinement {
    path: Vec<State>,
    /// Index of the path's end.
    end: usize,
    ends: Vec<End>,
    measure: Measure,
    /// Cost of the path and of what follows it, by the measure.
    cost: f32,
    /// Whether the cost accounts for the room that blends have.
    is_certain: bool,
    constraint: Option<Constraint>,
    random: ChaCha8Rng,
    shares: Shares,
    tree: Option<RrtStar>,
    /// The path that the tree adopted last.
    adopted: Vec<State>,
}

impl Refinement {
    /// Begins with a path that leads to the end with the index `end`.
    pub fn new(path: Vec<State>, end: usize, ends: Vec<End>, measure: Measure, seed: u64) -> Refinement {
        let random = ChaCha8Rng::seed_from_u64(seed);
        let mut new = Refinement {
            path,
            end,
            ends,
            measure,
            cost: f32::INFINITY,
            is_certain: false,
            constraint: None,
            random,
            shares: Shares::MIXED,
            tree: None,
            adopted: Vec::new(),
        };
        new.cost = new.cost_of(&new.path.clone(), end);
        new
    }

    /// Sets the shares; their sum must not be zero.
    #[must_use]
    pub fn with_shares(self, shares: Shares) -> Refinement {
        Refinement { shares, ..self }
    }

    /// Improves a path under a constraint; all later paths satisfy it, too.
    #[must_use]
    pub fn keeping(self, constraint: Constraint) -> Refinement {
        Refinement { constraint: Some(constraint), shares: Shares::CONSTRAINED, ..self }
    }

    /// The best path so far.
    pub fn path(&self) -> &[State] {
        &self.path
    }

    /// The index of its end.
    pub fn end(&self) -> usize {
        self.end
    }

    /// The possible ends.
    pub fn ends(&self) -> &[End] {
        &self.ends
    }

    /// Adds a possible end.
    pub fn add(&mut self, end: End) {
        self.ends.push(end);
    }

    /// Length of the path and of what follows it, in radians.
    pub fn length(&self) -> f32 {
        path_length(&self.path) + self.ends[self.end].rest
    }

    /// The cost that is minimised: that length, or the estimated duration of both, in seconds.
    pub fn cost(&self) -> f32 {
        self.cost
    }

    /// Whether a straight motion to an end would be better than the path.
    pub fn is_promising(&mut self, end: &End) -> bool {
        let straight = [self.path[0], end.state];
        let rest = self.rest(end);
        self.measured(&straight) + rest < self.cost
    }

    fn rest(&self, end: &End) -> f32 {
        match &self.measure {
            Measure::Length => end.rest,
            Measure::Duration(_) => end.rest_s,
        }
    }

    fn measured(&mut self, path: &[State]) -> f32 {
        match &mut self.measure {
            Measure::Length => path_length(path),
            Measure::Duration(rough) => rough.duration_s(path) as f32,
        }
    }

    fn cost_of(&mut self, path: &[State], end: usize) -> f32 {
        self.measured(path) + self.rest(&self.ends[end])
    }

    /// As [`Refinement::cost_of`], with blends only as wide as there is room for.
    fn certain_cost_of(&mut self, space: &mut Space, path: &[State], end: usize) -> f32 {
        let rest = self.rest(&self.ends[end]);
        match &mut self.measure {
            // Along a constraint no room for blends is computed: the path is smoothed as a whole.
            Measure::Duration(rough) if self.constraint.is_none() => {
                rough.duration_among_s(path, &mut |from, to| space.is_free_motion(from, to)) as f32 + rest
            }
            _ => self.cost_of(path, end),
        }
    }

    /// Whether a path would be better if every blend had room.
    fn may_be_better(&mut self, path: &[State], end: usize) -> bool {
        self.cost_of(path, end) < self.cost - LEAST_GAIN
    }

    /// Adopts a valid path, if it is better.
    fn take(&mut self, space: &mut Space, path: Vec<State>, end: usize) {
        if !self.may_be_better(&path, end) {
            return;
        }
        let cost = self.certain_cost_of(space, &path, end);
        if cost < self.cost - LEAST_GAIN {
            (self.path, self.end, self.cost) = (path, end, cost);
        }
    }

    /// Tries one way to improve the path. Takes some hundreds of microseconds at most, unless `control` ends it before.
    ///
    /// # Errors
    /// The answer of `control` that ended the step; the path stays valid.
    pub fn step(&mut self, space: &mut Space, control: &mut dyn FnMut(usize) -> Control) -> Result<(), Control> {
        if !self.is_certain {
            self.cost = self.certain_cost_of(space, &self.path.clone(), self.end);
            self.is_certain = true;
        }
        let Shares { shortcut, corner, turn, search, tree } = self.shares;
        let mut drawn = self.random.random_range(0..shortcut + corner + turn + search + tree);
        let mut is = |share: u32| {
            let here = drawn < share;
            drawn = drawn.wrapping_sub(share);
            here
        };
        if is(shortcut) {
            return self.shortcut(space, control);
        } else if is(corner) {
            return if self.constraint.is_some() { self.pull(space, control) } else { self.move_corner(space) };
        } else if is(turn) {
            return self.turn(space, control);
        } else if is(search) {
            return self.search_again(space, control);
        }
        self.grow_tree(space, control)
    }

    /// The postures of the straight motion between two postures, without the first one, or as straight as the constraint allows; none if there is
    /// a collision.
    fn motion(
        &self,
        space: &mut Space,
        from: &State,
        to: &State,
        control: &mut dyn FnMut(usize) -> Control,
    ) -> Result<Option<Vec<State>>, Control> {
        let Some(constraint) = &self.constraint else {
            return Ok(space.is_free_motion(from, to).then(|| vec![*to]));
        };
        let steps = walk(space, constraint, from, to, control)?;
        Ok(steps.last().is_some_and(|last| last == to).then_some(steps))
    }

    /// The point of the path at a length along it, and the index of the posture that follows.
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

    /// The path up to a point of it, through the postures `between`, and on from another point.
    fn detour(&self, (from, before): (State, usize), between: &[State], after: usize) -> Vec<State> {
        let mut path = self.path[..before].to_vec();
        path.push(from);
        path.extend_from_slice(between);
        path.extend_from_slice(&self.path[after..]);
        path.dedup();
        path
    }

    /// Two random lengths along the path, the smaller one first.
    fn stretch(&mut self) -> (f32, f32) {
        let whole = path_length(&self.path);
        let (a, b) = (self.random.random_range(0.0..=1.0) * whole, self.random.random_range(0.0..=1.0) * whole);
        (a.min(b), a.max(b))
    }

    /// Replaces a random part of the path by a straight motion.
    fn shortcut(&mut self, space: &mut Space, control: &mut dyn FnMut(usize) -> Control) -> Result<(), Control> {
        if self.path.len() < 3 {
            return Ok(());
        }
        let (low, high) = self.stretch();
        let ((from, after_from), (to, after_to)) = (self.point(low), self.point(high));
        // A motion along a constraint is never shorter than the straight one.
        let straight = self.detour((from, after_from), &[to], after_to);
        if after_from == after_to || !self.may_be_better(&straight, self.end) {
            return Ok(());
        }
        if let Some(steps) = self.motion(space, &from, &to, control)? {
            self.take(space, self.detour((from, after_from), &steps, after_to), self.end);
        }
        Ok(())
    }

    /// Moves a random corner towards the straight motion past it.
    fn move_corner(&mut self, space: &mut Space) -> Result<(), Control> {
        if self.path.len() < 3 {
            return Ok(());
        }
        let i = self.random.random_range(1..self.path.len() - 1);
        let (before, here, after) = (self.path[i - 1], self.path[i], self.path[i + 1]);
        let sides = distance(&before, &here) + distance(&here, &after);
        let middle = between(&before, &after, self.random.random_range(0.0..=1.0));
        let moved = between(&here, &middle, self.random.random_range(0.0..0.6));
        let moved = self.aside(space, &moved, STRAY.min(sides * STRAY_SHARE));
        let mut path = self.path.clone();
        path[i] = moved;
        let may_be_better = self.may_be_better(&path, self.end);
        if may_be_better && space.is_free_motion(&before, &moved) && space.is_free_motion(&moved, &after) {
            self.take(space, path, self.end);
        }
        Ok(())
    }

    /// Moves a random part of the path towards the straight motion, along the constraint.
    fn pull(&mut self, space: &mut Space, control: &mut dyn FnMut(usize) -> Control) -> Result<(), Control> {
        let (low, high) = self.stretch();
        let ((from, after_from), (to, after_to)) = (self.point(low), self.point(high));
        let (here, _) = self.point((low + high) / 2.0);
        let moved = between(&here, &between(&from, &to, 0.5), self.random.random_range(0.0..1.0));
        let moved = self.aside(space, &moved, STRAY.min((high - low) * STRAY_SHARE));
        let Some(over) = self.constraint.as_ref().and_then(|constraint| constraint.project(&moved)) else {
            return Ok(());
        };
        let straight = self.detour((from, after_from), &[over, to], after_to);
        if !self.may_be_better(&straight, self.end) {
            return Ok(());
        }
        let Some(mut steps) = self.motion(space, &from, &over, control)? else { return Ok(()) };
        let Some(rest) = self.motion(space, &over, &to, control)? else { return Ok(()) };
        steps.extend(rest);
        self.take(space, self.detour((from, after_from), &steps, after_to), self.end);
        Ok(())
    }

    /// A random posture near another one, within the limits.
    fn aside(&mut self, space: &Space, posture: &State, stray: f32) -> State {
        let (lower, upper) = space.limits();
        let mut moved = *posture;
        for j in 0..space.joints() {
            moved[j] = (moved[j] + stray * self.random.random_range(-1.0..1.0)).clamp(lower[j], upper[j]);
        }
        moved
    }

    /// Leaves the path at a random point for another end.
    fn turn(&mut self, space: &mut Space, control: &mut dyn FnMut(usize) -> Control) -> Result<(), Control> {
        let other = self.random.random_range(0..self.ends.len());
        let along = self.random.random_range(0.0..=1.0) * path_length(&self.path);
        if other == self.end {
            return Ok(());
        }
        let (from, after) = self.point(along);
        let to = self.ends[other].state;
        let straight = self.detour((from, after), &[to], self.path.len());
        if !self.may_be_better(&straight, other) {
            return Ok(());
        }
        if let Some(steps) = self.motion(space, &from, &to, control)? {
            self.take(space, self.detour((from, after), &steps, self.path.len()), other);
        }
        Ok(())
    }

    /// Maximum length of a better path, including what follows it.
    fn bound(&self) -> f32 {
        match self.measure {
            Measure::Length => self.length(),
            Measure::Duration(_) => self.length() * (1.0 + LONGER),
        }
    }

    /// A new search where a better path could run.
    fn search_again(&mut self, space: &mut Space, control: &mut dyn FnMut(usize) -> Control) -> Result<(), Control> {
        let bound = self.bound();
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
                self.take(space, path, end);
                Ok(())
            }
            Err(ConnectError::TimeUp { .. }) => Err(Control::TimeUp),
            Err(ConnectError::Cancelled) => Err(Control::Cancelled),
            Err(_) => Ok(()),
        }
    }

    /// Grows the RRT* tree, and adopts its path if that is better.
    fn grow_tree(&mut self, space: &mut Space, control: &mut dyn FnMut(usize) -> Control) -> Result<(), Control> {
        let bound = self.bound();
        let tree = self.tree.get_or_insert_with(|| RrtStar::new(&self.path[0], space.joints()));
        if self.adopted != self.path {
            tree.adopt(&self.path, &self.ends, self.end);
            self.adopted.clone_from(&self.path);
        }
        let grown = tree.grow(space, &self.ends, bound, TREE_SAMPLES, &mut self.random, control);
        if let Some((end, _)) = tree.best(&self.ends)
            && let Some(path) = tree.path(end)
        {
            self.take(space, path, end);
        }
        grown
    }
}
