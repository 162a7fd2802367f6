//! Acquires, and how each ends: granted, refused, withdrawn or released.

use crate::caller::{Share, for_all};
use crate::error::{ALL, ALL_BUT_OPERATORS, PoolError, check_owner, malformed};
use crate::event::{EndReason, Notice, Refusal};
use crate::expiry::Timer;
use crate::fingerprint::Fingerprint;
use crate::group::{Key, key};
use crate::id::{SessionId, WaiterId};
use crate::lease::LeaseRecord;
use crate::memory::{Recalled, Remembered, RequestId};
use crate::pool::Pool;
use crate::queue::{AcquireRequest, Place, Waiter};
use crate::record::Effect;
use crate::replaced::Earlier;
use crate::resource::{Resource, Units};
use crate::session::Session;
use crate::session::Speaker;
use ratn_model::id::{FencingToken, LeaseId};
use ratn_model::resource::{Lease, ResourceOperation};
use ratn_model::time::Timestamp;

impl Pool {
    /// Asks for several resources, all or nothing. The result comes as a [`Notice`], at once if the request can be granted now.
    ///
    /// # Errors
    /// An unknown session, no requirement, operations other than block, consume and exists, a passed deadline, or a full queue.
    pub fn acquire(&mut self, now: Timestamp, request: AcquireRequest) -> Result<WaiterId, PoolError> {
        self.begin(now);
        self.enqueue(request, RequestId::default(), Fingerprint::UNKNOWN)
    }

    /// Takes a waiter out of the queue.
    ///
    /// # Errors
    /// A waiter that has been answered already.
    pub fn cancel(&mut self, now: Timestamp, id: WaiterId) -> Result<(), PoolError> {
        self.begin(now);
        self.queue.get(id).ok_or(PoolError::UnknownWaiter { waiter: id })?;
        self.refuse(id, Refusal::Cancelled);
        self.schedule();
        Ok(())
    }

    /// Undoes an acquire by its request id: takes it out of the queue, or ends the lease that it was granted. The same request id may acquire anew
    /// after that. False if there is nothing to undo: if nobody has asked with this id, its acquire may be on its way, and is refused when it arrives
    /// ([`PoolError::Withdrawn`]), for as long as answers are remembered.
    ///
    /// # Errors
    /// An acquire of another session.
    pub fn withdraw(&mut self, now: Timestamp, caller: &SessionId, request_id: &str) -> Result<bool, PoolError> {
        let undone = self.undo(now, caller, request_id)?;
        if let Some(session) = self.sessions.get(caller).filter(|_| !undone) {
            let id = RequestId::new(&session.opened_by, request_id);
            if self.memory.reply(&id, self.is_over(session.number)).is_none() {
                self.withdrawals.withdrawn(self.now, &self.limits, id, caller);
            }
        }
        Ok(undone)
    }

    /// As [`Pool::withdraw`], but does not refuse an acquire that arrives later.
    ///
    /// # Errors
    /// As there.
    pub fn undo(&mut self, now: Timestamp, caller: &SessionId, request_id: &str) -> Result<bool, PoolError> {
        self.begin(now);
        let Some(session) = self.sessions.get(caller) else { return Ok(false) };
        match self.memory.reply(&RequestId::new(&session.opened_by, request_id), self.is_over(session.number)) {
            Some(Recalled::Waiting(id)) => {
                let Some(waiter) = self.queue.get(id) else { return Ok(false) };
                check_owner(|| id.to_string(), &waiter.request.session, caller)?;
                self.refuse(id, Refusal::Cancelled);
            }
            Some(Recalled::Answered(Remembered::Granted(lease))) => {
                let Some(record) = self.leases.get(&lease) else { return Ok(false) };
                check_owner(|| lease.to_string(), &record.session, caller)?;
                self.return_consumed(lease);
                self.commit(Effect::LeaseEnded { lease, reason: EndReason::Undelivered });
            }
            _ => return Ok(false),
        }
        self.schedule();
        Ok(true)
    }

    /// Ends a lease: its holder gives it back, and thereby says that nothing moves for it any more. With `None` as session, any lease may be
    /// released, which revokes it.
    ///
    /// # Errors
    /// An unknown or ended lease, or one of another session.
    pub fn release(&mut self, now: Timestamp, session: Option<&SessionId>, id: LeaseId) -> Result<(), PoolError> {
        self.give_back(now, session, id, EndReason::Asked)
    }

    /// As [`Pool::release`], by a holder that does not know whether something still moves for the lease: units with a bound for standstill are free
    /// when that is confirmed, or the bound has passed.
    ///
    /// # Errors
    /// As there.
    pub fn release_moving(
        &mut self,
        now: Timestamp,
        session: Option<&SessionId>,
        id: LeaseId,
    ) -> Result<(), PoolError> {
        self.give_back(now, session, id, EndReason::GivenUp)
    }

