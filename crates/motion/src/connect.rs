//! RRT-Connect: two trees, one from the start and one from the goals, each growing towards samples and then towards the other
//! (Kuffner and LaValle, ICRA 2000), with the trees kept balanced (Kuffner and LaValle 2005) and nodes that only take samples
//! near them once an extension failed (dynamic domain, Yershova et al., ICRA 2005).
//!
//! The same space, ends, seed and budget give the same path. The caller is asked every `POLL` iterations whether to go on.

use crate::ellipsoid;
use crate::halton::Halton;
use crate::pace::Control;
use crate::reach::{Reach, Target};
use crate::space::{Space, State, between, difference, distance, length};
use crate::tree::Tree;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

/// How far a tree grows at once, in radians.
const RANGE: f32 = 1.0;

/// The dynamic domain: where it begins after a failure, its least size and how fast it changes.
const DOMAIN: f32 = 4.0;
const LEAST_DOMAIN: f32 = 1.0;
const DOMAIN_CHANGE: f32 = 1e-4;

/// Iterations between two questions to the caller: some tens of microseconds.
const POLL: usize = 32;

/// Postures looked for per target, and attempts at them.
const POSTURES: usize = 8;
const ATTEMPTS: usize = 24;

/// Samples drawn at most to mend one motion, how much longer than it a detour through the first of them may be, in radians, and
/// after how many that doubles: the last are from everywhere.
const MENDING_ITERATIONS: usize = 512;
const FIRST_DETOUR: f32 = 0.1;
const DETOUR_DOUBLES: usize = 64;

/// How often a path with a gap between its postures is mended before the search gives up.
const MENDINGS: usize = 16;

/// What the search may cost.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Budget {
    /// Samples drawn at most.
    pub iterations: usize,
    /// Of the samples.
    pub seed: u64,
}

/// A free path.
#[derive(Debug, Clone, PartialEq)]
pub struct Route {
    /// From the start to a goal.
    pub path: Vec<State>,
    /// Which goal.
    pub goal: usize,
    /// Samples drawn.
    pub iterations: usize,
}

/// Why there is no path.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ConnectError {
    /// The start touches something or is out of the limits.
    #[error("the start is not free")]
    Start,
    /// So do all goals.
    #[error("none of the {goals} goals is free")]
    Goal {
        /// How many there are.
        goals: usize,
    },
    /// A posture breaks the constraint that the whole path is to keep.
    #[error("the {which} does not keep the constraint of the path")]
    Constraint {
        /// Start, or every free goal.
        which: &'static str,
    },
    /// The iterations are used up.
    #[error("no path found in {iterations} iterations; give more, or look whether there is a way at all")]
    Exhausted {
        /// How many.
        iterations: usize,
    },
    /// The caller's time is up.
    #[error("no path found in the time given ({iterations} iterations)")]
    TimeUp {
        /// How many.
        iterations: usize,
    },
    /// The caller gave up.
    #[error("the search was cancelled")]
    Cancelled,
}

/// Searches a path from `start` to the nearest goals. `control` gets the iterations so far.
///
/// # Errors
/// [`ConnectError`] says why there is none.
pub fn connect(
    space: &mut Space,
    start: &State,
    goals: &[State],
    budget: Budget,
    control: &mut dyn FnMut(usize) -> Control,
) -> Result<Route, ConnectError> {
    if !space.is_within(start) || !space.is_free(start) {
        return Err(ConnectError::Start);
    }
    let mut free: Vec<usize> = (0..goals.len()).filter(|g| space.is_within(&goals[*g])).collect();
    free.retain(|g| space.is_free(&goals[*g]));
    free.sort_by(|a, b| distance(start, &goals[*a]).total_cmp(&distance(start, &goals[*b])));
    if free.is_empty() {
        return Err(ConnectError::Goal { goals: goals.len() });
    }
    for &goal in &free {
        if space.is_free_motion(start, &goals[goal]) {
            return Ok(Route { path: vec![*start, goals[goal]], goal, iterations: 0 });
        }
    }
    let ends: Vec<State> = free.iter().map(|g| goals[*g]).collect();
    let (lower, upper) = (*space.limits().0, *space.limits().1);
    let mut samples = Halton::new(space.joints(), budget.seed);
    let (path, iterations) = grow(space, start, &ends, budget.iterations, || samples.next(&lower, &upper), control)?;
    let last = path[path.len() - 1];
    let goal = free.iter().copied().find(|g| goals[*g] == last).unwrap_or(free[0]);
    Ok(Route { path, goal, iterations })
}

/// Searches a path from `start` to a posture that meets one of `targets`: several postures for each, all of them roots of one
/// search. The route's `goal` is the index of the target.
///
/// # Errors
/// As [`connect`]; [`ConnectError::Goal`] also where no posture meets a target.
pub fn connect_to_targets(
    space: &mut Space,
    reach: &Reach,
    start: &State,
    targets: &[Target],
    budget: Budget,
    control: &mut dyn FnMut(usize) -> Control,
) -> Result<Route, ConnectError> {
    let near = start.map(f64::from);
    let mut random = ChaCha8Rng::seed_from_u64(budget.seed);
    let mut goals: Vec<(usize, State)> = Vec::new();
    for (index, target) in targets.iter().enumerate() {
        go_on(control, 0)?;
        let solutions = reach.solutions(target, &near, POSTURES, ATTEMPTS, &mut random);
        let states = solutions.into_iter().map(|q| (index, q.map(|q| q as f32)));
        goals.extend(states.filter(|(_, state)| space.is_within(state) && space.is_free(state)));
    }
    let states: Vec<State> = goals.iter().map(|(_, state)| *state).collect();
    let route = match connect(space, start, &states, budget, control) {
        Err(ConnectError::Goal { .. }) => return Err(ConnectError::Goal { goals: targets.len() }),
        other => other?,
    };
    Ok(Route { goal: goals[route.goal].0, ..route })
}

