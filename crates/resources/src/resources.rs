//! All resources by slot, and the indices that find them: by id, by kind, and the free ones of a kind.
//!
//! A slot is a small number that a resource keeps for its life; the lowest vacant one is used next, so the same history gives the same slots. Every
//! change of a resource goes through [`Resources::change`], which updates the indices.

use crate::id::{SessionId, Slot};
use crate::kinds::Kinds;
use crate::resource::{Description, Resource};
use ratn_model::resource::{Quantity, Requirement};
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Bound;

/// See the module.
#[derive(Debug, Clone, Default)]
pub(crate) struct Resources {
    kinds: Kinds,
    /// Maximum number of leases that may hold units of one resource; `None` for no limit.
    max_holders: Option<usize>,
    /// Ending sessions: what they provide is no longer given to anybody.
    closing: BTreeSet<SessionId>,
    slots: Vec<Option<Resource>>,
    vacant: BTreeSet<Slot>,
    by_id: BTreeMap<Box<str>, Slot>,
    by_kind: BTreeMap<Box<str>, OfKind>,
}

/// A position among the resources of a kind and its subclasses: the index of the kind, and the slot.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct OfKinds {
    kind: usize,
    slot: Slot,
}

/// The resources of one kind.
#[derive(Debug, Clone, Default)]
struct OfKind {
    all: BTreeSet<Slot>,
    /// The free ones, in the order in which they are given away: first those that match few other requests.
    free: BTreeSet<(usize, Slot)>,
    /// The amount that exists, held or not.
    quantity: Quantity,
    /// The number of divisible ones.
    divisible: usize,
}

impl Resources {
    pub(crate) fn kinds(&self) -> &Kinds {
        &self.kinds
    }

    pub(crate) fn set_kinds(&mut self, kinds: Kinds) {
        self.kinds = kinds;
    }

    pub(crate) fn set_max_holders(&mut self, holders: usize) {
        self.max_holders = Some(holders);
    }

    /// No longer gives what this session provides to anybody.
    pub(crate) fn close(&mut self, provider: &SessionId) {
        self.closing.insert(provider.clone());
    }

    /// The session has been removed completely.
    pub(crate) fn closed(&mut self, provider: &SessionId) {
        self.closing.remove(provider);
    }

    /// Whether nobody can get more of a resource: the maximum number of leases hold it, or its provider is ending.
    pub(crate) fn is_kept_back(&self, resource: &Resource) -> bool {
        self.max_holders.is_some_and(|most| resource.holders.len() >= most) || self.is_closing(resource)
    }

