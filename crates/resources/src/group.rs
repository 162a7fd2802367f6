//! Who waits for what: waiters whose requirements select the same resources form a group, and groups whose resources may
//! overlap (of one kind) a family. A change of a resource touches the groups that it fits and nobody else.

use crate::id::Slot;
use crate::pool::Pool;
use crate::queue::{Place, Queue, Waiter};
use crate::resource::{Description, Resource, Units};
use crate::resources::Resources;
use ratn_model::resource::{Quantity, Requirement, ResourceOperation};
use ratn_model::versioned;
use std::collections::BTreeSet;
use std::ops::Bound;
use std::sync::Arc;

/// What a requirement selects, in bytes.
pub(crate) type Key = Arc<[u8]>;

/// Waiters that want the same.
#[derive(Debug, Clone)]
pub(crate) struct Group {
    selector: Requirement,
    pub(crate) family: Arc<str>,
    /// Hopeful ones that lack something of the family.
    pub(crate) wanting: BTreeSet<Place>,
    /// Everybody in it, by how much they want.
    by_amount: BTreeSet<(Quantity, Place)>,
    /// Those of them with several requirements in the family: for these it is not enough to count.
    several: BTreeSet<Place>,
    /// Requirements in it.
    pub(crate) members: usize,
    /// How much there is, held or not.
    existing: Quantity,
    /// Of which of them something is free, where not simply every resource of the kind fits.
    free: Option<BTreeSet<Slot>>,
}

/// Groups that may want the same resources.
#[derive(Debug, Clone, Default)]
pub(crate) struct Family {
    pub(crate) groups: BTreeSet<Key>,
    /// Hopeful ones that take something of it.
    pub(crate) takers: BTreeSet<Place>,
    /// Those of them that have reserved some.
    pub(crate) reserving: BTreeSet<Place>,
    /// Those that must not be overtaken any more: they and all before them reserve.
    pub(crate) strict: BTreeSet<Place>,
}

/// A resource before or after a change.
#[derive(Debug, Clone)]
pub(crate) struct Seen {
    description: Arc<Description>,
    free: Quantity,
    quantity: Quantity,
}

pub(crate) fn key(requirement: &Requirement) -> Key {
    let selector = Requirement { operation: ResourceOperation::Block, count: Quantity::ZERO, ..requirement.clone() };
    versioned::encode(0, &selector).into()
}

pub(crate) fn takes(requirement: &Requirement) -> bool {
    matches!(requirement.operation, ResourceOperation::Block | ResourceOperation::Consume)
}

impl Seen {
    pub(crate) fn of(resource: &Resource) -> Seen {
        Seen { description: resource.description.clone(), free: resource.free(), quantity: resource.quantity() }
    }
}

impl Group {
    fn new(resources: &Resources, requirement: &Requirement, family: Arc<str>) -> Group {
        let selector = requirement.clone();
        let free = (!resources.fits_every(&selector))
            .then(|| resources.free(&selector).map(|(slot, _)| slot).collect::<BTreeSet<Slot>>());
        let existing = resources.quantity(&selector);
        let (wanting, by_amount, several) = Default::default();
        Group { selector, family, wanting, by_amount, several, members: 0, existing, free }
    }

    pub(crate) fn fits(&self, resources: &Resources, description: &Description) -> bool {
        resources.fits(description, &self.selector)
    }

    /// Whether there is nothing left of what fits, beside what is reserved; and how many resources were looked at.
    pub(crate) fn exhausted(&self, resources: &Resources, reserved: &Units) -> (bool, usize) {
        let mut looked_at = 0;
        let mut left = |slot: &Slot| {
            looked_at += 1;
            let free = resources.get(*slot).map(Resource::free).unwrap_or_default();
            free > reserved.get(slot).copied().unwrap_or_default()
        };
        let some = match &self.free {
            Some(free) => free.iter().any(left),
            None => resources.free(&self.selector).any(|(slot, _)| left(&slot)),
        };
        (!some, looked_at)
    }
}