    fn give_back(
        &mut self,
        now: Timestamp,
        session: Option<&SessionId>,
        id: LeaseId,
        reason: EndReason,
    ) -> Result<(), PoolError> {
        self.begin(now);
        let record = self.leases.get(&id).ok_or(PoolError::UnknownLease { lease: id })?;
        if let Some(caller) = session {
            check_owner(|| id.to_string(), &record.session, caller)?;
        }
        let reason = if session.is_some() { reason } else { EndReason::Revoked };
        self.commit(Effect::LeaseEnded { lease: id, reason });
        self.schedule();
        Ok(())
    }

    /// As [`Pool::confirm_standstill_as`], by [`Speaker::trusted`].
    ///
    /// # Errors
    /// As there.
    pub fn confirm_standstill(
        &mut self,
        now: Timestamp,
        session: Option<&SessionId>,
        lease: LeaseId,
        resource: &str,
    ) -> Result<bool, PoolError> {
        self.confirm_standstill_as(now, &Speaker::trusted(), session, lease, resource)
    }

    /// The provider of a resource confirms standstill: nothing moves any more for a lease that has ended, so the units that this lease had left are
    /// free. False if it had left none, or is alive. For a resource that no session provides, the session of the lease confirms; that session may
    /// have ended and been opened again, but only by the same caller. `None` as session may confirm for anything.
    ///
    /// # Errors
    /// An unknown resource, or one that another session provides; a lease of a session that another opened.
    pub fn confirm_standstill_as(
        &mut self,
        now: Timestamp,
        speaker: &Speaker,
        session: Option<&SessionId>,
        lease: LeaseId,
        resource: &str,
    ) -> Result<bool, PoolError> {
        self.begin(now);
        let unknown = || PoolError::UnknownResource { id: resource.to_owned() };
        let slot = self.resources.find(resource).ok_or_else(unknown)?;
        let ending = self.ending.get(&lease).filter(|ending| ending.slots.contains_key(&slot));
        let provider = self.resources.get(slot).and_then(|resource| resource.owner.as_ref());
        let speaks = provider.or(ending.map(|ending| &ending.session));
        if let (Some(speaks), Some(caller)) = (speaks, session) {
            check_owner(|| format!("resource `{resource}`"), speaks, caller)?;
        }
        let Some(ending) = ending else { return Ok(false) };
        if provider.is_none() && !speaker.for_anybody && ending.opened_by != speaker.name {
            let (session, opened_by) = (ending.session.clone(), ending.opened_by.clone());
            return Err(PoolError::SessionOfAnother { session, opened_by, speaker: speaker.name.clone() });
        }
        self.commit(Effect::UnitsFreed { lease, slot, confirmed: true });
        self.schedule();
        Ok(true)
    }

    /// Takes back a grant that nobody heard of, and what was consumed with it. Its request may be repeated under its id, and waits again.
    ///
    /// # Errors
    /// An unknown or ended lease.
    pub fn undo_grant(&mut self, now: Timestamp, id: LeaseId) -> Result<(), PoolError> {
        self.begin(now);
        if !self.leases.contains_key(&id) {
            return Err(PoolError::UnknownLease { lease: id });
        }
        self.return_consumed(id);
        self.commit(Effect::LeaseEnded { lease: id, reason: EndReason::Undelivered });
        self.schedule();
        Ok(())
    }

    pub(crate) fn enqueue(
        &mut self,
        request: AcquireRequest,
        request_id: RequestId,
        fingerprint: Fingerprint,
    ) -> Result<WaiterId, PoolError> {
        use ResourceOperation::{Block, Consume, Exists};
        self.session(&request.session)?;
        if request.requirements.is_empty() {
            return Err(malformed("requirements of an acquire", "at least one: what needs nothing needs no lease"));
        }
        self.check_requirements(&request.requirements, &[Block, Consume, Exists])?;
        if request.purpose.chars().count() > self.limits.name_length {
            return Err(malformed("purpose", &format!("at most {} characters", self.limits.name_length)));
        }
        if request.deadline.is_some_and(|deadline| deadline <= self.now) {
            return Err(malformed("deadline", "it lies in the future"));
        }
        let replaced = self.replaced_by(&request, &request_id);
        let groups: Vec<Key> = request.requirements.iter().map(key).collect();
        let kept = replaced.as_ref().and_then(|(_, of)| of.kept_by(self.now, request.speculative, &groups));
        let queued = self.enqueue_keeping(request, request_id, fingerprint, groups, kept);
        if let (Err(_), Some((id, earlier))) = (&queued, replaced) {
            // A refused request may come again and keep the time that it had waited.
            self.left.leaves(self.now, id, earlier);
        }
        queued
    }

