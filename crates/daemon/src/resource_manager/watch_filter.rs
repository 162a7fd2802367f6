//! Which resources a watch is about: a provider hears of its own, and not of everybody's.

use ratn_proto::types::ResourceUpdate;
use std::collections::BTreeSet;

/// All of them where a set is empty; where both are not, those that are in both.
#[derive(Debug, Default)]
pub(super) struct WatchFilter {
    pub(super) kinds: BTreeSet<String>,
    pub(super) resources: BTreeSet<String>,
}

impl WatchFilter {
    /// Whether it is about a resource.
    pub(super) fn passes(&self, id: &str, kind: &str) -> bool {
        (self.kinds.is_empty() || self.kinds.contains(kind))
            && (self.resources.is_empty() || self.resources.contains(id))
    }

    /// Whether it is about what an update tells of. A snapshot was made for it.
    pub(super) fn passes_update(&self, update: &ResourceUpdate) -> bool {
        match update {
            ResourceUpdate::Snapshot { .. } => true,
            ResourceUpdate::Event(event) => self.passes(&event.resource.id, &event.resource.kind),
        }
    }
}
