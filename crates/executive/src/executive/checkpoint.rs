//! STAND-IN, to be replaced by a checkpoint of the state itself: here it is every event so far, as JSON. Correct, and as long as the run.

use super::Executive;
use crate::protocol::Event;
use ratn_model::program::Program;
use ratn_model::time::Timestamp;
use ratn_model::tolerance::Tolerance;
use std::sync::Arc;

/// Why a checkpoint cannot be restored.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("not an executive's state of this version: {0}")]
pub struct RestoreError(String);

impl Executive {
    /// The whole state. An executive that is restored from it gives the same commands for the same further events.
    pub fn checkpoint(&self) -> Vec<u8> {
        serde_json::to_vec(&self.history).unwrap_or_default()
    }

    /// An executive as it was at a [`Executive::checkpoint`].
    ///
    /// # Errors
    /// Where the bytes are of another version.
    pub fn restore(program: Arc<Program>, tolerance: Tolerance, bytes: &[u8]) -> Result<Executive, RestoreError> {
        let history: Vec<(Timestamp, Event)> =
            serde_json::from_slice(bytes).map_err(|error| RestoreError(error.to_string()))?;
        let mut executive = Executive::new(program, tolerance);
        for (now, event) in history {
            executive.handle(now, event);
        }
        Ok(executive)
    }
}
