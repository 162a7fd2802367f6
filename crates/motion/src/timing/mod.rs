//! When the arm is where: a path becomes a trajectory within the joints' velocity, acceleration and jerk limits.
//!
//! The corners of a blended section are rounded in several ways: each by itself (`blend`), and all along, more or less closely (`spline`).
//! What comes out are smooth paths (`path`); the quickest of them is taken, and none of them where stopping at every corner is quicker. How a
//! path is followed: `follow`. Every section starts and ends at rest, unless both at a seam leave room to pass it without a stop (`seam`)
//! and the whole is quicker so.

mod blend;
mod cubics;
mod double_s;
mod follow;
mod path;
mod reachability;
mod room;
pub mod rough;
mod seam;
mod spline;
mod third_order;

use crate::collision::distance;
use crate::joint_vector::JointVector;
use crate::mechanism::MAX_JOINTS;
use crate::reach::Reach;
use crate::robot::{Joint, Robot};
use crate::trajectory::{Curve, Knot};
use blend::rounded;
use follow::{Bounds, estimate, follow};
use path::{Path, Segment};
use ratn_model::value::Trajectory;
use room::Room;
use seam::{Loose, joined};
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

/// A tool that is slower than this, per radian of the joints' way, stands still and limits nothing.
const STANDS: f64 = 1e-9;

/// How much of a blended section a seam may take at each end: two seams leave the middle.
const LOOSE_SHARE: f64 = 0.5;

/// How fast a path is followed.
#[derive(Debug, Clone)]
pub struct Speed {
    /// A fraction of the joints' limits of velocity and acceleration; those of jerk hold as they are.
    share: f64,
    tool: Option<Tool>,
}

/// What may not be too fast.
#[derive(Debug, Clone)]
struct Tool {
    reach: Reach,
    /// In metres and in radians per second.
    limits: [f64; 2],
}

impl From<f64> for Speed {
    fn from(share: f64) -> Speed {
        Speed { share, tool: None }
    }
}

impl Speed {
    /// The same, and the frame of `reach` is at most so fast, in metres and in radians per second. That holds at many places of the path and
    /// nearly between them: [`ToolSpeed::keep`](crate::tool_speed::ToolSpeed::keep) makes it hold everywhere.
    pub fn with_tool(self, reach: &Reach, limits: [f64; 2]) -> Speed {
        Speed { tool: Some(Tool { reach: reach.clone(), limits }), ..self }
    }
}

impl Tool {
    /// How many times as fast as with these velocities the joints may be.
    fn fastest(&self, positions: &JointVector, velocities: &JointVector) -> f64 {
        let speeds = self.reach.speeds(positions, velocities);
        (0..2).map(|k| self.limits[k] / speeds[k].max(STANDS)).fold(f64::INFINITY, f64::min)
    }
}

/// A section of a path.
#[derive(Debug, Clone, PartialEq)]
pub enum Section<P = JointVector> {
    /// Its corners may be blended where nothing is touched.
    Blended(Vec<P>),
    /// Followed as it is given, from rest to rest: postures close to each other, such as those along a straight line of the tool; or two, for a
    /// straight motion of the joints.
    AsGiven(Vec<P>),
    /// As given but for its ends: shares of its way, at its beginning and at its end, that may be left to pass into a neighbour without a stop,
    /// where nothing is touched.
    Loose(Vec<P>, [f64; 2]),
}

impl Section {
    /// With as many joints as an array has; those that are not there are at zero.
    fn padded<const N: usize>(&self) -> Section<[f64; N]> {
        let all = |path: &[JointVector]| path.iter().map(JointVector::padded).collect();
        match self {
            Section::Blended(path) => Section::Blended(all(path)),
            Section::AsGiven(path) => Section::AsGiven(all(path)),
            Section::Loose(path, shares) => Section::Loose(all(path), *shares),
        }
    }
}

impl<P: Copy> Section<P> {
    /// Its postures.
    pub fn path(&self) -> &[P] {
        let (Section::Blended(path) | Section::AsGiven(path) | Section::Loose(path, _)) = self;
        path
    }

    /// The shares of its way that seams may take.
    fn loose(&self) -> [f64; 2] {
        match self {
            Section::Blended(_) => [LOOSE_SHARE; 2],
            Section::AsGiven(_) => [0.0; 2],
            Section::Loose(_, shares) => *shares,
        }
    }
}

/// The trajectory along the sections at a fraction `speed` of the velocity and acceleration limits; those of jerk hold as they are.
/// Corners are rounded where `is_free` finds the straight motions from point to point of the curve free, and where no joint leaves its range.
pub fn parameterise(
    robot: &Robot,
    sections: &[Section],
    speed: f64,
    is_free: &mut dyn FnMut(&JointVector, &JointVector) -> bool,
) -> Trajectory {
    timed(robot.arm_joints(), sections, speed, is_free).named(robot.arm_joints())
}

