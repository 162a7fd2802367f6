//! Straight motions of the tool: depart straight up, approach straight down.

use crate::arm::positions;
use crate::reach::{Reach, Target};
use crate::robot::Joints;

/// The tool's way between two solved postures, in metres.
const STEP_M: f64 = 0.0025;

/// A joint that turns more than this between two of them has left the straight line, in radians.
const MAX_JUMP_RAD: f64 = 0.1;

/// A straight line that the arm cannot follow to its end.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("the arm can follow the straight line for only {reached_m:.3} m of {wanted_m:.3} m")]
pub struct LineError {
    /// How far it gets, in metres.
    pub reached_m: f64,
    /// How far it should, in metres.
    pub wanted_m: f64,
}

/// Postures along the straight line of the arm's tool from `start` by `offset` (in the frame of the base, metres), its rotation
/// kept; the first is `start`.
///
/// # Errors
/// [`LineError`] where limits or a singularity end the line early.
pub fn line(reach: &Reach, start: &Joints, offset: [f64; 3]) -> Result<Vec<Joints>, LineError> {
    let length = offset.iter().map(|c| c * c).sum::<f64>().sqrt();
    let from = reach.pose(&positions(start));
    let steps = ((length / STEP_M).ceil() as usize).max(1);
    let mut postures = vec![*start];
    let mut here = *start;
    for i in 1..=steps {
        let mut target = from;
        for (coordinate, way) in target.position.iter_mut().zip(offset) {
            *coordinate += way * i as f64 / steps as f64;
        }
        let next = reach.descend(&Target::at(target), &positions(&here));
        match next {
            Some(next) if (0..7).all(|j| (next[j] - here[j]).abs() < MAX_JUMP_RAD) => {
                here = std::array::from_fn(|j| next[j]);
            }
            _ => return Err(LineError { reached_m: length * (i - 1) as f64 / steps as f64, wanted_m: length }),
        }
        postures.push(here);
    }
    Ok(postures)
}
