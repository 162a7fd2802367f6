//! Expiry: the deadlines of sessions, waiters and leases, and the bounds within which providers confirm standstill.
//!
//! Waiters whose session or deadline has expired leave before anything is granted, however late the pool was called. Everything else that is due ends
//! in the same turn, unless that would take long: then the rest is overdue, and [`Pool::next_deadline`] asks for the next turn immediately. Overdue
//! resources stay taken until they have ended.

use crate::event::{EndReason, Refusal};
use crate::id::{SessionId, Slot, WaiterId};
use crate::pool::Pool;
use crate::record::Effect;
use ratn_model::id::LeaseId;
use ratn_model::time::Timestamp;

/// Number of resources that are read in one turn: some milliseconds.
const WORK_PER_TURN: usize = 100_000;
/// Number of resources that are read in one call, so that postponed work does not make it much longer.
const WORK_PER_CALL: usize = 20_000;
/// Ending a lease at a resource costs as much as reading this many resources.
const WORK_PER_END: usize = 25;

/// Work limits, counted in resources that are read.
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

/// What ends at some time.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Timer {
    Session(SessionId),
    Waiter(WaiterId),
    Lease(LeaseId),
    /// The bound within which a provider confirms standstill.
    Standstill(LeaseId, Slot),
}

impl Pool {
    /// The next time at which something changes by time alone: call [`Pool::advance`] then. Immediately, if one turn was not enough.
    pub fn next_deadline(&self) -> Option<Timestamp> {
        if self.queue.is_behind() || !self.overdue.is_empty() {
            return Some(self.now);
        }
        let timer = self.timers.first().map(|(at, _)| *at).filter(|at| *at < Timestamp(u64::MAX));
        timer.into_iter().chain(self.served_later()).chain(self.queue.growth.look_at()).min()
    }

    /// A turn: ends what has expired by `now`, then grants what became free.
    pub fn advance(&mut self, now: Timestamp) {
        self.turn(now, self.work.per_turn);
    }

    /// Like [`Pool::advance`], with less postponed work. Every other method calls this first.
    pub(crate) fn begin(&mut self, now: Timestamp) {
        self.turn(now, self.work.per_call);
    }

    /// Whether this turn has done its share of work.
    pub(crate) fn has_done_enough(&self) -> bool {
        self.worked >= self.enough
    }

    /// The same for ending: half of the share is reserved for waiters.
    pub(crate) fn has_ended_enough(&self) -> bool {
        self.worked >= self.enough / 2
    }

    /// Counts the work for this many ended holdings.
    pub(crate) fn ended(&mut self, holdings: usize) {
        self.worked += WORK_PER_END * holdings;
    }

    fn turn(&mut self, now: Timestamp, enough: usize) {
        // If the clock goes back, time stands still.
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

    /// Ends what is due, up to the limit of a turn.
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
                // The waiter leaves at its deadline.
                Timer::Waiter(_) => drop(self.overdue.remove(&timer)),
            }
        }
        // Recorded, so that they continue to end after a restart.
        let begun = |timer: &Timer| if let Timer::Session(id) = timer { Some(id.clone()) } else { None };
        let begun: Vec<SessionId> = self.overdue.iter().map_while(begun).collect();
        for session in begun {
            let Some(known) = self.sessions.get(&session).filter(|known| !known.ttl.is_zero()) else { continue };
            let (client, ttl) = (known.name.clone(), std::time::Duration::ZERO);
            self.commit(Effect::SessionKept { session, client, ttl });
        }
    }

    /// Removes a timer: it is not needed any more, or has ended.
    pub(crate) fn stop_timer(&mut self, at: Timestamp, timer: Timer) {
        self.overdue.remove(&timer);
        self.timers.remove(&(at, timer));
    }
}