/// As [`parameterise`], for any joints, to the end.
pub fn timed(
    joints: &[Joint],
    sections: &[Section],
    speed: f64,
    is_free: &mut dyn FnMut(&JointVector, &JointVector) -> bool,
) -> Curve {
    timed_while(joints, sections, speed, is_free, &mut || true)
}

/// As [`timed`], at any [`Speed`]; where `goes_on`, which is asked several times per millisecond, says no, what has not been rounded yet is followed with
/// a stop at every corner.
pub fn timed_while(
    joints: &[Joint],
    sections: &[Section],
    speed: impl Into<Speed>,
    is_free: &mut dyn FnMut(&JointVector, &JointVector) -> bool,
    goes_on: &mut dyn FnMut() -> bool,
) -> Curve {
    let speed = speed.into();
    // What follows computes with arrays of fixed sizes; joints up to the next size stand still at zero.
    match joints.len() {
        ..=3 => timed_as::<3>(joints, sections, speed, is_free, goes_on),
        4..=7 => timed_as::<7>(joints, sections, speed, is_free, goes_on),
        _ => timed_as::<MAX_JOINTS>(joints, sections, speed, is_free, goes_on),
    }
}

fn timed_as<const N: usize>(
    joints: &[Joint],
    sections: &[Section],
    speed: Speed,
    is_free: &mut dyn FnMut(&JointVector, &JointVector) -> bool,
    goes_on: &mut dyn FnMut() -> bool,
) -> Curve {
    let of = |padded: &[f64; N]| JointVector::from_fn(joints.len(), |j| padded[j]);
    let padded: Vec<Section<[f64; N]>> = sections.iter().map(Section::padded).collect();
    let is_free = &mut |from: &[f64; N], to: &[f64; N]| is_free(&of(from), &of(to));
    let knots = knots(&padded, &Bounds::new(joints, speed), is_free, goes_on);
    let knot = |knot: &Knot<[f64; N]>| Knot {
        time_s: knot.time_s,
        positions: of(&knot.positions),
        velocities: of(&knot.velocities),
    };
    Curve::new(knots.iter().map(knot).collect())
}

/// The knots of the whole motion.
fn knots<const N: usize>(
    sections: &[Section<[f64; N]>],
    bounds: &Bounds<N>,
    is_free: &mut dyn FnMut(&[f64; N], &[f64; N]) -> bool,
    goes_on: &mut dyn FnMut() -> bool,
) -> Vec<Knot<[f64; N]>> {
    let mut ways = Vec::new();
    for section in sections {
        let path = without_repeats(section.path());
        ways.push(match section {
            _ if path.len() < 2 => Way { pieces: Vec::new(), knots: Vec::new() },
            Section::Blended(_) => free(&path, bounds, is_free, goes_on),
            Section::AsGiven(_) | Section::Loose(..) => straight(&path, bounds, goes_on),
        });
    }
    let stops: f64 = ways.iter().map(|way| lasts_s(&way.knots)).sum();
    let passing = passing(sections, &ways, bounds, is_free, goes_on).filter(|knots| lasts_s(knots) < stops);
    let start = sections.first().and_then(|section| section.path().first()).copied().unwrap_or([0.0; N]);
    let mut knots = vec![Knot { time_s: 0.0, positions: start, velocities: [0.0; N] }];
    match passing {
        Some(passing) => append(&mut knots, passing),
        None => {
            for (section, way) in sections.iter().zip(ways) {
                append(&mut knots, way.knots);
                end_at(&mut knots, section);
            }
        }
    }
    if let Some(section) = sections.last() {
        end_at(&mut knots, section);
    }
    knots
}

/// To the last bit.
fn end_at<const N: usize>(knots: &mut [Knot<[f64; N]>], section: &Section<[f64; N]>) {
    if let (Some(knot), Some(end)) = (knots.last_mut(), section.path().last()) {
        knot.positions = *end;
    }
}

/// Smooth pieces from rest to rest, and what they are followed by.
struct Way<const N: usize> {
    pieces: Vec<Path<N>>,
    knots: Vec<Knot<[f64; N]>>,
}

