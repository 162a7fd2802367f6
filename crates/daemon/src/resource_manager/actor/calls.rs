//! The calls that wait in the queue, and what is undone where one was dropped.

use super::{ResourceCore, ResourceDesk};
use crate::resource_manager::Granted;
use ratn_model::id::LeaseId;
use ratn_resources::WaiterId;

impl ResourceCore {
    pub(super) fn abandon(&mut self, ticket: u64, desk: &ResourceDesk) {
        let Some(waiter) = self.tickets.remove(&ticket) else { return };
        let Some(calls) = self.calls.get_mut(&waiter) else { return };
        calls.retain(|(other, _)| *other != ticket);
        if calls.is_empty() {
            self.calls.remove(&waiter);
            // Unknown when it was answered in this moment: then the answer could not be delivered and was undone.
            let _ = self.pool.cancel(desk.now(), waiter);
        }
    }

    pub(super) fn give_back(&mut self, lease: LeaseId, desk: &ResourceDesk) {
        if let Some(calls) = self.shared.get_mut(&lease).filter(|calls| **calls > 1) {
            *calls -= 1;
            return;
        }
        tracing::debug!(%lease, "granted to a call that was dropped: taken back");
        // Unknown when it has ended meanwhile.
        let _ = self.pool.undo_grant(desk.now(), lease);
    }

    /// How many calls took it.
    pub(super) fn answer(&mut self, waiter: WaiterId, granted: Granted) -> usize {
        let mut taken = 0;
        for (ticket, call) in self.calls.remove(&waiter).unwrap_or_default() {
            self.tickets.remove(&ticket);
            taken += usize::from(call.send(granted.clone()).is_ok());
        }
        taken
    }
}
