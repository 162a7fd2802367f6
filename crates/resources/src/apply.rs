//! The only place where durable state changes: an effect is applied both when it happens and when its record is read back.
//!
//! [`Pool::commit`] applies an effect and records it; restoring only applies it, so the restored state cannot differ. Each effect also notifies the
//! watchers, which makes the revision a function of the records.

use crate::accounts::{Accounts, Within};
use crate::event::EndReason;
use crate::event::{Change, Notice, WatchEvent};
use crate::expiry::Timer;
use crate::fingerprint::Fingerprint;
use crate::group::Seen;
use crate::history::History;
use crate::id::{SessionId, Slot};
use crate::lease::{Bound, EndingLease, LeaseRecord};
use crate::memory::{Forgotten, Life, Remembered, RequestId};
use crate::pool::Pool;
use crate::record::{Effect, Record};
use crate::resource::{Resource, ResourceView, add_to, remove_from, take_from};
use crate::session::Session;
use ratn_model::id::{LeaseId, Revision};
use ratn_model::resource::Quantity;
use ratn_model::time::Timestamp;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

/// An effect that does not fit the pool: a record was lost, or belongs to another pool.
pub(crate) type Misfit = String;

impl Pool {
    /// Applies an effect and records it.
    pub(crate) fn commit(&mut self, effect: Effect) {
        let applied = self.apply(&effect);
        debug_assert_eq!(applied, Ok(()), "the pool made an effect that does not fit it: {effect:?}");
        self.records.push(Record(effect));
    }

