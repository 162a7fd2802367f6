//! Time in the cores: an argument, never a clock.

use serde::{Deserialize, Serialize};
use std::time::Duration;

/// A moment in nanoseconds since the start of the run (or of the daemon). In `ratn demo --speed X` the shell
/// multiplies wall time by X, so that every duration in an event log is in the robot's seconds.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Timestamp(pub u64);

impl Timestamp {
    /// The moment `seconds` after the start; negative values and NaN count as 0.
    pub fn from_seconds(seconds: f64) -> Self {
        Timestamp((seconds.max(0.0) * 1e9).round() as u64)
    }

    /// Seconds since the start.
    pub fn seconds(self) -> f64 {
        self.0 as f64 / 1e9
    }

    /// The time since `earlier`; zero if `earlier` is later.
    pub fn since(self, earlier: Timestamp) -> Duration {
        Duration::from_nanos(self.0.saturating_sub(earlier.0))
    }
}

impl std::ops::Add<Duration> for Timestamp {
    type Output = Timestamp;

    fn add(self, duration: Duration) -> Timestamp {
        Timestamp(self.0.saturating_add(u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX)))
    }
}
