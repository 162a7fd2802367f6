//! Restarts after a crash: at once after the first crash, with growing delay after further ones, and none after
//! [`Template::crash_limit`] crashes in a row: then the pool has failed, until a client asks for workers.
//!
//! Delays are shortened by up to a quarter, differently on every host and each time (but the same in every run), so that pools that
//! lost the same resource at the same moment do not restart at the same moment.

use crate::process_manager::template::Template;
use ratn_model::time::Timestamp;
use std::time::Duration;

/// Maximum number of doublings of a delay; more would exceed any allowed maximum.
const MOST_DOUBLINGS: u32 = 20;
/// A delay is shortened by up to one part in this many.
const JITTER: u64 = 4;

/// The crashes of a pool in a row.
#[derive(Debug)]
pub(super) struct Restarts {
    seed: u64,
    crashes: u32,
    last: Timestamp,
    not_before: Option<Timestamp>,
    failure: String,
}

impl Restarts {
    /// No crashes yet, in the pool of that template.
    pub(super) fn new(host: &str, template: &str) -> Restarts {
        let seed = host.bytes().chain([0]).chain(template.bytes()).fold(0, |seed, byte| mixed(seed ^ u64::from(byte)));
        Restarts { seed, crashes: 0, last: Timestamp(0), not_before: None, failure: String::new() }
    }

    /// A worker has crashed; it had served since `served`, if at all. `what` says which worker and how, its last output included.
    pub(super) fn crashed(&mut self, now: Timestamp, template: &Template, served: Option<Timestamp>, what: &str) {
        let stable = served.is_some_and(|since| now.since(since) >= template.stable());
        self.crashes = if stable || self.is_long_ago(now, template) { 1 } else { self.crashes + 1 };
        self.last = now;
        if self.crashes >= template.crash_limit {
            self.failure = format!("{} crashes in a row; {what}", self.crashes);
            self.not_before = None;
        } else if self.crashes > 1 {
            self.not_before = Some(now + self.pause(template));
        }
    }

    /// Whether the last crash is too long ago for a crash loop: longer than a worker takes to start, to become stable and to pause.
    fn is_long_ago(&self, now: Timestamp, template: &Template) -> bool {
        let pause = Duration::from_millis(template.max_backoff_ms);
        now.since(self.last) > template.start_timeout() + template.stable() + pause
    }

    fn pause(&mut self, template: &Template) -> Duration {
        let doublings = self.crashes.saturating_sub(2).min(MOST_DOUBLINGS);
        let pause_ms = template.backoff_ms.saturating_mul(1 << doublings).min(template.max_backoff_ms);
        let pause_us = pause_ms.saturating_mul(1_000);
        self.seed = mixed(self.seed);
        Duration::from_micros(pause_us - self.seed % (pause_us / JITTER + 1))
    }

    /// A client asks for workers: past crashes are forgotten.
    pub(super) fn forgive(&mut self) {
        (self.crashes, self.not_before) = (0, None);
        self.failure.clear();
    }

    /// Why no more workers are started; empty while the pool has not failed.
    pub(super) fn failure(&self) -> &str {
        &self.failure
    }

    pub(super) fn has_failed(&self) -> bool {
        !self.failure.is_empty()
    }

    /// Forgets a delay that is over.
    pub(super) fn advance(&mut self, now: Timestamp) {
        self.not_before = self.not_before.filter(|at| *at > now);
    }

    /// Whether a worker may be started now: the pool has not failed and is not in a delay.
    pub(super) fn allow(&mut self, now: Timestamp) -> bool {
        self.advance(now);
        !self.has_failed() && self.not_before.is_none()
    }

    /// When the delay is over.
    pub(super) fn pause_until(&self) -> Option<Timestamp> {
        self.not_before
    }
}

/// The step and finaliser of SplitMix64 (Steele, Lea, Flood 2014).
fn mixed(seed: u64) -> u64 {
    let mut bits = seed.wrapping_add(0x9e37_79b9_7f4a_7c15);
    bits = (bits ^ (bits >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    bits = (bits ^ (bits >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    bits ^ (bits >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn template(crash_limit: u32) -> Template {
        Template { crash_limit, ..Template::new("planner", "PathPlanner") }
    }

    fn pauses_ms(host: &str, count: u32) -> Vec<u128> {
        let (mut restarts, template) = (Restarts::new(host, "planner"), template(100));
        let pause = |_| {
            let now = restarts.pause_until().unwrap_or_default();
            restarts.crashed(now, &template, None, "");
            restarts.pause_until().map_or(0, |at| at.since(now).as_millis())
        };
        (0..count).map(pause).collect()
    }

    #[test]
    fn crashes_in_a_row_pause_longer_and_longer_up_to_the_maximum() {
        let most = [0, 100, 200, 400, 800, 1_600, 3_200, 5_000, 5_000, 5_000];
        for (pause, most) in pauses_ms("compute", 10).into_iter().zip(most) {
            assert!((most * 3 / 4..=most).contains(&pause), "{pause} of {most}");
        }
    }

    #[test]
    fn pauses_differ_from_host_to_host_and_not_from_run_to_run() {
        assert_eq!(pauses_ms("compute", 10), pauses_ms("compute", 10));
        assert_ne!(pauses_ms("compute", 10), pauses_ms("control", 10));
    }

    #[test]
    fn after_the_last_crash_allowed_nothing_is_started_until_that_is_forgiven() {
        let (mut restarts, now) = (Restarts::new("compute", "planner"), Timestamp(0));
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
        let mut restarts = Restarts::new("compute", "planner");
        for round in 0..5 {
            let since = Timestamp::from_seconds(f64::from(round) * 20.0);
            restarts.crashed(since + Duration::from_secs(15), &template(2), Some(since), "");
        }
        assert!(!restarts.has_failed());
    }

    #[test]
    fn a_crash_long_after_the_last_one_is_a_first_one() {
        // Starting takes 10 s at most, becoming stable 10 s, a delay 5 s.
        for (after_s, failed) in [(25, true), (26, false)] {
            let mut restarts = Restarts::new("compute", "planner");
            restarts.crashed(Timestamp(0), &template(2), None, "");
            restarts.crashed(Timestamp(0) + Duration::from_secs(after_s), &template(2), None, "");
            assert_eq!(restarts.has_failed(), failed);
        }
    }
}
