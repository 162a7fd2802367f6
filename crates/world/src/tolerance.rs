//! When two values of a fact are the same fact: measured poses and numbers never match to the last bit.

use ratn_model::value::Value;
use serde::{Deserialize, Serialize};

/// How far a measured value may be from the predicted one and still be equal to it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tolerance {
    /// Metres between the origins of two poses.
    pub position_m: f64,
    /// Radians between the rotations of two poses.
    pub angle_rad: f64,
    /// Absolute, for floats, and per joint for joint positions.
    pub number: f64,
}

impl Tolerance {
    /// Equal means equal.
    pub const EXACT: Tolerance = Tolerance { position_m: 0.0, angle_rad: 0.0, number: 0.0 };
    /// What a gripper with compliant fingers forgives.
    pub const ROBOT: Tolerance = Tolerance { position_m: 0.015, angle_rad: 0.09, number: 0.01 };

    /// Whether the two values are the same within the tolerance.
    pub fn equal(&self, a: &Value, b: &Value) -> bool {
        match (a, b) {
            _ if a == b => true,
            (Value::Pose(p), Value::Pose(q)) => p.distance(q) <= self.position_m && p.angle(q) <= self.angle_rad,
            (Value::Joints(p), Value::Joints(q)) => {
                p.len() == q.len() && p.iter().zip(q).all(|(x, y)| (x - y).abs() <= self.number)
            }
            (Value::List(p), Value::List(q)) => p.len() == q.len() && p.iter().zip(q).all(|(x, y)| self.equal(x, y)),
            (Value::Map(p), Value::Map(q)) => {
                p.len() == q.len() && p.iter().all(|(name, x)| q.get(name).is_some_and(|y| self.equal(x, y)))
            }
            _ => match (a.as_number(), b.as_number()) {
                (Some(x), Some(y)) => (x - y).abs() <= self.number,
                _ => false,
            },
        }
    }
}
