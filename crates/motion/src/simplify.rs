//! Path simplification: shortcuts over the vertices of a path, then corners cut (Chaikin's refinement, CGIP 1974, whose limit is the quadratic
//! B-spline). Every new motion is validated, parts of validated motions count as validated, and nothing found in collision is tried again. At the
//! end the whole path is also made free between its postures.

use crate::connect::{Budget, ConnectError, connect, mend};
use crate::pace::Control;
use crate::space::{Space, State, between, distance};

/// Maximum number of rounds of cutting.
const ROUNDS: usize = 6;

/// Maximum number of motions validated. Shortcuts over the thirty vertices of a long path take some four hundred; most are in collision, and found
/// so at once.
const MAX_CHECKS: usize = 1000;

/// A cut that saves less than this fraction of the length is not tried, and a round that saves less is the last.
const LEAST_CUT: f32 = 0.003;
const LEAST_SAVING: f32 = 0.002;

/// A vertex is dropped if the straight motion past it is shorter by no more than this, in radians: the path has no bend there.
const STRAIGHT: f32 = 1e-4;

/// Fractions of the shorter side at which a corner is cut.
const SHARES: [f32; 3] = [1.0, 0.5, 0.25];

/// The length of a path, in radians.
pub fn path_length(path: &[State]) -> f32 {
    path.windows(2).map(|pair| distance(&pair[0], &pair[1])).sum()
}

/// A shorter path with the same ends, free also between its postures.
///
/// # Errors
/// As [`mend`]: if the path found is not free between its postures and cannot be mended, or the caller stopped it there. If stopped earlier, the
/// path is as short as it was then.
pub fn simplify(
    space: &mut Space,
    path: &[State],
    budget: Budget,
    control: &mut dyn FnMut(usize) -> Control,
) -> Result<Vec<State>, ConnectError> {
    let short = shortened(space, path, control)?;
    match mend(space, &short, budget, control) {
        Err(ConnectError::Exhausted { .. }) => {}
        // Detours have corners of their own.
        Ok(mended) if mended.len() > short.len() => return shortened_swept(space, &mended, control),
        other => return other,
    }
    // The short path leads through a gap that does not exist. The long one may not, and another search checks between postures.
    let long = match mend(space, path, budget, control) {
        Err(ConnectError::Exhausted { .. }) => {
            space.set_swept(true);
            let route = connect(space, &path[0], &path[path.len() - 1..], budget, control);
            space.set_swept(false);
            route?.path
        }
        other => other?,
    };
    shortened_swept(space, &long, control)
}

fn shortened_swept(
    space: &mut Space,
    path: &[State],
    control: &mut dyn FnMut(usize) -> Control,
) -> Result<Vec<State>, ConnectError> {
    space.set_swept(true);
    let short = shortened(space, path, control);
    space.set_swept(false);
    short
}

/// As [`simplify`], but checks between the postures only if the space does.
pub(crate) fn shortened(
    space: &mut Space,
    path: &[State],
    control: &mut dyn FnMut(usize) -> Control,
) -> Result<Vec<State>, ConnectError> {
    let path = without_straight(path).into_iter().map(Vertex::after_shortcuts).collect();
    let mut work = Work { space, path, checks: 0, control, stopped: None };
    work.shorten();
    for _ in 0..ROUNDS {
        let before = work.length();
        work.cut_corners();
        work.shorten_neighbours();
        if work.is_over() || work.length() > before * (1.0 - LEAST_SAVING) {
            break;
        }
    }
    if work.stopped == Some(Control::Cancelled) {
        return Err(ConnectError::Cancelled);
    }
    Ok(work.path.into_iter().map(|vertex| vertex.state).collect())
}

/// The same path without the vertices on straight motions, which a search in steps leaves.
fn without_straight(path: &[State]) -> Vec<State> {
    let mut kept = vec![path[0]];
    for pair in path[1..].windows(2) {
        if saving(&kept[kept.len() - 1], &pair[0], &pair[1]) > STRAIGHT {
            kept.push(pair[0]);
        }
    }
    if path.len() > 1 {
        kept.push(path[path.len() - 1]);
    }
    kept
}

/// How much shorter the straight motion from `a` to `b` is than that through `v`.
fn saving(a: &State, v: &State, b: &State) -> f32 {
    distance(a, v) + distance(v, b) - distance(a, b)
}

