//! The pool's errors as gRPC statuses.

use crate::details::{retry_later, status, status_about};
use ratn_resources::{Compacted, PoolError, Refusal};
use std::time::Duration;
use tonic::{Code, Status};

/// When to retry after a limit was reached.
const RETRY_DELAY: Duration = Duration::from_millis(100);

pub(super) fn of_error(error: &PoolError) -> Status {
    let (code, reason) = match error {
        PoolError::UnknownSession { .. } => (Code::FailedPrecondition, "SESSION_UNKNOWN"),
        PoolError::UnknownLease { .. } => (Code::NotFound, "LEASE_UNKNOWN"),
        PoolError::UnknownWaiter { .. } => (Code::NotFound, "WAITER_UNKNOWN"),
        PoolError::UnknownResource { .. } => (Code::NotFound, "RESOURCE_UNKNOWN"),
        PoolError::ResourceTaken { .. } => (Code::AlreadyExists, "RESOURCE_TAKEN"),
        PoolError::NotYours { .. } | PoolError::SessionOfAnother { .. } | PoolError::SessionIdKept { .. } => {
            (Code::PermissionDenied, "NOT_YOURS")
        }
        PoolError::NotEnough { .. } => (Code::FailedPrecondition, "NOT_ENOUGH"),
        PoolError::Withdrawn { .. } => (Code::Aborted, "WITHDRAWN"),
        PoolError::Malformed { .. } => (Code::InvalidArgument, "MALFORMED"),
        PoolError::RequestIdReused { .. } => (Code::InvalidArgument, "REQUEST_ID_REUSED"),
        PoolError::DoneInPart { .. } => (Code::FailedPrecondition, "DONE_IN_PART"),
        PoolError::SessionEnding { .. } => {
            return retry_later(Code::Unavailable, "SESSION_ENDING", error.to_string(), RETRY_DELAY);
        }
        PoolError::Quota { .. } => {
            return retry_later(Code::ResourceExhausted, "QUOTA", error.to_string(), RETRY_DELAY);
        }
        PoolError::TooMany { .. } => {
            return retry_later(Code::ResourceExhausted, "TOO_MANY", error.to_string(), RETRY_DELAY);
        }
    };
    status(code, reason, error.to_string())
}

/// A caller who is not an operator names no session.
pub(super) fn without_session(who: &str) -> Status {
    status(Code::PermissionDenied, "NOT_YOURS", format!("{who} says no session: only an operator may do that"))
}

pub(super) fn of_refusal(refusal: &Refusal) -> Status {
    let (code, reason) = match refusal {
        Refusal::Deadline { .. } => (Code::DeadlineExceeded, "NOT_GRANTED_IN_TIME"),
        Refusal::Cancelled => (Code::Aborted, "WITHDRAWN"),
        Refusal::SessionEnded => (Code::FailedPrecondition, "SESSION_UNKNOWN"),
    };
    status(code, reason, format!("not granted: {refusal}"))
}

/// Contains `oldest_revision` and `newest_revision` for programs: a watch can continue from revisions between them.
pub(super) fn of_compacted(compacted: &Compacted) -> Status {
    let known = [("oldest_revision", compacted.oldest), ("newest_revision", compacted.newest)];
    let known = known.map(|(name, revision)| (name, revision.0.to_string()));
    status_about(Code::OutOfRange, "COMPACTED", compacted.to_string(), known)
}
