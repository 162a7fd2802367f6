//! Moves the tool along straight lines from pose to pose: its position along the segment, its rotation by the shortest turn, both evenly; corners are sharp or
//! rounded.
//!
//! The inverse kinematics are solved a few millimetres apart (closer where joints move far), each posture from the one before. There the tool is exactly on the
//! line; where the joints move straight between two postures it is at most [`STRAY_M`] beside it, which is bounded analytically, not sampled (`levers`). Where
//! that ends early and the arm is redundant, other postures of the same poses are tried (`ladder`). The result is the whole line or an error, which says how
//! far the nearest postures get and which joint ends the line. Works for any robot.

use crate::frame::compose;
use crate::joint_vector::JointVector;
use crate::ladder;
use crate::pace::{Control, Stop};
use crate::reach::{Reach, rotation_vector};
use crate::robot_model::Joint;
use crate::vector::{Vector, position};
use ratn_model::pose::Pose;
use std::fmt;

/// Maximum distance of the tool from the line between two solved postures, in metres.
pub const STRAY_M: f64 = 2.5e-4;

/// Maximum distance and rotation of the tool between two solved postures, in metres and radians.
pub(crate) const STEP_M: f64 = 0.0025;
pub(crate) const STEP_RAD: f64 = 0.01;

/// Where joints move far, steps are halved down to this part of one.
pub(crate) const FINEST: f64 = 1.0 / 16.0;

/// Maximum number of solved postures in one motion.
pub(crate) const MAX_STEPS: usize = 16_000;

/// Minimum number of solved postures in a rounded corner: so many that none of them is a kink at which the arm would stop.
const CORNER_STEPS: usize = 48;

/// A joint that moves more than this between two solved postures jumps to another solution branch, in radians or metres.
pub(crate) const MAX_JUMP: f64 = 0.1;

/// A joint this close to a limit counts as being at the limit, in radians or metres.
const AT_LIMIT: f64 = 0.01;

/// The control points of a rounded corner on each side, from its end to the corner: the curvature is zero at both ends.
const CONTROLS: [f64; 3] = [0.0, 0.4, 0.8];

/// The arm cannot follow a straight line to its end.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("the arm can follow the straight line for only {reached_m:.3} m of {wanted_m:.3} m: {cause}")]
pub struct LineError {
    /// The length that the arm can follow, in metres.
    pub reached_m: f64,
    /// The length of the line, in metres.
    pub wanted_m: f64,
    /// What ends the line.
    pub cause: Cause,
}

/// What ends a line.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Cause {
    /// A joint is at its limit.
    Limit {
        /// The joint.
        joint: String,
    },
    /// No posture continues the line: the arm is stretched, or would have to change its whole posture.
    OutOfReach,
    /// A joint would have to move much farther than the tool.
    Flip {
        /// The joint.
        joint: String,
    },
    /// The line needs more postures than one motion may have.
    TooLong,
    /// Something is in the way.
    Blocked {
        /// The obstacle.
        reason: String,
    },
}

impl fmt::Display for Cause {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Cause::Limit { joint } => write!(f, "{joint} is at its limit"),
            Cause::OutOfReach => write!(f, "what follows is out of its reach"),
            Cause::Flip { joint } => write!(f, "{joint} would have to flip there (a singular posture)"),
            Cause::Blocked { reason } => write!(f, "{reason}"),
            Cause::TooLong => write!(f, "it would take more than {MAX_STEPS} postures: divide the motion"),
        }
    }
}

/// Postures along straight lines, as far as the arm gets.
#[derive(Debug, Clone, PartialEq)]
pub struct Traced {
    /// The first posture is the start.
    pub postures: Vec<JointVector>,
    /// The tool's distance along the lines at each posture, in metres.
    pub along_m: Vec<f64>,
    /// For each posture, the index of the pose that it leads to.
    pub towards: Vec<usize>,
    /// The length of all lines, in metres.
    pub wanted_m: f64,
    /// Index of the pose that the last posture was leading to.
    pub whither: usize,
    /// What ends the lines early.
    pub ended: Option<Cause>,
}

