//! Outputs of the pool besides direct answers: answers to waiting requests, and events for watches.

use crate::id::{SessionId, WaiterId};
use crate::resource::ResourceView;
use ratn_model::id::{FencingToken, LeaseId, Revision};
use ratn_model::resource::Lease;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::sync::Arc;

/// Something that happened while a request was handled or time passed.
#[derive(Debug, Clone, PartialEq)]
pub enum Notice {
    /// An acquire is granted, immediately or after waiting.
    Granted {
        /// The acquire.
        waiter: WaiterId,
        /// The lease that it gets.
        lease: Lease,
    },
    /// An acquire will not be granted.
    Refused {
        /// The acquire.
        waiter: WaiterId,
        /// The reason.
        refusal: Refusal,
    },
    /// A change for watchers.
    Event(Arc<WatchEvent>),
}

/// Why a waiter left the queue without a lease.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Refusal {
    /// Its deadline has passed.
    Deadline {
        /// What it waited for, in the words of [`crate::Explanation`].
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
    /// The pool's revision after this change; each event increases it by one.
    pub revision: Revision,
    /// What changed.
    pub change: Change,
}

/// What changed.
#[derive(Debug, Clone, PartialEq)]
pub enum Change {
    /// A resource was created.
    ResourceCreated(ResourceView),
    /// The attributes or the capacity of a resource changed.
    ResourceUpdated(ResourceView),
    /// A resource was deleted.
    ResourceDeleted {
        /// The resource as it was before.
        resource: ResourceView,
        /// The reason.
        reason: EndReason,
    },
    /// A resource without a bound for standstill was deleted while a lease held it; the lease keeps its other resources.
    ResourceLost {
        /// The holder's lease.
        lease: LeaseId,
        /// The token of the lease.
        token: FencingToken,
        /// The holder.
        session: SessionId,
        /// The lost resource, as it was before.
        resource: ResourceView,
    },
    /// A lease was granted.
    LeaseGranted {
        /// The id of the lease.
        lease: LeaseId,
        /// The token of the lease.
        token: FencingToken,
        /// The holder.
        session: SessionId,
        /// Its resources, as they are after the grant.
        resources: Vec<ResourceView>,
    },
    /// A lease ended. What it held is free, except units of resources whose providers have to confirm standstill.
    LeaseEnded {
        /// The id of the lease.
        lease: LeaseId,
        /// The token of the lease.
        token: FencingToken,
        /// The holder.
        session: SessionId,
        /// The resources that it held, as they are without the lease.
        resources: Vec<ResourceView>,
        /// The reason.
        reason: EndReason,
    },
    /// Units that an ended lease had left are free: nothing moves for it any more.
    UnitsFreed {
        /// The ended lease.
        lease: LeaseId,
        /// The token of the lease.
        token: FencingToken,
        /// The resource, as it is now.
        resource: ResourceView,
        /// True if the provider has confirmed standstill; false if the bound has passed.
        confirmed: bool,
    },
}

impl Change {
    /// The resources in this change.
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
    /// The holder released the lease and knows that nothing moves for it any more, or the owner deleted the resource.
    Asked,
    /// The keep-alives of its session stopped.
    SessionExpired,
    /// Its session was closed.
    SessionClosed,
    /// The maximum holding time of the lease has passed.
    HeldTooLong,
    /// All of it was deleted or permanently consumed.
    UsedUp,
    /// The grant could not be delivered: as if it had not been made.
    Undelivered,
    /// Somebody other than the holder ended it.
    Revoked,
    /// A provider offers its own resource under the id that a task had given to one.
    Displaced,
    /// A resource that the lease held is gone. Grants are all or nothing, so no lease lives on with the rest.
    ResourceGone,
    /// The holder released the lease and does not know whether something still moves for it.
    GivenUp,
}

impl EndReason {
    /// Whether the holder itself ended the lease and knows that nothing moves for it any more, or never had it.
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
            EndReason::GivenUp => "given back while something may still move",
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
