//! Devices that may still move although their worker's process has ended. No process can confirm that they stand still, so only waiting
//! helps.

use ratn_model::time::Timestamp;
use std::time::Duration;

/// When motion has ended for certain, and the bound from which that follows.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Motion {
    until: Timestamp,
    bound: Duration,
}

impl Motion {
    /// A worker has ended now, and its device may go on moving for `bound`. Earlier motions keep their own end.
    pub(super) fn goes_on(&mut self, now: Timestamp, bound: Duration) {
        self.bound = self.bound(now).unwrap_or_default().max(bound);
        self.until = self.until.max(now + bound);
    }

    /// When all motion has ended.
    pub(super) fn until(&self) -> Timestamp {
        self.until
    }

    pub(super) fn is_over(&self, now: Timestamp) -> bool {
        self.until <= now
    }

    /// How long a process has to wait that does not know when the motion began; `None` when it is over.
    pub(super) fn bound(&self, now: Timestamp) -> Option<Duration> {
        (!self.is_over(now)).then_some(self.bound)
    }
}
