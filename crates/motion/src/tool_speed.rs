//! Limits of the tool's linear and angular speed, along a whole timed curve.
//!
//! The maximum speed of the tool on the curve is bounded analytically, not sampled: it is computed at the middle of a piece, and within the piece it
//! differs at most by the joints' motions and speed changes there, times the levers of the arm; pieces are halved until the bound is within a
//! thousandth. If a limit is exceeded, the path is timed again with the limit as one of the path (`timing`), so that the motion is slower only where
//! the tool would be too fast. Any excess that is left between the points that the timing checks slows the whole motion by one factor, so that its
//! fastest moment keeps the limit: all other limits still hold, and nothing but the time changes. Works for any robot.

use crate::joint_vector::JointVector;
use crate::plan::PlanError;
use crate::reach::Reach;
use crate::timing::Speed;
use crate::trajectory::{Curve, Knot};

/// Maximum relative error of the bound.
const CLOSE: f64 = 1e-3;

/// The smallest allowed limits, in metres or radians per second.
pub const LEAST_SPEED: f64 = 1e-3;

/// Limits of the tool's speed.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ToolSpeed {
    /// Maximum speed of its origin, in metres per second.
    pub m_per_s: Option<f64>,
    /// Maximum speed of its rotation, in radians per second.
    pub rad_per_s: Option<f64>,
}

impl ToolSpeed {
    /// Refuses invalid limits.
    pub(crate) fn check(&self) -> Result<(), PlanError> {
        for (what, limit, unit) in
            [("tool_speed_m_s", self.m_per_s, "m/s"), ("tool_turning_rad_s", self.rad_per_s, "rad/s")]
        {
            if let Some(limit) = limit.filter(|limit| !(LEAST_SPEED..f64::INFINITY).contains(limit)) {
                let expected = format!("{LEAST_SPEED} {unit} or more");
                return Err(PlanError::Malformed { what: what.to_owned(), value: limit.to_string(), expected });
            }
        }
        Ok(())
    }

    /// The fastest curve of `time` on which the frame of `reach` is nowhere too fast. Calls `time` at most twice, the second time with the limits.
    ///
    /// # Errors
    /// The errors of the first call.
    pub fn within<E>(
        &self,
        reach: &Reach,
        speed: &Speed,
        time: &mut dyn FnMut(&Speed) -> Result<Curve, E>,
    ) -> Result<Curve, E> {
        let curve = time(speed)?;
        let (free_s, slow) = (curve.duration_s(), self.keep(reach, curve));
        if slow.duration_s() <= free_s {
            return Ok(slow);
        }
        Ok(match time(&speed.clone().with_tool(reach, self.limits())).map(|curve| self.keep(reach, curve)) {
            Ok(curve) if curve.duration_s() < slow.duration_s() => curve,
            _ => slow,
        })
    }

    fn limits(&self) -> [f64; 2] {
        [self.m_per_s, self.rad_per_s].map(|limit| limit.unwrap_or(f64::INFINITY))
    }

    /// The curve, slowed down as a whole by one factor if the frame of `reach` would be too fast on it.
    pub fn keep(&self, reach: &Reach, curve: Curve) -> Curve {
        let limits = self.limits();
        if limits == [f64::INFINITY; 2] {
            return curve;
        }
        let greatest = greatest(reach, &curve, limits);
        let factor = (0..2).map(|k| greatest[k] / limits[k]).fold(1.0, f64::max);
        if factor > 1.0 { slowed(&curve, factor) } else { curve }
    }
}

/// The same motion with its duration multiplied by `factor`.
fn slowed(curve: &Curve, factor: f64) -> Curve {
    let slow = |knot: &Knot| Knot {
        time_s: knot.time_s * factor,
        positions: knot.positions,
        velocities: knot.velocities.map(|v| v / factor),
    };
    Curve::new(curve.knots().iter().map(slow).collect())
}

/// Upper bounds of the tool's maximum speed and rotation speed on the curve: at most [`CLOSE`] too high, or not above `limits`.
fn greatest(reach: &Reach, curve: &Curve, limits: [f64; 2]) -> [f64; 2] {
    let mut enough = limits;
    let mut bounds = [0.0_f64; 2];
    for (i, pair) in curve.knots().windows(2).enumerate() {
        let cubics = curve.cubics(i);
        let mut pieces = vec![[0.0, pair[1].time_s - pair[0].time_s]];
        while let Some([from, to]) = pieces.pop() {
            let (middle, half) = ((from + to) / 2.0, (to - from) / 2.0);
            let velocities = cubics.map(|cubic| cubic.velocity_at(middle));
            let speeds = reach.speeds(&cubics.map(|cubic| cubic.position_at(middle)), &velocities);
            let faster = cubics.map(|c| half * c.acceleration_at(from).abs().max(c.acceleration_at(to).abs()));
            let fastest = JointVector::from_fn(velocities.len(), |j| velocities[j].abs() + faster[j]);
            let further = fastest.map(|v| half * v);
            let levers = reach.levers();
            let above = [
                levers.moves_m(&faster) + levers.swing_m(&further, &fastest),
                levers.turns_rad(&faster) + levers.turns_rad(&further) * levers.turns_rad(&fastest),
            ];
            enough = std::array::from_fn(|k| enough[k].max(speeds[k] * (1.0 + CLOSE)));
            let bound: [f64; 2] = std::array::from_fn(|k| speeds[k] + above[k]);
            if (0..2).all(|k| bound[k] <= enough[k]) {
                bounds = std::array::from_fn(|k| bounds[k].max(bound[k]));
            } else {
                pieces.extend([[middle, to], [from, middle]]);
            }
        }
    }
    bounds
}