impl Traced {
    pub(crate) fn beginning(lines: &Lines, start: &JointVector) -> Traced {
        let wanted_m = lines.pieces.iter().map(|piece| piece.length_m).sum();
        Traced { postures: vec![*start], along_m: vec![0.0], towards: vec![0], wanted_m, whither: 0, ended: None }
    }

    /// The postures, if they reach the end of the lines.
    pub(crate) fn whole(self) -> Result<Vec<JointVector>, LineError> {
        match self.ended {
            None => Ok(self.postures),
            Some(cause) => {
                let reached_m = self.along_m[self.along_m.len() - 1];
                Err(LineError { reached_m, wanted_m: self.wanted_m, cause })
            }
        }
    }

    /// Adds a posture, at a share of a piece.
    pub(crate) fn push(&mut self, posture: JointVector, lines: &Lines, piece: usize, share: f64) {
        let before_m: f64 = lines.pieces[..piece].iter().map(|piece| piece.length_m).sum();
        self.postures.push(posture);
        self.along_m.push(before_m + share * lines.pieces[piece].length_m);
        self.towards.push(lines.pieces[piece].towards);
    }
}

/// Postures along the straight line that takes the frame of `reach` from its pose in the posture `start` to another pose (in the root's frame); the first is
/// `start`.
///
/// # Errors
/// [`LineError`] where limits or a singular posture end the line early.
pub fn line(reach: &Reach, start: &JointVector, to: &Pose) -> Result<Vec<JointVector>, LineError> {
    through(reach, start, &[*to], 0.0).whole()
}

/// As [`line()`], using only the nearest postures: each is solved from the one before.
///
/// # Errors
/// [`LineError`] where limits or a singular posture end the line early.
pub fn line_of_nearest(reach: &Reach, start: &JointVector, to: &Pose) -> Result<Vec<JointVector>, LineError> {
    let lines = Lines::new(reach.pose(start), &[*to], 0.0);
    let traced = nearest(reach, &lines, start, &mut |_, _| Ok(()), &mut || Control::Continue);
    // `control` never stops it.
    traced.unwrap_or_else(|_| Traced::beginning(&lines, start)).whole()
}

/// Postures along straight lines that take the frame of `reach` from its pose in the posture `start` through poses (in the root's frame), as far as the arm
/// gets. At each pose but the last the tool may deviate from the lines within `blend_m` of the pose.
pub fn through(reach: &Reach, start: &JointVector, to: &[Pose], blend_m: f64) -> Traced {
    let lines = Lines::new(reach.pose(start), to, blend_m);
    let traced = trace(reach, &lines, start, &mut |_, _| Ok(()), &mut || Control::Continue);
    // `control` never stops it.
    traced.unwrap_or_else(|_| Traced::beginning(&lines, start))
}

/// Postures along lines: each solved from the one before, or, where that ends or is blocked, by way of other postures of the same poses. `is_free` says what
/// blocks a straight motion of the joints; `control` is asked between the postures.
///
/// # Errors
/// What `control` returned, where that ends the planning.
pub(crate) fn trace(
    reach: &Reach,
    lines: &Lines,
    start: &JointVector,
    is_free: &mut dyn FnMut(&JointVector, &JointVector) -> Result<(), String>,
    control: &mut dyn FnMut() -> Control,
) -> Result<Traced, Stop> {
    let nearest = nearest(reach, lines, start, is_free, control)?;
    if nearest.ended.is_none() {
        return Ok(nearest);
    }
    let other = ladder::climb(reach, lines, start, &mut |from, to| is_free(from, to).is_ok(), control)?;
    Ok(other.unwrap_or(nearest))
}

