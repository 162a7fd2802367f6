//! What time does to the pool: sessions expire, waiters reach their deadline, leases their end,
//! and providers the bound within which they confirm standstill.
//!
//! Everything that is due is ended before anything is granted, so that a waiter whose session or deadline has passed is
//! never handed a lease, however late the pool was called.

use crate::event::{EndReason, Refusal};
use crate::id::{SessionId, Slot, WaiterId};
use crate::pool::Pool;
use crate::record::Effect;
use ratn_model::id::LeaseId;
use ratn_model::time::Timestamp;

/// What ends at a moment.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Timer {
    Session(SessionId),
    Waiter(WaiterId),
    Lease(LeaseId),
    /// The bound within which a provider confirms standstill.
    Standstill(LeaseId, Slot),
}

impl Pool {
    /// The next moment at which time alone changes something: call [`Pool::advance`] then. At once, where what a turn does for
    /// those who wait was not enough.
    pub fn next_deadline(&self) -> Option<Timestamp> {
        if self.queue.is_behind() {
            return Some(self.now);
        }
        let timer = self.timers.first().map(|(at, _)| *at).filter(|at| *at < Timestamp(u64::MAX));
        timer.into_iter().chain(self.served_later()).min()
    }

    /// Ends what has run out by `now`, then grants what became free. Every other method does this first.
    pub fn advance(&mut self, now: Timestamp) {
        // A clock that goes back is a clock that stands still.
        self.now = self.now.max(now);
        self.looked_at = 0;
        let now = self.now;
        self.pace.iter_mut().for_each(|pace| pace.heard_of(now));
        let mut ended = self.queue.is_behind() || !self.queue.ready.is_empty();
        while self.timers.first().is_some_and(|(at, _)| *at <= self.now) {
            let Some((_, timer)) = self.timers.pop_first() else { break };
            ended = true;
            match timer {
                Timer::Session(id) => self.end_session(&id, EndReason::SessionExpired),
                Timer::Lease(lease) => self.commit(Effect::LeaseEnded { lease, reason: EndReason::HeldTooLong }),
                Timer::Standstill(lease, slot) => {
                    self.commit(Effect::UnitsFreed { lease, slot, confirmed: false });
                }
                Timer::Waiter(id) => {
                    let explained = if self.has_done_enough() { None } else { self.explained(id) };
                    let (waited_for, looked_at) =
                        explained.map(|(e, looked_at)| (e.to_string(), looked_at)).unwrap_or_default();
                    self.looked_at += looked_at;
                    self.refuse(id, Refusal::Deadline { waited_for });
                }
            }
        }
        if ended {
            self.schedule();
        }
    }
}