    /// Queues a request that was checked, with what it keeps of the request that it replaces.
    fn enqueue_keeping(
        &mut self,
        request: AcquireRequest,
        request_id: RequestId,
        fingerprint: Fingerprint,
        groups: Vec<Key>,
        kept: Option<Timestamp>,
    ) -> Result<WaiterId, PoolError> {
        let full = self.no_room(&request.session)?;
        self.next_waiter += 1;
        let id = WaiterId(self.next_waiter);
        let place = (self.turn_of(&request, kept, id), id);
        let known = self.session(&request.session)?;
        self.check_leases(known)?;
        if self.may_grant_to(known)
            && let Some(taken) = self.at_once(place, &request.requirements)
        {
            self.give(place, request, request_id, fingerprint, taken);
            self.schedule();
            return Ok(id);
        }
        // A more urgent request may be served with what a waiter has reserved; any other one certainly has to wait.
        if let Some(full) = full.as_ref().filter(|_| !self.is_before_others(place, &request.requirements)) {
            return Err(full.clone());
        }
        self.check_selectors(self.session(&request.session)?, &groups)?;
        if let Some(deadline) = request.deadline {
            self.timers.insert((deadline, Timer::Waiter(id)));
        }
        if let Some(session) = self.sessions.get_mut(&request.session) {
            session.waiters.insert(id);
            self.callers.waits(&session.opened_by, &groups);
        }
        if !request_id.is_empty() {
            self.memory.wait(&request_id, fingerprint, id);
        }
        let reserved = vec![Units::new(); request.requirements.len()];
        let (hopeful, first, hopeful_since, since, lacks, overtaken, missing) = Default::default();
        let turn = self.turn_behind(&request);
        let waiter = Waiter {
            request,
            turn,
            asked: kept.unwrap_or(self.now),
            since,
            kept,
            first,
            request_id,
            groups,
            hopeful,
            hopeful_since,
            reserved,
            lacks,
            overtaken,
            missing,
        };
        self.join(id, waiter);
        self.schedule();
        match full {
            Some(full) if self.queue.get(id).is_some() => {
                self.leave(id, false);
                self.schedule();
                Err(full)
            }
            _ => Ok(id),
        }
    }

    /// Checks that the caller of a session may have one more lease.
    fn check_leases(&self, session: &Session) -> Result<(), PoolError> {
        let (caller, limit) = (&session.opened_by, self.limits.leases_per_caller);
        if session.is_operators() || self.callers.leases(caller) + self.callers.waiters(caller) < limit {
            return Ok(());
        }
        Err(PoolError::Quota { what: "leases", whose: caller.clone(), quota: "leases_per_caller", limit })
    }

    /// Checks that somebody may wait for these selectors.
    fn check_selectors(&self, session: &Session, groups: &[Key]) -> Result<(), PoolError> {
        let share = Share {
            what: "different selectors waited for",
            there: self.queue.groups.len(),
            limit: ("selectors", self.limits.selectors),
            for_operators: ("selectors_for_operators", self.limits.selectors_for_operators),
            of_caller: 0,
            quota: ("selectors_per_caller", usize::MAX),
        };
        let new = groups.iter().filter(|key| !self.queue.groups.contains_key(*key)).count();
        share.check(new, session)?;
        let (caller, limit) = (&session.opened_by, self.limits.selectors_per_caller);
        let own = self.callers.selectors(caller) + self.callers.new_selectors(caller, groups);
        if session.is_operators() || own <= limit {
            return Ok(());
        }
        let what = "different selectors waited for";
        Err(PoolError::Quota { what, whose: caller.clone(), quota: "selectors_per_caller", limit })
    }

    /// Why one more acquire of a session could not wait; `None` if it could.
    fn no_room(&self, session: &SessionId) -> Result<Option<PoolError>, PoolError> {
        let (known, limits) = (self.session(session)?, &self.limits);
        let (of_session, caller) = (known.waiters.len(), &known.opened_by);
        let for_all = for_all(limits.waiters, limits.waiters_for_operators);
        Ok(if !caller.is_empty() && self.callers.waiters(caller) >= limits.waiters_per_caller {
            let (what, quota) = ("waiters", "waiters_per_caller");
            Some(PoolError::Quota { what, whose: caller.clone(), quota, limit: limits.waiters_per_caller })
        } else if of_session >= limits.waiters_per_session {
            let (whose, key) = ("one session", "waiters_per_session");
            Some(PoolError::TooMany { what: "waiters", whose, key, limit: limits.waiters_per_session })
        } else if self.queue.len() >= limits.waiters {
            Some(PoolError::TooMany { what: "waiters", whose: ALL, key: "waiters", limit: limits.waiters })
        } else if !known.is_operators() && self.queue.len() >= for_all {
            let (whose, key) = (ALL_BUT_OPERATORS, "waiters_for_operators");
            Some(PoolError::TooMany { what: "waiters", whose, key, limit: for_all })
        } else {
            None
        })
    }

