//! Statuses with `google.rpc` details: a machine-readable reason, and when to try again.

pub(crate) use ratn_worker::gate::ending;
use std::time::Duration;
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt};

/// The domain of every reason.
const DOMAIN: &str = "ratn";

/// A status with a reason code for programs and a sentence for people.
pub(crate) fn status(code: Code, reason: &str, message: impl Into<String>) -> Status {
    let details = ErrorDetails::with_error_info(reason, DOMAIN, []);
    Status::with_error_details(code, message, details)
}

/// As `status`, with details for programs, by name.
pub(crate) fn status_about<const N: usize>(
    code: Code,
    reason: &str,
    message: impl Into<String>,
    about: [(&str, String); N],
) -> Status {
    let details = ErrorDetails::with_error_info(reason, DOMAIN, about.map(|(name, value)| (name.to_owned(), value)));
    Status::with_error_details(code, message, details)
}

/// A status of a call that may succeed when it is retried after a while.
pub(crate) fn retry_later(code: Code, reason: &str, message: impl Into<String>, after: Duration) -> Status {
    let mut details = ErrorDetails::with_error_info(reason, DOMAIN, []);
    details.set_retry_info(Some(after));
    Status::with_error_details(code, message, details)
}

/// The state can no longer be written. The message says what to do; a retry helps after that.
pub(crate) fn of_fault(fault: &dyn std::error::Error) -> Status {
    let mut message = fault.to_string();
    if let Some(source) = fault.source() {
        message = format!("{message} ({source})");
    }
    status(Code::Unavailable, "STORAGE_FAILED", message)
}

/// The reason code for programs; where there is none, the gRPC code.
pub(crate) fn reason(status: &Status) -> String {
    let details = status.get_error_details();
    let said = details.error_info().map(|info| info.reason.clone());
    said.unwrap_or_else(|| crate::metrics::name_of(status.code()).to_owned())
}
