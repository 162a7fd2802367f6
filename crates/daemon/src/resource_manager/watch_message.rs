//! Messages to watches, in the pool's types. They are converted to wire messages where they are sent: every event of a resource contains all its
//! holders, perhaps thousands of leases, which would take too much of the actor's time.

use super::watch_filter::WatchFilter;
use super::wire;
use ratn_model::id::{LeaseId, Revision};
use ratn_proto::types::{ResourceEvent, ResourceUpdate, WatchPosition};
use ratn_resources::{ResourceView, WatchEvent};
use std::sync::Arc;

/// See the module.
#[derive(Debug, Clone)]
pub(super) enum WatchMessage {
    /// The resources that match the watch; events follow from the next revision on.
    Snapshot { revision: Revision, resources: Vec<ResourceView>, youngest: LeaseId },
    /// A later change.
    Event(Arc<WatchEvent>),
}

impl WatchMessage {
    /// Whether it contains anything that matches the watch. A snapshot always does.
    pub(super) fn concerns(&self, filter: &WatchFilter) -> bool {
        match self {
            WatchMessage::Snapshot { .. } => true,
            WatchMessage::Event(event) => event.change.resources().iter().any(|resource| filter.passes(resource)),
        }
    }

    /// The updates in an event: what matches the watch and comes after its position. Snapshots are sent in parts elsewhere.
    pub(super) fn updates(&self, filter: &WatchFilter, after: Option<WatchPosition>) -> Vec<ResourceUpdate> {
        match self {
            WatchMessage::Snapshot { .. } => Vec::new(),
            WatchMessage::Event(event) => {
                let unseen = |event: &ResourceEvent| {
                    after.is_none_or(|after| event.revision > after.revision || Some(event.part) > after.part)
                };
                let events = wire::events(event, |resource| filter.passes(resource)).into_iter();
                events.filter(unseen).map(ResourceUpdate::Event).collect()
            }
        }
    }
}
