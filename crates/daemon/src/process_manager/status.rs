//! The pools' errors as gRPC statuses.

use super::pools::PoolError;
use crate::details::status;
use tonic::{Code, Status};

pub(super) fn of_error(error: &PoolError) -> Status {
    let (code, reason) = match error {
        PoolError::UnknownTemplate { .. } => (Code::NotFound, "TEMPLATE_UNKNOWN"),
        PoolError::UnknownWorker { .. } => (Code::NotFound, "WORKER_UNKNOWN"),
        PoolError::TooMany { .. } => (Code::ResourceExhausted, "TOO_MANY"),
        PoolError::Size { .. } => (Code::OutOfRange, "BEYOND_CONFIG"),
        PoolError::Drained { .. } => (Code::FailedPrecondition, "DRAINED"),
        PoolError::Ending => return crate::details::ending(),
    };
    status(code, reason, error.to_string())
}
