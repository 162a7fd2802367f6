//! Where a measured fact comes from, and how sure it is.

use crate::fact::FactKey;
use serde::{Deserialize, Serialize};

/// What measured which of the facts that are written together.
pub type Evidence = Vec<(FactKey, Measurement)>;

/// What came with a fact that was measured.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Measurement {
    /// What measured it, `detector-2` or `wrist camera`; empty where nobody said.
    pub source: String,
    /// How sure it is, where the source says so.
    pub certainty: Option<Certainty>,
}

/// How sure a measured value is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Certainty {
    /// The probability that it is so, 0 to 1.
    Confidence(f64),
    /// The covariance of the value's numbers, a square matrix row by row, in their units (of a pose x, y, z in metres and the
    /// rotation about x, y and z in radians).
    Covariance(Vec<f64>),
}

/// A matrix is not wider than this.
pub const MAX_COVARIANCE_ROWS: usize = 64;

impl Certainty {
    /// Its kind, as an ontology names it.
    pub fn name(&self) -> &'static str {
        match self {
            Certainty::Confidence(_) => "confidence",
            Certainty::Covariance(_) => "covariance",
        }
    }

    /// What is wrong with it: a confidence outside 0 to 1, a matrix that is not square or too large, a number that is none.
    ///
    /// # Errors
    /// What it has to be.
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
