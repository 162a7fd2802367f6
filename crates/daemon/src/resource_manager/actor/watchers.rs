//! What a watch begins with: everything as it is, or what happened after a position that is known.

use super::{ResourceCore, ResourceDesk};
use crate::resource_manager::{status, wire};
use ratn_model::id::Revision;
use ratn_proto::types::{ResourceEvent, ResourceUpdate, WatchPosition};
use std::sync::Arc;
use tokio::sync::mpsc;
use tonic::Status;

impl ResourceCore {
    pub(super) fn watch(
        &self,
        after: Option<WatchPosition>,
        desk: &mut ResourceDesk,
    ) -> Result<mpsc::Receiver<Arc<ResourceUpdate>>, Status> {
        desk.watchers.admit(self.config.max_watchers)?;
        let Some(after) = after else {
            let resources = self.pool.list().iter().map(wire::resource).collect();
            let (revision, youngest) = (self.pool.revision(), self.pool.youngest_lease());
            return desk.watch(vec![Arc::new(ResourceUpdate::Snapshot { revision, resources, youngest })]);
        };
        // Some of this revision may have been seen.
        let before = Revision(after.revision.0.saturating_sub(u64::from(after.part.is_some())));
        let events = self.pool.changes_after(before).map_err(|compacted| status::of_compacted(&compacted))?;
        let events = events.iter().flat_map(|event| wire::events(event));
        let unseen = |event: &ResourceEvent| event.revision > after.revision || Some(event.part) > after.part;
        desk.watch(events.filter(unseen).map(|event| Arc::new(ResourceUpdate::Event(event))).collect())
    }
}
