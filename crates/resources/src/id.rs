//! The ids of sessions and waiters. Resources are named by plain strings (`path-planner-1@compute`).

use std::fmt;
use std::sync::Arc;

/// A client's session, named by the client: what it holds and provides lives as long as its keep-alive.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct SessionId(Arc<str>);

ratn_model::number_id!(
    /// A queued acquire; numbered in the order of arrival.
    WaiterId, "waiter-"
);

impl SessionId {
    /// The name as chosen by the client.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl From<&str> for SessionId {
    fn from(name: &str) -> SessionId {
        SessionId(name.into())
    }
}

impl fmt::Display for SessionId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "session {}", self.0)
    }
}
