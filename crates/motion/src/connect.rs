//! RRT-Connect: two trees, one from the start and one from the goals, each growing towards samples and then towards the other (Kuffner and
//! LaValle, ICRA 2000). The trees are kept balanced (Kuffner and LaValle 2005). Nodes that failed to extend take only samples near them (dynamic
//! domain, Yershova et al., ICRA 2005) and make shorter motions now and then. If most extensions of a tree fail, an extension that succeeds goes
//! on as long as it comes nearer to the other tree. A robot with several arms moves one after the other first (`branches`).
//!
//! The same space, ends, seed and budget give the same path. The caller is asked whether to go on after every `POLL` of work.

use crate::ahead::Ahead;
use crate::branches::{together, with};
use crate::ellipsoid;
use crate::joint_vector::JointVector;
use crate::pace::Control;
use crate::reach::{Reach, Target};
use crate::sobol::Sobol;
use crate::space::{Space, State, between, difference, distance, length, towards};
use crate::tree::Tree;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use std::cell::Cell;

/// Maximum length of an extension per attempt, as a fraction of the root-mean-square difference per joint of two random postures. A search that
/// does not end is restarted with the next value, shorter and longer in turn. For a Panda the two are 1.0 and 0.5 radians.
const RANGES: [f32; 2] = [0.5, 0.25];

/// Samples of the first attempt; each further attempt has four times as many.
const FIRST_ATTEMPT: usize = 131_072;

/// Samples of the first attempt for each branch of a robot that has several.
const IN_TURN: usize = 4096;

/// The dynamic domain: its radius after a failure, as a fraction of the root-mean-square distance of two random postures over all joints together
/// (postures of more joints are further apart, and the ball around a node is to hold a similar share of the samples); its minimum, as a fraction
/// of the range of the first attempt; and how fast it changes. It does not shrink with the range of an attempt: a ball of half the radius holds
/// only one of 2^joints of its samples.
const DOMAIN: f32 = 0.64;
const LEAST_DOMAIN: f32 = 1.0;
const DOMAIN_CHANGE: f32 = 1e-4;

/// A tree grows until the other has less than this fraction of its nodes; then the other one grows. If trees took turns at every sample until one
/// is twice as large, a shut-in tree would get half of the samples that it needs. From 0.3 to 0.8 the times differ little.
const BALANCE: f32 = 0.67;

/// A tree is shut in if the number of its failed motions is this many times the number of its nodes. Its motions are then checked several at once
/// ([`Ahead`]). A motion that succeeds goes on towards its sample as long as the way is free and comes nearer to the other tree: the next success
/// would take as many attempts. For other trees that finds little, and makes paths longer.
const SHUT_IN: usize = 8;

/// After `SHORT_FROM` samples, one in `SHORT_EVERY` extensions of nodes that have failed before is shorter, by the factor below: a shut-in tree
/// gets out by short motions, which only cost time elsewhere.
const SHORT_FROM: usize = 4096;
const SHORT_EVERY: usize = 4;
const SHORT: f32 = 0.5;

/// Work between two calls of the caller's `control`, where a sample is 1 and a motion towards it `MOTION` more: some tens of microseconds. The caller
/// reads a clock, which takes as long as several samples that are too far from a tree to make a motion.
const POLL: usize = 256;
const MOTION: usize = 7;

/// Postures searched per target, and attempts to find them.
const POSTURES: usize = 8;
const ATTEMPTS: usize = 24;

/// For mending one motion: the maximum number of samples; how much longer than the motion a detour through the first samples may be, in radians;
/// and the number of samples after which that doubles, so that the last samples come from everywhere.
const MENDING_ITERATIONS: usize = 512;
const FIRST_DETOUR: f32 = 0.1;
const DETOUR_DOUBLES: usize = 64;

/// How often a path whose motions are not free is mended before the search gives up.
const MENDINGS: usize = 16;

/// Limits of a search.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Budget {
    /// Maximum number of samples.
    pub iterations: usize,
    /// Seed of the samples.
    pub seed: u64,
}

