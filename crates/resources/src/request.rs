//! Mutations as values, so that each can carry a request id: the same id twice is performed once.

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
        /// With which it vanishes.
        session: Option<SessionId>,
        /// What.
        spec: ResourceSpec,
    },
    /// See [`crate::Pool::delete`].
    Delete {
        /// Who asks; `None` may delete anything.
        session: Option<SessionId>,
        /// Which.
        id: String,
    },
    /// See [`crate::Pool::delete_units`].
    DeleteUnits {
        /// Who asks.
        session: SessionId,
        /// What.
        requirement: Requirement,
    },
    /// See [`crate::Pool::consume`] and [`crate::Pool::consume_of`].
    Consume {
        /// Who asks.
        session: SessionId,
        /// What.
        requirement: Requirement,
        /// Of this resource alone.
        resource: Option<String>,
    },
    /// See [`crate::Pool::acquire`].
    Acquire(AcquireRequest),
    /// See [`crate::Pool::release`].
    Release {
        /// Who asks; `None` may release anything.
        session: Option<SessionId>,
        /// Which.
        lease: LeaseId,
    },
    /// See [`crate::Pool::end_task`].
    EndTask {
        /// Whose.
        session: SessionId,
    },
    /// See [`crate::Pool::confirm_standstill`].
    ConfirmStandstill {
        /// Whose resource it is; `None` may confirm for any provider.
        session: Option<SessionId>,
        /// The lease that has ended.
        lease: LeaseId,
        /// The resource's id.
        resource: String,
    },
}

impl Request {
    /// The session that it is made for; without one it is an operator's.
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
    /// To a create: the resource's id, and the pool's revision with it. It may have changed or gone since, where the
    /// request is a repeated one.
    Created {
        /// Its id.
        id: String,
        /// The revision.
        revision: Revision,
    },
    /// To an acquire: it is in the queue; a [`crate::Notice`] will tell how it ends.
    Queued(WaiterId),
    /// To an acquire repeated after it was granted.
    Granted(Lease),
    /// To a consume or a delete of units: what of which resources.
    Operated(Vec<OperatedUnits>),
    /// To a confirmation of standstill: the resource, if units of it became free by it. To a consume or a delete of units that an earlier version
    /// performed: the ids of the resources.
    Touched(Vec<String>),
    /// To the end of a task with much to return: some of it has. The same request once more goes on with it.
    Unfinished,
    /// To the rest.
    Done,
}
