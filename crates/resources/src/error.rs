//! Why the pool does not do what a request asks.

use crate::id::{SessionId, WaiterId};
use ratn_model::id::LeaseId;
use ratn_model::resource::Quantity;
use std::sync::Arc;

/// A refused request; the pool is as it was before.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PoolError {
    /// The session was never opened, has expired or was closed.
    #[error("{session} is unknown or has expired: send a keep-alive to open it anew")]
    UnknownSession {
        /// Which.
        session: SessionId,
    },
    /// The session has ended, and not everything that hung on it is gone yet.
    #[error("{session} is ending: try again in a moment")]
    SessionEnding {
        /// Which.
        session: SessionId,
    },
    /// No such lease, or it has ended.
    #[error("{lease} is unknown or has ended")]
    UnknownLease {
        /// Which.
        lease: LeaseId,
    },
    /// No such waiter, or it has been answered.
    #[error("{waiter} is not in the queue")]
    UnknownWaiter {
        /// Which.
        waiter: WaiterId,
    },
    /// No such resource.
    #[error("there is no resource `{id}`")]
    UnknownResource {
        /// Which.
        id: String,
    },
    /// A resource of that id is there and belongs to another session.
    #[error("resource `{id}` exists already and belongs to {owner}")]
    ResourceTaken {
        /// Which.
        id: String,
        /// Whose: a session, or nobody's.
        owner: String,
    },
    /// The lease or session is not the caller's.
    #[error("{what} belongs to {owner}, not to {caller}")]
    NotYours {
        /// What.
        what: String,
        /// Whose it is.
        owner: SessionId,
        /// Who asked.
        caller: SessionId,
    },
    /// Somebody speaks for a session that another opened.
    #[error("session `{}` belongs to {}, not to {speaker}", session.as_str(), owner_of(opened_by))]
    SessionOfAnother {
        /// Which.
        session: SessionId,
        /// Who opened it; empty where nobody knows.
        opened_by: Arc<str>,
        /// Who spoke.
        speaker: Arc<str>,
    },
    /// Somebody speaks for a session that has ended, whose id is kept for who opened it.
    #[error(
        "session `{}` has ended, and its id is kept for {opened_by}, who opened it: {speaker} has to open a session with another id",
        session.as_str()
    )]
    SessionIdKept {
        /// Which.
        session: SessionId,
        /// For whom.
        opened_by: Arc<str>,
        /// Who spoke.
        speaker: Arc<str>,
    },
    /// Fewer resources match than the operation takes.
    #[error("{wanted} wanted, but {found} units of it are free")]
    NotEnough {
        /// What was asked.
        wanted: String,
        /// How much there is.
        found: Quantity,
    },
    /// A request that no pool could perform.
    #[error("{what}: {rule}")]
    Malformed {
        /// What is wrong, as written.
        what: String,
        /// The rule that it breaks.
        rule: String,
    },
    /// A bound of [`crate::Limits`] is reached.
    #[error("{what} of {whose}: the limit of {limit} is reached (limits.{key}): try again later")]
    TooMany {
        /// Of what.
        what: &'static str,
        /// Of whom together.
        whose: &'static str,
        /// Which, of [`crate::Limits`].
        key: &'static str,
        /// The bound.
        limit: usize,
    },
    /// What one caller may have is reached.
    #[error("{what} of {whose}: the quota of {limit} is reached (limits.{quota}): end some first")]
    Quota {
        /// Of what.
        what: &'static str,
        /// Whose.
        whose: Arc<str>,
        /// Which, of [`crate::Limits`].
        quota: &'static str,
        /// The bound.
        limit: usize,
    },
    /// An acquire whose request id was withdrawn before it arrived.
    #[error("request id `{id}` was withdrawn before its acquire arrived: to acquire anew, ask with another one")]
    Withdrawn {
        /// Which.
        id: String,
    },
    /// A request id that was used for something else before.
    #[error("request id `{id}` was used for another request before")]
    RequestIdReused {
        /// Which.
        id: String,
    },
    /// A request that was done in an earlier session of this id, of which only a part ended with that.
    #[error(
        "request id `{id}` was done in an earlier session of this id, and only a part of it ended with that session: ask with another request \
         id for what is missing"
    )]
    DoneInPart {
        /// Which.
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

/// Whose share a bound in all is.
pub(crate) const ALL: &str = "all callers";
/// Whose share it is without what is kept for operators.
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
