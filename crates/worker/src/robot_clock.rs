//! Robot time: wall time since a start, multiplied by the speed at which the cell runs. Durations in goals, trajectories and event logs are
//! robot time.

use ratn_model::time::Timestamp;
use std::time::{Duration, Instant};

/// A clock of robot time.
#[derive(Debug, Clone, Copy)]
pub struct RobotClock {
    start: Instant,
    /// Robot time at the start.
    at: Timestamp,
    speed: f64,
}

impl RobotClock {
    /// A clock that is at zero now. `speed`, above 0, is the number of seconds of robot time per second of wall time.
    pub fn start(speed: f64) -> RobotClock {
        RobotClock::going_on(Timestamp(0), speed)
    }

    /// A clock that is at `at` now.
    pub fn going_on(at: Timestamp, speed: f64) -> RobotClock {
        RobotClock { start: Instant::now(), at, speed }
    }

    /// The present robot time.
    pub fn now(&self) -> Timestamp {
        self.at + self.start.elapsed().mul_f64(self.speed)
    }

    /// Wall time until a moment of robot time; zero if it is past.
    pub fn until(&self, moment: Timestamp) -> Duration {
        moment.since(self.now()).div_f64(self.speed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_moment_of_the_robot_is_sooner_for_us_by_the_speed() {
        let clock = RobotClock::start(10.0);
        let wait = clock.until(Timestamp::from_seconds(100.0));
        assert!(wait <= Duration::from_secs(10) && wait > Duration::from_secs(9), "{wait:?}");
        assert_eq!(clock.until(Timestamp(0)), Duration::ZERO);
    }

    #[test]
    fn a_clock_that_goes_on_is_never_behind_where_it_was() {
        let at = Timestamp::from_seconds(100.0);
        let clock = RobotClock::going_on(at, 10.0);
        assert!(clock.now() >= at && clock.until(at + Duration::from_secs(10)) <= Duration::from_secs(1));
    }
}
