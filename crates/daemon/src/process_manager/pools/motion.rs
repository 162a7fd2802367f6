//! Devices that may still move although their worker's process has ended. No process can confirm that they stand still, so only time decides.

use ratn_model::time::Timestamp;
use std::time::Duration;

/// Until when something may move, and the bound from which that follows.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Motion {
    until: Timestamp,
    bound: Duration,
}

impl Motion {
    /// A worker is gone now, and what it moved may go on for so long. What others moved ends no earlier for that.
    pub(super) fn goes_on(&mut self, now: Timestamp, bound: Duration) {
        self.bound = self.bound(now).unwrap_or_default().max(bound);
        self.until = self.until.max(now + bound);
    }

    /// When nothing moves any more.
    pub(super) fn until(&self) -> Timestamp {
        self.until
    }

    pub(super) fn is_over(&self, now: Timestamp) -> bool {
        self.until <= now
    }

    /// How long somebody has to wait who does not know when it began; nothing where it is over.
    pub(super) fn bound(&self, now: Timestamp) -> Option<Duration> {
        (!self.is_over(now)).then_some(self.bound)
    }
}
