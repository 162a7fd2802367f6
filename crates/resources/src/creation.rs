//! Create and delete: which resources the pool has.

use crate::caller::Share;
use crate::error::{ALL, PoolError, check_owner, malformed};
use crate::event::EndReason;
use crate::id::{SessionId, Slot};
use crate::pool::Pool;
use crate::record::Effect;
use crate::resource::{Description, LONGEST_STANDSTILL_MS, Resource, ResourceSpec, ResourceView, STANDSTILL_ATTRIBUTE};
use crate::session::Session;
use ratn_model::id::LeaseId;
use ratn_model::resource::{OperatedUnits, Quantity, Requirement, ResourceClass, ResourceOperation};
use ratn_model::time::Timestamp;
use ratn_model::value::Value;
use std::sync::Arc;

impl Pool {
    /// Adds a resource, bound to a session if one is given. If a resource with the same id and owner exists, it is updated: its kind stays, its
    /// attributes and capacity are replaced (holders keep what they hold); if they are equal, nothing changes. A resource that a task has made gives
    /// its id to a provider's resource: it is deleted, and its holders lose it.
    ///
    /// # Errors
    /// An unknown session, the id of another owner's resource that does not give way, or a malformed or too large description.
    pub fn create(
        &mut self,
        now: Timestamp,
        session: Option<&SessionId>,
        spec: ResourceSpec,
    ) -> Result<ResourceView, PoolError> {
        self.begin(now);
        session.map(|id| self.session(id)).transpose()?;
        self.check_spec(&spec)?;
        let mut numbered = self.last_number;
        let id = match &spec.id {
            Some(id) => id.clone(),
            None => self.numbered_id(&spec.kind, &mut numbered),
        };
        let known = self.resources.find(&id);
        let before = known.and_then(|slot| Some((slot, self.resources.get(slot)?)));
        match before {
            Some((slot, resource)) if resource.owner.as_ref() != session && self.gives_way(resource, spec.class) => {
                self.check_room(session, 1)?;
                self.remove(slot, EndReason::Displaced);
                self.add(session, spec, id.clone(), numbered);
            }
            Some((_, resource)) if resource.owner.as_ref() != session || resource.description.kind != spec.kind => {
                let owner = resource.owner.as_ref().map_or_else(|| "no session".to_owned(), ToString::to_string);
                return Err(PoolError::ResourceTaken { id, owner });
            }
            Some((slot, resource)) => {
                let description = spec.described(id.clone());
                if *resource.description != description {
                    let description = Arc::new(description);
                    self.commit(Effect::ResourceUpdated { slot, description });
                }
            }
            None => {
                self.check_room(session, 0)?;
                self.add(session, spec, id.clone(), numbered);
            }
        }
        self.schedule();
        self.get(&id).ok_or(PoolError::UnknownResource { id })
    }

    fn add(&mut self, session: Option<&SessionId>, spec: ResourceSpec, id: String, numbered: u64) {
        let (slot, owner) = (self.resources.next_slot(), session.cloned());
        let description = Arc::new(spec.described(id));
        self.commit(Effect::ResourceCreated { slot, description, owner, numbered });
    }

    /// Whether a task's resource gives its id to a resource of this class: whoever may create other classes than a task's is a provider. Nothing
    /// moves for a task's resource, so no standstill is lost with it. An operator's resource stays, and so does one that may be an operator's: until
    /// the owner's first ping after a restart, the provider is refused and asks again. Later the owner has pinged, or has no session any more.
    fn gives_way(&self, resource: &Resource, class: ResourceClass) -> bool {
        let owner = resource.owner.as_ref().and_then(|owner| self.sessions.get(owner));
        resource.description.class == ResourceClass::Task
            && class != ResourceClass::Task
            && owner.is_some_and(Session::is_no_operators)
    }

