//! Mutations as values, so that each can carry a request id: the same id twice is performed once.

use crate::error::PoolError;
use crate::id::{SessionId, WaiterId};
use crate::queue::AcquireRequest;
use crate::resource::{ResourceSpec, ResourceView};
use ratn_model::id::LeaseId;
use ratn_model::resource::{Lease, Requirement};
use std::collections::{BTreeMap, VecDeque};

/// A mutation of the pool; each does what the method of the same name on [`crate::Pool`] does.
#[derive(Debug, Clone, PartialEq)]
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
    /// See [`crate::Pool::consume`].
    Consume {
        /// Who asks.
        session: SessionId,
        /// What.
        requirement: Requirement,
    },
    /// See [`crate::Pool::operate`].
    Operate {
        /// Who asks.
        session: SessionId,
        /// Creates and deletes.
        operations: Vec<Requirement>,
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
}

/// The answer to a [`Request`].
#[derive(Debug, Clone, PartialEq)]
pub enum Reply {
    /// To a create.
    Created(ResourceView),
    /// To an operate: the ids of the resources created, in order.
    Operated(Vec<String>),
    /// To an acquire: it is in the queue; a [`crate::Notice`] will tell how it ends.
    Queued(WaiterId),
    /// To an acquire repeated after it was granted.
    Granted(Lease),
    /// To a consume or a delete of units: the ids of the resources touched.
    Touched(Vec<String>),
    /// To the rest.
    Done,
}

/// The answers given, by request id; bounded, the oldest forgotten first.
#[derive(Debug, Clone, Default)]
pub(crate) struct RequestMemory {
    answers: BTreeMap<String, (Request, Reply)>,
    order: VecDeque<String>,
}

impl RequestMemory {
    /// The answer given to this request before.
    pub(crate) fn recall(&self, id: &str, request: &Request) -> Result<Option<Reply>, PoolError> {
        match self.answers.get(id) {
            None => Ok(None),
            Some((before, reply)) if *before == identity(request.clone()) => Ok(Some(reply.clone())),
            Some(_) => Err(PoolError::RequestIdReused { id: id.to_owned() }),
        }
    }

    pub(crate) fn reply(&self, id: &str) -> Option<Reply> {
        self.answers.get(id).map(|(_, reply)| reply.clone())
    }

    pub(crate) fn remember(&mut self, id: String, request: Request, reply: Reply, limit: usize) {
        if self.answers.insert(id.clone(), (identity(request), reply)).is_none() {
            self.order.push_back(id);
        }
        while self.order.len() > limit {
            if let Some(oldest) = self.order.pop_front() {
                self.answers.remove(&oldest);
            }
        }
    }

    pub(crate) fn granted(&mut self, id: &str, lease: Lease) {
        if let Some((_, reply)) = self.answers.get_mut(id) {
            *reply = Reply::Granted(lease);
        }
    }

    pub(crate) fn forget(&mut self, id: &str) {
        if !id.is_empty() && self.answers.remove(id).is_some() {
            self.order.retain(|other| other != id);
        }
    }

    pub(crate) fn len(&self) -> usize {
        self.order.len()
    }
}

/// What makes two requests the same one: a repeated acquire has another deadline.
fn identity(mut request: Request) -> Request {
    if let Request::Acquire(acquire) = &mut request {
        acquire.deadline = None;
    }
    request
}
