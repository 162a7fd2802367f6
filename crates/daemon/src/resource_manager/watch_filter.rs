//! Filters of watches by resource: a provider watches its own resources only.

use ratn_resources::ResourceView;
use std::collections::BTreeSet;

/// An empty set matches everything; two non-empty sets match what is in both.
#[derive(Debug, Default)]
pub(super) struct WatchFilter {
    pub(super) kinds: BTreeSet<String>,
    pub(super) resources: BTreeSet<String>,
}

impl WatchFilter {
    /// Whether it matches a resource.
    pub(super) fn passes(&self, resource: &ResourceView) -> bool {
        (self.kinds.is_empty() || self.kinds.contains(&resource.kind))
            && (self.resources.is_empty() || self.resources.contains(&resource.id))
    }
}