    /// Grants a waiter the units that were found for it.
    pub(crate) fn grant(&mut self, id: WaiterId, taken: Vec<Units>) {
        let Some((waiter, fingerprint)) = self.leave(id, true) else { return };
        self.give(waiter.place(id), waiter.request, waiter.request_id, fingerprint, taken);
    }

    fn give(
        &mut self,
        place: Place,
        request: AcquireRequest,
        request_id: RequestId,
        fingerprint: Fingerprint,
        taken: Vec<Units>,
    ) {
        self.overtake(place, &taken);
        let (mut held, mut consumed) = (Vec::new(), Vec::new());
        for (requirement, taken) in request.requirements.iter().zip(taken) {
            if requirement.operation == ResourceOperation::Consume {
                taken.iter().for_each(|(slot, amount)| crate::apply::join(&mut consumed, *slot, *amount));
                self.commit_consumed(&request.session, taken);
            } else {
                taken.into_iter().for_each(|(slot, amount)| crate::apply::join(&mut held, slot, amount));
            }
        }
        held.shrink_to_fit();
        let (lease, token) = (LeaseId(self.last_lease + 1), FencingToken(self.last_token + 1));
        let life = self.life(Some(&request.session));
        let granted = LeaseRecord {
            token,
            session: request.session,
            held,
            consumed,
            hold_for: request.hold_for,
            purpose: request.purpose.into(),
            opened_by: Default::default(),
            expires: None,
        };
        self.commit(Effect::LeaseGranted { lease, granted });
        self.remember(request_id, fingerprint, Remembered::Granted(lease), life);
        if let Some(lease) = self.lease(lease) {
            self.notices.push(Notice::Granted { waiter: place.1, lease });
        }
    }

    fn return_consumed(&mut self, lease: LeaseId) {
        let Some(record) = self.leases.get(&lease) else { return };
        let session = record.session.clone();
        for (slot, amount) in record.consumed.clone() {
            self.commit(Effect::Returned { session: session.clone(), slot, amount });
        }
    }

    pub(crate) fn refuse(&mut self, id: WaiterId, refusal: Refusal) {
        if self.leave(id, false).is_some() {
            self.notices.push(Notice::Refused { waiter: id, refusal });
        }
    }

    /// The lease as its holder gets it; without what it has lost since.
    pub fn lease(&self, id: LeaseId) -> Option<Lease> {
        let record = self.leases.get(&id)?;
        let mut resources = Vec::new();
        let leased = |resource: &Resource| {
            resource.description.leased(self.resources.kinds().superclasses(&resource.description.kind))
        };
        for (slot, amount) in &record.held {
            let Some(resource) = self.resources.get(*slot) else { continue };
            let units = if amount.is_whole() && !resource.description.divisible { amount.units() } else { 1 };
            resources.extend(std::iter::repeat_n(leased(resource), units as usize));
        }
        let consumed = record.consumed.iter();
        let consumed = consumed.filter_map(|(slot, amount)| self.consumed_units(&record.session, *slot, *amount));
        Some(Lease { id, token: record.token, resources, consumed: consumed.collect() })
    }

    /// Removes a waiter from the queue and its indices; returns it with the fingerprint of its request.
    fn leave(&mut self, id: WaiterId, granted: bool) -> Option<(Waiter, Fingerprint)> {
        let competed = self.queue.get(id)?.hopeful;
        let waiter = self.part(id, granted)?;
        if let Some(deadline) = waiter.request.deadline {
            self.timers.remove(&(deadline, Timer::Waiter(id)));
        }
        if let Some(session) = self.sessions.get_mut(&waiter.request.session) {
            session.waiters.remove(&id);
            self.callers.waits_no_more(&session.opened_by, &waiter.groups);
        }
        let kept = if competed { Some(waiter.since) } else { waiter.kept };
        let kept = kept.map(|since| self.not_before_served(&waiter.request, since));
        if competed {
            self.has_competed(&waiter.request, id, granted && waiter.first);
        }
        let fingerprint = self.memory.waited(&waiter.request_id).unwrap_or_default();
        if !granted {
            let (session, speculative) = (waiter.request.session.clone(), waiter.request.speculative);
            let earlier = Earlier { session, kept, speculative, groups: waiter.groups.clone() };
            self.left.leaves(self.now, waiter.request_id.clone(), earlier);
            self.withdrawals.heard_of(self.now, &self.limits, waiter.request_id.clone());
        }
        Some((waiter, fingerprint))
    }
}
