//! Paths on which every posture satisfies a constraint on a frame, such as keeping a bowl upright: two trees as in `connect`, grown by small steps,
//! each projected onto the constraint (Berenson, Srinivasa, Ferguson, Kuffner: *Manipulation Planning on Constraint Manifolds*, ICRA 2009).
//!
//! A step is taken only if it is free and if the constraint holds between its ends as well; so the resulting path is a dense list of postures, to be
//! followed without changes. Steps are projected to half of the tolerance, which leaves the other half for the motion between them: tolerances below
//! [`LEAST_TOLERANCE`] cannot be planned.

use crate::connect::{Budget, ConnectError, Route};
use crate::joint_vector::JointVector;
use crate::levers::Levers;
use crate::pace::Control;
use crate::reach::{Reach, Target};
use crate::simplify::path_length;
use crate::sobol::Sobol;
use crate::space::{Space, State, between, distance};
use crate::tree::Tree;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// The minimum tolerance, in radians or metres.
pub const LEAST_TOLERANCE: f64 = 0.005;

/// Length of a step, in radians.
const STEP: f32 = 0.0625;

/// Each step has to reduce the distance by at least this share of its length, and with its projection may be at most this many steps long.
const LEAST_PROGRESS: f32 = 0.1;
const MOST_ASTRAY: f32 = 2.0;

/// Attempts at shortcuts that make most paths short.
pub const SHORTCUTS: usize = 60;

/// Reserve of every tolerance for the motion between the checked postures, in radians and metres, and its maximum share of the tolerance.
const RESERVE: f64 = 5e-4;
const RESERVED_SHARE: f64 = 0.1;

/// Steps are projected this far inside of a large position tolerance, in metres.
const INWARD_M: f64 = 0.01;

/// A constraint for all postures of a path.
#[derive(Debug, Clone)]
pub struct Constraint {
    reach: Reach,
    /// The requested tolerances, those that are checked, and those that steps are projected to.
    asked: Target,
    target: Target,
    inner: Target,
}

impl Constraint {
    /// Keeps the frame of `reach` within the tolerances of `target`.
    pub fn new(reach: Reach, target: Target) -> Constraint {
        let less = |tolerance: [f64; 3]| tolerance.map(|t| t - RESERVE.min(RESERVED_SHARE * t));
        let half = |tolerance: [f64; 3]| tolerance.map(|t| if t < std::f64::consts::PI { t / 2.0 } else { t });
        let inward = |tolerance: [f64; 3]| tolerance.map(|t| t - INWARD_M.min(t / 2.0));
        let kept = Target {
            tolerance_m: less(target.tolerance_m),
            tolerance_rad: free_or(target.tolerance_rad, less),
            ..target
        };
        let inner =
            Target { tolerance_m: inward(target.tolerance_m), tolerance_rad: half(target.tolerance_rad), ..target };
        Constraint { reach, asked: target, target: kept, inner }
    }

    fn positions(&self, state: &State) -> JointVector {
        JointVector::from_fn(self.reach.joints(), |j| f64::from(state[j]))
    }

    /// Whether a posture satisfies the constraint.
    pub fn holds(&self, state: &State) -> bool {
        self.target.is_met_by(&self.reach.pose(&self.positions(state)))
    }

    /// How far the frame may move, in metres, and rotate, in radians, from a posture; negative where it violates the requested tolerances.
    pub(crate) fn room(&self, positions: &JointVector) -> [f64; 2] {
        self.asked.room(&self.reach.pose(positions))
    }

    pub(crate) fn levers(&self) -> &Levers {
        self.reach.levers()
    }

    /// How a posture violates the constraint.
    pub(crate) fn breach(&self, state: &State) -> String {
        let [left_m, left_rad] = self.room(&self.positions(state));
        match left_m < left_rad {
            true => format!("the tool is {:.3} m outside the box", (-left_m).max(0.0)),
            false => format!("the tool is {:.3} rad off the direction that it keeps", self.tilt_rad(state)),
        }
    }