/// A vertex, and which motions around it are known to be in collision as long as its neighbours stay.
#[derive(Clone)]
struct Vertex {
    state: State,
    /// Whether the straight motion between its neighbours is known to be in collision.
    is_needed: bool,
    /// Whether every cut that saves enough is known to be in collision.
    is_sharp: bool,
}

impl Vertex {
    /// After shortcuts no vertex can be dropped.
    fn after_shortcuts(state: State) -> Vertex {
        Vertex { state, is_needed: true, is_sharp: false }
    }
}

struct Work<'a> {
    space: &'a mut Space,
    path: Vec<Vertex>,
    checks: usize,
    control: &'a mut dyn FnMut(usize) -> Control,
    stopped: Option<Control>,
}

impl Work<'_> {
    fn is_over(&self) -> bool {
        self.stopped.is_some() || self.checks >= MAX_CHECKS
    }

    fn length(&self) -> f32 {
        self.path.windows(2).map(|pair| distance(&pair[0].state, &pair[1].state)).sum()
    }

    /// A vertex with its neighbours.
    fn corner(&self, at: usize) -> (State, State, State) {
        (self.path[at - 1].state, self.path[at].state, self.path[at + 1].state)
    }

    fn is_free(&mut self, from: &State, to: &State) -> bool {
        if self.is_over() {
            return false;
        }
        self.checks += 1;
        if self.checks.is_multiple_of(8) {
            let answer = (self.control)(self.checks);
            self.stopped = (answer != Control::Continue).then_some(answer);
        }
        self.space.is_free_motion(from, to)
    }

    /// Replaces a vertex by others; its neighbours get new neighbours.
    fn replace(&mut self, at: usize, new: &[State]) {
        // A single replacement has the same neighbours.
        let is_needed = new.len() == 1 && self.path[at].is_needed;
        self.path.splice(at..=at, new.iter().map(|state| Vertex { state: *state, is_needed, is_sharp: false }));
        for neighbour in [at - 1, at + new.len()] {
            (self.path[neighbour].is_needed, self.path[neighbour].is_sharp) = (false, false);
        }
    }

    /// From each vertex, takes the longest free straight motion.
    fn shorten(&mut self) {
        let mut from = 0;
        while from + 2 < self.path.len() {
            for to in (from + 2..self.path.len()).rev() {
                let (a, b) = (self.path[from].state, self.path[to].state);
                if self.is_free(&a, &b) {
                    self.path.drain(from + 1..to);
                    break;
                }
            }
            from += 1;
        }
    }

    /// Drops vertices whose neighbours have a free straight motion between them.
    fn shorten_neighbours(&mut self) {
        let mut middle = 1;
        while middle + 1 < self.path.len() {
            let (a, v, b) = self.corner(middle);
            let is_worth_it = !self.path[middle].is_needed && saving(&a, &v, &b) > LEAST_SAVING * 0.5;
            if is_worth_it && self.is_free(&a, &b) {
                self.replace(middle, &[]);
            } else {
                self.path[middle].is_needed = true;
                middle += 1;
            }
        }
    }

    /// Replaces corners by shorter ways.
    fn cut_corners(&mut self) {
        let least = LEAST_CUT * self.length();
        let mut middle = 1;
        while middle + 1 < self.path.len() {
            match if self.path[middle].is_sharp { None } else { self.cut(middle, least) } {
                Some(new) => {
                    self.replace(middle, &new);
                    middle += new.len();
                }
                None => {
                    self.path[middle].is_sharp = true;
                    middle += 1;
                }
            }
        }
    }

    /// The replacement of a vertex by a cut, if that is free; a cut that reaches a neighbour leaves no new vertex there.
    fn cut(&mut self, at: usize, least: f32) -> Option<Vec<State>> {
        let (a, v, b) = self.corner(at);
        let (before, after) = (distance(&a, &v), distance(&v, &b));
        for share in SHARES {
            let cut = before.min(after) * share;
            let p = between(&v, &a, cut / before);
            let q = between(&v, &b, cut / after);
            if 2.0 * cut - distance(&p, &q) < least {
                return None;
            }
            if self.is_free(&p, &q) {
                let new = [(p, cut < before), (q, cut < after)];
                return Some(new.into_iter().filter_map(|(state, inside)| inside.then_some(state)).collect());
            }
        }
        None
    }
}
