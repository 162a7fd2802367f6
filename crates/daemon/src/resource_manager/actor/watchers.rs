//! Who watches: everything as it is, then every change; one that does not keep up is cut off.

use super::Actor;
use crate::details::{retry_later, status as status_with};
use crate::resource_manager::outgoing::Outgoing;
use crate::resource_manager::{status, wire};
use ratn_model::id::Revision;
use ratn_proto::types::{ResourceEvent, ResourceUpdate, WatchPosition};
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::mpsc;
use tonic::{Code, Status};

/// Updates that wait for a watcher; one that has more to catch up with is cut off.
const WATCH_BUFFER: usize = 4_096;

impl Actor {
    pub(super) fn watch(
        &mut self,
        after: Option<WatchPosition>,
    ) -> Result<mpsc::Receiver<Arc<ResourceUpdate>>, Status> {
        self.watchers.retain(|watcher| !watcher.is_closed());
        if self.watchers.len() >= self.config.max_watchers {
            let message = format!("{} clients watch already", self.watchers.len());
            return Err(retry_later(Code::ResourceExhausted, "TOO_MANY", message, Duration::from_secs(1)));
        }
        if let Some(after) = after {
            // Some of this revision may have been seen.
            let before = Revision(after.revision.0.saturating_sub(u64::from(after.part.is_some())));
            let events = self.pool.changes_after(before).map_err(|compacted| status::of_compacted(&compacted))?;
            let events = events.iter().flat_map(|event| wire::events(event));
            let unseen = |event: &ResourceEvent| event.revision > after.revision || Some(event.part) > after.part;
            let events: Vec<ResourceEvent> = events.filter(unseen).collect();
            let (sender, updates) = mpsc::channel(WATCH_BUFFER + events.len());
            for event in events {
                sender
                    .try_send(Arc::new(ResourceUpdate::Event(event)))
                    .map_err(|_| status_with(Code::Internal, "BROKEN", "a new watch took no event"))?;
            }
            // Events of before that wait for the disk are in the history.
            self.outgoing.push(Outgoing::Watcher(sender));
            return Ok(updates);
        }
        let (sender, updates) = mpsc::channel(WATCH_BUFFER);
        let resources = self.pool.list().iter().map(wire::resource).collect();
        let (revision, youngest) = (self.pool.revision(), self.pool.youngest_lease());
        let snapshot = ResourceUpdate::Snapshot { revision, resources, youngest };
        sender
            .try_send(Arc::new(snapshot))
            .map_err(|_| status_with(Code::Internal, "BROKEN", "a new watch took no snapshot"))?;
        // Events of before that wait for the disk are in the snapshot.
        self.outgoing.push(Outgoing::Watcher(sender));
        Ok(updates)
    }

    pub(super) fn publish(&mut self, event: ResourceEvent) {
        if self.watchers.is_empty() {
            return;
        }
        tracing::trace!(revision = event.revision.0, kind = ?event.kind, resource = event.resource.id, "event");
        let update = Arc::new(ResourceUpdate::Event(event));
        self.watchers.retain(|watcher| match watcher.try_send(update.clone()) {
            Ok(()) => true,
            Err(mpsc::error::TrySendError::Closed(_)) => false,
            Err(mpsc::error::TrySendError::Full(_)) => {
                tracing::warn!("a watcher did not keep up and was cut off");
                false
            }
        });
    }
}