    /// Removes a resource. Holders hear [`crate::Change::ResourceLost`]; if it has a bound for standstill, their leases end as a whole
    /// ([`EndReason::ResourceGone`]). `None` as session may delete anything.
    ///
    /// # Errors
    /// An unknown resource, or one that belongs to another session.
    pub fn delete(&mut self, now: Timestamp, session: Option<&SessionId>, id: &str) -> Result<(), PoolError> {
        self.begin(now);
        let found = self.resources.find(id).and_then(|slot| Some((slot, self.resources.get(slot)?)));
        let (slot, resource) = found.ok_or_else(|| PoolError::UnknownResource { id: id.to_owned() })?;
        may_delete(resource, session)?;
        self.remove(slot, EndReason::Asked);
        self.schedule();
        Ok(())
    }

    /// Deletes a resource; what moves ends its leases first.
    fn remove(&mut self, slot: Slot, reason: EndReason) {
        while let Some(lease) = self.lease_that_ends_with(slot) {
            self.commit(Effect::LeaseEnded { lease, reason: EndReason::ResourceGone });
        }
        self.commit(Effect::ResourceDeleted { slot, reason });
    }

    /// A live lease of a resource whose deletion ends the lease as a whole: one with a bound for standstill. Under such a lease something may
    /// still move that relies on the deleted resource. Of other resources (a planner that died) the lease keeps the rest.
    pub(crate) fn lease_that_ends_with(&self, slot: Slot) -> Option<LeaseId> {
        let resource = self.resources.get(slot).filter(|resource| !resource.description.standstill().is_zero())?;
        resource.holders.iter().map(|(lease, _)| *lease).find(|lease| self.leases.contains_key(lease))
    }

    /// Removes an amount, for good, from the free units of all resources that fit and that the session may delete by id ([`Pool::delete`]); a
    /// resource with no units left vanishes. Returns the ids of the resources from which units were removed.
    ///
    /// # Errors
    /// An unknown session, an operation other than delete, too little to delete, or enough only together with resources of other sessions.
    pub fn delete_units(
        &mut self,
        now: Timestamp,
        session: &SessionId,
        requirement: &Requirement,
    ) -> Result<Vec<String>, PoolError> {
        let deleted = self.take_units(now, session, requirement)?;
        Ok(deleted.into_iter().map(|one| one.resource).collect())
    }

    /// The same; returns the amounts.
    pub(crate) fn take_units(
        &mut self,
        now: Timestamp,
        session: &SessionId,
        requirement: &Requirement,
    ) -> Result<Vec<OperatedUnits>, PoolError> {
        self.begin(now);
        self.session(session)?;
        self.check_requirements(std::slice::from_ref(requirement), &[ResourceOperation::Delete])?;
        let whole = requirement.count.is_whole();
        let amount = |resource: &Resource| match whole {
            true => resource.free().floor_to(Quantity::ONE),
            false if resource.description.divisible => resource.free(),
            false => Quantity::ZERO,
        };
        let (mut free, mut of_others) = (Vec::new(), None);
        for (slot, resource) in self.resources.free(requirement) {
            match may_delete(resource, Some(session)) {
                Ok(()) => free.push((slot, amount(resource))),
                Err(refused) if !amount(resource).is_zero() => of_others = of_others.or(Some(refused)),
                Err(_) => {}
            }
        }
        // The session's own resources first: they vanish with the session, but others' deleted resources do not come back.
        free.sort_by_key(|(slot, _)| self.resources.get(*slot).is_none_or(|one| one.owner.as_ref() != Some(session)));
        let found: Quantity = free.iter().map(|(_, free)| *free).sum();
        let mut wanted = requirement.count;
        if found < wanted {
            return Err(of_others.unwrap_or(PoolError::NotEnough { wanted: requirement.to_string(), found }));
        }
        let mut deleted = Vec::new();
        for (slot, free) in free {
            let amount = free.min(wanted);
            if amount.is_zero() {
                continue;
            }
            wanted = wanted.saturating_sub(amount);
            deleted.extend(self.resources.get(slot).map(|one| OperatedUnits {
                resource: one.description.id.clone(),
                kind: one.description.kind.clone(),
                units: amount,
                ends_with_session: one.owner.as_ref() == Some(session),
            }));
            self.shrink(slot, amount);
        }
        self.schedule();
        Ok(deleted)
    }