    /// Applies an effect.
    pub(crate) fn apply(&mut self, effect: &Effect) -> Result<(), Misfit> {
        match effect {
            Effect::SessionKept { session, client, ttl } => {
                let expires = self.now + *ttl;
                if let Some(known) = self.sessions.get_mut(session) {
                    let before = std::mem::replace(&mut known.expires, expires);
                    known.ttl = *ttl;
                    known.name.clone_from(client);
                    if ttl.is_zero() {
                        known.ending.get_or_insert(EndReason::SessionExpired);
                    }
                    self.stop_timer(before, Timer::Session(session.clone()));
                } else {
                    let new = Session::new(client.clone(), Arc::default(), 0, *ttl, expires);
                    self.callers.opened(&new.opened_by);
                    self.kept_ids.give_up(session);
                    self.sessions.insert(session.clone(), new);
                }
                self.start_session_timer(session, expires);
                Ok(())
            }
            Effect::SessionOpened { session, client, ttl, opened_by } => {
                let expires = self.now + *ttl;
                self.opened(session, Session::new(client.clone(), opened_by.clone(), 0, *ttl, expires))
            }
            Effect::SessionNumbered { session, client, ttl, opened_by, number } => {
                if *number <= self.last_session {
                    return Err(format!("{session} has number {number}, which is not above {}", self.last_session));
                }
                self.last_session = *number;
                let expires = self.now + *ttl;
                self.opened(session, Session::new(client.clone(), opened_by.clone(), *number, *ttl, expires))
            }
            Effect::RevisionsLeapt { revision } => {
                if *revision <= self.revision {
                    return Err(format!("revisions leap to {}, which is not ahead", revision.0));
                }
                self.revision = *revision;
                self.history = History::default();
                Ok(())
            }
            Effect::SessionEnded { session } => {
                let known = self.sessions.remove(session).ok_or_else(|| format!("{session} is not there"))?;
                self.stop_timer(known.expires, Timer::Session(session.clone()));
                self.resources.closed(session);
                self.accounts.forget(session);
                self.callers.closed(&known.opened_by);
                self.kept_ids.keep(session, &known.opened_by, self.now, &self.limits);
                Ok(())
            }
            Effect::ResourceCreated { slot, description, owner, numbered } => {
                let revision = Revision(self.revision.0 + 1);
                let resource = Resource::new(description.clone(), owner.clone(), revision);
                let seen = Seen::of(&resource);
                if !self.resources.insert(*slot, resource) {
                    return Err(format!("`{}` or {slot} is there already", description.id));
                }
                self.queue.touch(*slot, None, Some(&seen), self.resources.family(&description.kind));
                self.last_number = (*numbered).max(self.last_number);
                if let Some(owner) = owner {
                    let session = self.session_mut(owner)?;
                    session.provides.insert(*slot);
                    let caller = session.opened_by.clone();
                    self.callers.provides(&caller);
                }
                let view = self.view(*slot)?;
                self.publish(Change::ResourceCreated(view));
                Ok(())
            }
            Effect::ResourceUpdated { slot, description } => {
                let revision = Revision(self.revision.0 + 1);
                let changed = self.change(*slot, |resource| {
                    resource.description = description.clone();
                    resource.revision = revision;
                });
                changed.ok_or_else(|| missing(*slot))?;
                self.updated(*slot)
            }
            Effect::ResourceDeleted { slot, reason } => {
                let view = self.view(*slot)?;
                let resource = self.resources.remove(*slot).ok_or_else(|| missing(*slot))?;
                let family = self.resources.family(&resource.description.kind);
                self.queue.touch(*slot, Some(&Seen::of(&resource)), None, family);
                if let Some(owner) = &resource.owner {
                    let session = self.session_mut(owner)?;
                    session.provides.remove(slot);
                    let caller = session.opened_by.clone();
                    self.callers.provides_no_more(&caller);
                }
                for (session, _) in &resource.consumers {
                    self.session_mut(session)?.consumed.remove(slot);
                }
                self.crowds.remove(slot);
                for lease in self.undoable.remove(slot).unwrap_or_default() {
                    let record = self.leases.get_mut(&lease).ok_or_else(|| format!("{lease} is not there"))?;
                    record.consumed.retain(|(consumed, _)| consumed != slot);
                }
                for (lease, _) in resource.holders {
                    if self.end_standstill(lease, *slot) {
                        continue;
                    }
                    let record = self.leases.get_mut(&lease).ok_or_else(|| format!("{lease} is not there"))?;
                    let lost = record.held.iter().filter(|(held, _)| held == slot).map(|(_, amount)| *amount).sum();
                    record.held.retain(|(held, _)| held != slot);
                    let (token, session) = (record.token, record.session.clone());
                    let kind = &resource.description.kind;
                    self.in_account(&session, kind, |accounts, within| accounts.holds_no_more(within, lost));
                    self.publish(Change::ResourceLost { lease, token, session, resource: view.clone() });
                }
                self.publish(Change::ResourceDeleted { resource: view, reason: *reason });
                Ok(())
            }
            Effect::Consumed { session, slot, amount } => {
                let renewable = self.change(*slot, |resource| {
                    if resource.description.renewable {
                        add_to(&mut resource.consumers, session, *amount);
                    } else {
                        resource.spent += *amount;
                    }
                    resource.description.renewable
                });
                if renewable.ok_or_else(|| missing(*slot))? {
                    self.session_mut(session)?.consumed.insert(*slot);
                }
                self.updated(*slot)
            }
            Effect::TaskEnded { session } => {
                let slots = std::mem::take(&mut self.session_mut(session)?.consumed);
                self.end_consumption(session, slots)
            }
            Effect::SomeReturned { session, resources } => {
                let consumed = &mut self.session_mut(session)?.consumed;
                let slots: BTreeSet<Slot> = (0..*resources).map_while(|_| consumed.pop_first()).collect();
                self.end_consumption(session, slots)
            }
            Effect::Returned { session, slot, amount } => {
                let left = self.change(*slot, |resource| {
                    if resource.description.renewable {
                        take_from(&mut resource.consumers, session, *amount)
                    } else {
                        resource.spent = resource.spent.saturating_sub(*amount);
                        true
                    }
                });
                if !left.ok_or_else(|| missing(*slot))? {
                    self.session_mut(session)?.consumed.remove(slot);
                }
                self.updated(*slot)
            }
            Effect::LeaseGranted { lease, granted } => self.begin_lease(*lease, granted),
            Effect::LeaseEnded { lease, reason } => {
                let record = self.leases.remove(lease).ok_or_else(|| format!("{lease} is not there"))?;
                if let Some(expires) = record.expires {
                    self.stop_timer(expires, Timer::Lease(*lease));
                }
                let slots = record.slots();
                self.count_held(&record.session, &record.held, Accounts::holds_no_more);
                for slot in &slots {
                    if !self.begin_standstill(*lease, &record, *slot, *reason) {
                        self.change(*slot, |resource| remove_from(&mut resource.holders, lease));
                    }
                    self.held_otherwise(*slot, *lease);
                }
                self.not_undoable(*lease, record.consumed);
                self.session_mut(&record.session)?.leases.remove(lease);
                self.callers.holds_no_more(&record.opened_by);
                if *reason == EndReason::Undelivered {
                    let undone = self.memory.forget_grant(*lease);
                    undone.into_iter().for_each(|id| self.withdrawals.heard_of(self.now, &self.limits, id));
                }
                let resources = self.views(&slots)?;
                let (token, session) = (record.token, record.session);
                self.publish(Change::LeaseEnded { lease: *lease, token, session, resources, reason: *reason });
                Ok(())
            }
            Effect::UnitsFreed { lease, slot, confirmed } => {
                let token = self.ending.get(lease).map(|ending| ending.token);
                let token = token.ok_or_else(|| format!("{lease} does not end"))?;
                if !self.end_standstill(*lease, *slot) {
                    return Err(format!("{lease} has left nothing of {slot}"));
                }
                self.change(*slot, |resource| remove_from(&mut resource.holders, lease))
                    .ok_or_else(|| missing(*slot))?;
                self.held_otherwise(*slot, *lease);
                let resource = self.view(*slot)?;
                self.publish(Change::UnitsFreed { lease: *lease, token, resource, confirmed: *confirmed });
                Ok(())
            }
            Effect::Answered { request_id, fingerprint, reply, forget } => {
                self.memory.forget_oldest(*forget);
                let id = RequestId::new(&Arc::default(), request_id);
                self.memory.remember(id, *fingerprint, reply.clone(), 0, self.now);
                Ok(())
            }
            Effect::AnsweredTo { caller, request_id, fingerprint, reply, forget } => {
                self.answered((caller, request_id), (*fingerprint, reply), forget, 0);
                Ok(())
            }
            Effect::AnsweredForLife { caller, request_id, fingerprint, reply, forget, life } => {
                self.answered((caller, request_id), (*fingerprint, reply), forget, *life);
                Ok(())
            }
        }
    }

