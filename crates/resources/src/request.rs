//! Mutations as values, so that each can carry a request id: a repeated id is performed only once.

use crate::id::{SessionId, WaiterId};
use crate::queue::AcquireRequest;
use crate::resource::ResourceSpec;
use ratn_model::id::{LeaseId, Revision};
use ratn_model::resource::{Lease, OperatedUnits, Requirement};
use serde::{Deserialize, Serialize};

/// A mutation of the pool; each does what the method of the same name on [`crate::Pool`] does.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum Request {
    /// See [`crate::Pool::create`].
    Create {
        /// The session with which the resource vanishes.
        session: Option<SessionId>,
        /// The resource.
        spec: ResourceSpec,
    },
    /// See [`crate::Pool::delete`].
    Delete {
        /// The session that asks; `None` may delete anything.
        session: Option<SessionId>,
        /// The resource's id.
        id: String,
    },
    /// See [`crate::Pool::delete_units`].
    DeleteUnits {
        /// The session that asks.
        session: SessionId,
        /// The resources.
        requirement: Requirement,
    },
    /// See [`crate::Pool::consume`] and [`crate::Pool::consume_of`].
    Consume {
        /// The session that asks.
        session: SessionId,
        /// The amount and kind.
        requirement: Requirement,
        /// Only from this resource, if set.
        resource: Option<String>,
    },
    /// See [`crate::Pool::acquire`].
    Acquire(AcquireRequest),
    /// See [`crate::Pool::release`] and [`crate::Pool::release_moving`].
    Release {
        /// The session that asks; `None` may release anything.
        session: Option<SessionId>,
        /// The lease.
        lease: LeaseId,
        /// The holder knows that nothing moves any more for the lease. False for holders of earlier versions, which do not say it.
        #[serde(default, skip_serializing_if = "std::ops::Not::not")]
        at_rest: bool,
    },
    /// See [`crate::Pool::end_task`].
    EndTask {
        /// The session whose task ends.
        session: SessionId,
    },
    /// See [`crate::Pool::confirm_standstill`].
    ConfirmStandstill {
        /// The session that provides the resource; `None` may confirm for any provider.
        session: Option<SessionId>,
        /// The lease that has ended.
        lease: LeaseId,
        /// The resource's id.
        resource: String,
    },
}

impl Request {
    /// The session for which it is made; without one it is an operator's.
    pub fn session(&self) -> Option<&SessionId> {
        match self {
            Request::Create { session, .. }
            | Request::Delete { session, .. }
            | Request::Release { session, .. }
            | Request::ConfirmStandstill { session, .. } => session.as_ref(),
            Request::DeleteUnits { session, .. } | Request::Consume { session, .. } | Request::EndTask { session } => {
                Some(session)
            }
            Request::Acquire(request) => Some(&request.session),
        }
    }
}

/// The answer to a [`Request`].
#[derive(Debug, Clone, PartialEq)]
pub enum Reply {
    /// To a create: the resource's id, and the pool's revision after it. The resource may have changed or gone since if the request is a repeated one.
    Created {
        /// Its id.
        id: String,
        /// The revision.
        revision: Revision,
    },
    /// To an acquire: it is in the queue; a [`crate::Notice`] will report its end.
    Queued(WaiterId),
    /// To an acquire repeated after it was granted.
    Granted(Lease),
    /// To a consume or a delete of units: the units of each resource.
    Operated(Vec<OperatedUnits>),
    /// To a confirmation of standstill: the resource, if units of it became free. To a consume or a delete of units by an earlier version: the ids of
    /// the resources.
    Touched(Vec<String>),
    /// To the end of a task with much to return: some of it has returned. Repeat the same request to continue.
    Unfinished,
    /// To all other requests.
    Done,
}