/// A free path.
#[derive(Debug, Clone, PartialEq)]
pub struct Route {
    /// Postures from the start to a goal.
    pub path: Vec<State>,
    /// Index of the goal.
    pub goal: usize,
    /// Samples drawn.
    pub iterations: usize,
}

/// Why there is no path.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ConnectError {
    /// The start is in collision or outside the limits.
    #[error("the start is not free")]
    Start,
    /// All goals are in collision or outside the limits.
    #[error("none of the {goals} goals is free")]
    Goal {
        /// How many there are.
        goals: usize,
    },
    /// A posture violates the constraint of the whole path.
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
    /// The caller cancelled the planning.
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
    let (path, iterations) = search(space, start, &ends, budget, control)?;
    let last = path[path.len() - 1];
    let goal = free.iter().copied().find(|g| goals[*g] == last).unwrap_or(free[0]);
    Ok(Route { path, goal, iterations })
}

/// Searches the branches of the robot in turn, if it has several, and then all joints, with more samples each time.
fn search(
    space: &mut Space,
    start: &State,
    ends: &[State],
    budget: Budget,
    control: &mut dyn FnMut(usize) -> Control,
) -> Result<(Vec<State>, usize), ConnectError> {
    let branches = space.branches().to_vec();
    let used = Cell::new(0);
    let mut control = |iterations: usize| control(used.get() + iterations);
    let mut samples = Sobol::new(budget.seed);
    let mut share = if branches.len() > 1 { IN_TURN } else { FIRST_ATTEMPT };
    let all: Vec<usize> = (0..space.joints()).collect();
    for attempt in 0.. {
        let range = range(space, RANGES[attempt % RANGES.len()]);
        let effort = || (share.min(budget.iterations - used.get()), range);
        for first in (0..branches.len()).filter(|_| branches.len() > 1) {
            let order: Vec<&[usize]> =
                branches.iter().cycle().skip(first).take(branches.len()).map(Vec::as_slice).collect();
            match in_turn(space, start, &ends[0], &order, effort(), &mut samples, &mut control) {
                Err(ConnectError::Exhausted { iterations }) => used.set(used.get() + iterations),
                found => return found.map(|(path, iterations)| (path, used.get() + iterations)),
            }
        }
        match grow_with(space, start, ends, &all, effort(), &mut samples, &mut control) {
            Err(ConnectError::Exhausted { iterations }) => used.set(used.get() + iterations),
            found => return found.map(|(path, iterations)| (path, used.get() + iterations)),
        }
        if used.get() >= budget.iterations {
            break;
        }
        share *= 4;
    }
    Err(ConnectError::Exhausted { iterations: used.get() })
}

/// Searches one branch after the other.
fn in_turn(
    space: &mut Space,
    start: &State,
    end: &State,
    order: &[&[usize]],
    (iterations, range): (usize, f32),
    samples: &mut Sobol,
    control: &mut dyn FnMut(usize) -> Control,
) -> Result<(Vec<State>, usize), ConnectError> {
    let mut postures = vec![*start];
    for joints in order {
        postures.push(with(&postures[postures.len() - 1], end, joints));
    }
    let between_free = postures[1..postures.len() - 1].iter().all(|posture| space.is_free(posture));
    if !between_free {
        return Err(ConnectError::Exhausted { iterations: 0 });
    }
    let (mut paths, mut used) = (Vec::new(), 0);
    for (pair, joints) in postures.windows(2).zip(order) {
        if space.is_free_motion(&pair[0], &pair[1]) {
            paths.push(pair.to_vec());
            continue;
        }
        let found = grow_with(space, &pair[0], &pair[1..], joints, (iterations - used, range), samples, control);
        let (path, more) = found.map_err(|error| match error {
            ConnectError::Exhausted { iterations } => ConnectError::Exhausted { iterations: used + iterations },
            other => other,
        })?;
        used += more;
        paths.push(path);
    }
    Ok((together(space, &paths), used))
}