    /// The angle between the z axes of the frame and the target, in radians.
    pub fn tilt_rad(&self, state: &State) -> f64 {
        let up = [0.0, 0.0, 1.0];
        let (have, want) = (self.reach.pose(&self.positions(state)).rotate(up), self.target.pose.rotate(up));
        (0..3).map(|i| have[i] * want[i]).sum::<f64>().clamp(-1.0, 1.0).acos()
    }

    /// Whether all postures of a straight motion satisfy the constraint: the checked ones are so close that the motion between them deviates from the
    /// line between their frames by less than half of the reserve.
    pub fn holds_along(&self, from: &State, to: &State) -> bool {
        let by = JointVector::from_fn(self.reach.joints(), |j| f64::from((from[j] - to[j]).abs()));
        let bends = [self.levers().bend_m(&by), self.levers().turns_rad(&by).powi(2) / 8.0];
        let close = bends.map(|bend| (bend / (RESERVE / 2.0)).sqrt()).into_iter().fold(0.0, f64::max);
        let steps = f64::from(distance(from, to) * Space::RESOLUTION).max(close).ceil().max(1.0) as usize;
        (1..=steps).all(|i| self.holds(&between(from, to, i as f32 / steps as f32)))
    }

    /// The posture itself if it is within the inner tolerances, else a posture near it that is.
    pub(crate) fn project(&self, state: &State) -> Option<State> {
        let positions = self.positions(state);
        if self.inner.is_met_by(&self.reach.pose(&positions)) {
            return Some(*state);
        }
        self.reach.descend(&self.inner, &positions).map(|p| crate::space::state(&p))
    }
}

/// Reduces rotation tolerances, except those that leave a rotation free.
fn free_or(tolerance: [f64; 3], less: impl Fn([f64; 3]) -> [f64; 3]) -> [f64; 3] {
    let reduced = less(tolerance);
    std::array::from_fn(|i| if tolerance[i] < std::f64::consts::PI { reduced[i] } else { tolerance[i] })
}

/// Searches for a path from `start` to one of `goals` that satisfies the constraint. `control` gets the number of iterations.
///
/// # Errors
/// [`ConnectError`] says why there is none.
pub fn connect(
    space: &mut Space,
    constraint: &Constraint,
    start: &State,
    goals: &[State],
    budget: Budget,
    control: &mut dyn FnMut(usize) -> Control,
) -> Result<Route, ConnectError> {
    if !space.is_within(start) || !space.is_free(start) {
        return Err(ConnectError::Start);
    }
    if !constraint.holds(start) {
        return Err(ConnectError::Constraint { which: "start" });
    }
    let mut usable: Vec<usize> = (0..goals.len()).filter(|g| space.is_within(&goals[*g])).collect();
    usable.retain(|g| space.is_free(&goals[*g]));
    if usable.is_empty() {
        return Err(ConnectError::Goal { goals: goals.len() });
    }
    usable.retain(|g| constraint.holds(&goals[*g]));
    if usable.is_empty() {
        return Err(ConnectError::Constraint { which: "goal" });
    }
    usable.sort_by(|a, b| distance(start, &goals[*a]).total_cmp(&distance(start, &goals[*b])));
    let ends: Vec<State> = usable.iter().map(|g| goals[*g]).collect();
    let (path, iterations) = grow(space, constraint, start, &ends, budget, control)?;
    let last = path[path.len() - 1];
    let goal = usable.iter().copied().find(|g| goals[*g] == last).unwrap_or(usable[0]);
    Ok(Route { path, goal, iterations })
}