/// Solves each posture from the one before.
pub(crate) fn nearest(
    reach: &Reach,
    lines: &Lines,
    start: &JointVector,
    is_free: &mut dyn FnMut(&JointVector, &JointVector) -> Result<(), String>,
    control: &mut dyn FnMut() -> Control,
) -> Result<Traced, Stop> {
    let mut traced = Traced::beginning(lines, start);
    if lines.is_too_long() {
        traced.ended = Some(Cause::TooLong);
        return Ok(traced);
    }
    for (index, piece) in lines.pieces.iter().enumerate() {
        traced.whither = piece.towards;
        let steps = piece.steps();
        if traced.postures.len() + steps > MAX_STEPS {
            traced.ended = Some(Cause::TooLong);
            return Ok(traced);
        }
        for i in 1..=steps {
            let answer = control();
            if !answer.goes_on() {
                return Err(answer.into());
            }
            let share = |part: f64| (i as f64 - 1.0 + part) / steps as f64;
            // Near a singular posture the joints move far while the tool hardly moves: there the postures are closer together.
            let (mut done, mut part) = (0.0, 1.0);
            while done < 1.0 {
                let here = traced.postures[traced.postures.len() - 1];
                match step(reach, &here, &here, &piece.curve.at(share(done + part))) {
                    Ok(next) => {
                        if let Err(reason) = is_free(&here, &next) {
                            traced.ended = Some(Cause::Blocked { reason });
                            return Ok(traced);
                        }
                        done += part;
                        traced.push(next, lines, index, share(done));
                    }
                    Err(Cause::Flip { .. }) if part > FINEST && traced.postures.len() < MAX_STEPS => part /= 2.0,
                    Err(cause) => {
                        traced.ended = Some(cause);
                        return Ok(traced);
                    }
                }
            }
        }
    }
    Ok(traced)
}

/// The next posture on a line: the one that a descent from `seed` finds.
pub(crate) fn step(reach: &Reach, here: &JointVector, seed: &JointVector, to: &Pose) -> Result<JointVector, Cause> {
    let joints = reach.limits();
    let Some(next) = reach.descend(&reach.target(*to), seed) else {
        let held = |(joint, q): &(&Joint, &f64)| (joint.upper - **q).min(**q - joint.lower) < AT_LIMIT;
        let limit = joints.iter().zip(here).find(held).map(|(joint, _)| joint.name.clone());
        return Err(limit.map_or(Cause::OutOfReach, |joint| Cause::Limit { joint }));
    };
    let by = JointVector::from_fn(joints.len(), |j| (next[j] - here[j]).abs());
    let most = (0..joints.len()).max_by(|a, b| by[*a].total_cmp(&by[*b])).unwrap_or(0);
    if by[most] > MAX_JUMP || reach.levers().bend_m(&by) > STRAY_M {
        return Err(Cause::Flip { joint: joints.get(most).map(|joint| joint.name.clone()).unwrap_or_default() });
    }
    Ok(next)
}

/// Lines from pose to pose with their corners, as a sequence of pieces.
#[derive(Debug, Clone)]
pub(crate) struct Lines {
    pub(crate) pieces: Vec<Piece>,
}

/// A part of a line, or a rounded corner.
#[derive(Debug, Clone)]
pub(crate) struct Piece {
    curve: Curve,
    /// For a corner an upper bound.
    length_m: f64,
    turn_rad: f64,
    /// The index of the pose that it leads to.
    pub(crate) towards: usize,
}

#[derive(Debug, Clone)]
enum Curve {
    /// From one share of a leg to another.
    Straight(Leg, f64, f64),
    /// A Bézier curve.
    Corner(Box<[Pose; 6]>),
}

