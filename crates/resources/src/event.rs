//! Outputs of the pool besides direct answers: answers to waiting requests, and the events for watches.

use crate::id::{SessionId, WaiterId};
use crate::resource::ResourceView;
use ratn_model::id::{FencingToken, LeaseId, Revision};
use ratn_model::resource::Lease;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::sync::Arc;

/// Something that happened while a request was handled or time went on.
#[derive(Debug, Clone, PartialEq)]
pub enum Notice {
    /// An acquire is granted, at once or after waiting.
    Granted {
        /// Which acquire.
        waiter: WaiterId,
        /// What it got.
        lease: Lease,
    },
    /// An acquire will not be granted.
    Refused {
        /// Which acquire.
        waiter: WaiterId,
        /// Why.
        refusal: Refusal,
    },
    /// A change that watchers see.
    Event(Arc<WatchEvent>),
}

/// Why a waiter left the queue without a lease.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Refusal {
    /// Its deadline has passed; what it waited for until then.
    Deadline {
        /// In the words of [`crate::Explanation`].
        waited_for: String,
    },
    /// Its client withdrew it.
    Cancelled,
    /// Its session has ended.
    SessionEnded,
}

/// A change of the pool.
#[derive(Debug, Clone, PartialEq)]
pub struct WatchEvent {
    /// The pool's revision with this change; grows by one per event.
    pub revision: Revision,
    /// What changed.
    pub change: Change,
}

/// What changed.
#[derive(Debug, Clone, PartialEq)]
pub enum Change {
    /// A resource is there.
    ResourceCreated(ResourceView),
    /// A resource has other attributes or another capacity.
    ResourceUpdated(ResourceView),
    /// A resource is gone.
    ResourceDeleted {
        /// As it was before.
        resource: ResourceView,
        /// Why.
        reason: EndReason,
    },
    /// A resource vanished while somebody held it, and the rest of the lease stayed. Only records of earlier versions tell of that: a lease
    /// ends before a resource of it is deleted.
    ResourceLost {
        /// The holder's lease.
        lease: LeaseId,
        /// Its token.
        token: FencingToken,
        /// The holder.
        session: SessionId,
        /// What it lost, as it was before.
        resource: ResourceView,
    },
    /// A lease began.
    LeaseGranted {
        /// Its id.
        lease: LeaseId,
        /// Its token.
        token: FencingToken,
        /// Whose.
        session: SessionId,
        /// Its resources, as they are with it.
        resources: Vec<ResourceView>,
    },
    /// A lease ended. What it held is free, but for the units of resources whose providers have to confirm standstill.
    LeaseEnded {
        /// Its id.
        lease: LeaseId,
        /// Its token.
        token: FencingToken,
        /// Whose it was.
        session: SessionId,
        /// The resources that it held until now, as they are without it.
        resources: Vec<ResourceView>,
        /// Why.
        reason: EndReason,
    },
    /// Units that a lease had left when it ended are free: nothing moves for it any more.
    UnitsFreed {
        /// The lease that has ended.
        lease: LeaseId,
        /// Its token.
        token: FencingToken,
        /// The resource, as it is now.
        resource: ResourceView,
        /// The provider has confirmed standstill; else the bound has passed.
        confirmed: bool,
    },
}

impl Change {
    /// The resources that it tells of.
    pub fn resources(&self) -> &[ResourceView] {
        match self {
            Change::ResourceCreated(resource)
            | Change::ResourceUpdated(resource)
            | Change::ResourceDeleted { resource, .. }
            | Change::ResourceLost { resource, .. }
            | Change::UnitsFreed { resource, .. } => std::slice::from_ref(resource),
            Change::LeaseGranted { resources, .. } | Change::LeaseEnded { resources, .. } => resources,
        }
    }
}

/// Why a lease or a resource ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum EndReason {
    /// Its holder released it, its owner deleted it.
    Asked,
    /// Its session's keep-alive stopped.
    SessionExpired,
    /// Its session was closed.
    SessionClosed,
    /// The lease's own time is over.
    HeldTooLong,
    /// All of it was deleted or consumed for good.
    UsedUp,
    /// Nobody heard of the grant: as if it had not been made.
    Undelivered,
    /// Somebody else than its holder ended it.
    Revoked,
    /// A provider offers its own resource under the id that a task had given to one.
    Displaced,
    /// A resource that the lease held is gone. Grants are all or nothing, so no lease lives on with the rest.
    ResourceGone,
}

impl EndReason {
    /// Whether the holder itself has ended the lease, or never had it: it says by that that nothing is to move for it any more.
    pub(crate) fn is_the_holders(self) -> bool {
        matches!(self, EndReason::Asked | EndReason::Undelivered)
    }
}

impl fmt::Display for EndReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            EndReason::Asked => "asked",
            EndReason::SessionExpired => "session expired",
            EndReason::SessionClosed => "session closed",
            EndReason::HeldTooLong => "held too long",
            EndReason::UsedUp => "used up",
            EndReason::Undelivered => "undelivered",
            EndReason::Revoked => "revoked",
            EndReason::Displaced => "displaced by a provider's resource of its id",
            EndReason::ResourceGone => "a resource of it is gone",
        })
    }
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Refusal::Deadline { waited_for } => write!(f, "deadline passed while waiting for {waited_for}"),
            Refusal::Cancelled => f.write_str("cancelled"),
            Refusal::SessionEnded => f.write_str("its session has ended"),
        }
    }
}
