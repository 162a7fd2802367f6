//! The actor's own time, without the time in which the process was not running or was not allowed to send anything.
//!
//! An actor that was suspended (SIGSTOP, an overloaded machine) has received no pings meanwhile, so that time must not count against any
//! session, lease or waiter. The actor reads the clock at every turn, and takes a turn at least every [`TICK`]; between two reads at most
//! [`MOST_STEP`] counts.
//!
//! Time does not count either after a read at which nothing might be sent ([`super::may_speak`]): a ping may have arrived then without an
//! answer. Otherwise a session would expire because a directory or etcd was unreachable, although its client and this process were running
//! all the time.
//!
//! Both are safe, because deadlines only become later, never earlier. A holder trusts its lease only until the time of its last answered
//! ping plus the time to live, by its own clock, and stops by itself: it needs no deadline here. Waiters wait longer. A process that was
//! superseded while it was silent never sends again, and its successor uses its own clock.

use ratn_model::time::Timestamp;
use std::time::{Duration, Instant};

/// Maximum time between two turns of the actor.
pub(super) const TICK: Duration = Duration::from_millis(100);
/// A longer time between two reads means that the actor was not running; only this much counts.
const MOST_STEP: Duration = Duration::from_millis(250);
/// A longer pause is logged.
const LONG_PAUSE: Duration = Duration::from_secs(1);

#[derive(Debug)]
pub(super) struct Clock {
    /// Counted time up to the last read.
    lived: Duration,
    looked: Instant,
    /// Sending was allowed at the last read.
    counts: bool,
}

impl Clock {
    pub(super) fn start(now: Instant) -> Clock {
        Clock { lived: Duration::ZERO, looked: now, counts: true }
    }

    /// Reads the clock at the beginning of a turn; `may_speak` is whether sending is allowed now.
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

    /// The instant of `at` if no pause comes before; `None` while no time counts.
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
