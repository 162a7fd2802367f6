//! The limits of a server's connections, and the errors for connections beyond them.

use super::origin::Origin;
use std::fmt;
use std::sync::Arc;
use std::time::Duration;
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt};

/// Limits of a server's connections.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ConnectionLimits {
    /// Maximum number of open connections, of all callers together.
    pub connections: usize,
    /// Maximum number of connections accepted per second from one user of this machine, or one host; the burst may be as large as
    /// `connections`.
    pub per_s: u32,
    /// Maximum number of connections with calls under way of one caller.
    pub of_one_caller: usize,
    /// How many of `connections` are never in use by calls of callers that are not operators. They are reserved for operators, and for new
    /// connections.
    pub for_operators: usize,
    /// Maximum time from accepting a connection to its first call, including the TLS handshake.
    pub first_call: Duration,
    /// Maximum time without a call under way.
    pub idle: Duration,
    /// Maximum time in which the client takes nothing of the answers that wait for it, of those that count ([`crate::gate::Gate::unread`]).
    pub unread: Duration,
}

impl Default for ConnectionLimits {
    fn default() -> ConnectionLimits {
        ConnectionLimits {
            connections: 768,
            per_s: 200,
            of_one_caller: 512,
            for_operators: 128,
            first_call: Duration::from_secs(10),
            idle: Duration::from_secs(600),
            unread: Duration::from_secs(300),
        }
    }
}

/// Why a caller gets no further connection.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum OutOfConnections {
    /// All connections have calls under way: the new connection was closed.
    All,
    /// More connections per second came from one user or host than allowed: the new connection was closed.
    TooOften {
        /// The user or host.
        origin: Origin,
        /// How many are allowed.
        per_s: u32,
    },
    /// A caller has calls under way on as many connections as allowed: the call was refused.
    OfOneCaller {
        /// The caller.
        caller: Arc<str>,
        /// How many are allowed.
        most: usize,
    },
    /// All callers that are not operators together have calls under way on as many connections as allowed: the call was refused.
    OfOthers {
        /// How many are allowed.
        most: usize,
    },
}

/// Delay after which a caller with too many connections may try again.
const RETRY_DELAY: Duration = Duration::from_secs(1);

impl OutOfConnections {
    /// The reason code, for programs.
    pub fn reason(&self) -> &'static str {
        match self {
            OutOfConnections::All => "CONNECTIONS",
            OutOfConnections::TooOften { .. } => "QUOTA_CONNECTIONS_PER_S",
            OutOfConnections::OfOneCaller { .. } => "QUOTA_CONNECTIONS",
            OutOfConnections::OfOthers { .. } => "QUOTA_CONNECTIONS_OF_ALL",
        }
    }

    /// The status that the caller gets.
    pub(crate) fn status(&self) -> Status {
        let mut details = ErrorDetails::with_error_info(self.reason(), "ratn", []);
        details.set_retry_info(Some(RETRY_DELAY));
        Status::with_error_details(Code::ResourceExhausted, self.to_string(), details)
    }
}

impl fmt::Display for OutOfConnections {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (whose, most, key) = match self {
            OutOfConnections::All => {
                return f
                    .write_str("all connections have calls under way (service.quotas.connections): try again later");
            }
            OutOfConnections::TooOften { origin, per_s } => {
                return write!(
                    f,
                    "connections a second of {origin}: the quota of {per_s} is reached (service.quotas.connections_per_s): use one for many calls"
                );
            }
            OutOfConnections::OfOneCaller { caller, most } => (&**caller, most, "connections_in_use"),
            OutOfConnections::OfOthers { most } => ("all who are no operators", most, "connections_for_operators"),
        };
        write!(f, "connections of {whose}: the quota of {most} with calls under way is reached (service.quotas.{key})")
    }
}
