//! The bounds of connections, and what is said of one that is beyond them.

use super::origin::Origin;
use std::fmt;
use std::sync::Arc;
use std::time::Duration;
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt};

/// Bounds of the connections of a server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ConnectionLimits {
    /// At once, whoever has them.
    pub connections: usize,
    /// Accepted in a second from one user of this machine, or one host; as many as `connections` may come at once.
    pub per_s: u32,
    /// Of one caller with calls under way.
    pub of_one_caller: usize,
    /// So many of `connections` never have calls under way of callers that are no operators. They are for operators, and for new
    /// connections.
    pub for_operators: usize,
    /// From being accepted to the first call, the handshake of TLS included.
    pub first_call: Duration,
    /// Without a call under way.
    pub idle: Duration,
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
        }
    }
}

/// Why somebody has no connection more.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum OutOfConnections {
    /// All have calls under way: a new connection was closed.
    All,
    /// From one user or host more connections came in a second than may: a new one was closed.
    TooOften {
        /// Who.
        origin: Origin,
        /// How many are allowed.
        per_s: u32,
    },
    /// A caller has calls under way on as many as one may: the call was refused.
    OfOneCaller {
        /// Who.
        caller: Arc<str>,
        /// How many are allowed.
        most: usize,
    },
    /// All who are no operators have calls under way on as many as they may: the call was refused.
    OfOthers {
        /// How many are allowed.
        most: usize,
    },
}

/// When a caller with too many connections may try again.
const RETRY_DELAY: Duration = Duration::from_secs(1);

impl OutOfConnections {
    /// In one word, for programs.
    pub fn reason(&self) -> &'static str {
        match self {
            OutOfConnections::All => "CONNECTIONS",
            OutOfConnections::TooOften { .. } => "QUOTA_CONNECTIONS_PER_S",
            OutOfConnections::OfOneCaller { .. } => "QUOTA_CONNECTIONS",
            OutOfConnections::OfOthers { .. } => "QUOTA_CONNECTIONS_OF_ALL",
        }
    }

    /// What the caller is told.
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
