//! The pace at which tokens grow: no faster than a clock's microseconds, so that the time is above all that was ever handed out.
//!
//! ```text
//!   started at floor t ──▶ last token ≤ t + AHEAD + microseconds since ──▶ state lost, started anew at floor t' > all of them
//! ```
//! More grants than one a microsecond are made a little later. A process takes longer to be started than [`AHEAD`] microseconds.

use crate::caller::for_all;
use crate::pool::Pool;
use crate::session::Session;
use ratn_model::time::Timestamp;
use std::time::Duration;

/// Tokens that may be handed out before any time has passed.
const AHEAD: u64 = 1_000;
/// When it is looked again whether time has caught up.
const A_WHILE: Duration = Duration::from_micros(10);

/// See the module.
#[derive(Debug, Clone)]
pub(crate) struct Pace {
    from: u64,
    /// When that was so: the first moment that the pool hears of.
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

    /// The same of one for a session: of all leases some are only for operators.
    pub(crate) fn may_grant_to(&self, session: &Session) -> bool {
        let for_all = for_all(self.limits.leases, self.limits.leases_for_operators);
        self.may_grant() && (session.is_operators() || self.leases.len() + self.ending.len() < for_all)
    }

    /// Whether the next token would be ahead of the time.
    pub(crate) fn is_ahead_of_time(&self) -> bool {
        let next = self.last_token.max(self.last_lease) + 1;
        self.pace.as_ref().is_some_and(|pace| !pace.allows(next, self.now))
    }

    /// When somebody who could be served is to be looked at again because tokens were ahead of the time.
    pub(crate) fn served_later(&self) -> Option<Timestamp> {
        (!self.queue.ready.is_empty() && self.is_ahead_of_time()).then(|| self.now + A_WHILE)
    }
}