fn grow(
    space: &mut Space,
    constraint: &Constraint,
    start: &State,
    ends: &[State],
    budget: Budget,
    control: &mut dyn FnMut(usize) -> Control,
) -> Result<(Vec<State>, usize), ConnectError> {
    let joints = space.joints();
    let (lower, upper) = (*space.limits().0, *space.limits().1);
    let mut samples = Sobol::new(budget.seed);
    let mut trees = [Tree::new(space.isa(), joints), Tree::new(space.isa(), joints)];
    trees[0].push(*start, 0);
    for (i, end) in ends.iter().enumerate() {
        trees[1].push(*end, i);
    }
    let mut growing = 0;
    for iteration in 0..budget.iterations {
        // The first sample is the root of the other tree: this tries the straight motion.
        let sample = if iteration == 0 { ends[0] } else { samples.next(&lower, &upper) };
        let (near, _) = trees[growing].nearest(&sample);
        let node = extend(space, constraint, &mut trees[growing], near, &sample, control)
            .map_err(|answer| stopped(answer, iteration))?;
        let reached = trees[growing].states[node];
        let (near, _) = trees[1 - growing].nearest(&reached);
        let meeting = extend(space, constraint, &mut trees[1 - growing], near, &reached, control)
            .map_err(|answer| stopped(answer, iteration))?;
        if trees[1 - growing].states[meeting] == reached {
            let (mut path, rest) = (trees[growing].branch(node), trees[1 - growing].branch(meeting));
            path.reverse();
            path.extend(&rest[1..]);
            if growing == 1 {
                path.reverse();
            }
            return Ok((path, iteration));
        }
        growing = 1 - growing;
    }
    Err(ConnectError::Exhausted { iterations: budget.iterations })
}

fn stopped(answer: Control, iterations: usize) -> ConnectError {
    if answer == Control::Cancelled { ConnectError::Cancelled } else { ConnectError::TimeUp { iterations } }
}

/// Adds the steps of a walk to a tree; returns the last node, or `near` without any step.
fn extend(
    space: &mut Space,
    constraint: &Constraint,
    tree: &mut Tree,
    near: usize,
    to: &State,
    control: &mut dyn FnMut(usize) -> Control,
) -> Result<usize, Control> {
    let mut node = near;
    for state in walk(space, constraint, &tree.states[near].clone(), to, control)? {
        node = tree.push(state, node);
    }
    Ok(node)
}

/// Postures on the constraint from a posture (excluded) towards another, as far as they get.
pub(crate) fn walk(
    space: &mut Space,
    constraint: &Constraint,
    from: &State,
    to: &State,
    control: &mut dyn FnMut(usize) -> Control,
) -> Result<Vec<State>, Control> {
    let (mut here, mut steps) = (*from, Vec::new());
    loop {
        let answer = control(steps.len());
        if !answer.goes_on() {
            return Err(answer);
        }
        let far = distance(&here, to);
        if far == 0.0 {
            return Ok(steps);
        }
        let ahead = if far <= STEP { *to } else { between(&here, to, STEP / far) };
        let Some(next) = constraint.project(&ahead) else { return Ok(steps) };
        let (way, left) = (distance(&here, &next), distance(&next, to));
        let progress = far - left >= LEAST_PROGRESS * STEP.min(far) && way <= MOST_ASTRAY * STEP;
        if !progress || !constraint.holds_along(&here, &next) || !space.is_free_motion(&here, &next) {
            return Ok(steps);
        }
        steps.push(next);
        here = next;
    }
}

/// Shortens a path that satisfies the constraint, and keeps it satisfied, by this number of attempts at shortcuts.
///
/// # Errors
/// The answer of `control`, if it ends the planning; the path is valid all the same.
pub fn shorten(
    space: &mut Space,
    constraint: &Constraint,
    path: &mut Vec<State>,
    attempts: usize,
    seed: u64,
    control: &mut dyn FnMut(usize) -> Control,
) -> Result<(), Control> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    for attempt in 0..attempts {
        let answer = control(attempt);
        if !answer.goes_on() {
            return Err(answer);
        }
        if path.len() < 3 {
            break;
        }
        let (a, b) = (random.random_range(0..path.len()), random.random_range(0..path.len()));
        let (low, high) = (a.min(b), a.max(b));
        if high < low + 2 {
            continue;
        }
        let (from, to) = (path[low], path[high]);
        let steps = walk(space, constraint, &from, &to, control)?;
        let whole: Vec<State> = std::iter::once(from).chain(steps).collect();
        if whole.last() == Some(&to) && path_length(&whole) < path_length(&path[low..=high]) {
            path.splice(low..=high, whole);
        }
    }
    Ok(())
}
