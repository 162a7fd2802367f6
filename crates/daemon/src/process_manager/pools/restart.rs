//! What follows a crash: another worker at once after a first one, later after each further one, and none any more after
//! [`Template::crash_limit`] in a row: then the pool has failed, until somebody asks for it.

use crate::process_manager::config::Template;
use ratn_model::time::Timestamp;
use std::time::Duration;

/// Doublings of a pause; what comes to more is more than any maximum.
const MOST_DOUBLINGS: u32 = 20;

/// The crashes of a pool in a row.
#[derive(Debug, Default)]
pub(super) struct Restarts {
    crashes: u32,
    not_before: Option<Timestamp>,
    failure: String,
}

impl Restarts {
    /// A worker has crashed that served since `served`, if it did. `what` says which and how, its last words included.
    pub(super) fn crashed(&mut self, now: Timestamp, template: &Template, served: Option<Timestamp>, what: &str) {
        let stable = served.is_some_and(|since| now.since(since) >= template.stable());
        self.crashes = if stable { 1 } else { self.crashes + 1 };
        if self.crashes >= template.crash_limit {
            self.failure = format!("{} crashes in a row; {what}", self.crashes);
            self.not_before = None;
        } else if self.crashes > 1 {
            let doublings = (self.crashes - 2).min(MOST_DOUBLINGS);
            let pause_ms = template.backoff_ms.saturating_mul(1 << doublings).min(template.max_backoff_ms);
            self.not_before = Some(now + Duration::from_millis(pause_ms));
        }
    }

    /// Somebody asks for workers: what was is forgotten.
    pub(super) fn forgive(&mut self) {
        *self = Restarts::default();
    }

    /// Why nothing is started any more; empty while all is well.
    pub(super) fn failure(&self) -> &str {
        &self.failure
    }

    pub(super) fn has_failed(&self) -> bool {
        !self.failure.is_empty()
    }

    /// Whether a worker may be started now: neither has it failed, nor is it pausing.
    pub(super) fn allow(&mut self, now: Timestamp) -> bool {
        self.not_before = self.not_before.filter(|at| *at > now);
        !self.has_failed() && self.not_before.is_none()
    }

    /// When the pause is over.
    pub(super) fn pause_until(&self) -> Option<Timestamp> {
        self.not_before
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn template(crash_limit: u32) -> Template {
        Template { crash_limit, ..Template::new("planner", "PathPlanner") }
    }

    fn pause_ms(restarts: &Restarts, now: Timestamp) -> u128 {
        restarts.pause_until().map_or(0, |at| at.since(now).as_millis())
    }

    #[test]
    fn crashes_in_a_row_pause_longer_and_longer_up_to_the_maximum() {
        let (mut restarts, now, template) = (Restarts::default(), Timestamp(0), template(100));
        let pauses = (0..10).map(|_| {
            restarts.crashed(now, &template, None, "");
            pause_ms(&restarts, now)
        });
        assert_eq!(pauses.collect::<Vec<_>>(), [0, 100, 200, 400, 800, 1_600, 3_200, 5_000, 5_000, 5_000]);
        assert!(!restarts.allow(now) && restarts.allow(now + Duration::from_secs(5)));
    }

    #[test]
    fn after_the_last_crash_allowed_nothing_is_started_until_that_is_forgiven() {
        let (mut restarts, now) = (Restarts::default(), Timestamp(0));
        restarts.crashed(now, &template(2), None, "");
        assert!(restarts.allow(now));
        restarts.crashed(now, &template(2), None, "planner-2@compute: exited with status 1");
        assert_eq!(restarts.failure(), "2 crashes in a row; planner-2@compute: exited with status 1");
        assert!(!restarts.allow(Timestamp::from_seconds(1e6)) && restarts.pause_until().is_none());
        restarts.forgive();
        assert!(restarts.allow(now) && restarts.failure().is_empty());
    }

    #[test]
    fn a_worker_that_served_for_long_was_not_part_of_a_crash_loop() {
        let mut restarts = Restarts::default();
        for round in 0..5 {
            let since = Timestamp::from_seconds(f64::from(round) * 100.0);
            restarts.crashed(since + Duration::from_secs(50), &template(2), Some(since), "");
        }
        assert!(!restarts.has_failed());
    }
}
