//! How a call fails: the server refused it, or the connection broke.

use super::{PAUSE, chain};
use crate::action::{MANAGER_UNHEARD, NOT_AT_REST, TOO_MANY_WAITING};
use crate::endpoint::Endpoint;
use ratn_proto::convert::Malformed;
use std::error::Error;
use std::time::Duration;
use tonic::{Code, Status};
use tonic_types::StatusExt;

/// Minimum delay before a server that asks the client to retry is asked again, and
const SOONEST: Duration = Duration::from_millis(10);
/// the maximum delay.
const LATEST: Duration = Duration::from_secs(5);

/// How an error message of prost begins.
const NO_MESSAGE: &str = "failed to decode Protobuf message";

/// Why a call failed.
#[derive(Debug, Clone, thiserror::Error)]
pub enum CallError {
    /// Nobody answered: the process died, the connection broke, or nothing listens there.
    #[error("{endpoint} does not answer: {reason}")]
    Broken {
        /// The server.
        endpoint: Endpoint,
        /// The reason, as far as it is known.
        reason: String,
    },
    /// The server refused.
    #[error("{message}")]
    Refused {
        /// The server.
        endpoint: Endpoint,
        /// The gRPC status code.
        code: Code,
        /// The reason of its `google.rpc.ErrorInfo`, `NOT_AT_REST`; empty where the server gave none.
        reason: String,
        /// The server's message.
        message: String,
        /// If the server refused because of load: the delay after which the call may be made again, from its `google.rpc.RetryInfo`.
        retry_after: Option<Duration>,
    },
    /// The answer cannot be read.
    #[error("{endpoint} answered nonsense")]
    Malformed {
        /// The server.
        endpoint: Endpoint,
        /// What is wrong with the answer.
        #[source]
        source: Malformed,
    },
}

impl CallError {
    /// Whether the call was not answered: a crash or a broken connection, not a refusal.
    pub fn is_crash(&self) -> bool {
        !matches!(self, CallError::Refused { .. })
    }

    /// Whether the answer cannot be read: it is not a message, too long, or has no meaning. A retry would give the same.
    pub fn is_unreadable(&self) -> bool {
        match self {
            CallError::Malformed { .. } => true,
            CallError::Refused { code, .. } => *code == Code::OutOfRange,
            CallError::Broken { reason, .. } => reason.starts_with(NO_MESSAGE),
        }
    }

    /// The gRPC status code of a refusal; `None` for other errors.
    pub fn code(&self) -> Option<Code> {
        match self {
            CallError::Refused { code, .. } => Some(*code),
            _ => None,
        }
    }

    /// The reason of a refusal, as the servers name it; empty for other errors.
    pub fn reason(&self) -> &str {
        match self {
            CallError::Refused { reason, .. } => reason,
            _ => "",
        }
    }

    /// The delay after which the call may be made again: if it was not answered, or if the server refused it because of load
    /// (RESOURCE_EXHAUSTED with a retry delay). `None` for every other refusal, and for an answer that cannot be read.
    pub fn again_after(&self) -> Option<Duration> {
        match self {
            CallError::Refused { retry_after, .. } => *retry_after,
            CallError::Malformed { .. } => None,
            _ => Some(PAUSE),
        }
    }

    /// The error for a status that `endpoint` answered (or that stands for its silence).
    pub fn from_status(endpoint: &Endpoint, status: &Status) -> CallError {
        let endpoint = endpoint.clone();
        let refused = match status.code() {
            // A refusal: the provider begins nothing for now.
            Code::Unavailable if begins_nothing_yet(status) => true,
            // Servers of this system do not refuse with any of these codes: they come from the connection.
            Code::Unavailable | Code::Unknown | Code::Internal | Code::Cancelled | Code::DataLoss => false,
            // A status with a source was made on this side.
            _ => status.source().is_none(),
        };
        if refused {
            let reason = status.get_details_error_info().map(|info| info.reason).unwrap_or_default();
            let (code, message) = (status.code(), status.message().to_owned());
            let is_load = code == Code::ResourceExhausted;
            let retry_after = is_load.then(|| status.get_details_retry_info()?.retry_delay).flatten();
            let retry_after = retry_after.map(|after| after.clamp(SOONEST, LATEST));
            return CallError::Refused { endpoint, code, reason, message, retry_after };
        }
        let reason = match status.source() {
            Some(source) => chain(source),
            None => format!("{} ({:?})", status.message(), status.code()),
        };
        let reason = format!("{reason}{}", about_tls(&endpoint, &reason));
        CallError::Broken { endpoint, reason }
    }

    /// Whether a provider refused a goal temporarily, because it does not hear the resource manager, which confirms leases, or because too
    /// many goals wait. The provider has begun nothing, and the goal may be given again.
    pub fn is_unconfirmed(&self) -> bool {
        self.code() == Some(Code::Unavailable)
    }

    pub(crate) fn malformed(endpoint: &Endpoint, source: Malformed) -> CallError {
        CallError::Malformed { endpoint: endpoint.clone(), source }
    }
}

fn begins_nothing_yet(status: &Status) -> bool {
    let reason = status.get_details_error_info().map(|info| info.reason);
    reason.is_some_and(|reason| [MANAGER_UNHEARD, NOT_AT_REST, TOO_MANY_WAITING].contains(&reason.as_str()))
}

/// Advice for a connection that failed because of TLS, as far as the error (of rustls or h2) tells the cause.
fn about_tls(endpoint: &Endpoint, reason: &str) -> &'static str {
    match endpoint {
        Endpoint::Tls { .. } if reason.contains("UnknownIssuer") => {
            "; who serves there has a certificate of an authority that is not trusted here: RATN_TLS_CA names its file"
        }
        Endpoint::Tls { .. } if reason.contains("CertificateRequired") || reason.contains("DecryptError") => {
            "; who connects has to show a certificate of the system's authority: RATN_TLS_CERT and RATN_TLS_KEY name its files"
        }
        Endpoint::Tcp { .. } if reason.contains("frame with invalid size") => {
            "; it seems to serve with TLS: then its address begins with https://"
        }
        _ => "",
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    #[test]
    fn what_cannot_be_decoded_or_is_too_long_is_unreadable_and_silence_is_not() {
        let endpoint = "http://a:1".parse().unwrap();
        let is_unreadable = |status: Status| CallError::from_status(&endpoint, &status).is_unreadable();
        assert!(is_unreadable(Status::internal("failed to decode Protobuf message: invalid varint")));
        assert!(is_unreadable(Status::out_of_range("Error, decoded message length too large")));
        assert!(!is_unreadable(Status::internal("no")) && !is_unreadable(Status::unavailable("nobody")));
    }

    #[test]
    fn an_error_of_tls_says_which_file_is_missing() {
        let said = |endpoint: &str, message: &str| {
            CallError::from_status(&endpoint.parse().unwrap(), &Status::unavailable(message)).to_string()
        };
        assert!(said("https://a:1", "invalid peer certificate: UnknownIssuer").contains("RATN_TLS_CA names"));
        assert!(said("https://a:1", "received fatal alert: CertificateRequired").contains("RATN_TLS_CERT"));
        assert!(said("http://a:1", "frame with invalid size").contains("https://"));
        assert!(!said("http://a:1", "connection refused").contains("TLS"));
    }
}