    fn answered(
        &mut self,
        (caller, id): (&Arc<str>, &Arc<str>),
        (fingerprint, reply): (Fingerprint, &Remembered),
        forget: &Forgotten,
        life: Life,
    ) {
        self.memory.forget(forget);
        let id = RequestId { id: id.clone(), caller: caller.clone() };
        self.memory.remember(id, fingerprint, reply.clone(), life, self.now);
    }

    /// Returns what a session has consumed of these resources, so that undoing a grant does not return it again.
    fn end_consumption(&mut self, session: &SessionId, slots: BTreeSet<Slot>) -> Result<(), Misfit> {
        let of_session = |lease: &&LeaseId| self.leases.get(*lease).is_some_and(|known| known.session == *session);
        let undoable = slots.iter().filter_map(|slot| self.undoable.get(slot)).flatten();
        let leases: BTreeSet<LeaseId> = undoable.filter(of_session).copied().collect();
        for lease in leases {
            let known = self.leases.get_mut(&lease).ok_or_else(|| format!("{lease} is not there"))?;
            let (gone, left) = known.consumed.drain(..).partition(|(slot, _)| slots.contains(slot));
            known.consumed = left;
            self.not_undoable(lease, gone);
        }
        for slot in slots {
            self.change(slot, |resource| remove_from(&mut resource.consumers, session));
            self.updated(slot)?;
        }
        Ok(())
    }

    fn begin_lease(&mut self, lease: LeaseId, granted: &LeaseRecord) -> Result<(), Misfit> {
        for (slot, amount) in &granted.held {
            let held = self.change(*slot, |resource| {
                let enough = resource.free() >= *amount;
                add_to(&mut resource.holders, &lease, *amount);
                enough
            });
            match held {
                None => return Err(missing(*slot)),
                Some(false) => return Err(format!("{slot} has not got {amount} free")),
                Some(true) => {}
            }
        }
        if lease.0 <= self.last_lease || granted.token.0 <= self.last_token {
            return Err(format!("{lease} with {} is not younger than what was granted before", granted.token));
        }
        (self.last_lease, self.last_token) = (lease.0, granted.token.0);
        let expires = granted.hold_for.map(|hold_for| self.now + hold_for);
        if let Some(expires) = expires {
            self.timers.insert((expires, Timer::Lease(lease)));
        }
        let session = self.session_mut(&granted.session)?;
        session.leases.insert(lease);
        let opened_by = session.opened_by.clone();
        self.callers.holds(&opened_by);
        let slots = granted.slots();
        self.count_held(&granted.session, &granted.held, Accounts::holds);
        self.leases.insert(lease, LeaseRecord { expires, opened_by, ..granted.clone() });
        self.undoable(lease, &granted.consumed);
        slots.iter().for_each(|slot| self.held_otherwise(*slot, lease));
        let resources = self.views(&slots)?;
        let (token, session) = (granted.token, granted.session.clone());
        self.publish(Change::LeaseGranted { lease, token, session, resources });
        Ok(())
    }

    /// Keeps the units of an ending lease taken if the resource's provider has to confirm standstill; returns whether it has to.
    fn begin_standstill(&mut self, lease: LeaseId, record: &LeaseRecord, slot: Slot, reason: EndReason) -> bool {
        let standstill = self.resources.get(slot).map_or(Duration::ZERO, |resource| resource.description.standstill());
        if reason.is_the_holders() || standstill.is_zero() {
            return false;
        }
        let until = self.now + standstill;
        if !self.ending.contains_key(&lease) {
            self.callers.holds(&record.opened_by);
        }
        let ending = self.ending.entry(lease).or_insert_with(|| EndingLease {
            token: record.token,
            session: record.session.clone(),
            reason,
            slots: BTreeMap::new(),
            opened_by: record.opened_by.clone(),
        });
        ending.slots.insert(slot, Bound(until));
        self.timers.insert((until, Timer::Standstill(lease, slot)));
        true
    }

