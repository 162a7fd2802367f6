//! The tool in a straight line from one pose to another: its position along the segment, its rotation by the shortest turn, both evenly.
//!
//! The arm is solved at postures a few millimetres apart, each from the one before. The tool is exactly on the line there; where the joints
//! go straight from one of them to the next it is at most [`STRAY_M`] beside the line, which is bounded and not sampled (`levers`). All or
//! an error, which says how far the arm gets and which joint ends the line. Any robot.

use crate::frame::{compose, difference, norm};
use crate::reach::{Positions, Reach, Target, rotation_vector};
use crate::robot_model::Joint;
use ratn_model::pose::Pose;
use std::fmt;

/// How far the tool may be beside the line between two solved postures, in metres.
pub const STRAY_M: f64 = 2.5e-4;

/// The tool's way and turn between two solved postures, in metres and radians.
const STEP_M: f64 = 0.0025;
const STEP_RAD: f64 = 0.01;

/// The most solved postures of one line.
const MAX_STEPS: usize = 4_000;

/// A joint that moves more than this between two solved postures jumps to another branch, in radians or metres.
const MAX_JUMP: f64 = 0.1;

/// A joint this close to a limit is taken as held by it, in radians or metres.
const AT_LIMIT: f64 = 0.01;

/// A straight line that the arm cannot follow to its end.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("the arm can follow the straight line for only {reached_m:.3} m of {wanted_m:.3} m: {cause}")]
pub struct LineError {
    /// How far it gets, in metres.
    pub reached_m: f64,
    /// How far it should, in metres.
    pub wanted_m: f64,
    /// What ends the line.
    pub cause: Cause,
}

/// What ends a line.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Cause {
    /// A joint cannot turn further.
    Limit {
        /// Which joint.
        joint: String,
    },
    /// No posture leads on: the arm is stretched, or all of it would have to turn.
    OutOfReach,
    /// A joint would have to turn at once by far more than the tool moves.
    Flip {
        /// Which joint.
        joint: String,
    },
    /// More postures than are solved for one line.
    TooLong,
}

impl fmt::Display for Cause {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Cause::Limit { joint } => write!(f, "{joint} is at its limit"),
            Cause::OutOfReach => write!(f, "what follows is out of its reach"),
            Cause::Flip { joint } => write!(f, "{joint} would have to flip there (a singular posture)"),
            Cause::TooLong => write!(f, "it would take more than {MAX_STEPS} postures: divide it"),
        }
    }
}

/// Postures along the straight line of the frame of `reach` from where it is in the posture `start` to a pose (in the frame of the root);
/// the first is `start`.
///
/// # Errors
/// [`LineError`] where limits or a singular posture end the line early.
pub fn line(reach: &Reach, start: &Positions, to: &Pose) -> Result<Vec<Positions>, LineError> {
    let from = reach.pose(start);
    let leg = Leg::new(from, *to);
    let steps = ((leg.length_m() / STEP_M).max(leg.turn_rad() / STEP_RAD).ceil() as usize).max(1);
    let error = |done: usize, cause| LineError {
        reached_m: leg.length_m() * done as f64 / steps as f64,
        wanted_m: leg.length_m(),
        cause,
    };
    if steps > MAX_STEPS {
        return Err(error(0, Cause::TooLong));
    }
    let mut postures = vec![*start];
    for i in 1..=steps {
        let here = postures[i - 1];
        let next = step(reach, &here, &leg.at(i as f64 / steps as f64)).map_err(|cause| error(i - 1, cause))?;
        postures.push(next);
    }
    Ok(postures)
}

/// From one posture to the next on a line.
fn step(reach: &Reach, here: &Positions, to: &Pose) -> Result<Positions, Cause> {
    let joints = reach.limits();
    let Some(next) = reach.descend(&Target::at(*to), here) else {
        let held = |(joint, q): &(&Joint, &f64)| (joint.upper - **q).min(**q - joint.lower) < AT_LIMIT;
        let limit = joints.iter().zip(here).find(held).map(|(joint, _)| joint.name.clone());
        return Err(limit.map_or(Cause::OutOfReach, |joint| Cause::Limit { joint }));
    };
    let by: Positions = std::array::from_fn(|j| (next[j] - here[j]).abs());
    let most = (0..joints.len()).max_by(|a, b| by[*a].total_cmp(&by[*b])).unwrap_or(0);
    if by[most] > MAX_JUMP || reach.levers().bend_m(&by) > STRAY_M {
        return Err(Cause::Flip { joint: joints.get(most).map(|joint| joint.name.clone()).unwrap_or_default() });
    }
    Ok(next)
}

/// A straight line from pose to pose.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Leg {
    from: Pose,
    way: [f64; 3],
    /// Rotation vector.
    turn: [f64; 3],
}

impl Leg {
    pub(crate) fn new(from: Pose, to: Pose) -> Leg {
        let turn = rotation_vector(&compose(&to, &from.inverse()));
        Leg { from, way: difference(to.position, from.position), turn }
    }

    pub(crate) fn length_m(&self) -> f64 {
        norm(self.way)
    }

    pub(crate) fn turn_rad(&self) -> f64 {
        norm(self.turn)
    }

    /// The pose at a share of the way.
    pub(crate) fn at(&self, share: f64) -> Pose {
        let turned = compose(&turned_by(self.turn.map(|c| c * share)), &self.from);
        Pose { position: std::array::from_fn(|i| self.from.position[i] + share * self.way[i]), ..turned }
    }
}

/// The rotation by a rotation vector.
pub(crate) fn turned_by(vector: [f64; 3]) -> Pose {
    let angle = norm(vector);
    // Near zero the sine of half of the angle is half of the angle.
    let scale = if angle > 1e-9 { (angle / 2.0).sin() / angle } else { 0.5 };
    let [x, y, z] = vector.map(|c| c * scale);
    Pose { position: [0.0; 3], quaternion_xyzw: [x, y, z, (angle / 2.0).cos()] }
}
