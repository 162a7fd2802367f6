//! Groups of waiting requests: requirements that select the same resources form a group, and groups whose resources may overlap (in kinds) form a
//! family. A change of a resource affects only the groups that it fits (`changed.rs`).

use crate::id::Slot;
use crate::pool::Pool;
use crate::queue::{Place, Waiter};
use crate::resource::{Description, Resource, Units};
use crate::resources::Resources;
use ratn_model::resource::{Quantity, Requirement, ResourceOperation};
use ratn_model::versioned;
use std::collections::BTreeSet;
use std::sync::Arc;

/// The selector of a requirement, in bytes.
pub(crate) type Key = Arc<[u8]>;

/// Waiters with the same selector.
#[derive(Debug, Clone)]
pub(crate) struct Group {
    pub(crate) selector: Requirement,
    pub(crate) family: Arc<str>,
    /// Hopeful waiters that lack something of the family.
    pub(crate) wanting: BTreeSet<Place>,
    /// All waiters, ordered by the amount that they want.
    pub(crate) by_amount: BTreeSet<(Quantity, Place)>,
    /// Waiters with several requirements in the family, or that want fractions of units: for these, counting is not enough.
    pub(crate) several: BTreeSet<Place>,
    /// Waiters that existing resources would not satisfy, and that lack something of this group.
    pub(crate) lacking: BTreeSet<Place>,
    /// The number of requirements in it.
    pub(crate) members: usize,
    /// The amount that exists, held or not.
    pub(crate) existing: Quantity,
    /// The number of divisible resources that fit. If there are any, counting is enough for no waiter: fractions of two units make no whole unit.
    pub(crate) divisible: usize,
    /// The resources that are free, and some that were; `None` if every resource of the kind fits.
    pub(crate) free: Option<BTreeSet<Slot>>,
}

/// Groups that may want the same resources.
#[derive(Debug, Clone, Default)]
pub(crate) struct Family {
    pub(crate) groups: BTreeSet<Key>,
    /// Hopeful waiters that take units of the family.
    pub(crate) takers: BTreeSet<Place>,
    /// Those of them that have reserved units.
    pub(crate) reserving: BTreeSet<Place>,
    /// Those of them that must not be overtaken any more: they and all before them reserve.
    pub(crate) strict: BTreeSet<Place>,
    /// The number of requirements in it whose waiters have to be re-examined.
    pub(crate) doubtful: usize,
}

/// The state of a resource before or after a change.
#[derive(Debug, Clone)]
pub(crate) struct Seen {
    pub(crate) description: Arc<Description>,
    pub(crate) free: Quantity,
    pub(crate) quantity: Quantity,
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
        let (existing, divisible) = (resources.quantity(&selector), resources.divisible(&selector));
        let (wanting, by_amount, several, lacking) = Default::default();
        Group { selector, family, wanting, by_amount, several, lacking, members: 0, existing, divisible, free }
    }

    pub(crate) fn fits(&self, resources: &Resources, description: &Description) -> bool {
        resources.fits(description, &self.selector)
    }

    /// Whether the group knows how much exists for it, and all its free resources.
    pub(crate) fn knows(&self, resources: &Resources) -> bool {
        let known = |(slot, _)| self.free.as_ref().is_none_or(|free| free.contains(&slot));
        self.existing == resources.quantity(&self.selector)
            && self.divisible == resources.divisible(&self.selector)
            && resources.free(&self.selector).all(known)
    }

    /// Whether nothing that fits is left besides reservations; and the number of resources that were read.
    pub(crate) fn exhausted(&mut self, resources: &Resources, reserved: &Units) -> (bool, usize) {
        let (mut looked_at, mut taken) = (0, Vec::new());
        let mut left = |slot: &Slot| {
            looked_at += 1;
            let free = resources.get(*slot).map(Resource::free).unwrap_or_default();
            if free.is_zero() {
                taken.push(*slot);
            }
            free > reserved.get(slot).copied().unwrap_or_default()
        };
        let some = match &self.free {
            Some(free) => free.iter().any(left),
            None => resources.free(&self.selector).any(|(slot, _)| left(&slot)),
        };
        if let Some(free) = &mut self.free {
            for slot in &taken {
                free.remove(slot);
            }
        }
        (!some, looked_at)
    }
}

impl Pool {
    /// Adds a waiter to the queue and its groups.
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
                    let mut group = Group::new(&self.resources, requirement, Arc::clone(&name));
                    self.queue.touched.as_before(&self.resources, &mut group);
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
            let in_family = families.iter().filter(|family| **family == families[index]).count();
            if in_family > 1 || !requirement.count.is_whole() {
                group.several.insert(place);
            }
        }
        self.queue.order.insert(place);
        self.queue.waiters.insert(id, waiter);
        self.queue.doubt(place);
    }

    /// Removes a waiter from the queue and its groups. Its reservations are free for others, unless they are granted to it.
    pub(crate) fn part(&mut self, id: crate::id::WaiterId, granted: bool) -> Option<Waiter> {
        self.stop_wanting(id, granted);
        let place = self.queue.get(id)?.place(id);
        self.queue.doubt_no_more(place);
        self.queue.demand_changed |= self.queue.set_hopeless(place, false);
        let waiter = self.queue.waiters.remove(&id)?;
        self.queue.order.remove(&place);
        self.queue.ready.remove(&place);
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
                    self.queue.touched.forget(&group.family);
                    self.queue.changed.remove(&group.family);
                    self.queue.shared_until.remove(&group.family);
                }
            }
        }
        Some(waiter)
    }

    /// A waiter gives up its reservations and wants nothing, but stays in the queue.
    pub(crate) fn give_up(&mut self, id: crate::id::WaiterId) {
        self.stop_wanting(id, false);
    }

    fn stop_wanting(&mut self, id: crate::id::WaiterId, granted: bool) {
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
            // One waiter less lacks it, so others may reserve what is free.
            let freed = !units.is_empty() && !granted;
            if freed || ((wanted || granted) && self.limits.overtaken > 0) {
                self.queue.mark(&family, false);
            }
            self.unreserve(units, &family);
        }
    }
}
