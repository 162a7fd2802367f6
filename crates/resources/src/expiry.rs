//! Expiry: sessions expire, waiters reach their deadline, leases their end,
//! and providers the bound within which they confirm standstill.
//!
//! Waiters whose session or deadline has passed leave before anything is granted, however late the pool was called. What else is
//! due ends in the same turn, unless that would take long: then the rest is overdue, and [`Pool::next_deadline`] asks for the next
//! turn at once. What is overdue is held until it has ended, and nobody gets it meanwhile.

use crate::event::{EndReason, Refusal};
use crate::id::{SessionId, Slot, WaiterId};
use crate::pool::Pool;
use crate::record::Effect;
use ratn_model::id::LeaseId;
use ratn_model::time::Timestamp;

/// Resources that are looked at in one turn: some milliseconds.
const WORK_PER_TURN: usize = 100_000;
/// And in one call: what others are owed does not make it much longer.
const WORK_PER_CALL: usize = 20_000;
/// The end of a lease at a resource takes as long as looking at so many of them.
const WORK_PER_END: usize = 25;

/// How much is done at a time, counted in resources that are looked at.
#[derive(Debug, Clone)]
pub(crate) struct Work {
    pub(crate) per_turn: usize,
    pub(crate) per_call: usize,
}

impl Default for Work {
    fn default() -> Work {
        Work { per_turn: WORK_PER_TURN, per_call: WORK_PER_CALL }
    }
}

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
    /// The next moment at which time alone changes something: call [`Pool::advance`] then. At once, where what a turn does was not
    /// enough.
    pub fn next_deadline(&self) -> Option<Timestamp> {
        if self.queue.is_behind() || !self.overdue.is_empty() {
            return Some(self.now);
        }
        let timer = self.timers.first().map(|(at, _)| *at).filter(|at| *at < Timestamp(u64::MAX));
        timer.into_iter().chain(self.served_later()).chain(self.queue.growth.look_at()).min()
    }

    /// A turn: ends what has run out by `now`, then grants what became free.
    pub fn advance(&mut self, now: Timestamp) {
        self.turn(now, self.work.per_turn);
    }

    /// As [`Pool::advance`], with less that is put off. Every other method does this first.
    pub(crate) fn begin(&mut self, now: Timestamp) {
        self.turn(now, self.work.per_call);
    }

    /// Whether this turn has done its share.
    pub(crate) fn has_done_enough(&self) -> bool {
        self.worked >= self.enough
    }

    /// The same of what ends: half of the share is for those who wait.
    pub(crate) fn has_ended_enough(&self) -> bool {
        self.worked >= self.enough / 2
    }

    /// So many holdings have ended.
    pub(crate) fn ended(&mut self, holdings: usize) {
        self.worked += WORK_PER_END * holdings;
    }

    fn turn(&mut self, now: Timestamp, enough: usize) {
        // A clock that goes back is a clock that stands still.
        self.now = self.now.max(now);
        (self.worked, self.enough) = (0, enough);
        let now = self.now;
        self.pace.iter_mut().for_each(|pace| pace.heard_of(now));
        self.queue.growth.advance(now);
        self.left.forget(now);
        let mut ended = self.queue.is_behind() || !self.queue.ready.is_empty() || !self.overdue.is_empty();
        while self.timers.first().is_some_and(|(at, _)| *at <= self.now) {
            let Some((_, timer)) = self.timers.pop_first() else { break };
            ended = true;
            match timer {
                Timer::Session(id) => self.begin_end(&id, EndReason::SessionExpired),
                Timer::Lease(_) | Timer::Standstill(..) => drop(self.overdue.insert(timer)),
                Timer::Waiter(id) => {
                    let explained = if self.has_done_enough() { None } else { self.explained(id) };
                    let (waited_for, looked_at) =
                        explained.map(|(e, looked_at)| (e.to_string(), looked_at)).unwrap_or_default();
                    self.worked += looked_at;
                    self.refuse(id, Refusal::Deadline { waited_for });
                }
            }
        }
        self.end_overdue();
        if ended {
            self.schedule();
        }
    }

    /// Ends what is due, as much of it as a turn may.
    pub(crate) fn end_overdue(&mut self) {
        while !self.has_ended_enough()
            && let Some(timer) = self.overdue.first().cloned()
        {
            match timer {
                Timer::Session(id) => self.end_some_of(&id),
                Timer::Lease(lease) => {
                    self.ended(self.leases.get(&lease).map_or(0, |record| record.held.len()) + 1);
                    self.commit(Effect::LeaseEnded { lease, reason: EndReason::HeldTooLong });
                }
                Timer::Standstill(lease, slot) => {
                    self.ended(1);
                    self.commit(Effect::UnitsFreed { lease, slot, confirmed: false });
                }
                // It leaves at its deadline.
                Timer::Waiter(_) => drop(self.overdue.remove(&timer)),
            }
        }
        // Also after a restart they go on ending.
        let begun = |timer: &Timer| if let Timer::Session(id) = timer { Some(id.clone()) } else { None };
        let begun: Vec<SessionId> = self.overdue.iter().map_while(begun).collect();
        for session in begun {
            let Some(known) = self.sessions.get(&session).filter(|known| !known.ttl.is_zero()) else { continue };
            let (client, ttl) = (known.name.clone(), std::time::Duration::ZERO);
            self.commit(Effect::SessionKept { session, client, ttl });
        }
    }

    /// Nothing is to end any more at a moment, or what was due has ended.
    pub(crate) fn stop_timer(&mut self, at: Timestamp, timer: Timer) {
        self.overdue.remove(&timer);
        self.timers.remove(&(at, timer));
    }
}
