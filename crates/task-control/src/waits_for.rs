//! Whom what is decided waits for: to say so where that is in vain.

use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};

/// Whom the next of what was decided waits for.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) enum WaitsFor {
    /// Nothing waits.
    #[default]
    Nobody,
    /// The log, which has to be safe before.
    Disk,
    /// Leases, which have to be back before something is used up or deleted.
    Leases,
    /// For what is created, deleted or used up.
    ResourceManager,
    /// For a commit.
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

/// The one place where that is kept. Clones share it.
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