/// As [`grow`], with samples in which only some of the joints move.
fn grow_with(
    space: &mut Space,
    start: &State,
    ends: &[State],
    joints: &[usize],
    (iterations, range): (usize, f32),
    samples: &mut Sobol,
    control: &mut dyn FnMut(usize) -> Control,
) -> Result<(Vec<State>, usize), ConnectError> {
    let (lower, upper) = (with(start, space.limits().0, joints), with(start, space.limits().1, joints));
    let mut drawn = 0;
    let sample = || {
        drawn += 1;
        samples.next(&lower, &upper)
    };
    let found = grow_by(space, start, ends, (iterations, range), sample, control);
    if let Ok((_, used)) = &found {
        // The unused samples were drawn ahead; the next branch begins with them.
        samples.take_back(drawn - used);
    }
    found
}

/// Searches a path from `start` to a posture that meets one of `targets`: several postures for each, all of them roots of one search. The route's
/// `goal` is the index of the target.
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
    let near = JointVector::from_fn(reach.joints(), |j| f64::from(start[j]));
    let mut random = ChaCha8Rng::seed_from_u64(budget.seed);
    let mut goals: Vec<(usize, State)> = Vec::new();
    for (index, target) in targets.iter().enumerate() {
        go_on(control, 0)?;
        let solutions = reach.solutions(target, &near, POSTURES, ATTEMPTS, &mut random);
        let states = solutions.into_iter().map(|q| (index, crate::space::state(&q)));
        goals.extend(states.filter(|(_, state)| space.is_within(state) && space.is_free(state)));
    }
    let states: Vec<State> = goals.iter().map(|(_, state)| *state).collect();
    let route = match connect(space, start, &states, budget, control) {
        Err(ConnectError::Goal { .. }) => return Err(ConnectError::Goal { goals: targets.len() }),
        other => other?,
    };
    Ok(Route { goal: goals[route.goal].0, ..route })
}

/// Turns the caller's answer into the result of the search.
fn go_on(control: &mut dyn FnMut(usize) -> Control, iterations: usize) -> Result<(), ConnectError> {
    match control(iterations) {
        Control::Continue | Control::Settle => Ok(()),
        Control::TimeUp => Err(ConnectError::TimeUp { iterations }),
        Control::Cancelled => Err(ConnectError::Cancelled),
    }
}

/// Makes sure that a path with free postures is also free between them: for motions that are not, a detour is searched, close to them first.
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

/// A path with free motions that is little longer than the straight motion, if there is one.
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

/// Maximum length of an extension for this robot, for a fraction of [`RANGES`].
fn range(space: &Space, part: f32) -> f32 {
    let (lower, upper) = space.limits();
    // The mean squared difference of two uniform samples is a sixth of the squared range.
    let squares: f32 = difference(upper, lower).iter().map(|range| range * range / 6.0).sum();
    part * (squares / space.joints().max(1) as f32).sqrt()
}

/// As [`grow_by`], with the range of the first attempt.
pub(crate) fn grow(
    space: &mut Space,
    start: &State,
    ends: &[State],
    iterations: usize,
    sample: impl FnMut() -> State,
    control: &mut dyn FnMut(usize) -> Control,
) -> Result<(Vec<State>, usize), ConnectError> {
    let range = range(space, RANGES[0]);
    grow_by(space, start, ends, (iterations, range), sample, control)
}

/// Result of growing a tree towards the other one.
struct Joining {
    /// Distance between the trees.
    gap: f32,
    /// The last new node and the node of the other tree next to it, if the motion between them is free.
    met: Option<(usize, usize)>,
}

/// Grows a tree from a node towards the nearest node of the other tree, as far as the way is free.
fn join(space: &mut Space, tree: &mut Tree, other: &Tree, mut node: usize, range: f32) -> Joining {
    let from = tree.states[node];
    let (meeting, gap) = other.nearest(&from);
    let goal = other.states[meeting];
    let steps = (gap / range).ceil().max(1.0) as usize;
    let mut reached = from;
    for step in 1..=steps {
        let next = if step == steps { goal } else { between(&from, &goal, step as f32 / steps as f32) };
        if !space.is_free_motion(&reached, &next) {
            return Joining { gap, met: None };
        }
        if step < steps {
            node = tree.push(next, node);
            reached = next;
        }
    }
    Joining { gap, met: Some((node, meeting)) }
}

