//! Tolerances: when two values of a fact count as the same, because measured poses and numbers are never exactly equal.
//!
//! A [`Tolerance`] is complete. Task and ontology give parts of one ([`Deviation`]), for all facts or for one predicate.
//! [`Tolerances::of`] combines them with this precedence: the task for the predicate, the ontology for the predicate, the
//! task for all, the default of the run.

use crate::value::Value;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// The largest difference between a predicted and a measured value that count as the same.
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

/// A part of a [`Tolerance`]: what is `None` is given elsewhere.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Deviation {
    /// Metres between the origins of two poses.
    pub position_m: Option<f64>,
    /// Radians between the rotations of two poses.
    pub angle_rad: Option<f64>,
    /// Absolute, in the predicate's unit.
    pub number: Option<f64>,
}

/// The tolerances of a task.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Tolerances {
    /// For every fact.
    pub default: Deviation,
    /// For the facts of a predicate.
    pub predicates: BTreeMap<String, Deviation>,
}

impl Tolerance {
    /// No tolerance.
    pub const EXACT: Tolerance = Tolerance { position_m: 0.0, angle_rad: 0.0, number: 0.0 };
    /// The differences that a gripper with compliant fingers can absorb.
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

impl Deviation {
    /// Whether all parts are `None`.
    pub fn is_empty(&self) -> bool {
        *self == Deviation::default()
    }

    /// Fills the missing parts from `further`.
    #[must_use]
    pub fn or(self, further: Deviation) -> Deviation {
        Deviation {
            position_m: self.position_m.or(further.position_m),
            angle_rad: self.angle_rad.or(further.angle_rad),
            number: self.number.or(further.number),
        }
    }

    fn over(self, base: Tolerance) -> Tolerance {
        Tolerance {
            position_m: self.position_m.unwrap_or(base.position_m),
            angle_rad: self.angle_rad.unwrap_or(base.angle_rad),
            number: self.number.unwrap_or(base.number),
        }
    }
}

impl Tolerances {
    /// The tolerance of a predicate's facts; `base` gives the parts that are not set.
    pub fn of(&self, predicate: &str, base: Tolerance) -> Tolerance {
        let own = self.predicates.get(predicate).copied().unwrap_or_default();
        own.or(self.default).over(base)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_that_says_it_counts() {
        let number = |number| Deviation { number: Some(number), ..Deviation::default() };
        let tolerances =
            Tolerances { default: number(0.5), predicates: BTreeMap::from([("weight".to_owned(), number(2.0))]) };
        assert!((tolerances.of("weight", Tolerance::ROBOT).number - 2.0).abs() < f64::EPSILON);
        assert!((tolerances.of("load", Tolerance::ROBOT).number - 0.5).abs() < f64::EPSILON);
        assert!((tolerances.of("weight", Tolerance::ROBOT).position_m - 0.015).abs() < f64::EPSILON);
        assert!(tolerances.of("weight", Tolerance::EXACT).equal(&Value::Float(1.0), &Value::Int(3)));
        assert!(!tolerances.of("load", Tolerance::EXACT).equal(&Value::Float(1.0), &Value::Int(3)));
    }
}
