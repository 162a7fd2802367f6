//! A battery that drains with time, faster while the arm moves, and faster still while the base does.

use crate::config::BatteryConfig;
use std::time::Duration;

#[derive(Debug, Clone)]
pub(crate) struct Battery {
    config: BatteryConfig,
    level: f64,
}

impl Battery {
    pub(crate) fn new(config: BatteryConfig) -> Battery {
        Battery { config, level: config.level }
    }

    /// One that is as full as that.
    pub(crate) fn at(config: BatteryConfig, level: f64) -> Battery {
        Battery { config, level }
    }

    /// How full it is, 0 to 1.
    pub(crate) fn level(&self) -> f64 {
        self.level
    }

    pub(crate) fn drain(&mut self, time: Duration, moving: bool, driving: bool) {
        let hours = time.as_secs_f64() / 3600.0;
        let more = |is: bool, rate: f64| if is { rate } else { 0.0 };
        let rate = self.config.idle_per_hour
            + more(moving, self.config.motion_per_hour)
            + more(driving, self.config.driving_per_hour);
        self.level = (self.level - rate * hours).max(0.0);
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
