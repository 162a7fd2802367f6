//! What leaves when its records are on the disk: grants to whoever still waits, events to everybody who watches.

use super::{ResourceCore, ResourceDesk};
use crate::resource_manager::{status, wire};
use ratn_proto::types::{ResourceEvent, ResourceUpdate};
use ratn_resources::{Change, Notice};
use std::sync::Arc;

impl ResourceCore {
    pub(super) fn notify(&mut self, notice: Notice, desk: &mut ResourceDesk) {
        match notice {
            Notice::Event(event) => {
                self.told = self.told.max(event.revision);
                if let Change::LeaseEnded { lease, .. } = &event.change {
                    self.shared.remove(lease);
                }
                wire::events(&event).into_iter().for_each(|event| publish(event, desk));
            }
            Notice::Granted { waiter, lease } => {
                let id = lease.id;
                match self.answer(waiter, Ok(lease)) {
                    0 => self.give_back(id, desk),
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

fn publish(event: ResourceEvent, desk: &mut ResourceDesk) {
    if desk.watchers.len() == 0 {
        return;
    }
    tracing::trace!(revision = event.revision.0, kind = ?event.kind, resource = event.resource.id, "event");
    desk.watchers.publish(&Arc::new(ResourceUpdate::Event(event)));
}
