//! Replies that are sent after their records have been synced: grants to requests that still wait, events to all watches.

use super::{ResourceCore, ResourceTurn};
use crate::resource_manager::status;
use crate::resource_manager::watch_message::WatchMessage;
use ratn_resources::{Change, Notice};

impl ResourceCore {
    pub(super) fn notify(&mut self, notice: Notice, context: &mut ResourceTurn) {
        match notice {
            Notice::Event(event) => {
                self.told = self.told.max(event.revision);
                if let Change::LeaseEnded { lease, .. } = &event.change {
                    self.shared.remove(lease);
                }
                tracing::trace!(revision = event.revision.0, change = ?event.change, "event");
                context.watchers.publish(&WatchMessage::Event(event));
            }
            Notice::Granted { waiter, lease } => {
                let id = lease.id;
                match self.answer(waiter, Ok(lease)) {
                    0 => self.give_back(id, context),
                    1 => {}
                    // Repeated since, perhaps.
                    calls => *self.shared.entry(id).or_insert(1) += calls - 1,
                }
            }
            Notice::Refused { waiter, refusal } => {
                self.answer(waiter, Err(status::of_refusal(&refusal)));
            }
        }
    }
}
