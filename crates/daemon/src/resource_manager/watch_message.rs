//! Messages to watches, in the types of the pool. The wire's messages are made of it where they are sent: the holders of a resource that
//! thousands of leases hold are in every event of it, and the actor has no time for that.

use super::watch_filter::WatchFilter;
use super::wire;
use ratn_model::id::{LeaseId, Revision};
use ratn_proto::types::{ResourceEvent, ResourceUpdate, WatchPosition};
use ratn_resources::{ResourceView, WatchEvent};
use std::sync::Arc;

/// See the module.
#[derive(Debug, Clone)]
pub(super) enum WatchMessage {
    /// What is there, of what a watch is about; events follow from the next revision on.
    Snapshot { revision: Revision, resources: Vec<ResourceView>, youngest: LeaseId },
    /// What happened since.
    Event(Arc<WatchEvent>),
}

impl WatchMessage {
    /// Whether some of it is what a watch is about. A snapshot was made for it.
    pub(super) fn concerns(&self, filter: &WatchFilter) -> bool {
        match self {
            WatchMessage::Snapshot { .. } => true,
            WatchMessage::Event(event) => event.change.resources().iter().any(|resource| filter.passes(resource)),
        }
    }

    /// What a watch is told of an event: what it is about, behind what it has seen. A snapshot is told in parts.
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
