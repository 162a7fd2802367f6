//! Robot time: wall time since a start, multiplied by the speed at which the cell runs. Durations in goals, trajectories and event logs are
//! robot time. It goes on while the machine is suspended, as it does while a process is ([`BootClock`]).

use crate::boot_clock::{BootClock, BootInstant};
use ratn_model::time::Timestamp;
use std::time::Duration;

/// A clock of robot time.
#[derive(Debug, Clone)]
pub struct RobotClock {
    wall: BootClock,
    start: BootInstant,
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
        RobotClock::by(BootClock::default(), at, speed)
    }

    /// As [`RobotClock::going_on`], with this clock of wall time.
    pub fn by(wall: BootClock, at: Timestamp, speed: f64) -> RobotClock {
        RobotClock { start: wall.now(), wall, at, speed }
    }

    /// The present wall time.
    pub fn wall(&self) -> BootInstant {
        self.wall.now()
    }

    /// The present robot time.
    pub fn now(&self) -> Timestamp {
        self.at + self.wall().saturating_duration_since(self.start).mul_f64(self.speed)
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
    fn robot_time_goes_on_while_the_machine_is_suspended() {
        let wall = BootClock::suspendable();
        let clock = RobotClock::by(wall.clone(), Timestamp(0), 10.0);
        wall.suspend(Duration::from_secs(60));
        assert!(clock.now() >= Timestamp::from_seconds(600.0));
    }

    #[test]
    fn a_clock_that_goes_on_is_never_behind_where_it_was() {
        let at = Timestamp::from_seconds(100.0);
        let clock = RobotClock::going_on(at, 10.0);
        assert!(clock.now() >= at && clock.until(at + Duration::from_secs(10)) <= Duration::from_secs(1));
    }
}
