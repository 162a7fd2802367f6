//! Making a path shorter: shortcuts between two of its points, and corners moved towards where the path would rather be.

use crate::collision::{Checker, Contact, between, distance};
use crate::robot::Joints;
use rand::{Rng, RngExt};

/// A shortcut must gain at least this much, in radians.
const LEAST_GAIN_RAD: f64 = 1e-4;

/// The length of a path, in radians.
pub fn length(path: &[Joints]) -> f64 {
    path.windows(2).map(|pair| distance(&pair[0], &pair[1])).sum()
}

/// A point of the path `along` radians from its start, and the index of the posture that follows it.
pub(crate) fn point(path: &[Joints], along: f64) -> (Joints, usize) {
    let mut left = along;
    for i in 1..path.len() {
        let step = distance(&path[i - 1], &path[i]);
        if left <= step && step > 0.0 {
            return (between(&path[i - 1], &path[i], left / step), i);
        }
        left -= step;
    }
    (path[path.len() - 1], path.len() - 1)
}

/// Tries to replace a random part of the path by a straight line; whether it did.
pub(crate) fn shortcut(path: &mut Vec<Joints>, checker: &mut Checker<'_>, random: &mut impl Rng) -> bool {
    let whole = length(path);
    if path.len() < 3 {
        return false;
    }
    let (a, b) = (random.random_range(0.0..=1.0) * whole, random.random_range(0.0..=1.0) * whole);
    let (low, high) = (a.min(b), a.max(b));
    let (from, after_from) = point(path, low);
    let (to, after_to) = point(path, high);
    if after_from == after_to || distance(&from, &to) > high - low - LEAST_GAIN_RAD {
        return false;
    }
    if !checker.edge_is_free(&from, &to, Contact::None) {
        return false;
    }
    path.splice(after_from..after_to, [from, to]);
    tidy(path);
    true
}

/// Tries to move a random corner towards the straight line past it; whether it did.
pub(crate) fn move_corner(path: &mut [Joints], checker: &mut Checker<'_>, random: &mut impl Rng) -> bool {
    if path.len() < 3 {
        return false;
    }
    let i = random.random_range(1..path.len() - 1);
    let (before, here, after) = (path[i - 1], path[i], path[i + 1]);
    let middle = between(&before, &after, random.random_range(0.0..=1.0));
    let mut moved = between(&here, &middle, random.random_range(0.0..0.6));
    for q in &mut moved {
        *q += random.random_range(-0.1..0.1);
    }
    let moved = checker.robot().clamp(&moved);
    let gain =
        distance(&before, &here) + distance(&here, &after) - distance(&before, &moved) - distance(&moved, &after);
    if gain < LEAST_GAIN_RAD
        || !checker.edge_is_free(&before, &moved, Contact::None)
        || !checker.edge_is_free(&after, &moved, Contact::None)
    {
        return false;
    }
    path[i] = moved;
    true
}

/// Removes postures that repeat their predecessor.
fn tidy(path: &mut Vec<Joints>) {
    let last = path[path.len() - 1];
    path.dedup_by(|next, kept| distance(next, kept) < 1e-9);
    if path.len() == 1 {
        path.push(last);
    }
}