    /// Frees what an ended lease has left of a resource; returns whether there was anything.
    fn end_standstill(&mut self, lease: LeaseId, slot: Slot) -> bool {
        let Some(ending) = self.ending.get_mut(&lease) else { return false };
        let Some(Bound(until)) = ending.slots.remove(&slot) else { return false };
        if ending.slots.is_empty() {
            self.callers.holds_no_more(&ending.opened_by);
            self.ending.remove(&lease);
        }
        self.stop_timer(until, Timer::Standstill(lease, slot));
        true
    }

    /// Adds what a lease holds, or has held, to the account of its session.
    fn count_held(
        &mut self,
        session: &SessionId,
        held: &[(Slot, Quantity)],
        count: fn(&mut Accounts, &Within<'_>, Quantity),
    ) {
        for (slot, amount) in held {
            let Some(description) = self.resources.get(*slot).map(|resource| resource.description.clone()) else {
                continue;
            };
            self.in_account(session, &description.kind, |accounts, within| count(accounts, within, *amount));
        }
    }

    fn opened(&mut self, id: &SessionId, session: Session) -> Result<(), Misfit> {
        let (expires, opened_by) = (session.expires, session.opened_by.clone());
        if self.sessions.insert(id.clone(), session).is_some() {
            return Err(format!("{id} is there already"));
        }
        self.callers.opened(&opened_by);
        self.kept_ids.give_up(id);
        self.timers.insert((expires, Timer::Session(id.clone())));
        Ok(())
    }

    /// A session whose time to live is zero is ending.
    pub(crate) fn start_session_timer(&mut self, session: &SessionId, expires: Timestamp) {
        if self.sessions.get(session).is_some_and(|known| known.ending.is_some()) {
            self.resources.close(session);
            self.overdue.insert(Timer::Session(session.clone()));
        } else {
            self.timers.insert((expires, Timer::Session(session.clone())));
        }
    }

    pub(crate) fn undoable(&mut self, lease: LeaseId, consumed: &[(Slot, Quantity)]) {
        for (slot, _) in consumed {
            self.undoable.entry(*slot).or_default().insert(lease);
        }
    }

    fn not_undoable(&mut self, lease: LeaseId, consumed: Vec<(Slot, Quantity)>) {
        for (slot, _) in consumed {
            if let Some(leases) = self.undoable.get_mut(&slot) {
                leases.remove(&lease);
                if leases.is_empty() {
                    self.undoable.remove(&slot);
                }
            }
        }
    }

    /// Changes a resource, and notifies the queue.
    fn change<T>(&mut self, slot: Slot, change: impl FnOnce(&mut Resource) -> T) -> Option<T> {
        if self.queue.families.is_empty() {
            return self.resources.change(slot, change);
        }
        let before = Seen::of(self.resources.get(slot)?);
        let changed = self.resources.change(slot, change)?;
        let after = Seen::of(self.resources.get(slot)?);
        let family = self.resources.family(&after.description.kind);
        self.queue.touch(slot, Some(&before), Some(&after), family);
        Some(changed)
    }

    fn updated(&mut self, slot: Slot) -> Result<(), Misfit> {
        let view = self.view(slot)?;
        self.publish(Change::ResourceUpdated(view));
        Ok(())
    }

    fn view(&self, slot: Slot) -> Result<ResourceView, Misfit> {
        self.resources.get(slot).map(|resource| self.view_of((slot, resource))).ok_or_else(|| missing(slot))
    }

    fn views(&self, slots: &[Slot]) -> Result<Vec<ResourceView>, Misfit> {
        slots.iter().map(|slot| self.view(*slot)).collect()
    }

    fn session_mut(&mut self, id: &SessionId) -> Result<&mut Session, Misfit> {
        self.sessions.get_mut(id).ok_or_else(|| format!("{id} is not there"))
    }

    fn publish(&mut self, change: Change) {
        self.revision.0 += 1;
        let event = Arc::new(WatchEvent { revision: self.revision, change });
        self.history.push(event.clone(), self.limits.history);
        self.notices.push(Notice::Event(event));
    }
}

fn missing(slot: Slot) -> Misfit {
    format!("{slot} is empty")
}

/// Adds an amount to the list of what a lease has taken, in order; adjacent amounts of one resource are merged.
pub(crate) fn join(held: &mut Vec<(Slot, Quantity)>, slot: Slot, amount: Quantity) {
    match held.last_mut() {
        Some((last, sum)) if *last == slot => *sum += amount,
        _ => held.push((slot, amount)),
    }
}
