//! Time as the actor lives through it: what it was not running is left out, and what it might say nothing.
//!
//! An actor that was suspended (SIGSTOP, a machine without a moment for it) has heard no ping meanwhile, so no session, lease or
//! waiter may be held to that time. The actor looks at the clock at every turn, and takes a turn at least every [`TICK`]; from one
//! look to the next at most [`MOST_STEP`] counts.
//!
//! Nor does time count after a look at which nothing might be said ([`super::may_speak`]): a ping may have arrived then, and was not
//! answered. Otherwise a session would run out although its client and this process were there all the time, because a directory or etcd
//! was not.
//!
//! Both are safe, because deadlines are only ever later for that, never earlier. Whoever holds something believes in it until its ping was
//! asked plus the time to live, by a clock of its own, and stops by itself: it needs no deadline here. Whoever waits for something
//! waits longer. A process that was got past while it was silent never speaks again, and its successor counts by a clock of its own.

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
    /// Something might be said at the last look.
    counts: bool,
}

impl Clock {
    pub(super) fn start(now: Instant) -> Clock {
        Clock { lived: Duration::ZERO, looked: now, counts: true }
    }

    /// A turn begins; whether anything may be said now.
    pub(super) fn look(&mut self, now: Instant, may_speak: bool) {
        let passed = now.saturating_duration_since(self.looked);
        self.lived += self.counted(passed);
        (self.looked, self.counts) = (now, may_speak);
        if let Some(pause) = passed.checked_sub(MOST_STEP).filter(|pause| *pause > LONG_PAUSE) {
            let pause_ms = u64::try_from(pause.as_millis()).unwrap_or(u64::MAX);
            tracing::warn!(pause_ms, "this process was not running: every deadline is later by that");
        }
    }

    pub(super) fn at(&self, now: Instant) -> Timestamp {
        let lived = self.lived + self.counted(now.saturating_duration_since(self.looked));
        Timestamp(u64::try_from(lived.as_nanos()).unwrap_or(u64::MAX))
    }

    /// When it is `at`, unless there is a pause before; nothing while no time counts.
    pub(super) fn instant(&self, at: Timestamp) -> Option<Instant> {
        let left = Duration::from_nanos(at.0).saturating_sub(self.lived);
        (self.counts || left.is_zero()).then(|| self.looked + left)
    }

    fn counted(&self, passed: Duration) -> Duration {
        if self.counts { passed.min(MOST_STEP) } else { Duration::ZERO }
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
            clock.look(start + TICK * turn, true);
        }
        let before = start + TICK * 10;
        assert_eq!(clock.at(before), Timestamp(1_000_000_000));
        let after = before + Duration::from_millis(3_600);
        assert_eq!(clock.at(after), Timestamp(1_250_000_000), "also before the next look");
        clock.look(after, true);
        assert_eq!(clock.at(after), Timestamp(1_250_000_000));
        assert_eq!(clock.at(after + TICK), Timestamp(1_350_000_000));
        assert_eq!(clock.instant(Timestamp(2_250_000_000)), Some(after + Duration::from_secs(1)));
    }

    #[test]
    fn no_time_counts_while_nothing_may_be_said_and_no_deadline_comes_then() {
        let start = Instant::now();
        let mut clock = Clock::start(start);
        clock.look(start + TICK, true);
        let seen = clock.at(start + 2 * TICK);
        clock.look(start + 2 * TICK, false);
        assert_eq!(clock.at(start + 2 * TICK), seen, "time never goes back");
        for turn in 3..=40 {
            assert_eq!(clock.at(start + TICK * turn), seen);
            assert_eq!(clock.instant(Timestamp(seen.0 + 1)), None, "nobody waits for it again and again");
            clock.look(start + TICK * turn, turn == 40);
        }
        let heard = start + TICK * 40;
        assert_eq!(clock.at(heard), seen, "nor what ended the silence");
        assert_eq!(clock.instant(Timestamp(seen.0 + 1)), Some(heard + Duration::from_nanos(1)));
        clock.look(heard + TICK, true);
        assert_eq!(clock.at(heard + TICK), Timestamp(300_000_000));
    }

    #[test]
    fn a_step_at_the_bound_counts_in_full_and_one_past_it_does_not() {
        let start = Instant::now();
        for (passed, counted) in [(MOST_STEP, MOST_STEP), (MOST_STEP + Duration::from_nanos(1), MOST_STEP)] {
            let mut clock = Clock::start(start);
            clock.look(start + passed, true);
            assert_eq!(clock.at(start + passed).0, u64::try_from(counted.as_nanos()).unwrap_or(0));
        }
    }
}
