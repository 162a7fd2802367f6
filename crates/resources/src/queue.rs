//! The queue of acquires: larger priority first, then first come, first served.

use crate::id::{SessionId, WaiterId};
use ratn_model::resource::Requirement;
use ratn_model::time::Timestamp;
use serde::{Deserialize, Serialize};
use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

/// What an acquire asks for: all of it, or to wait.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AcquireRequest {
    /// Who asks; the lease ends with this session.
    pub session: SessionId,
    /// Blocks, consumes and exists.
    pub requirements: Vec<Requirement>,
    /// Larger first.
    pub priority: i64,
    /// When to give up; `None` waits as long as the session lives.
    pub deadline: Option<Timestamp>,
    /// For how long the lease may be held at most; `None` is as long as the session lives.
    pub hold_for: Option<Duration>,
    /// Whom or what it is for, in explanations and events (a run's instance); may be empty.
    pub purpose: String,
}

/// A queued acquire.
#[derive(Debug, Clone)]
pub(crate) struct Waiter {
    pub(crate) request: AcquireRequest,
    /// Forgotten again when it leaves without a lease, so that the client can ask once more.
    pub(crate) request_id: String,
}

/// Waiters in the order in which they are served.
#[derive(Debug, Clone, Default)]
pub(crate) struct Queue {
    waiters: BTreeMap<WaiterId, Waiter>,
    order: BTreeSet<(Reverse<i64>, WaiterId)>,
}

impl AcquireRequest {
    /// Without priority, deadline or bound on holding.
    pub fn new(session: SessionId, requirements: Vec<Requirement>) -> AcquireRequest {
        AcquireRequest { session, requirements, priority: 0, deadline: None, hold_for: None, purpose: String::new() }
    }

    /// With this priority.
    #[must_use]
    pub fn priority(mut self, priority: i64) -> AcquireRequest {
        self.priority = priority;
        self
    }

    /// With this deadline.
    #[must_use]
    pub fn deadline(mut self, deadline: Timestamp) -> AcquireRequest {
        self.deadline = Some(deadline);
        self
    }
}

impl Queue {
    pub(crate) fn len(&self) -> usize {
        self.waiters.len()
    }

    pub(crate) fn get(&self, id: WaiterId) -> Option<&Waiter> {
        self.waiters.get(&id)
    }

    pub(crate) fn insert(&mut self, id: WaiterId, waiter: Waiter) {
        self.order.insert((Reverse(waiter.request.priority), id));
        self.waiters.insert(id, waiter);
    }

    pub(crate) fn remove(&mut self, id: WaiterId) -> Option<Waiter> {
        let waiter = self.waiters.remove(&id)?;
        self.order.remove(&(Reverse(waiter.request.priority), id));
        Some(waiter)
    }

    /// In the order in which they are served.
    pub(crate) fn iter(&self) -> impl Iterator<Item = (WaiterId, &Waiter)> {
        self.order.iter().filter_map(|(_, id)| self.waiters.get(id).map(|waiter| (*id, waiter)))
    }

    pub(crate) fn order_agrees(&self) -> bool {
        self.order.len() == self.waiters.len()
            && self.waiters.iter().all(|(id, w)| self.order.contains(&(Reverse(w.request.priority), *id)))
    }
}