/// What the caller's answer means for the search.
fn go_on(control: &mut dyn FnMut(usize) -> Control, iterations: usize) -> Result<(), ConnectError> {
    match control(iterations) {
        Control::Continue => Ok(()),
        Control::TimeUp => Err(ConnectError::TimeUp { iterations }),
        Control::Cancelled => Err(ConnectError::Cancelled),
    }
}

/// Makes sure that a path whose postures are free is free also between them: for motions that are not, a detour is
/// searched, near them first.
///
/// # Errors
/// [`ConnectError::Exhausted`] where a motion cannot be mended, [`ConnectError::TimeUp`] and [`ConnectError::Cancelled`].
pub fn mend(
    space: &mut Space,
    path: &[State],
    budget: Budget,
    control: &mut dyn FnMut(usize) -> Control,
) -> Result<Vec<State>, ConnectError> {
    let mut whole = vec![path[0]];
    let mut mended = 0;
    for pair in path.windows(2) {
        go_on(control, 0)?;
        if space.is_swept_free_too(&pair[0], &pair[1]) {
            whole.push(pair[1]);
            continue;
        }
        mended += 1;
        if mended > MENDINGS {
            return Err(ConnectError::Exhausted { iterations: budget.iterations });
        }
        let little = Budget { iterations: budget.iterations.min(MENDING_ITERATIONS), ..budget };
        whole.extend_from_slice(&detour(space, &pair[0], &pair[1], little, control)?[1..]);
    }
    Ok(whole)
}

/// A way free between its postures that is little longer than the straight motion, where there is one.
fn detour(
    space: &mut Space,
    from: &State,
    to: &State,
    budget: Budget,
    control: &mut dyn FnMut(usize) -> Control,
) -> Result<Vec<State>, ConnectError> {
    let (lower, upper, joints) = (*space.limits().0, *space.limits().1, space.joints());
    let mut random = ChaCha8Rng::seed_from_u64(budget.seed);
    let (straight, mut drawn) = (distance(from, to), 0);
    let sample = || {
        let more = FIRST_DETOUR * 2_f32.powi((drawn / DETOUR_DOUBLES) as i32);
        drawn += 1;
        ellipsoid::draw(from, to, straight + more, (&lower, &upper), joints, &mut random)
    };
    space.set_swept(true);
    let found = grow(space, from, std::slice::from_ref(to), budget.iterations, sample, control);
    space.set_swept(false);
    found.map(|(path, _)| path)
}

/// Grows a tree from the start and one from all ends, which are free, until they meet; gives the path and the iterations.
pub(crate) fn grow(
    space: &mut Space,
    start: &State,
    ends: &[State],
    iterations: usize,
    mut sample: impl FnMut() -> State,
    control: &mut dyn FnMut(usize) -> Control,
) -> Result<(Vec<State>, usize), ConnectError> {
    let joints = space.joints();
    let mut trees = [Tree::new(space.isa(), joints), Tree::new(space.isa(), joints)];
    trees[0].push(*start, 0);
    for (i, end) in ends.iter().enumerate() {
        trees[1].push(*end, i);
    }
    // Which tree grows towards the sample.
    let mut growing = 1;
    // Where nothing may be left between postures, an iteration takes as long as many others.
    let poll = if space.is_swept() { 1 } else { POLL };
    for iteration in 1..=iterations {
        if iteration % poll == 0 {
            go_on(control, iteration)?;
        }
        let (own, others) = (trees[growing].len(), trees[1 - growing].len());
        if own.abs_diff(others) < own {
            growing = 1 - growing;
        }
        let sample = sample();
        let (first, second) = trees.split_at_mut(1);
        let (tree, other) = if growing == 0 { (&mut first[0], &second[0]) } else { (&mut second[0], &first[0]) };
        let (near, far) = tree.nearest(&sample);
        if tree.radii[near] < far {
            continue;
        }
        let from = tree.states[near];
        let to = if far <= RANGE { sample } else { between(&from, &sample, RANGE / far) };
        if !space.is_free_motion(&from, &to) {
            let radius = &mut tree.radii[near];
            *radius = if radius.is_infinite() { DOMAIN } else { (*radius * (1.0 - DOMAIN_CHANGE)).max(LEAST_DOMAIN) };
            continue;
        }
        let mut node = tree.push(to, near);
        if tree.radii[near].is_finite() {
            tree.radii[near] *= 1.0 + DOMAIN_CHANGE;
        }
        let (meeting, gap) = other.nearest(&to);
        let goal = other.states[meeting];
        let steps = (gap / RANGE).ceil().max(1.0) as usize;
        let mut reached = to;
        let joined = (1..=steps).all(|step| {
            let next = if step == steps { goal } else { between(&to, &goal, step as f32 / steps as f32) };
            let free = space.is_free_motion(&reached, &next);
            if free && step < steps {
                node = tree.push(next, node);
                reached = next;
            }
            free
        });
        if joined {
            let (mut path, rest) = (tree.branch(node), other.branch(meeting));
            path.reverse();
            path.extend(rest);
            if growing == 1 {
                path.reverse();
            }
            path.dedup_by(|a, b| length(&difference(a, b)) == 0.0);
            return Ok((path, iteration));
        }
    }
    Err(ConnectError::Exhausted { iterations })
}
