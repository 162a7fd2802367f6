//! What the decisions that are to be performed wait for, so that it can be said if the wait is in vain.

use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};

/// What the next decision to be performed waits for.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) enum WaitsFor {
    /// Nothing waits.
    #[default]
    Nobody,
    /// The log, which has to be safe on disk first.
    Disk,
    /// Leases, which have to be back before something is used up or deleted.
    Leases,
    /// The answer to a create, delete or consume.
    ResourceManager,
    /// The answer to a commit.
    WorldPool,
}

impl fmt::Display for WaitsFor {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            WaitsFor::Nobody => "it was not all asked for in time",
            WaitsFor::Disk => "the event log was not safe on its disk in time",
            WaitsFor::Leases => "the resource manager has not taken leases back in time, behind which something was to be created, deleted or used up",
            WaitsFor::ResourceManager => "the resource manager has not answered in time",
            WaitsFor::WorldPool => "the world pool has not answered in time",
        })
    }
}

/// The one place where this is kept. Clones share it.
#[derive(Debug, Clone, Default)]
pub(super) struct Waiting(Arc<Mutex<WaitsFor>>);

impl Waiting {
    pub(super) fn set(&self, waits_for: WaitsFor) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = waits_for;
    }

    pub(super) fn get(&self) -> WaitsFor {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
