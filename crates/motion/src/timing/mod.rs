//! Time parameterization: a path becomes a trajectory within the joints' velocity, acceleration and jerk limits.
//!
//! The corners of a blended section are rounded in several ways: each by itself (`blend`), and all together, more or less closely (`spline`). The results
//! are smooth paths (`path`); the fastest of them is used, or a stop at every corner where that is faster. `follow` times a path: within limits of
//! velocity and acceleration (`second_order`), and where jerk is limited once more (`third_order`), in cells that are short where acceleration changes
//! (`mesh`). Every section starts and ends at rest, unless both sections at a seam leave room to pass it without a stop (`seam`) and the whole motion is
//! faster so.

mod blend;
mod cubics;
mod double_s;
mod follow;
mod mesh;
mod path;
mod reachability;
mod room;
pub mod rough;
mod seam;
mod second_order;
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

/// Maximum distance between a curve and the chords that are checked for collisions, in radians.
const SAGITTA_RAD: f64 = 5e-4;

/// A smaller change of direction is not a corner, in radians.
const STRAIGHT_RAD: f64 = 1e-6;

/// Maximum distances between the control points of a spline, in radians: one spline is tried for each.
const SPACINGS_RAD: [f64; 2] = [0.5, 0.25];

/// A path with shorter motions than this is dense, in radians: splines then also skip postures, by these strides.
const DENSE_RAD: f64 = 0.15;
const STRIDES: [usize; 2] = [2, 4];

/// Maximum number of candidates that are timed exactly, and how much longer than the best another one may be by estimate.
const FOLLOWED: usize = 2;
const CLOSE: f64 = 1.03;

/// A tool slower than this, per radian of joint motion, stands still and is no limit.
const STANDS: f64 = 1e-9;

/// The part of a blended section that a seam may take at each end: two seams leave the middle.
const LOOSE_SHARE: f64 = 0.5;

/// How fast a path is followed.
#[derive(Debug, Clone)]
pub struct Speed {
    /// A fraction of the joints' limits of velocity and acceleration; jerk limits are not scaled.
    share: f64,
    tool: Option<Tool>,
}

/// A frame whose speed is limited.
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
    /// Also limits the speed of the frame of `reach`, in metres and in radians per second. The limit holds at many points of the path and approximately
    /// between them: [`ToolSpeed::keep`](crate::tool_speed::ToolSpeed::keep) makes it hold everywhere.
    pub fn with_tool(self, reach: &Reach, limits: [f64; 2]) -> Speed {
        Speed { tool: Some(Tool { reach: reach.clone(), limits }), ..self }
    }
}

impl Tool {
    /// The factor by which these joint velocities may be multiplied.
    fn fastest(&self, positions: &JointVector, velocities: &JointVector) -> f64 {
        let speeds = self.reach.speeds(positions, velocities);
        (0..2).map(|k| self.limits[k] / speeds[k].max(STANDS)).fold(f64::INFINITY, f64::min)
    }
}

/// A section of a path.
#[derive(Debug, Clone, PartialEq)]
pub enum Section<P = JointVector> {
    /// Its corners may be blended where that causes no collision.
    Blended(Vec<P>),
    /// Followed exactly, from rest to rest: closely spaced postures, such as those along a straight line of the tool; or two, for a straight joint
    /// motion.
    AsGiven(Vec<P>),
    /// Followed exactly except for its ends: shares of its length, at its beginning and at its end, that a seam may replace to pass into a neighbour
    /// without a stop, where that causes no collision.
    Loose(Vec<P>, [f64; 2]),
}

impl Section {
    /// Padded to the number of joints of an array; the missing ones are zero.
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

    /// The shares of its length that seams may take.
    fn loose(&self) -> [f64; 2] {
        match self {
            Section::Blended(_) => [LOOSE_SHARE; 2],
            Section::AsGiven(_) => [0.0; 2],
            Section::Loose(_, shares) => *shares,
        }
    }
}

/// The trajectory along the sections at a fraction `speed` of the velocity and acceleration limits; jerk limits are not scaled. Corners are rounded where
/// `is_free` finds the chords of the curve free, and where no joint leaves its range.
pub fn parameterise(
    robot: &Robot,
    sections: &[Section],
    speed: f64,
    is_free: &mut dyn FnMut(&JointVector, &JointVector) -> bool,
) -> Trajectory {
    timed(robot.arm_joints(), sections, speed, is_free).named(robot.arm_joints())
}

/// As [`parameterise`], for any joints, without interruption.
pub fn timed(
    joints: &[Joint],
    sections: &[Section],
    speed: f64,
    is_free: &mut dyn FnMut(&JointVector, &JointVector) -> bool,
) -> Curve {
    timed_while(joints, sections, speed, is_free, &mut || true)
}

/// As [`timed`], at any [`Speed`]. When `goes_on`, which is asked several times per millisecond, returns false, corners that have not been rounded yet
/// are followed with a stop.
pub fn timed_while(
    joints: &[Joint],
    sections: &[Section],
    speed: impl Into<Speed>,
    is_free: &mut dyn FnMut(&JointVector, &JointVector) -> bool,
    goes_on: &mut dyn FnMut() -> bool,
) -> Curve {
    let speed = speed.into();
    // The computation uses arrays of fixed sizes; joints up to the next size stand still at zero.
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

/// Ends exactly at the section's last posture.
fn end_at<const N: usize>(knots: &mut [Knot<[f64; N]>], section: &Section<[f64; N]>) {
    if let (Some(knot), Some(end)) = (knots.last_mut(), section.path().last()) {
        knot.positions = *end;
    }
}

/// Smooth pieces from rest to rest, and their knots.
struct Way<const N: usize> {
    pieces: Vec<Path<N>>,
    knots: Vec<Knot<[f64; N]>>,
}

/// Through all sections, without a stop where that is free and faster by the estimate; `None` where every seam stays.
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

/// Through the postures exactly, or with a stop at each of them if there is no time for more.
fn straight<const N: usize>(path: &[[f64; N]], bounds: &Bounds<N>, goes_on: &mut dyn FnMut() -> bool) -> Way<N> {
    let pieces = through(path);
    match followed(&pieces, bounds, goes_on) {
        Some(knots) => Way { pieces, knots },
        None => stopping(path, bounds),
    }
}

/// Stops at every posture.
fn stopping<const N: usize>(path: &[[f64; N]], bounds: &Bounds<N>) -> Way<N> {
    let pieces: Vec<Path<N>> = path.windows(2).map(|pair| line(&pair[0], &pair[1])).collect();
    let knots = followed(&pieces, bounds, &mut || true).unwrap_or_default();
    Way { pieces, knots }
}

/// The fastest way along a path whose corners may be rounded.
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
    // On a short path several ways to round it are the same.
    ranked.dedup_by(|a, b| a.0 == b.0);
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

/// The knots of all pieces, each from rest to rest.
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

/// Appends knots after the last time; the first one is dropped because it repeats the last.
fn append<const N: usize>(knots: &mut Vec<Knot<[f64; N]>>, next: Vec<Knot<[f64; N]>>) {
    let begins_s = lasts_s(knots);
    let skipped = usize::from(!knots.is_empty());
    knots.extend(next.into_iter().skip(skipped).map(|knot| Knot { time_s: begins_s + knot.time_s, ..knot }));
}