/// Through all sections, without a stop where that is free and quicker by the estimate; none where every seam stays.
fn passing<const N: usize>(
    sections: &[Section<[f64; N]>],
    ways: &[Way<N>],
    bounds: &Bounds<N>,
    is_free: &mut dyn FnMut(&[f64; N], &[f64; N]) -> bool,
    goes_on: &mut dyn FnMut() -> bool,
) -> Option<Vec<Knot<[f64; N]>>> {
    if ways.len() < 2 {
        return None;
    }
    let loose = |(section, way): (&Section<[f64; N]>, &Way<N>)| -> Vec<Loose<N>> {
        let shares = section.loose();
        let of = |piece: &Path<N>| Loose { path: piece.clone(), ends: shares.map(|share| share * piece.length()) };
        way.pieces.iter().map(of).collect()
    };
    let pieces: Vec<Vec<Loose<N>>> = sections.iter().zip(ways).map(loose).collect();
    let postures = sections.iter().flat_map(|section| section.path());
    let room = ways.iter().fold(Room::new(bounds, postures), |room, way| room.with(&way.knots));
    let pieces = joined(&pieces, bounds, &room, is_free, goes_on)?;
    followed(&pieces, bounds, goes_on).filter(|knots| room.holds_motion(knots))
}

/// Along postures as they are, or with a stop at each of them if there is no time for more.
fn straight<const N: usize>(path: &[[f64; N]], bounds: &Bounds<N>, goes_on: &mut dyn FnMut() -> bool) -> Way<N> {
    let pieces = through(path);
    match followed(&pieces, bounds, goes_on) {
        Some(knots) => Way { pieces, knots },
        None => stopping(path, bounds),
    }
}

/// With a stop at every posture.
fn stopping<const N: usize>(path: &[[f64; N]], bounds: &Bounds<N>) -> Way<N> {
    let pieces: Vec<Path<N>> = path.windows(2).map(|pair| line(&pair[0], &pair[1])).collect();
    let knots = followed(&pieces, bounds, &mut || true).unwrap_or_default();
    Way { pieces, knots }
}

/// The quickest way along a path whose corners may be rounded.
fn free<const N: usize>(
    path: &[[f64; N]],
    bounds: &Bounds<N>,
    is_free: &mut dyn FnMut(&[f64; N], &[f64; N]) -> bool,
    goes_on: &mut dyn FnMut() -> bool,
) -> Way<N> {
    let mut best = stopping(path, bounds);
    if path.len() == 2 {
        return best;
    }
    let room = Room::new(bounds, path);
    let mut candidates = vec![rounded(path, &room, is_free)];
    for spacing in SPACINGS_RAD {
        candidates.extend(smoothed(path, Sides::Free, spacing, &room, is_free));
    }
    let length: f64 = path.windows(2).map(|pair| distance(&pair[0], &pair[1])).sum();
    if length / (path.len() as f64) < DENSE_RAD {
        for stride in STRIDES.into_iter().filter(|stride| path.len() > 2 * stride) {
            let kept = path.iter().step_by(stride).chain(path.last());
            let polygon = without_repeats(&kept.copied().collect::<Vec<_>>());
            candidates.extend(smoothed(&polygon, Sides::Unknown, SPACINGS_RAD[0], &room, is_free));
        }
    }
    let rough = |pieces: &Vec<Path<N>>| pieces.iter().map(|piece| estimate(piece, bounds)).sum::<f64>();
    let mut ranked: Vec<(f64, Vec<Path<N>>)> = candidates.into_iter().map(|c| (rough(&c), c)).collect();
    ranked.sort_by(|a, b| a.0.total_cmp(&b.0));
    let quickest = ranked[0].0;
    for (_, pieces) in ranked.into_iter().filter(|(rough_s, _)| *rough_s < quickest * CLOSE).take(FOLLOWED) {
        let motion = followed(&pieces, bounds, goes_on).filter(|knots| room.holds_motion(knots));
        let Some(knots) = motion else { continue };
        if lasts_s(&knots) < lasts_s(&best.knots) {
            best = Way { pieces, knots };
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

fn lasts_s<const N: usize>(knots: &[Knot<[f64; N]>]) -> f64 {
    knots.last().map_or(0.0, |knot| knot.time_s)
}

/// Piece after piece, each from rest to rest.
fn followed<const N: usize>(
    pieces: &[Path<N>],
    bounds: &Bounds<N>,
    goes_on: &mut dyn FnMut() -> bool,
) -> Option<Vec<Knot<[f64; N]>>> {
    let mut knots = Vec::new();
    for piece in pieces {
        append(&mut knots, follow(piece, bounds, goes_on)?);
    }
    Some(knots)
}

/// Begins where the knots end; what comes first there is left out.
fn append<const N: usize>(knots: &mut Vec<Knot<[f64; N]>>, next: Vec<Knot<[f64; N]>>) {
    let begins_s = lasts_s(knots);
    let skipped = usize::from(!knots.is_empty());
    knots.extend(next.into_iter().skip(skipped).map(|knot| Knot { time_s: begins_s + knot.time_s, ..knot }));
}
