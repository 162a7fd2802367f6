//! What a watch begins with: everything as it is, or what happened after a position that is known.

use super::{ResourceCore, ResourceDesk};
use crate::resource_manager::watch_filter::WatchFilter;
use crate::resource_manager::{status, wire};
use ratn_model::id::Revision;
use ratn_proto::types::{ResourceEvent, ResourceUpdate, WatchPosition};
use ratn_resources::ResourceView;
use std::sync::Arc;
use tokio::sync::mpsc;
use tonic::Status;

impl ResourceCore {
    pub(super) fn watch(
        &self,
        after: Option<WatchPosition>,
        filter: WatchFilter,
        desk: &mut ResourceDesk,
    ) -> Result<mpsc::Receiver<Arc<ResourceUpdate>>, Status> {
        desk.watchers.admit(self.config.max_watchers)?;
        let Some(after) = after else {
            let wanted = |view: &&ResourceView| filter.passes(&view.description.id, &view.description.kind);
            let resources = self.pool.list().iter().filter(wanted).map(wire::resource).collect();
            let (revision, youngest) = (self.pool.revision(), self.pool.youngest_lease());
            let first = vec![Arc::new(ResourceUpdate::Snapshot { revision, resources, youngest })];
            return desk.watch_where(first, move |update| filter.passes_update(update));
        };
        // Some of this revision may have been seen.
        let before = Revision(after.revision.0.saturating_sub(u64::from(after.part.is_some())));
        let events = self.pool.changes_after(before).map_err(|compacted| status::of_compacted(&compacted))?;
        let events = events.iter().flat_map(|event| wire::events(event));
        let unseen = |event: &ResourceEvent| event.revision > after.revision || Some(event.part) > after.part;
        let first = events.filter(unseen).map(|event| Arc::new(ResourceUpdate::Event(event)));
        let first = first.filter(|update| filter.passes_update(update)).collect();
        desk.watch_where(first, move |update| filter.passes_update(update))
    }
}
