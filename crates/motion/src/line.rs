//! Straight motions of the tool: depart straight up, approach straight down.

use crate::inverse::Solver;
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

/// Postures along the straight line of the tool from `start` by `offset` (world frame, metres), its rotation kept; the first
/// is `start`.
///
/// # Errors
/// [`LineError`] where limits or a singularity end the line early.
pub fn line(solver: &mut Solver<'_>, start: &Joints, offset: [f64; 3]) -> Result<Vec<Joints>, LineError> {
    let length = offset.iter().map(|c| c * c).sum::<f64>().sqrt();
    let from = solver.tool(start);
    let steps = ((length / STEP_M).ceil() as usize).max(1);
    let mut postures = vec![*start];
    let mut here = *start;
    for i in 1..=steps {
        let mut target = from;
        for (coordinate, way) in target.position.iter_mut().zip(offset) {
            *coordinate += way * i as f64 / steps as f64;
        }
        let next = solver.descend(&target, &here, None);
        match next {
            Some(next) if (0..7).all(|j| (next[j] - here[j]).abs() < MAX_JUMP_RAD) => here = next,
            _ => return Err(LineError { reached_m: length * (i - 1) as f64 / steps as f64, wanted_m: length }),
        }
        postures.push(here);
    }
    Ok(postures)
}
