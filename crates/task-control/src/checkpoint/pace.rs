//! Decides when the next checkpoint is due. Pure: the time is an argument.

use std::time::{Duration, Instant};

/// Number of events between checkpoints: reading and replaying them takes 0.24 s (measured: 5 lines of 160 bytes per event, optimised build, busy
/// machine with two cores); there may be twice as many since the last checkpoint.
pub const EVERY_EVENTS: u64 = 10_000;
/// Number of log bytes between checkpoints, because lines also have to be read and compared: events of some tasks carry trajectories and worlds.
const EVERY_BYTES: u64 = 8 << 20;
/// A checkpoint waits until no event has come for this long, so that it does not delay commands.
const QUIET: Duration = Duration::from_millis(20);
/// A checkpoint stops waiting when there are this many times the events or bytes since the last one.
const PATIENCE: u64 = 2;
/// The pause between two checkpoints is this multiple of the time that one takes: checkpoints take at most 2 % of a run.
const SHARE: u32 = 50;

/// The progress of a run since its last checkpoint.
#[derive(Debug)]
pub(super) struct Pace {
    every_events: u64,
    /// Events since the last checkpoint.
    events: u64,
    /// The length of the log at the last checkpoint.
    bytes: u64,
    not_before: Option<Instant>,
}

impl Pace {
    /// For a log of `bytes` bytes with `events` events since the last checkpoint.
    pub(super) fn new(every_events: u64, events: u64, bytes: u64) -> Pace {
        Pace { every_events, events, bytes, not_before: None }
    }

    /// An event was logged.
    pub(super) fn event(&mut self) {
        self.events += 1;
    }

    /// When a checkpoint may be made if nothing happens until then; `None` if none is due. `now` is when the last event was handled, `bytes` the
    /// length of the log.
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

    /// A checkpoint was made when the log had this many bytes.
    pub(super) fn made(&mut self, bytes: u64) {
        (self.events, self.bytes) = (0, bytes);
    }

    /// A checkpoint has been written; it took this long.
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
        // A run that is never quiet also gets checkpoints.
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
