//! Sessions: everything that a client provides, holds, waits for or has consumed hangs on one.

use crate::id::{SessionId, WaiterId};
use ratn_model::id::LeaseId;
use ratn_model::time::Timestamp;
use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

/// A live session.
#[derive(Debug, Clone)]
pub(crate) struct Session {
    /// The client's name, for people.
    pub(crate) name: String,
    /// How long it lives without a keep-alive.
    pub(crate) ttl: Duration,
    /// When it expires unless kept alive.
    pub(crate) expires: Timestamp,
    /// The resources that vanish with it.
    pub(crate) provides: BTreeSet<String>,
    /// Its leases.
    pub(crate) leases: BTreeSet<LeaseId>,
    /// Its queued acquires.
    pub(crate) waiters: BTreeSet<WaiterId>,
    /// The resources of which it has consumed something that returns at its task's end.
    pub(crate) consumed: BTreeSet<String>,
}

/// A session as others see it.
#[derive(Debug, Clone, PartialEq)]
pub struct SessionView {
    /// Its id.
    pub id: SessionId,
    /// The client's name.
    pub name: String,
    /// How long it lives without a keep-alive.
    pub ttl: Duration,
    /// When it expires unless kept alive.
    pub expires: Timestamp,
    /// Its live leases.
    pub leases: Vec<LeaseId>,
    /// Ids of the resources that it provides, in order.
    pub provides: Vec<String>,
}

/// By id.
pub(crate) type Sessions = BTreeMap<SessionId, Session>;

impl Session {
    pub(crate) fn new(name: String, ttl: Duration, expires: Timestamp) -> Session {
        Session {
            name,
            ttl,
            expires,
            provides: BTreeSet::new(),
            leases: BTreeSet::new(),
            waiters: BTreeSet::new(),
            consumed: BTreeSet::new(),
        }
    }

    pub(crate) fn view(&self, id: &SessionId) -> SessionView {
        SessionView {
            id: id.clone(),
            name: self.name.clone(),
            ttl: self.ttl,
            expires: self.expires,
            leases: self.leases.iter().copied().collect(),
            provides: self.provides.iter().cloned().collect(),
        }
    }
}