impl Queue {
    /// Keeps the groups right when a resource changes. What is taken for a grant was reserved or free for it: `granted`.
    pub(crate) fn touched(
        &mut self,
        resources: &Resources,
        slot: Slot,
        before: Option<&Seen>,
        after: Option<&Seen>,
        granted: bool,
    ) {
        if self.families.is_empty() {
            return;
        }
        let Some(some) = after.or(before) else { return };
        let Some((name, family)) = self.families.get_key_value(resources.family(&some.description.kind)) else {
            return;
        };
        for key in &family.groups {
            let Some(group) = self.groups.get_mut(key) else { continue };
            let fitting = |seen: Option<&Seen>| {
                let seen = seen.filter(|seen| resources.fits(&seen.description, &group.selector));
                seen.map_or((Quantity::ZERO, Quantity::ZERO), |seen| (seen.free, seen.quantity))
            };
            let ((free_before, before), (free, quantity)) = (fitting(before), fitting(after));
            if let Some(slots) = &mut group.free {
                if free.is_zero() {
                    slots.remove(&slot);
                } else {
                    slots.insert(slot);
                }
            }
            let was = group.existing;
            group.existing = was.saturating_sub(before) + quantity;
            if was != group.existing {
                self.demand_changed |= !self.hopeless.is_empty();
                // Those to whom it makes a difference; of parts of units every one.
                let (low, high) = (was.min(group.existing), was.max(group.existing));
                let last = (Bound::Excluded((low, LAST)), Bound::Included((high, LAST)));
                let range = if some.description.divisible { (Bound::Unbounded, Bound::Unbounded) } else { last };
                let (waiters, more) = (&self.waiters, group.existing > was);
                // More makes hopeful who is not, and less the other way.
                let concerned = |place: &&Place| waiters.get(&place.1).is_some_and(|waiter| waiter.hopeful != more);
                let by_amount = group.by_amount.range(range).map(|(_, place)| place);
                self.doubtful.extend(by_amount.chain(&group.several).filter(concerned).copied());
            }
            if free > free_before {
                self.changed.entry(name.clone()).or_default();
                self.shared_until.remove(name);
            } else if free < free_before && !granted {
                self.changed.insert(name.clone(), true);
            }
        }
    }
}

/// Behind every place.
const LAST: Place = (std::cmp::Reverse(i64::MIN), crate::id::WaiterId(u64::MAX));

impl Pool {
    /// Puts a waiter into the queue and its groups.
    pub(crate) fn join(&mut self, id: crate::id::WaiterId, waiter: Waiter) {
        let place = waiter.place(id);
        let mut families: Vec<Arc<str>> = Vec::new();
        for (requirement, key) in waiter.request.requirements.iter().zip(&waiter.groups) {
            let family: Arc<str> = match self.queue.groups.get(key) {
                Some(group) => group.family.clone(),
                None => {
                    let name = self.resources.family(&requirement.kind);
                    let known = self.queue.families.get_key_value(name);
                    let name = known.map_or_else(|| name.into(), |(name, _)| name.clone());
                    let group = Group::new(&self.resources, requirement, Arc::clone(&name));
                    self.queue.groups.insert(key.clone(), group);
                    self.queue.families.entry(name.clone()).or_default().groups.insert(key.clone());
                    name
                }
            };
            families.push(family);
        }
        for (index, (requirement, key)) in waiter.request.requirements.iter().zip(&waiter.groups).enumerate() {
            let Some(group) = self.queue.groups.get_mut(key) else { continue };
            group.members += 1;
            group.by_amount.insert((requirement.count, place));
            if families.iter().filter(|family| **family == families[index]).count() > 1 {
                group.several.insert(place);
            }
        }
        self.queue.order.insert(place);
        self.queue.waiters.insert(id, waiter);
        self.queue.doubtful.insert(place);
    }

    /// Takes a waiter from the queue and its groups. What it had reserved is free for others.
    pub(crate) fn part(&mut self, id: crate::id::WaiterId) -> Option<Waiter> {
        self.give_up(id);
        let waiter = self.queue.waiters.remove(&id)?;
        let place = waiter.place(id);
        self.queue.order.remove(&place);
        self.queue.ready.remove(&place);
        self.queue.doubtful.remove(&place);
        self.queue.demand_changed |= self.queue.hopeless.remove(&place);
        for (requirement, key) in waiter.request.requirements.iter().zip(&waiter.groups) {
            let Some(group) = self.queue.groups.get_mut(key) else { continue };
            group.by_amount.remove(&(requirement.count, place));
            group.several.remove(&place);
            group.members -= 1;
            if group.members > 0 {
                continue;
            }
            let Some(group) = self.queue.groups.remove(key) else { continue };
            if let Some(family) = self.queue.families.get_mut(&group.family) {
                family.groups.remove(key);
                if family.groups.is_empty() {
                    self.queue.families.remove(&group.family);
                    self.queue.changed.remove(&group.family);
                    self.queue.shared_until.remove(&group.family);
                }
            }
        }
        Some(waiter)
    }

    /// A waiter reserves nothing and wants nothing, though it stays.
    pub(crate) fn give_up(&mut self, id: crate::id::WaiterId) {
        let Some(waiter) = self.queue.waiters.get_mut(&id) else { return };
        let place = waiter.place(id);
        let reserved: Vec<Units> = waiter.reserved.iter_mut().map(std::mem::take).collect();
        waiter.hopeful = false;
        let groups = waiter.groups.clone();
        self.queue.ready.remove(&place);
        for (key, units) in groups.iter().zip(reserved) {
            let Some(group) = self.queue.groups.get_mut(key) else { continue };
            let wanted = group.wanting.remove(&place);
            let family = group.family.clone();
            if let Some(family) = self.queue.families.get_mut(&family) {
                family.takers.remove(&place);
                family.reserving.remove(&place);
                family.strict.remove(&place);
            }
            // Without one who lacked it, others may reserve what is free.
            if !units.is_empty() || (wanted && self.limits.overtaken > 0) {
                self.queue.mark(&family, false);
            }
            units.into_iter().for_each(|(slot, amount)| self.queue.unreserve(slot, amount));
        }
    }
}
