//! Why the pool refuses a request.

use crate::id::{SessionId, WaiterId};
use ratn_model::id::LeaseId;
use ratn_model::resource::Quantity;
use std::sync::Arc;

/// A refused request; the pool is unchanged.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PoolError {
    /// The session was never opened, has expired or was closed.
    #[error("{session} is unknown or has expired: send a keep-alive to open it anew")]
    UnknownSession {
        /// The session.
        session: SessionId,
    },
    /// The session has ended, but not everything that belongs to it has been removed.
    #[error("{session} is ending: try again in a moment")]
    SessionEnding {
        /// The session.
        session: SessionId,
    },
    /// There is no such lease, or it has ended.
    #[error("{lease} is unknown or has ended")]
    UnknownLease {
        /// The lease.
        lease: LeaseId,
    },
    /// There is no such waiter, or it has been answered.
    #[error("{waiter} is not in the queue")]
    UnknownWaiter {
        /// The waiter.
        waiter: WaiterId,
    },
    /// There is no such resource.
    #[error("there is no resource `{id}`")]
    UnknownResource {
        /// The id of the resource.
        id: String,
    },
    /// A resource with that id exists and belongs to another session.
    #[error("resource `{id}` exists already and belongs to {owner}")]
    ResourceTaken {
        /// The id of the resource.
        id: String,
        /// The owner: a session, or nobody.
        owner: String,
    },
    /// The lease or session does not belong to the caller.
    #[error("{what} belongs to {owner}, not to {caller}")]
    NotYours {
        /// The lease or session.
        what: String,
        /// The owner.
        owner: SessionId,
        /// The caller's session.
        caller: SessionId,
    },
    /// The caller uses a session that another caller opened.
    #[error("session `{}` belongs to {}, not to {speaker}", session.as_str(), owner_of(opened_by))]
    SessionOfAnother {
        /// The session.
        session: SessionId,
        /// The caller who opened it; empty if unknown.
        opened_by: Arc<str>,
        /// The caller.
        speaker: Arc<str>,
    },
    /// The caller uses the id of an ended session, which is kept for the caller who opened it.
    #[error(
        "session `{}` has ended, and its id is kept for {opened_by}, who opened it: {speaker} has to open a session with another id",
        session.as_str()
    )]
    SessionIdKept {
        /// The session.
        session: SessionId,
        /// The caller for whom the id is kept.
        opened_by: Arc<str>,
        /// The caller.
        speaker: Arc<str>,
    },
    /// Fewer resources match than the operation needs.
    #[error("{wanted} wanted, but {found} units of it are free")]
    NotEnough {
        /// What was requested.
        wanted: String,
        /// How much is free.
        found: Quantity,
    },
    /// A request that no pool could perform.
    #[error("{what}: {rule}")]
    Malformed {
        /// The wrong part of the request.
        what: String,
        /// The rule that it violates.
        rule: String,
    },
    /// A limit of [`crate::Limits`] is reached.
    #[error("{what} of {whose}: the limit of {limit} is reached (limits.{key}): try again later")]
    TooMany {
        /// What is limited.
        what: &'static str,
        /// The callers to whom the limit applies together.
        whose: &'static str,
        /// The name of the limit in [`crate::Limits`].
        key: &'static str,
        /// The value of the limit.
        limit: usize,
    },
    /// The quota of one caller is reached.
    #[error("{what} of {whose}: the quota of {limit} is reached (limits.{quota}): end some first")]
    Quota {
        /// What is limited.
        what: &'static str,
        /// The caller.
        whose: Arc<str>,
        /// The name of the quota in [`crate::Limits`].
        quota: &'static str,
        /// The value of the quota.
        limit: usize,
    },
    /// The request id of an acquire was withdrawn before the acquire arrived.
    #[error("request id `{id}` was withdrawn before its acquire arrived: to acquire anew, ask with another one")]
    Withdrawn {
        /// The request id.
        id: String,
    },
    /// The request id was used for another request before.
    #[error("request id `{id}` was used for another request before")]
    RequestIdReused {
        /// The request id.
        id: String,
    },
    /// The request was performed in an earlier session with this id, and only a part of its effect ended with that session.
    #[error(
        "request id `{id}` was done in an earlier session of this id, and only a part of it ended with that session: ask with another request \
         id for what is missing"
    )]
    DoneInPart {
        /// The request id.
        id: String,
    },
}

fn owner_of(opened_by: &str) -> &str {
    if opened_by.is_empty() {
        "whom an earlier version did not write down (only an operator may speak for it)"
    } else {
        opened_by
    }
}

/// The limit applies to all callers together.
pub(crate) const ALL: &str = "all callers";
/// The limit applies to all callers except operators.
pub(crate) const ALL_BUT_OPERATORS: &str = "all who are no operators";

pub(crate) fn check_owner(
    what: impl FnOnce() -> String,
    owner: &SessionId,
    caller: &SessionId,
) -> Result<(), PoolError> {
    if owner == caller {
        return Ok(());
    }
    Err(PoolError::NotYours { what: what(), owner: owner.clone(), caller: caller.clone() })
}

pub(crate) fn malformed(what: &str, rule: &str) -> PoolError {
    PoolError::Malformed { what: what.to_owned(), rule: rule.to_owned() }
}