/// Grows a tree from the start and one from all ends, which are free, until they meet. Returns the path and the number of iterations.
fn grow_by(
    space: &mut Space,
    start: &State,
    ends: &[State],
    (iterations, range): (usize, f32),
    sample: impl FnMut() -> State,
    control: &mut dyn FnMut(usize) -> Control,
) -> Result<(Vec<State>, usize), ConnectError> {
    let joints = space.joints();
    let mut trees = [Tree::new(space.isa(), joints), Tree::new(space.isa(), joints)];
    trees[0].push(*start, 0);
    for (i, end) in ends.iter().enumerate() {
        trees[1].push(*end, i);
    }
    let first_range = self::range(space, RANGES[0]);
    let apart = self::range(space, 1.0) * (joints as f32).sqrt();
    let (domain, least_domain) = (DOMAIN * apart, LEAST_DOMAIN * first_range);
    // Index of the tree that grows towards the sample, and the number of failed motions per tree.
    let (mut growing, mut failed) = (1, [0, 0]);
    let is_shut_in = |failed: usize, tree: &Tree| failed >= SHUT_IN * tree.len();
    let step = |iteration: usize, radius: f32| {
        let may_be_short = iteration > SHORT_FROM && iteration.is_multiple_of(SHORT_EVERY);
        if may_be_short && radius.is_finite() { SHORT * range } else { range }
    };
    let mut ahead = Ahead::new(sample);
    // If motions have to be free between their postures, an iteration takes as long as many others.
    let poll = if space.is_swept() { 1 } else { POLL };
    let mut work = 0;
    for iteration in 1..=iterations {
        if work >= poll {
            go_on(control, iteration)?;
            work = 0;
        }
        work += 1;
        let (own, others) = (trees[growing].len() as f32, trees[1 - growing].len() as f32);
        if others < BALANCE * own {
            growing = 1 - growing;
        }
        let (first, second) = trees.split_at_mut(1);
        let (tree, other) = if growing == 0 { (&mut first[0], &second[0]) } else { (&mut second[0], &first[0]) };
        if is_shut_in(failed[growing], tree) && !ahead.knows_next(growing) {
            // A search that has failed this often is likely to fail as often again.
            let wanted = failed[growing].min(iterations - iteration + 1);
            ahead.look(space, (growing, tree), wanted, |after, radius| step(iteration + after, radius));
        }
        let drawn = ahead.next(growing);
        let sample = drawn.sample;
        let (near, far) = drawn.nearest.unwrap_or_else(|| tree.nearest(&sample));
        if tree.radii[near] < far {
            continue;
        }
        work += MOTION;
        let from = tree.states[near];
        let step = step(iteration, tree.radii[near]);
        let next = if drawn.touches == Some(step) { None } else { Some(towards(&from, &sample, far, step)) };
        let Some(mut to) = next.filter(|to| space.is_free_motion(&from, to)) else {
            failed[growing] += 1;
            let radius = &mut tree.radii[near];
            *radius = if radius.is_infinite() { domain } else { (*radius * (1.0 - DOMAIN_CHANGE)).max(least_domain) };
            continue;
        };
        let first = tree.len();
        let mut node = tree.push(to, near);
        if tree.radii[near].is_finite() {
            tree.radii[near] *= 1.0 + DOMAIN_CHANGE;
        }
        // Zero makes no gap small enough.
        let mut least_gap = if is_shut_in(failed[growing], tree) { other.nearest(&from).1 } else { 0.0 };
        let joined = loop {
            let joining = join(space, tree, other, node, range);
            if joining.met.is_some() {
                break joining.met;
            }
            let far = distance(&to, &sample);
            if joining.gap >= least_gap || far == 0.0 {
                break None;
            }
            least_gap = joining.gap;
            let next = towards(&to, &sample, far, step);
            if !space.is_free_motion(&to, &next) {
                break None;
            }
            node = tree.push(next, node);
            to = next;
        };
        ahead.grown(growing, tree, first);
        if let Some((node, meeting)) = joined {
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
