//! Waiting calls, and how the effects of a dropped call are undone.

use super::{ResourceCore, ResourceTurn, Said};
use crate::resource_manager::Granted;
use ratn_model::id::LeaseId;
use ratn_model::resource::Lease;
use ratn_resources::WaiterId;
use tokio::sync::oneshot;

impl ResourceCore {
    pub(super) fn abandon(&mut self, ticket: u64, context: &ResourceTurn) {
        let Some(waiter) = self.tickets.remove(&ticket) else { return };
        let Some(calls) = self.calls.get_mut(&waiter) else { return };
        calls.retain(|(other, _)| *other != ticket);
        if calls.is_empty() {
            self.calls.remove(&waiter);
            // Unknown if it was answered just now: then the answer could not be delivered and was undone.
            let _ = self.pool.cancel(context.now(), waiter);
        }
    }

    pub(super) fn give_back(&mut self, lease: LeaseId, context: &ResourceTurn) {
        if let Some(calls) = self.shared.get_mut(&lease).filter(|calls| **calls > 1) {
            *calls -= 1;
            return;
        }
        tracing::debug!(%lease, "granted to a call that was dropped: taken back");
        // Unknown if the lease has ended since.
        let _ = self.pool.undo_grant(context.now(), lease);
    }

    /// Answers a repeated request with the lease that it was granted before. Its first call may be dropped unread: the lease stays for the reader of
    /// this answer.
    pub(super) fn grant_again(
        &mut self,
        ticket: u64,
        lease: Lease,
        call: oneshot::Sender<Granted>,
        context: &mut ResourceTurn,
    ) {
        *self.shared.entry(lease.id).or_insert(1) += 1;
        self.repeated.insert(ticket, (lease, call));
        context.say(Said::GrantedAgain { ticket });
    }

    pub(super) fn answer_again(&mut self, ticket: u64, context: &ResourceTurn) {
        let Some((lease, call)) = self.repeated.remove(&ticket) else { return };
        let id = lease.id;
        if call.send(Ok(lease)).is_err() {
            self.give_back(id, context);
        }
    }

    /// Answers a waiter's calls; returns how many took the answer.
    pub(super) fn answer(&mut self, waiter: WaiterId, granted: Granted) -> usize {
        let mut taken = 0;
        for (ticket, call) in self.calls.remove(&waiter).unwrap_or_default() {
            self.tickets.remove(&ticket);
            taken += usize::from(call.send(granted.clone()).is_ok());
        }
        taken
    }
}
