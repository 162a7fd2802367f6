//! The order of calls to the resource manager: some have to arrive before others are sent. What an operation of the run consumes or deletes is gone
//! for everything later in the program, and it may be what the run has just released:
//!
//! ```text
//! releases of leases ─► an operation ─► later requests
//! ```

use crate::record::Order;
use crate::safe_on_disk::Mark;
use tokio_util::sync::{CancellationToken, DropGuard};

/// From this number on, answered calls are removed from time to time.
const FORGETS_FROM: usize = 64;

/// Calls of one kind that have no answer yet.
#[derive(Debug, Default)]
pub(super) struct OnTheWay(Vec<CancellationToken>);

impl OnTheWay {
    /// Adds a call, which ends when the returned guard is dropped.
    pub(super) fn begin(&mut self) -> DropGuard {
        let over = CancellationToken::new();
        self.add(over.clone());
        over.drop_guard()
    }

    /// Adds a call, which ends when this token is cancelled.
    pub(super) fn add(&mut self, over: CancellationToken) {
        // Clean up now and then: `all` may never be called.
        if self.0.len() >= FORGETS_FROM && self.0.len().is_power_of_two() {
            self.0.retain(|over| !over.is_cancelled());
        }
        self.0.push(over);
    }

    /// The tokens of the open calls; each is cancelled when its call ends.
    pub(super) fn all(&mut self) -> Vec<CancellationToken> {
        self.0.retain(|over| !over.is_cancelled());
        self.0.clone()
    }

    /// Whether there are no open calls.
    pub(super) fn is_empty(&self) -> bool {
        self.0.iter().all(CancellationToken::is_cancelled)
    }
}

/// The order of a run's operations relative to its leases.
#[derive(Debug, Default)]
pub(super) struct Operations {
    /// Releases of leases, and withdrawn acquires, whose grants are released too.
    pub(super) returning: OnTheWay,
    /// Operations under way.
    pub(super) operating: OnTheWay,
}

impl Operations {
    /// The order of the next operation: it is sent after the releases so far.
    pub(super) fn next(&mut self, safe: Option<Mark>) -> Order {
        Order { safe, after: self.returning.all(), _ends: self.operating.begin() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn calls_that_are_over_are_forgotten_though_nobody_asks_for_all_of_them() {
        let mut calls = OnTheWay::default();
        let open = calls.begin();
        for _ in 0..10 * FORGETS_FROM {
            drop(calls.begin());
        }
        assert!(calls.0.len() <= FORGETS_FROM && !calls.is_empty(), "{}", calls.0.len());
        assert_eq!(calls.all().len(), 1);
        drop(open);
        assert!(calls.is_empty());
    }
}