    /// Whether the provider of one of these is ending.
    pub(crate) fn is_any_closing<'a>(&self, mut slots: impl Iterator<Item = &'a Slot>) -> bool {
        !self.closing.is_empty() && slots.any(|slot| self.get(*slot).is_some_and(|resource| self.is_closing(resource)))
    }

    fn is_closing(&self, resource: &Resource) -> bool {
        !self.closing.is_empty() && resource.owner.as_ref().is_some_and(|owner| self.closing.contains(owner))
    }

    pub(crate) fn len(&self) -> usize {
        self.by_id.len()
    }

    pub(crate) fn get(&self, slot: Slot) -> Option<&Resource> {
        self.slots.get(slot.index()).and_then(Option::as_ref)
    }

    pub(crate) fn find(&self, id: &str) -> Option<Slot> {
        self.by_id.get(id).copied()
    }

    /// The slot for the next new resource.
    pub(crate) fn next_slot(&self) -> Slot {
        self.vacant.first().copied().unwrap_or_else(|| Slot::new(self.slots.len()))
    }

    /// False if the slot or the id is taken.
    pub(crate) fn insert(&mut self, slot: Slot, resource: Resource) -> bool {
        if self.get(slot).is_some() || self.by_id.contains_key(resource.description.id.as_str()) {
            return false;
        }
        while self.slots.len() <= slot.index() {
            self.vacant.insert(Slot::new(self.slots.len()));
            self.slots.push(None);
        }
        self.vacant.remove(&slot);
        self.by_id.insert(resource.description.id.as_str().into(), slot);
        let kind = resource.description.kind.as_str();
        if !self.by_kind.contains_key(kind) {
            self.by_kind.insert(kind.into(), OfKind::default());
        }
        if let Some(of_kind) = self.by_kind.get_mut(kind) {
            of_kind.all.insert(slot);
            of_kind.quantity += resource.quantity();
            of_kind.divisible += usize::from(resource.description.divisible);
            if !resource.free().is_zero() {
                of_kind.free.insert((special(&resource), slot));
            }
        }
        self.slots[slot.index()] = Some(resource);
        true
    }

    pub(crate) fn remove(&mut self, slot: Slot) -> Option<Resource> {
        let resource = self.slots.get_mut(slot.index())?.take()?;
        self.vacant.insert(slot);
        self.by_id.remove(resource.description.id.as_str());
        let kind = resource.description.kind.as_str();
        if let Some(of_kind) = self.by_kind.get_mut(kind) {
            of_kind.all.remove(&slot);
            of_kind.quantity = of_kind.quantity.saturating_sub(resource.quantity());
            of_kind.divisible -= usize::from(resource.description.divisible);
            of_kind.free.remove(&(special(&resource), slot));
            if of_kind.all.is_empty() {
                self.by_kind.remove(kind);
            }
        }
        Some(resource)
    }

    /// Changes a resource; its kind and id must not change.
    pub(crate) fn change<T>(&mut self, slot: Slot, change: impl FnOnce(&mut Resource) -> T) -> Option<T> {
        let resource = self.slots.get_mut(slot.index())?.as_mut()?;
        let key = |resource: &Resource| (!resource.free().is_zero()).then(|| (special(resource), slot));
        let amount = |resource: &Resource| (resource.quantity(), usize::from(resource.description.divisible));
        let (before, was) = (key(resource), amount(resource));
        let changed = change(resource);
        let (after, is) = (key(resource), amount(resource));
        if (before != after || was != is)
            && let Some(of_kind) = self.by_kind.get_mut(resource.description.kind.as_str())
        {
            of_kind.quantity = of_kind.quantity.saturating_sub(was.0) + is.0;
            of_kind.divisible = of_kind.divisible - was.1 + is.1;
            before.map(|key| of_kind.free.remove(&key));
            of_kind.free.extend(after);
        }
        Some(changed)
    }

    /// All resources, ordered by id.
    pub(crate) fn iter(&self) -> impl Iterator<Item = (Slot, &Resource)> {
        self.by_id.values().filter_map(|slot| self.get(*slot).map(|resource| (*slot, resource)))
    }

    /// The resources after an id, ordered by id.
    pub(crate) fn after<'a>(&'a self, id: &'a str) -> impl Iterator<Item = (Slot, &'a Resource)> + 'a {
        let behind = (Bound::Excluded(id), Bound::Unbounded);
        self.by_id.range::<str, _>(behind).filter_map(|(_, slot)| self.get(*slot).map(|resource| (*slot, resource)))
    }

    pub(crate) fn has_kind(&self, kind: &str) -> bool {
        self.kinds.subclasses(kind).any(|kind| self.by_kind.contains_key(kind))
    }

    /// The number of resources of a kind and its subclasses.
    pub(crate) fn count(&self, kind: &str) -> usize {
        self.of(kind).map(|of_kind| of_kind.all.len()).sum()
    }

    /// The resources that match a requirement, ordered by slot; subclasses last.
    pub(crate) fn fitting<'a>(
        &'a self,
        requirement: &'a Requirement,
    ) -> impl Iterator<Item = (Slot, &'a Resource)> + 'a {
        self.all_of(&requirement.kind).filter(|(_, resource)| resource.description.fits(requirement))
    }

    /// The matching resources with free units, in the order in which they are given away.
    pub(crate) fn free<'a>(&'a self, requirement: &'a Requirement) -> impl Iterator<Item = (Slot, &'a Resource)> + 'a {
        self.free_of(&requirement.kind).filter(|(_, resource)| resource.description.fits(requirement))
    }

    /// All resources of a kind and its subclasses, matching or not, in the order of [`Resources::fitting`].
    pub(crate) fn all_of<'a>(&'a self, kind: &'a str) -> impl Iterator<Item = (Slot, &'a Resource)> + 'a {
        self.present(self.of(kind).flat_map(|of_kind| &of_kind.all))
    }

    /// The same, after a position.
    pub(crate) fn all_of_after<'a>(
        &'a self,
        kind: &'a str,
        after: Option<OfKinds>,
    ) -> impl Iterator<Item = (OfKinds, &'a Resource)> + 'a {
        let first = after.map_or(0, |after| after.kind);
        let kinds = self.kinds.subclasses(kind).enumerate().skip(first);
        kinds.flat_map(move |(kind, name)| {
            let behind = after.filter(|after| after.kind == kind).map_or(Bound::Unbounded, |a| Bound::Excluded(a.slot));
            let slots = self.by_kind.get(name).map(|of_kind| of_kind.all.range((behind, Bound::Unbounded)));
            let slots = slots.into_iter().flatten();
            slots.filter_map(move |slot| Some((OfKinds { kind, slot: *slot }, self.get(*slot)?)))
        })
    }

    /// The resources of a kind and its subclasses with free units, in the order of [`Resources::free`].
    pub(crate) fn free_of<'a>(&'a self, kind: &'a str) -> impl Iterator<Item = (Slot, &'a Resource)> + 'a {
        self.present(self.of(kind).flat_map(|of_kind| of_kind.free.iter().map(|(_, slot)| slot)))
    }

    fn present<'a>(
        &'a self,
        slots: impl Iterator<Item = &'a Slot> + 'a,
    ) -> impl Iterator<Item = (Slot, &'a Resource)> + 'a {
        slots.filter_map(|slot| self.get(*slot).map(|resource| (*slot, resource)))
    }

    /// The indices of a kind and of its subclasses.
    fn of<'a>(&'a self, kind: &'a str) -> impl Iterator<Item = &'a OfKind> + 'a {
        self.kinds.subclasses(kind).filter_map(|kind| self.by_kind.get(kind))
    }

    /// The family of a kind: kinds of different families share no resource.
    pub(crate) fn family<'a>(&'a self, kind: &'a str) -> &'a str {
        self.kinds.family(kind)
    }

    /// Whether a resource with that description matches a requirement.
    pub(crate) fn fits(&self, description: &Description, requirement: &Requirement) -> bool {
        self.kinds.is_a(&description.kind, &requirement.kind) && description.fits(requirement)
    }

    /// Whether every resource of the kind matches.
    pub(crate) fn fits_every(&self, requirement: &Requirement) -> bool {
        requirement.class.is_none() && requirement.attributes.is_empty() && requirement.conditions.is_empty()
    }

    /// The matching amount that exists, held or not, without what is consumed.
    pub(crate) fn quantity(&self, requirement: &Requirement) -> Quantity {
        if self.fits_every(requirement) {
            return self.of(&requirement.kind).map(|of_kind| of_kind.quantity).sum();
        }
        self.fitting(requirement).map(|(_, resource)| resource.quantity()).sum()
    }

    /// The number of matching divisible resources.
    pub(crate) fn divisible(&self, requirement: &Requirement) -> usize {
        if self.fits_every(requirement) {
            return self.of(&requirement.kind).map(|of_kind| of_kind.divisible).sum();
        }
        self.fitting(requirement).filter(|(_, resource)| resource.description.divisible).count()
    }

    /// Whether the indices match the resources.
    pub(crate) fn index_agrees(&self) -> bool {
        let indexed: usize = self.by_kind.values().map(|of_kind| of_kind.all.len()).sum();
        let free: usize = self.by_kind.values().map(|of_kind| of_kind.free.len()).sum();
        let present = self.slots.iter().filter(|slot| slot.is_some()).count();
        let really_free = self.slots.iter().flatten().filter(|resource| !resource.free().is_zero()).count();
        let quantity: Quantity = self.by_kind.values().map(|of_kind| of_kind.quantity).sum();
        present == self.by_id.len()
            && quantity == self.slots.iter().flatten().map(Resource::quantity).sum::<Quantity>()
            && self.by_kind.values().all(|of_kind| {
                let divisible = of_kind.all.iter().filter_map(|slot| self.get(*slot));
                of_kind.divisible == divisible.filter(|resource| resource.description.divisible).count()
            })
            && present == indexed
            && free == really_free
            && self.vacant.len() + present == self.slots.len()
            && self.iter().all(|(slot, resource)| {
                self.by_kind.get(resource.description.kind.as_str()).is_some_and(|of_kind| {
                    of_kind.all.contains(&slot)
                        && of_kind.free.contains(&(special(resource), slot)) != resource.free().is_zero()
                })
            })
    }
}

/// A resource with more attributes alone can satisfy more requests: it is given away last, which keeps most options open.
fn special(resource: &Resource) -> usize {
    resource.description.attributes.iter().len()
}
