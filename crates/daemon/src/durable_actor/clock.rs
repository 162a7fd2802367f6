//! Time as the actor lives through it: what it was not running is left out.
//!
//! An actor that was suspended (SIGSTOP, a machine without a moment for it) has heard no ping meanwhile, so no session, lease or
//! waiter may be held to that time. The actor looks at the clock at every turn, and takes a turn at least every [`TICK`]; from one
//! look to the next at most [`MOST_STEP`] counts. Deadlines are only ever later for that, never earlier: a client counts from its
//! own question.

use ratn_model::time::Timestamp;
use std::time::{Duration, Instant};

/// The actor takes a turn at least so often.
pub(super) const TICK: Duration = Duration::from_millis(100);
/// More than this has passed between two looks only where the actor was not running.
const MOST_STEP: Duration = Duration::from_millis(250);
/// A longer pause is said in the log.
const LONG_PAUSE: Duration = Duration::from_secs(1);

#[derive(Debug)]
pub(super) struct Clock {
    /// Up to the last look.
    lived: Duration,
    looked: Instant,
}

impl Clock {
    pub(super) fn start(now: Instant) -> Clock {
        Clock { lived: Duration::ZERO, looked: now }
    }

    /// A turn begins.
    pub(super) fn look(&mut self, now: Instant) {
        let passed = now.saturating_duration_since(self.looked);
        self.lived += passed.min(MOST_STEP);
        self.looked = now;
        if let Some(pause) = passed.checked_sub(MOST_STEP).filter(|pause| *pause > LONG_PAUSE) {
            let pause_ms = u64::try_from(pause.as_millis()).unwrap_or(u64::MAX);
            tracing::warn!(pause_ms, "this process was not running: every deadline is later by that");
        }
    }

    pub(super) fn at(&self, now: Instant) -> Timestamp {
        let lived = self.lived + now.saturating_duration_since(self.looked).min(MOST_STEP);
        Timestamp(u64::try_from(lived.as_nanos()).unwrap_or(u64::MAX))
    }

    /// When it is `at`, unless there is a pause before.
    pub(super) fn instant(&self, at: Timestamp) -> Instant {
        self.looked + Duration::from_nanos(at.0).saturating_sub(self.lived)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pause_is_left_out_and_turns_count_in_full() {
        let start = Instant::now();
        let mut clock = Clock::start(start);
        for turn in 1..=10 {
            clock.look(start + TICK * turn);
        }
        let before = start + TICK * 10;
        assert_eq!(clock.at(before), Timestamp(1_000_000_000));
        let after = before + Duration::from_millis(3_600);
        assert_eq!(clock.at(after), Timestamp(1_250_000_000), "also before the next look");
        clock.look(after);
        assert_eq!(clock.at(after), Timestamp(1_250_000_000));
        assert_eq!(clock.at(after + TICK), Timestamp(1_350_000_000));
        assert_eq!(clock.instant(Timestamp(2_250_000_000)), after + Duration::from_secs(1));
    }

    #[test]
    fn a_step_at_the_bound_counts_in_full_and_one_past_it_does_not() {
        let start = Instant::now();
        for (passed, counted) in [(MOST_STEP, MOST_STEP), (MOST_STEP + Duration::from_nanos(1), MOST_STEP)] {
            let mut clock = Clock::start(start);
            clock.look(start + passed);
            assert_eq!(clock.at(start + passed).0, u64::try_from(counted.as_nanos()).unwrap_or(0));
        }
    }
}
