//! Groups of waiting requests: those whose requirements select the same resources form a group, and groups whose resources may
//! overlap (of one kind) a family. A change of a resource touches only the groups that it fits (`changed.rs`).

use crate::id::Slot;
use crate::pool::Pool;
use crate::queue::{Place, Waiter};
use crate::resource::{Description, Resource, Units};
use crate::resources::Resources;
use ratn_model::resource::{Quantity, Requirement, ResourceOperation};
use ratn_model::versioned;
use std::collections::BTreeSet;
use std::sync::Arc;

/// What a requirement selects, in bytes.
pub(crate) type Key = Arc<[u8]>;

/// Waiters that want the same.
#[derive(Debug, Clone)]
pub(crate) struct Group {
    pub(crate) selector: Requirement,
    pub(crate) family: Arc<str>,
    /// Hopeful ones that lack something of the family.
    pub(crate) wanting: BTreeSet<Place>,
    /// Everybody in it, by how much they want.
    pub(crate) by_amount: BTreeSet<(Quantity, Place)>,
    /// Those of them with several requirements in the family, and those who want parts of units: for these it is not enough to count.
    pub(crate) several: BTreeSet<Place>,
    /// Those of them for whom what exists would not do, and who lack something of it.
    pub(crate) lacking: BTreeSet<Place>,
    /// Requirements in it.
    pub(crate) members: usize,
    /// How much there is, held or not.
    pub(crate) existing: Quantity,
    /// How many of the resources that fit are divisible. With some it is enough to count for nobody: parts of two are no whole unit.
    pub(crate) divisible: usize,
    /// Those of which something is free, and some that were, where not simply every resource of the kind fits.
    pub(crate) free: Option<BTreeSet<Slot>>,
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
    /// Requirements in it of those of whom it is to be found out whether what exists would do.
    pub(crate) doubtful: usize,
}

/// A resource before or after a change.
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

    /// Whether it knows how much exists for it, and everything of which something is free.
    pub(crate) fn knows(&self, resources: &Resources) -> bool {
        let known = |(slot, _)| self.free.as_ref().is_none_or(|free| free.contains(&slot));
        self.existing == resources.quantity(&self.selector)
            && self.divisible == resources.divisible(&self.selector)
            && resources.free(&self.selector).all(known)
    }

    /// Whether there is nothing left of what fits, beside what is reserved; and how many resources were looked at.
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

    /// Takes a waiter from the queue and its groups. What it had reserved is free for others, unless it gets that.
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

    /// A waiter reserves nothing and wants nothing, though it stays.
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
            // Without one who lacked it, others may reserve what is free.
            let freed = !units.is_empty() && !granted;
            if freed || ((wanted || granted) && self.limits.overtaken > 0) {
                self.queue.mark(&family, false);
            }
            self.unreserve(units, &family);
        }
    }
}
