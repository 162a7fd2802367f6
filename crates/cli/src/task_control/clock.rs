//! The robot's time: wall time since the start of the run, times the speed.

use ratn_model::time::Timestamp;
use std::time::Instant;

/// The clock of one run.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Clock {
    start: Instant,
    speed: f64,
}

impl Clock {
    /// Starts now.
    pub(crate) fn start(speed: f64) -> Clock {
        Clock { start: Instant::now(), speed }
    }

    /// The robot's time.
    pub(crate) fn now(&self) -> Timestamp {
        Timestamp::from_seconds(self.start.elapsed().as_secs_f64() * self.speed)
    }
}