    fn shrink(&mut self, slot: Slot, amount: Quantity) {
        let Some(resource) = self.resources.get(slot) else { return };
        let capacity = resource.description.capacity.saturating_sub(amount);
        let effect = if capacity.is_zero() {
            Effect::ResourceDeleted { slot, reason: EndReason::UsedUp }
        } else {
            let description = Arc::new(Description { capacity, ..(*resource.description).clone() });
            Effect::ResourceUpdated { slot, description }
        };
        self.commit(effect);
    }

    fn numbered_id(&self, kind: &str, number: &mut u64) -> String {
        loop {
            *number += 1;
            let id = format!("{kind}-{number}");
            if self.resources.find(&id).is_none() {
                return id;
            }
        }
    }

    /// Checks that a session may have one more resource after `gone` others were removed; without a session the resource is an operator's.
    fn check_room(&self, session: Option<&SessionId>, gone: usize) -> Result<(), PoolError> {
        let (limit, there) = (self.limits.resources, self.resources.len() - gone);
        let Some(session) = session.map(|id| self.session(id)).transpose()? else {
            let room = there < limit;
            let refused = || PoolError::TooMany { what: "resources", whose: ALL, key: "resources", limit };
            return room.then_some(()).ok_or_else(refused);
        };
        let share = Share {
            what: "resources",
            there,
            limit: ("resources", limit),
            for_operators: ("resources_for_operators", self.limits.resources_for_operators),
            of_caller: self.callers.resources(&session.opened_by),
            quota: ("resources_per_caller", self.limits.resources_per_caller),
        };
        share.check(1, session)
    }

    fn check_standstill(&self, spec: &ResourceSpec) -> Result<(), PoolError> {
        let Some(bound) = spec.attributes.get(STANDSTILL_ATTRIBUTE) else { return Ok(()) };
        let bounded = |ms: &i64| u64::try_from(*ms).is_ok_and(|ms| ms <= LONGEST_STANDSTILL_MS);
        if matches!(bound, Value::Int(ms) if bounded(ms)) {
            return Ok(());
        }
        let what = format!("attribute {STANDSTILL_ATTRIBUTE} of {}", spec.kind);
        Err(malformed(&what, &format!("it is a whole number of milliseconds from 0 to {LONGEST_STANDSTILL_MS}")))
    }

    fn check_spec(&self, spec: &ResourceSpec) -> Result<(), PoolError> {
        self.check_kind(&spec.kind)?;
        if let Some(id) = &spec.id {
            self.check_name("resource id", id)?;
        }
        if !spec.host.is_empty() {
            self.check_name("host", &spec.host)?;
        }
        if spec.capacity.is_zero() {
            return Err(malformed(
                &format!("capacity 0 of {}", spec.kind),
                "there is at least something of a resource",
            ));
        }
        if !spec.divisible && !spec.capacity.is_whole() {
            let what = format!("capacity {} of {}", spec.capacity, spec.kind);
            return Err(malformed(&what, "what is not divisible has whole units"));
        }
        self.check_standstill(spec)?;
        self.check_attributes(spec.attributes.keys())?;
        self.check_size(spec)
    }
}

/// Checks that a session may delete a resource, by id or by requirement: its own, and those that belong to no session. `None` may delete anything.
fn may_delete(resource: &Resource, session: Option<&SessionId>) -> Result<(), PoolError> {
    match (&resource.owner, session) {
        (Some(owner), Some(caller)) => check_owner(|| format!("resource `{}`", resource.description.id), owner, caller),
        _ => Ok(()),
    }
}
