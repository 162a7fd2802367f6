//! The world pool's errors as gRPC statuses.

use super::core::{CommitError, ProjectError, QueryError};
use crate::details::{retry_later, status};
use ratn_model::id::LeaseId;
use std::time::Duration;
use tonic::{Code, Status};

/// When to try again after a bound was reached.
const RETRY_DELAY: Duration = Duration::from_millis(200);

pub(super) fn of_commit(error: &CommitError) -> Status {
    let reason = match error {
        CommitError::Revision { .. } => "WRONG_REVISION",
        CommitError::Change(_) => "CHANGE_DOES_NOT_APPLY",
    };
    status(Code::FailedPrecondition, reason, error.to_string())
}

pub(super) fn of_project(error: &ProjectError) -> Status {
    let (code, reason) = match error {
        ProjectError::Future { .. } => (Code::FailedPrecondition, "NO_SUCH_REVISION"),
        ProjectError::Forgotten { .. } => (Code::OutOfRange, "REVISION_FORGOTTEN"),
        ProjectError::Change(_) => (Code::FailedPrecondition, "CHANGE_DOES_NOT_APPLY"),
        ProjectError::Ended { .. } => (Code::FailedPrecondition, "PROJECTION_ENDED"),
        ProjectError::TooMany { .. } => {
            return retry_later(Code::ResourceExhausted, "TOO_MANY", error.to_string(), RETRY_DELAY);
        }
    };
    status(code, reason, error.to_string())
}

pub(super) fn of_query(error: &QueryError) -> Status {
    match error {
        QueryError::Unknown { .. } => status(Code::NotFound, "PROJECTION_UNKNOWN", error.to_string()),
        QueryError::Hidden { .. } => status(Code::PermissionDenied, "NOT_AMONG_READS", error.to_string()),
    }
}

pub(super) fn lease_ended(lease: LeaseId) -> Status {
    let message = format!("{lease} has ended: acquire a new one and project under that");
    status(Code::FailedPrecondition, "LEASE_ENDED", message)
}
