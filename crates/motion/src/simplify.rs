//! Makes a path shorter and rounder: shortcuts over its vertices, then its corners cut (Chaikin's refinement, CGIP 1974, whose
//! limit is the quadratic B-spline), every new motion validated, parts of validated motions taken as validated. In the end
//! the whole is made sure of between its postures too.

use crate::connect::{Budget, ConnectError, connect, mend};
use crate::pace::Control;
use crate::space::{Space, State, between, distance};

/// Rounds of cutting at the most.
const ROUNDS: usize = 6;

/// Motions validated at the most.
const MAX_CHECKS: usize = 96;

/// A cut that saves less than this part of the whole is not tried.
const LEAST_SAVING: f32 = 0.002;

/// Shares of the shorter side that a corner is cut at.
const SHARES: [f32; 3] = [1.0, 0.5, 0.25];

/// The length of a path, in radians.
pub fn path_length(path: &[State]) -> f32 {
    path.windows(2).map(|pair| distance(&pair[0], &pair[1])).sum()
}

/// A shorter path with the same ends, free also between its postures.
///
/// # Errors
/// As [`mend`]: where what was found is not free between its postures and cannot be mended, or the caller stopped it there.
/// Stopped earlier, the path is as short as it was then.
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
    // The short way leads through a gap that is none. The long one may not, and another search looks between postures.
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

/// As [`simplify`], as sure of what is between the postures as the space is.
pub(crate) fn shortened(
    space: &mut Space,
    path: &[State],
    control: &mut dyn FnMut(usize) -> Control,
) -> Result<Vec<State>, ConnectError> {
    let mut work = Work { space, path: path.to_vec(), checks: 0, control, stopped: None };
    work.shorten();
    for _ in 0..ROUNDS {
        let before = path_length(&work.path);
        work.cut_corners();
        work.shorten_neighbours();
        if work.is_over() || path_length(&work.path) > before * (1.0 - LEAST_SAVING) {
            break;
        }
    }
    if work.stopped == Some(Control::Cancelled) {
        return Err(ConnectError::Cancelled);
    }
    Ok(work.path)
}

struct Work<'a> {
    space: &'a mut Space,
    path: Vec<State>,
    checks: usize,
    control: &'a mut dyn FnMut(usize) -> Control,
    stopped: Option<Control>,
}

impl Work<'_> {
    fn is_over(&self) -> bool {
        self.stopped.is_some() || self.checks >= MAX_CHECKS
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

    /// From each vertex as far as a straight motion leads.
    fn shorten(&mut self) {
        let mut from = 0;
        while from + 2 < self.path.len() {
            for to in (from + 2..self.path.len()).rev() {
                let (a, b) = (self.path[from], self.path[to]);
                if self.is_free(&a, &b) {
                    self.path.drain(from + 1..to);
                    break;
                }
            }
            from += 1;
        }
    }

    /// Leaves out vertices between whose neighbours the straight motion is free.
    fn shorten_neighbours(&mut self) {
        let mut middle = 1;
        while middle + 1 < self.path.len() {
            let (a, v, b) = (self.path[middle - 1], self.path[middle], self.path[middle + 1]);
            let saving = distance(&a, &v) + distance(&v, &b) - distance(&a, &b);
            if saving > LEAST_SAVING * 0.5 && self.is_free(&a, &b) {
                self.path.remove(middle);
            } else {
                middle += 1;
            }
        }
    }

    /// Replaces corners by shorter ones.
    fn cut_corners(&mut self) {
        let least = LEAST_SAVING * path_length(&self.path);
        let mut middle = 1;
        while middle + 1 < self.path.len() {
            let (a, v, b) = (self.path[middle - 1], self.path[middle], self.path[middle + 1]);
            let (before, after) = (distance(&a, &v), distance(&v, &b));
            let shorter = before.min(after);
            for share in SHARES {
                let cut = shorter * share;
                let p = between(&v, &a, cut / before);
                let q = between(&v, &b, cut / after);
                if 2.0 * cut - distance(&p, &q) < least {
                    break;
                }
                if self.is_free(&p, &q) {
                    // A cut that reaches a neighbour leaves no new vertex there.
                    let new: Vec<State> = [(p, cut < before), (q, cut < after)]
                        .into_iter()
                        .filter_map(|(state, inside)| inside.then_some(state))
                        .collect();
                    middle += new.len().saturating_sub(1);
                    let at = self.path.iter().position(|s| *s == v).unwrap_or(middle);
                    self.path.splice(at..=at, new);
                    break;
                }
            }
            middle += 1;
        }
    }
}