impl Lines {
    /// Lines from a pose through others to the last of them. At each but the last the tool may deviate from the lines within `blend_m` of the pose, and not
    /// beyond the middle of either line.
    pub(crate) fn new(from: Pose, to: &[Pose], blend_m: f64) -> Lines {
        let starts = std::iter::once(&from).chain(to);
        let legs: Vec<Leg> = starts.zip(to).map(|(from, to)| Leg::new(*from, *to)).collect();
        let mut pieces = Vec::new();
        let mut begins = 0.0;
        for (i, leg) in legs.iter().enumerate() {
            let next = legs.get(i + 1);
            let radius = next.map_or(0.0, |next| blend_m.min(leg.length_m() / 2.0).min(next.length_m() / 2.0));
            // A smaller corner would not be faster.
            let radius = if radius < STEP_M { 0.0 } else { radius };
            let ends = if radius > 0.0 { 1.0 - radius / leg.length_m() } else { 1.0 };
            if ends > begins {
                let part = ends - begins;
                let (length_m, turn_rad) = (part * leg.length_m(), part * leg.turn_rad());
                pieces.push(Piece { curve: Curve::Straight(*leg, begins, ends), length_m, turn_rad, towards: i });
            }
            begins = 0.0;
            if let Some(next) = next.filter(|_| radius > 0.0) {
                let share = radius / next.length_m();
                let before = CONTROLS.map(|c| leg.at(1.0 - (1.0 - c) * (1.0 - ends)));
                let after = CONTROLS.map(|c| next.at((1.0 - c) * share));
                let corner = [before[0], before[1], before[2], after[2], after[1], after[0]];
                let turn_rad = (1.0 - ends) * leg.turn_rad() + share * next.turn_rad();
                let curve = Curve::Corner(Box::new(corner));
                pieces.push(Piece { curve, length_m: 2.0 * radius, turn_rad, towards: i });
                begins = share;
            }
        }
        Lines { pieces }
    }

    /// Whether they need more postures than one motion may have, for any arm.
    pub(crate) fn is_too_long(&self) -> bool {
        self.pieces.iter().fold(1, |sum: usize, piece| sum.saturating_add(piece.steps())) > MAX_STEPS
    }
}

impl Piece {
    /// Number of steps where the joints do not move far.
    pub(crate) fn steps(&self) -> usize {
        let steps = (self.length_m / STEP_M).max(self.turn_rad / STEP_RAD).ceil() as usize;
        steps.max(if matches!(self.curve, Curve::Corner(_)) { CORNER_STEPS } else { 1 })
    }

    /// The pose at a share of the piece.
    pub(crate) fn at(&self, share: f64) -> Pose {
        self.curve.at(share)
    }
}

impl Curve {
    fn at(&self, share: f64) -> Pose {
        match self {
            Curve::Straight(leg, from, to) => leg.at(from + share * (to - from)),
            Curve::Corner(controls) => {
                let mut level = **controls;
                for last in (1..level.len()).rev() {
                    for i in 0..last {
                        level[i] = Leg::new(level[i], level[i + 1]).at(share);
                    }
                }
                level[0]
            }
        }
    }
}

/// A straight line from pose to pose.
#[derive(Debug, Clone, Copy)]
struct Leg {
    from: Pose,
    way: Vector,
    /// A rotation vector.
    turn: Vector,
}

impl Leg {
    fn new(from: Pose, to: Pose) -> Leg {
        let turn = rotation_vector(&compose(&to, &from.inverse()));
        Leg { from, way: position(&to) - position(&from), turn }
    }

    fn length_m(&self) -> f64 {
        self.way.length()
    }

    fn turn_rad(&self) -> f64 {
        self.turn.length()
    }

    /// The pose at a share of the line.
    fn at(&self, share: f64) -> Pose {
        let turned = compose(&turned_by(self.turn * share), &self.from);
        Pose { position: (position(&self.from) + share * self.way).into(), ..turned }
    }
}

/// The rotation by a rotation vector.
fn turned_by(vector: Vector) -> Pose {
    let angle = vector.length();
    // Near zero the sine of half the angle is about half the angle.
    let scale = if angle > 1e-9 { (angle / 2.0).sin() / angle } else { 0.5 };
    Pose { position: [0.0; 3], quaternion_xyzw: (vector * scale).extend((angle / 2.0).cos()).into() }
}
