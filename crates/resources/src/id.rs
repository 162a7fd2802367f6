//! The ids of sessions and waiters, and the slots of resources. To the outside, resources are named by strings (`path-planner-1@compute`).

use serde::{Deserialize, Serialize};
use std::fmt;
use std::sync::Arc;

/// A client's session, named by the client: what it holds and provides lives as long as its keep-alives continue.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct SessionId(Arc<str>);

ratn_model::number_id!(
    /// A queued acquire; numbered in order of arrival.
    WaiterId, "waiter-"
);

/// The index of a resource in the pool's table; records use it to identify the resource.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(transparent)]
pub(crate) struct Slot(u32);

impl Slot {
    /// Tables are much shorter than the range of `u32`: [`crate::Limits::resources`].
    pub(crate) fn new(index: usize) -> Slot {
        Slot(u32::try_from(index).unwrap_or(u32::MAX))
    }

    pub(crate) fn index(self) -> usize {
        self.0 as usize
    }
}

impl fmt::Display for Slot {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "slot {}", self.0)
    }
}

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
