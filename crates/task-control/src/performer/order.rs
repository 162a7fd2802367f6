//! What is on its way to the resource manager and has to be there before something else leaves. What the run has used up or deleted is gone for
//! what comes behind it in the program, and what it gave back just before may be exactly that:
//!
//! ```text
//! leases go back ─► an operation ─► what is asked for behind it
//! ```

use crate::record::Order;
use crate::safe_on_disk::Mark;
use tokio_util::sync::{CancellationToken, DropGuard};

/// From so many on, those that have their answer are forgotten.
const FORGETS_FROM: usize = 64;

/// Calls of one kind that have no answer yet.
#[derive(Debug, Default)]
pub(super) struct OnTheWay(Vec<CancellationToken>);

impl OnTheWay {
    /// One more, until what is returned is dropped.
    pub(super) fn begin(&mut self) -> DropGuard {
        let over = CancellationToken::new();
        self.add(over.clone());
        over.drop_guard()
    }

    /// What this token stands for is one of them, until it is cancelled.
    pub(super) fn add(&mut self, over: CancellationToken) {
        // Now and then: nobody may ever ask for all of them.
        if self.0.len() >= FORGETS_FROM && self.0.len().is_power_of_two() {
            self.0.retain(|over| !over.is_cancelled());
        }
        self.0.push(over);
    }

    /// Each token is cancelled when its call is over.
    pub(super) fn all(&mut self) -> Vec<CancellationToken> {
        self.0.retain(|over| !over.is_cancelled());
        self.0.clone()
    }

    /// Whether there is none.
    pub(super) fn is_empty(&self) -> bool {
        self.0.iter().all(CancellationToken::is_cancelled)
    }
}

/// Where a run's operations stand among its leases.
#[derive(Debug, Default)]
pub(super) struct Operations {
    /// Leases that go back, and acquires that are withdrawn: what was granted to these meanwhile goes back, too.
    pub(super) returning: OnTheWay,
    /// Operations.
    pub(super) operating: OnTheWay,
}

impl Operations {
    /// The place of the next operation.
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
