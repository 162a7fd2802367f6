//! When the arm is where: a path becomes a trajectory within the joints' velocity, acceleration and jerk limits.
//!
//! Every section starts and ends at rest. The corners of a blended section are rounded in several ways: each by itself (`blend`), and all
//! along, more or less closely (`spline`). What comes out are smooth paths (`path`); the quickest of them is taken, and none of
//! them where stopping at every corner is quicker. How a path is followed: `follow`.

mod blend;
mod cubics;
mod double_s;
mod follow;
mod path;
mod reachability;
mod spline;
mod third_order;

use crate::collision::distance;
use crate::robot::{Joint, Joints, Robot};
use crate::trajectory::{Curve, Knot};
use blend::rounded;
use follow::{Bounds, estimate, follow};
use path::{Path, Segment};
use ratn_model::value::Trajectory;
use spline::{Sides, smoothed, through};

/// The chords for which a curve is asked to be free are at most this far from it, in radians.
const SAGITTA_RAD: f64 = 5e-4;

/// A bend that is none, in radians.
const STRAIGHT_RAD: f64 = 1e-6;

/// How far apart the control points of a spline are at most, in radians: one spline for each.
const SPACINGS_RAD: [f64; 2] = [0.5, 0.25];

/// A path whose motions are shorter is dense: splines also leave out postures of it. In radians, and how many make one.
const DENSE_RAD: f64 = 0.15;
const STRIDES: [usize; 2] = [2, 4];

/// The most candidates that are followed to the end, and how much longer another than the first may take roughly.
const FOLLOWED: usize = 2;
const CLOSE: f64 = 1.03;

/// A section of a path, from rest to rest.
#[derive(Debug, Clone, PartialEq)]
pub enum Section<const N: usize = 7> {
    /// Its corners may be blended where nothing is touched.
    Blended(Vec<[f64; N]>),
    /// Followed as it is given: postures close to each other, such as those along a straight line of the tool; or two, for a straight
    /// motion of the joints.
    AsGiven(Vec<[f64; N]>),
}

/// The trajectory along the sections at a fraction `speed` of the velocity and acceleration limits; those of jerk hold as they are.
/// Corners are rounded where `is_free` finds the straight motions from point to point of the curve free.
pub fn parameterise(
    robot: &Robot,
    sections: &[Section],
    speed: f64,
    is_free: &mut dyn FnMut(&Joints, &Joints) -> bool,
) -> Trajectory {
    timed(robot.arm_joints(), sections, speed, is_free).to_model(robot)
}

/// As [`parameterise`], for any joints, to the end.
pub fn timed<const N: usize>(
    joints: &[Joint],
    sections: &[Section<N>],
    speed: f64,
    is_free: &mut dyn FnMut(&[f64; N], &[f64; N]) -> bool,
) -> Curve<N> {
    timed_while(joints, sections, speed, is_free, &mut || true)
}

/// As [`timed`]; where `goes_on`, which is asked several times per millisecond, says no, what has not been rounded yet is followed with
/// a stop at every corner.
pub fn timed_while<const N: usize>(
    joints: &[Joint],
    sections: &[Section<N>],
    speed: f64,
    is_free: &mut dyn FnMut(&[f64; N], &[f64; N]) -> bool,
    goes_on: &mut dyn FnMut() -> bool,
) -> Curve<N> {
    let bounds = Bounds::new(joints, speed);
    let first = sections.first().and_then(|section| match section {
        Section::Blended(path) | Section::AsGiven(path) => path.first(),
    });
    let start = first.copied().unwrap_or([0.0; N]);
    let mut knots = vec![Knot { time_s: 0.0, positions: start, velocities: [0.0; N] }];
    for section in sections {
        let quickest = match section {
            Section::AsGiven(path) => straight(path, &bounds, goes_on),
            Section::Blended(path) => free(path, &bounds, is_free, goes_on),
        };
        append(&mut knots, quickest);
        let (Section::Blended(path) | Section::AsGiven(path)) = section;
        if let (Some(knot), Some(end)) = (knots.last_mut(), path.last()) {
            // To the last bit.
            knot.positions = *end;
        }
    }
    Curve::new(knots)
}

