//! When the next checkpoint is due. Pure: the time comes in as an argument.

use std::time::{Duration, Instant};

/// A checkpoint after so many events: reading and replaying them takes 0.24 s (measured: 5 lines of 160 bytes an event, optimised
/// build, busy machine of two cores), and twice as many may be behind the last one.
pub const EVERY_EVENTS: u64 = 10_000;
/// Or after so many bytes of the log, for lines are read and compared, too: events of some tasks carry trajectories and worlds.
const EVERY_BYTES: u64 = 8 << 20;
/// A checkpoint waits until no event has come for so long, so that it does not delay commands.
const QUIET: Duration = Duration::from_millis(20);
/// It waits no longer than until this many times the events or bytes are behind the last one.
const PATIENCE: u64 = 2;
/// Between two checkpoints is this many times the time that one takes: they take at most 2 % of a run.
const SHARE: u32 = 50;

/// How far a run is behind its last checkpoint.
#[derive(Debug)]
pub(super) struct Pace {
    every_events: u64,
    /// Since the last one.
    events: u64,
    /// The log's length at the last one.
    bytes: u64,
    not_before: Option<Instant>,
}

impl Pace {
    /// For a log of so many bytes, of which so many events are behind the last checkpoint.
    pub(super) fn new(every_events: u64, events: u64, bytes: u64) -> Pace {
        Pace { every_events, events, bytes, not_before: None }
    }

    /// An event was logged.
    pub(super) fn event(&mut self) {
        self.events += 1;
    }

    /// When a checkpoint may be made if nothing happens until then; `None` where none is due. `now` is when the last event was
    /// handled, `bytes` the log's length.
    pub(super) fn due(&self, now: Instant, bytes: u64) -> Option<Instant> {
        let behind = |times: u64| {
            self.events >= self.every_events.saturating_mul(times)
                || bytes.saturating_sub(self.bytes) >= EVERY_BYTES.saturating_mul(times)
        };
        if self.events == 0 || !behind(1) {
            return None;
        }
        let quiet = if behind(PATIENCE) { now } else { now + QUIET };
        Some(self.not_before.map_or(quiet, |not_before| quiet.max(not_before)))
    }

    /// A checkpoint was made of a log of so many bytes.
    pub(super) fn made(&mut self, bytes: u64) {
        (self.events, self.bytes) = (0, bytes);
    }

    /// It took so long, until now.
    pub(super) fn took(&mut self, now: Instant, duration: Duration) {
        self.not_before = now.checked_add(duration.saturating_mul(SHARE));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_checkpoint_is_due_after_enough_events_or_bytes_and_waits_for_a_quiet_moment() {
        let now = Instant::now();
        let mut pace = Pace::new(3, 0, 100);
        assert_eq!(pace.due(now, 100 + EVERY_BYTES), None, "there is nothing new");
        pace.event();
        pace.event();
        assert_eq!(pace.due(now, 200), None);
        assert_eq!(pace.due(now, 100 + EVERY_BYTES), Some(now + QUIET));
        pace.event();
        assert_eq!(pace.due(now, 200), Some(now + QUIET));
        // A run that is never quiet has checkpoints, too.
        (0..3).for_each(|_| pace.event());
        assert_eq!(pace.due(now, 200), Some(now));
        pace.made(200);
        assert_eq!(pace.due(now, 200), None);
    }

    #[test]
    fn checkpoints_take_at_most_their_share_of_the_time() {
        let now = Instant::now();
        let mut pace = Pace::new(1, 9, 0);
        pace.took(now, Duration::from_millis(100));
        assert_eq!(pace.due(now, 10), Some(now + Duration::from_secs(5)));
        let later = now + Duration::from_secs(6);
        assert_eq!(pace.due(later, 10), Some(later));
    }
}
