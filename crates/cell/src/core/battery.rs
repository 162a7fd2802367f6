//! A battery that drains with time, faster while the arm moves, and even faster while the base moves.
//!
//! Times are added up exactly: the level does not depend on how often it is read.

use crate::config::BatteryConfig;
use std::time::Duration;

#[derive(Debug, Clone)]
pub(crate) struct Battery {
    config: BatteryConfig,
    /// The level when the battery was created.
    level: f64,
    /// The time since then, and the parts of it during which the arm and the base moved.
    passed: Duration,
    moving: Duration,
    driving: Duration,
}

impl Battery {
    pub(crate) fn new(config: BatteryConfig) -> Battery {
        Battery::at(config, config.level)
    }

    /// A battery with this level.
    pub(crate) fn at(config: BatteryConfig, level: f64) -> Battery {
        Battery { config, level, passed: Duration::ZERO, moving: Duration::ZERO, driving: Duration::ZERO }
    }

    /// The level, 0 to 1.
    pub(crate) fn level(&self) -> f64 {
        let hours = |time: Duration| time.as_secs_f64() / 3600.0;
        let idle = self.config.idle_per_hour * hours(self.passed);
        let moving = self.config.motion_per_hour * hours(self.moving);
        (self.level - idle - moving - self.config.driving_per_hour * hours(self.driving)).max(0.0)
    }

    pub(crate) fn drain(&mut self, time: Duration, moving: bool, driving: bool) {
        let part = |is: bool| if is { time } else { Duration::ZERO };
        self.passed += time;
        self.moving += part(moving);
        self.driving += part(driving);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_hour_of_motion_drains_more_than_an_hour_of_rest_driving_even_more_and_nothing_below_empty() {
        let (mut rest, mut motion) = (Battery::new(BatteryConfig::default()), Battery::new(BatteryConfig::default()));
        rest.drain(Duration::from_secs(3600), false, false);
        motion.drain(Duration::from_secs(3600), true, false);
        assert!((rest.level() - 0.9).abs() < 1e-9 && (motion.level() - 0.5).abs() < 1e-9);
        motion.drain(Duration::from_secs(1800), false, true);
        assert!((motion.level() - 0.05).abs() < 1e-9);
        motion.drain(Duration::from_secs(36_000), true, true);
        assert_eq!(motion.level(), 0.0);
    }
}
