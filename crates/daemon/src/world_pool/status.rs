//! The world pool's errors as gRPC statuses.

use super::core::{MadeByAnother, ProjectError, QueryError};
use super::history::{CommitError, RevisionError};
use super::parked;
use super::query::TooMuch;
use crate::access::Caller;
use crate::details::{retry_later, status, status_about};
use ratn_model::id::LeaseId;
use std::time::Duration;
use tonic::{Code, Status};

/// Retry delay after a limit was reached.
const RETRY_DELAY: Duration = Duration::from_millis(200);

pub(super) fn of_commit(error: &CommitError) -> Status {
    let (code, reason) = match error {
        CommitError::Revision { .. } => (Code::FailedPrecondition, "WRONG_REVISION"),
        CommitError::Change(_) => (Code::FailedPrecondition, "CHANGE_DOES_NOT_APPLY"),
        CommitError::Reused(_) => (Code::InvalidArgument, "REQUEST_ID_REUSED"),
        CommitError::Evidence { .. } => (Code::InvalidArgument, "NOT_WRITTEN"),
        CommitError::Violation(_) => (Code::FailedPrecondition, "OUTSIDE_THE_ONTOLOGY"),
        CommitError::TooManyLooks(_) => (Code::InvalidArgument, "TOO_MANY_LOOKS"),
    };
    status(code, reason, error.to_string())
}

/// Details for programs: `oldest_revision` and `newest_revision` that are kept.
pub(super) fn of_revision(error: RevisionError) -> Status {
    match error {
        RevisionError::Future { .. } => status(Code::FailedPrecondition, "NO_SUCH_REVISION", error.to_string()),
        RevisionError::Forgotten { oldest, root, .. } => {
            let kept = [("oldest_revision", oldest), ("newest_revision", root)];
            let kept = kept.map(|(name, revision)| (name, revision.to_string()));
            status_about(Code::OutOfRange, "REVISION_FORGOTTEN", error.to_string(), kept)
        }
    }
}

pub(super) fn of_project(error: &ProjectError) -> Status {
    let (code, reason) = match error {
        ProjectError::Revision(error) => return of_revision(*error),
        ProjectError::Reused(_) => (Code::InvalidArgument, "REQUEST_ID_REUSED"),
        ProjectError::Change(_) => (Code::FailedPrecondition, "CHANGE_DOES_NOT_APPLY"),
        ProjectError::TooManyLooks(_) => (Code::InvalidArgument, "TOO_MANY_LOOKS"),
        ProjectError::Ended { .. } => (Code::FailedPrecondition, "PROJECTION_ENDED"),
        ProjectError::NotPromised { .. } => (Code::FailedPrecondition, "NOT_PROMISED"),
        ProjectError::NoSuchCommit { .. } => (Code::FailedPrecondition, "NO_SUCH_COMMIT"),
        ProjectError::Quota { .. } | ProjectError::QuotaOfBytes { .. } => {
            return retry_later(Code::ResourceExhausted, "QUOTA", error.to_string(), RETRY_DELAY);
        }
        ProjectError::TooMany { .. }
        | ProjectError::KeptForOperators { .. }
        | ProjectError::TooManyBytes { .. }
        | ProjectError::BytesKeptForOperators { .. } => {
            return retry_later(Code::ResourceExhausted, "TOO_MANY", error.to_string(), RETRY_DELAY);
        }
    };
    status(code, reason, error.to_string())
}

pub(super) fn of_query(error: &QueryError) -> Status {
    match error {
        QueryError::Scene(_) => status(Code::FailedPrecondition, "NO_SCENE", error.to_string()),
        QueryError::Unknown { .. } => status(Code::NotFound, "PROJECTION_UNKNOWN", error.to_string()),
        QueryError::NotYet { .. } => retry_later(Code::Unavailable, "NOT_YET", error.to_string(), Duration::ZERO),
        QueryError::Revision(error) => of_revision(*error),
        QueryError::Hidden { .. } => status(Code::PermissionDenied, "NOT_AMONG_READS", error.to_string()),
    }
}

pub(super) fn of_too_much(error: &TooMuch) -> Status {
    status(Code::ResourceExhausted, "QUERY_TOO_LARGE", error.to_string())
}

/// The call would have to wait for a projection or commit, and too many calls wait already.
pub(super) fn too_many_wait() -> Status {
    let message = format!(
        "{} calls, or {} of one caller, wait for projections and commits that are on their way: ask again later",
        parked::MOST,
        parked::MOST_OF_ONE
    );
    // Reported like a daemon that is unavailable for a moment: the projection or commit may exist by the time of the retry.
    retry_later(Code::Unavailable, "TOO_MANY_WAIT", message, parked::PATIENCE)
}

pub(super) fn lease_ended(lease: LeaseId) -> Status {
    let message = format!("{lease} has ended: acquire a new one and project under that");
    status(Code::FailedPrecondition, "LEASE_ENDED", message)
}

/// An unknown lease looks like one that the resource manager has just given, so the client should retry.
pub(super) fn lease_not_known(lease: LeaseId) -> Status {
    let message = format!(
        "{lease} is not known to the world pool: it was never given, or holds nothing, or the resource manager has not told of it yet; ask \
         again, or project without a lease"
    );
    retry_later(Code::Unavailable, "LEASE_NOT_KNOWN", message, RETRY_DELAY)
}

pub(super) fn lease_of_another(lease: LeaseId, opened_by: &str, caller: &Caller) -> Status {
    let message = format!(
        "{lease} is of a session of `{opened_by}`, and the projection is asked for by `{caller}`: acquire a lease of your own; only agents \
         and operators project under the leases of others"
    );
    status(Code::PermissionDenied, "NOT_YOURS", message)
}

pub(super) fn of_release(error: &MadeByAnother) -> Status {
    status(Code::PermissionDenied, "NOT_YOURS", error.to_string())
}
