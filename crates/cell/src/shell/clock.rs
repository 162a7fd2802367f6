//! The robot's time: wall time, faster by a factor.

use ratn_model::time::Timestamp;
use std::time::{Duration, Instant};

#[derive(Debug, Clone, Copy)]
pub(crate) struct Clock {
    start: Instant,
    speed: f64,
}

impl Clock {
    pub(crate) fn start(speed: f64) -> Clock {
        Clock { start: Instant::now(), speed }
    }

    /// The robot's time.
    pub(crate) fn now(&self) -> Timestamp {
        Timestamp::from_seconds(self.start.elapsed().as_secs_f64() * self.speed)
    }

    /// How long to wait, in wall time, until a moment of the robot's time.
    pub(crate) fn until(&self, moment: Timestamp) -> Duration {
        moment.since(self.now()).div_f64(self.speed)
    }
}
