//! The beginning of a watch: a snapshot, or all events after a known position.

use super::{ResourceCore, ResourceTurn};
use crate::resource_manager::status;
use crate::resource_manager::watch_filter::WatchFilter;
use crate::resource_manager::watch_message::WatchMessage;
use ratn_model::id::Revision;
use ratn_proto::types::WatchPosition;
use std::sync::Arc;
use tokio::sync::mpsc;
use tonic::Status;

impl ResourceCore {
    pub(super) fn watch(
        &self,
        after: Option<WatchPosition>,
        filter: Arc<WatchFilter>,
        context: &mut ResourceTurn,
    ) -> Result<mpsc::Receiver<WatchMessage>, Status> {
        context.watchers.admit(self.config.max_watchers)?;
        let first = match after {
            None => {
                let resources = self.pool.list().into_iter().filter(|view| filter.passes(view)).collect();
                let (revision, youngest) = (self.pool.revision(), self.pool.youngest_lease());
                vec![WatchMessage::Snapshot { revision, resources, youngest }]
            }
            Some(after) => {
                // Some events of this revision may have been received.
                let before = Revision(after.revision.0.saturating_sub(u64::from(after.part.is_some())));
                let events = self.pool.changes_after(before).map_err(|compacted| status::of_compacted(&compacted))?;
                events.into_iter().map(WatchMessage::Event).filter(|told| told.concerns(&filter)).collect()
            }
        };
        context.watch_where(first, move |told| told.concerns(&filter))
    }
}
