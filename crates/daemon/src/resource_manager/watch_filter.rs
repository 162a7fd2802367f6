//! Filters of watches by resource: a provider watches its own resources only.

use ratn_resources::ResourceView;
use std::collections::BTreeSet;

/// All of them where a set is empty; where both are not, those that are in both.
#[derive(Debug, Default)]
pub(super) struct WatchFilter {
    pub(super) kinds: BTreeSet<String>,
    pub(super) resources: BTreeSet<String>,
}

impl WatchFilter {
    /// Whether it is about a resource.
    pub(super) fn passes(&self, resource: &ResourceView) -> bool {
        (self.kinds.is_empty() || self.kinds.contains(&resource.kind))
            && (self.resources.is_empty() || self.resources.contains(&resource.id))
    }
}