/// Along postures as they are, or with a stop at each of them if there is no time for more.
fn straight<const N: usize>(path: &[[f64; N]], bounds: &Bounds<N>, goes_on: &mut dyn FnMut() -> bool) -> Vec<Knot<N>> {
    let path = without_repeats(path);
    if path.len() < 2 {
        return Vec::new();
    }
    followed(&through(&path), bounds, goes_on).unwrap_or_else(|| stopping(&path, bounds))
}

/// With a stop at every posture.
fn stopping<const N: usize>(path: &[[f64; N]], bounds: &Bounds<N>) -> Vec<Knot<N>> {
    let stops: Vec<Path<N>> = path.windows(2).map(|pair| line(&pair[0], &pair[1])).collect();
    followed(&stops, bounds, &mut || true).unwrap_or_default()
}

/// The quickest way along a path whose corners may be rounded.
fn free<const N: usize>(
    path: &[[f64; N]],
    bounds: &Bounds<N>,
    is_free: &mut dyn FnMut(&[f64; N], &[f64; N]) -> bool,
    goes_on: &mut dyn FnMut() -> bool,
) -> Vec<Knot<N>> {
    let path = without_repeats(path);
    if path.len() < 2 {
        return Vec::new();
    }
    let mut best = stopping(&path, bounds);
    if path.len() == 2 {
        return best;
    }
    let mut candidates = vec![rounded(&path, is_free)];
    for spacing in SPACINGS_RAD {
        candidates.extend(smoothed(&path, Sides::Free, spacing, is_free));
    }
    let length: f64 = path.windows(2).map(|pair| distance(&pair[0], &pair[1])).sum();
    if length / (path.len() as f64) < DENSE_RAD {
        for stride in STRIDES.into_iter().filter(|stride| path.len() > 2 * stride) {
            let kept = path.iter().step_by(stride).chain(path.last());
            let polygon = without_repeats(&kept.copied().collect::<Vec<_>>());
            candidates.extend(smoothed(&polygon, Sides::Unknown, SPACINGS_RAD[0], is_free));
        }
    }
    let rough = |pieces: &Vec<Path<N>>| pieces.iter().map(|piece| estimate(piece, bounds)).sum::<f64>();
    let mut ranked: Vec<(f64, Vec<Path<N>>)> = candidates.into_iter().map(|c| (rough(&c), c)).collect();
    ranked.sort_by(|a, b| a.0.total_cmp(&b.0));
    let quickest = ranked[0].0;
    for (_, pieces) in ranked.iter().filter(|(rough_s, _)| *rough_s < quickest * CLOSE).take(FOLLOWED) {
        let Some(knots) = followed(pieces, bounds, goes_on) else { continue };
        if lasts_s(&knots) < lasts_s(&best) {
            best = knots;
        }
    }
    best
}

fn line<const N: usize>(from: &[f64; N], to: &[f64; N]) -> Path<N> {
    let mut path = Path::default();
    path.push(Segment::line(from, to));
    path
}

fn without_repeats<const N: usize>(path: &[[f64; N]]) -> Vec<[f64; N]> {
    let mut all: Vec<[f64; N]> = Vec::with_capacity(path.len());
    for posture in path {
        if all.last().is_none_or(|last| distance(last, posture) > 1e-9) {
            all.push(*posture);
        }
    }
    all
}

fn lasts_s<const N: usize>(knots: &[Knot<N>]) -> f64 {
    knots.last().map_or(0.0, |knot| knot.time_s)
}

/// Piece after piece, each from rest to rest.
fn followed<const N: usize>(
    pieces: &[Path<N>],
    bounds: &Bounds<N>,
    goes_on: &mut dyn FnMut() -> bool,
) -> Option<Vec<Knot<N>>> {
    let mut knots = Vec::new();
    for piece in pieces {
        append(&mut knots, follow(piece, bounds, goes_on)?);
    }
    Some(knots)
}

/// Begins where the knots end; what comes first there is left out.
fn append<const N: usize>(knots: &mut Vec<Knot<N>>, next: Vec<Knot<N>>) {
    let begins_s = lasts_s(knots);
    let skipped = usize::from(!knots.is_empty());
    knots.extend(next.into_iter().skip(skipped).map(|knot| Knot { time_s: begins_s + knot.time_s, ..knot }));
}
