//! Invariants between calls; checked after every step of simulated runs and property tests.

use crate::caller::Callers;
use crate::expiry::Timer;
use crate::id::SessionId;
use crate::pool::Pool;
use ratn_model::time::Timestamp;
use std::collections::BTreeSet;

impl Pool {
    /// Checks all invariants.
    ///
    /// # Errors
    /// The first violated invariant, in words.
    pub fn check_invariants(&self) -> Result<(), String> {
        for (slot, resource) in self.resources.iter() {
            let id = &resource.description.id;
            let (held, consumed, free) = (resource.held(), resource.consumed(), resource.free());
            // A provider may reduce a capacity below what is given out; then nothing is free.
            let capacity = resource.description.capacity;
            ensure(free.is_zero() || held + consumed + free == capacity, || {
                format!("{id}: held {held} + consumed {consumed} + free {free} is not its capacity {capacity}")
            })?;
            for (lease, amount) in &resource.holders {
                if self.ending.get(lease).is_some_and(|ending| ending.slots.contains_key(&slot)) {
                    continue;
                }
                let listed = self.leases.get(lease).map(|record| record.held.iter().filter(|(held, _)| *held == slot));
                let listed = listed.map(|amounts| amounts.map(|(_, amount)| *amount).sum());
                ensure(listed == Some(*amount), || format!("{id}: {lease} holds {amount} of it and lists {listed:?}"))?;
            }
            for (session, _) in &resource.consumers {
                let known = self.sessions.get(session).is_some_and(|s| s.consumed.contains(&slot));
                ensure(known, || format!("{id} is consumed by {session}, which does not know it"))?;
            }
            if let Some(owner) = &resource.owner {
                let known = self.sessions.get(owner).is_some_and(|s| s.provides.contains(&slot));
                ensure(known, || format!("{id} belongs to {owner}, which does not provide it"))?;
            }
        }
        ensure(self.resources.index_agrees(), || "the index of kinds does not agree with the resources".to_owned())?;
        ensure(self.crowds_agree(), || "the holders of a resource as they are shown are not those it has".to_owned())?;
        let undoable = self.leases.iter().flat_map(|(id, lease)| lease.consumed.iter().map(|(slot, _)| (*slot, *id)));
        let indexed = self.undoable.iter().flat_map(|(slot, leases)| leases.iter().map(|lease| (*slot, *lease)));
        ensure(undoable.collect::<BTreeSet<_>>() == indexed.collect(), || {
            "what can be taken back is indexed otherwise".to_owned()
        })?;
        let mut tokens = 0;
        for (id, record) in &self.leases {
            ensure(record.token.0 > tokens, || format!("{id}: tokens do not grow"))?;
            tokens = record.token.0;
            ensure(self.sessions.get(&record.session).is_some_and(|s| s.leases.contains(id)), || {
                format!("{id} belongs to {}, which does not know it", record.session)
            })?;
            for slot in record.slots() {
                let holds = self.resources.get(slot).is_some_and(|r| r.holders.iter().any(|(lease, _)| lease == id));
                ensure(holds, || format!("{id} lists {slot}, which it does not hold"))?;
            }
        }
        for (id, ending) in &self.ending {
            ensure(!self.leases.contains_key(id), || format!("{id} has ended and lives"))?;
            ensure(!ending.slots.is_empty(), || format!("{id} has left nothing and is kept"))?;
            for slot in ending.slots.keys() {
                let held = self.resources.get(*slot).is_some_and(|r| r.holders.iter().any(|(lease, _)| lease == id));
                ensure(held, || format!("{id} has left something of {slot}, which does not know it"))?;
            }
        }
        ensure(tokens <= self.last_token, || "a token is ahead of the counter".to_owned())?;
        self.queue.index_agrees()?;
        self.groups_agree()?;
        for (slot, amount) in &self.queue.reserved {
            let free = self.resources.get(*slot).map(|resource| resource.free()).unwrap_or_default();
            let shared_out_anew = self.queue.changed.values().any(|anew| *anew);
            ensure(free >= *amount || shared_out_anew, || {
                format!("{slot}: {amount} is reserved and only {free} free")
            })?;
        }
        for (id, waiter) in self.queue.iter() {
            ensure(self.sessions.get(&waiter.request.session).is_some_and(|s| s.waiters.contains(&id)), || {
                format!("{id} waits for {}, which does not know it", waiter.request.session)
            })?;
            ensure(waiter.request.deadline.is_none_or(|deadline| deadline > self.now), || {
                format!("{id} waits beyond its deadline")
            })?;
            // No lost wake-up: every waiter that can be served has been.
            let obstacles = self.explain(id).map_or(0, |explanation| explanation.obstacles.len());
            let session = self.sessions.get(&waiter.request.session);
            let may_have = session.is_some_and(|session| self.may_grant_to(session));
            let waits = obstacles > 0 || !may_have || self.queue.is_behind();
            ensure(waits, || format!("{id} waits for nothing"))?;
        }
        let ids: usize = self.sessions.values().map(|s| s.waiters.len()).sum();
        ensure(ids == self.queue.len(), || "a session knows a waiter that is not in the queue".to_owned())?;
        ensure(self.callers == Callers::of(&self.sessions, &self.ending, &self.queue), || {
            "what callers have is miscounted".to_owned()
        })?;
        let leases: usize = self.sessions.values().map(|s| s.leases.len()).sum();
        ensure(leases == self.leases.len(), || "a session knows a lease that has ended".to_owned())?;
        let provided: usize = self.sessions.values().map(|s| s.provides.len()).sum();
        let owned = self.resources.iter().filter(|(_, resource)| resource.owner.is_some()).count();
        ensure(provided == owned, || "a session provides a resource that is gone".to_owned())?;
        let ending = |id: &SessionId| self.sessions.get(id).is_some_and(|session| session.ending.is_some());
        let overdue = |timer: &Timer| !matches!(timer, Timer::Session(id) if !ending(id));
        ensure(self.overdue.iter().all(overdue), || "a session that lives is overdue".to_owned())?;
        let of_living = |(id, _): (&SessionId, _)| self.sessions.contains_key(id);
        ensure(self.kept_ids.agree() && !self.kept_ids.iter().any(of_living), || {
            "the ids that are kept do not agree, or one of a session that lives is kept".to_owned()
        })?;
        let unwritten = self.sessions.values().any(|session| session.ending.is_some() != session.ttl.is_zero());
        ensure(!unwritten, || "that a session ends is not written down".to_owned())?;
        let timers = self.timers.iter().map(|(_, timer)| timer).chain(&self.overdue).cloned().collect::<BTreeSet<_>>();
        let expected = self.expected_timers();
        let named: BTreeSet<Timer> = expected.iter().map(|(_, timer)| timer.clone()).collect();
        ensure(self.timers.is_subset(&expected) && timers == named, || {
            "the timers do not agree with what they are for".to_owned()
        })?;
        self.accounts_agree()?;
        self.memory.check(&self.limits)?;
        let waiting = self.queue.iter().filter(|(_, waiter)| !waiter.request_id.is_empty()).count();
        ensure(self.memory.waiting() == waiting, || "a request id waits without a waiter".to_owned())
    }

    fn expected_timers(&self) -> BTreeSet<(Timestamp, Timer)> {
        let sessions = self.sessions.iter().map(|(id, session)| (session.expires, Timer::Session(id.clone())));
        let waiters = self.queue.iter().filter_map(|(id, w)| Some((w.request.deadline?, Timer::Waiter(id))));
        let leases = self.leases.iter().filter_map(|(id, lease)| Some((lease.expires?, Timer::Lease(*id))));
        let ending = self
            .ending
            .iter()
            .flat_map(|(id, ending)| ending.slots.iter().map(|(slot, bound)| (bound.0, Timer::Standstill(*id, *slot))));
        sessions.chain(waiters).chain(leases).chain(ending).collect()
    }
}

fn ensure(holds: bool, broken: impl FnOnce() -> String) -> Result<(), String> {
    if holds { Ok(()) } else { Err(broken()) }
}
