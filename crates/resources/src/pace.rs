//! Limits how fast tokens grow: at most one per microsecond, so that a clock's microseconds are larger than every token handed out.
//!
//! ```text
//!   started at floor t ──▶ last token ≤ t + AHEAD + microseconds since ──▶ state lost, restarted at floor t' > all of them
//! ```
//! Grants beyond one per microsecond are made a little later. Starting a process takes longer than [`AHEAD`] microseconds.

use crate::caller::for_all;
use crate::pool::Pool;
use crate::session::Session;
use ratn_model::time::Timestamp;
use std::time::Duration;

/// Number of tokens that may be handed out before any time has passed.
const AHEAD: u64 = 1_000;
/// When to check again whether time has caught up.
const A_WHILE: Duration = Duration::from_micros(10);

/// See the module.
#[derive(Debug, Clone)]
pub(crate) struct Pace {
    from: u64,
    /// The time of `from`: the first time that the pool was told.
    at: Option<Timestamp>,
}

impl Pace {
    pub(crate) fn from(from: u64) -> Pace {
        Pace { from, at: None }
    }

    pub(crate) fn heard_of(&mut self, now: Timestamp) {
        self.at.get_or_insert(now);
    }

    fn allows(&self, token: u64, now: Timestamp) -> bool {
        let passed_us = now.0.saturating_sub(self.at.unwrap_or(now).0) / 1_000;
        token <= self.from.saturating_add(AHEAD).saturating_add(passed_us)
    }
}

impl Pool {
    /// Whether one more lease may be granted now.
    pub(crate) fn may_grant(&self) -> bool {
        self.leases.len() + self.ending.len() < self.limits.leases && !self.is_ahead_of_time()
    }

    /// The same for a session: some of all leases are reserved for operators.
    pub(crate) fn may_grant_to(&self, session: &Session) -> bool {
        let for_all = for_all(self.limits.leases, self.limits.leases_for_operators);
        self.may_grant() && (session.is_operators() || self.leases.len() + self.ending.len() < for_all)
    }

    /// Whether the next token would be ahead of time.
    pub(crate) fn is_ahead_of_time(&self) -> bool {
        let next = self.last_token.max(self.last_lease) + 1;
        self.pace.as_ref().is_some_and(|pace| !pace.allows(next, self.now))
    }

    /// When waiters that could be served are examined again, because tokens were ahead of time.
    pub(crate) fn served_later(&self) -> Option<Timestamp> {
        (!self.queue.ready.is_empty() && self.is_ahead_of_time()).then(|| self.now + A_WHILE)
    }
}
