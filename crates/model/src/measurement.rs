//! The source of a measured fact, and its certainty.

use crate::fact::FactKey;
use serde::{Deserialize, Serialize};

/// Measurements, by the fact that each belongs to.
pub type Evidence = Vec<(FactKey, Measurement)>;

/// Additional data of a measured fact.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Measurement {
    /// The source, `detector-2` or `wrist camera`; empty if unknown.
    pub source: String,
    /// The certainty, if the source gives one.
    pub certainty: Option<Certainty>,
}

/// The certainty of a measured value.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Certainty {
    /// The probability that the value is correct, 0 to 1.
    Confidence(f64),
    /// The covariance matrix of the value's numbers, row by row, in their units (for a pose: x, y, z in metres and the
    /// rotations about x, y and z in radians).
    Covariance(Vec<f64>),
}

/// Limit of the number of rows of a covariance matrix.
pub const MAX_COVARIANCE_ROWS: usize = 64;

impl Certainty {
    /// The name of this kind of certainty in an ontology.
    pub fn name(&self) -> &'static str {
        match self {
            Certainty::Confidence(_) => "confidence",
            Certainty::Covariance(_) => "covariance",
        }
    }

    /// Checks the certainty: a confidence within 0 to 1; a square matrix that is not too large; only finite numbers.
    ///
    /// # Errors
    /// The condition that does not hold.
    pub fn check(&self) -> Result<(), &'static str> {
        match self {
            Certainty::Confidence(p) if (0.0..=1.0).contains(p) => Ok(()),
            Certainty::Confidence(_) => Err("a confidence is a number from 0 to 1"),
            Certainty::Covariance(entries) => {
                let square = (1..=MAX_COVARIANCE_ROWS).any(|rows| rows * rows == entries.len());
                match square && entries.iter().all(|entry| entry.is_finite()) {
                    true => Ok(()),
                    false => Err("a covariance is a square matrix of at most 64 rows of finite numbers"),
                }
            }
        }
    }
}
