//! Every resource by its slot, and what finds them: by id, by kind, the free ones of a kind.
//!
//! A slot is a small number that a resource keeps for its life; the lowest vacant one is given next, so the same history
//! gives the same slots. Every change of a resource goes through [`Resources::change`], which keeps the indices right.

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
    /// More leases than these do not hold some of one resource; none where nothing is said.
    max_holders: Option<usize>,
    /// Sessions that end: what they provide is given to nobody any more.
    closing: BTreeSet<SessionId>,
    slots: Vec<Option<Resource>>,
    vacant: BTreeSet<Slot>,
    by_id: BTreeMap<Box<str>, Slot>,
    by_kind: BTreeMap<Box<str>, OfKind>,
}

/// A place among the resources of a kind and of those below it: which of the kinds, and which resource.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct OfKinds {
    kind: usize,
    slot: Slot,
}

/// The resources of one kind.
#[derive(Debug, Clone, Default)]
struct OfKind {
    all: BTreeSet<Slot>,
    /// Those of which something is free, in the order in which they are given away: first what is like few others ask for.
    free: BTreeSet<(usize, Slot)>,
    /// How much of them there is, held or not.
    quantity: Quantity,
    /// How many of them are divisible.
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

    /// What a session provides is given to nobody any more.
    pub(crate) fn close(&mut self, provider: &SessionId) {
        self.closing.insert(provider.clone());
    }

    /// Nothing of a session is left.
    pub(crate) fn closed(&mut self, provider: &SessionId) {
        self.closing.remove(provider);
    }

    /// Whether nobody can have more of a resource: as many leases hold some of it as may, or its provider ends.
    pub(crate) fn is_kept_back(&self, resource: &Resource) -> bool {
        self.max_holders.is_some_and(|most| resource.holders.len() >= most) || self.is_closing(resource)
    }

    /// Whether the provider of one of these ends.
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

    /// The slot that the next new resource gets.
    pub(crate) fn next_slot(&self) -> Slot {
        self.vacant.first().copied().unwrap_or_else(|| Slot::new(self.slots.len()))
    }

    /// False where the slot or the id is taken already.
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

    /// Changes a resource; its kind and id stay.
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

    /// In the order of ids.
    pub(crate) fn iter(&self) -> impl Iterator<Item = (Slot, &Resource)> {
        self.by_id.values().filter_map(|slot| self.get(*slot).map(|resource| (*slot, resource)))
    }

    /// Those behind an id, in the order of ids.
    pub(crate) fn after<'a>(&'a self, id: &'a str) -> impl Iterator<Item = (Slot, &'a Resource)> + 'a {
        let behind = (Bound::Excluded(id), Bound::Unbounded);
        self.by_id.range::<str, _>(behind).filter_map(|(_, slot)| self.get(*slot).map(|resource| (*slot, resource)))
    }

    pub(crate) fn has_kind(&self, kind: &str) -> bool {
        self.kinds.subclasses(kind).any(|kind| self.by_kind.contains_key(kind))
    }

    /// How many resources there are of a kind and of the kinds below it.
    pub(crate) fn count(&self, kind: &str) -> usize {
        self.of(kind).map(|of_kind| of_kind.all.len()).sum()
    }

    /// Those that a requirement can be met with, in the order of slots; those of subclasses last.
    pub(crate) fn fitting<'a>(
        &'a self,
        requirement: &'a Requirement,
    ) -> impl Iterator<Item = (Slot, &'a Resource)> + 'a {
        self.all_of(&requirement.kind).filter(|(_, resource)| resource.description.fits(requirement))
    }

    /// Those of them of which something is free, in the order in which they are given away.
    pub(crate) fn free<'a>(&'a self, requirement: &'a Requirement) -> impl Iterator<Item = (Slot, &'a Resource)> + 'a {
        self.free_of(&requirement.kind).filter(|(_, resource)| resource.description.fits(requirement))
    }

    /// All of a kind and of the kinds below it, whether they fit or not, in the order of [`Resources::fitting`].
    pub(crate) fn all_of<'a>(&'a self, kind: &'a str) -> impl Iterator<Item = (Slot, &'a Resource)> + 'a {
        self.present(self.of(kind).flat_map(|of_kind| &of_kind.all))
    }

    /// The same, behind a place.
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

    /// Those of them of which something is free, in the order of [`Resources::free`].
    pub(crate) fn free_of<'a>(&'a self, kind: &'a str) -> impl Iterator<Item = (Slot, &'a Resource)> + 'a {
        self.present(self.of(kind).flat_map(|of_kind| of_kind.free.iter().map(|(_, slot)| slot)))
    }

    fn present<'a>(
        &'a self,
        slots: impl Iterator<Item = &'a Slot> + 'a,
    ) -> impl Iterator<Item = (Slot, &'a Resource)> + 'a {
        slots.filter_map(|slot| self.get(*slot).map(|resource| (*slot, resource)))
    }

    /// What there is of a kind and of the kinds below it.
    fn of<'a>(&'a self, kind: &'a str) -> impl Iterator<Item = &'a OfKind> + 'a {
        self.kinds.subclasses(kind).filter_map(|kind| self.by_kind.get(kind))
    }

    /// The family of a kind: kinds of different families have no resource in common.
    pub(crate) fn family<'a>(&'a self, kind: &'a str) -> &'a str {
        self.kinds.family(kind)
    }

    /// Whether a requirement can be met with a resource of that description.
    pub(crate) fn fits(&self, description: &Description, requirement: &Requirement) -> bool {
        self.kinds.is_a(&description.kind, &requirement.kind) && description.fits(requirement)
    }

    /// Whether every resource of the kind fits.
    pub(crate) fn fits_every(&self, requirement: &Requirement) -> bool {
        requirement.class.is_none() && requirement.attributes.is_empty() && requirement.conditions.is_empty()
    }

    /// How much of what fits exists, held or not, what is consumed excluded.
    pub(crate) fn quantity(&self, requirement: &Requirement) -> Quantity {
        if self.fits_every(requirement) {
            return self.of(&requirement.kind).map(|of_kind| of_kind.quantity).sum();
        }
        self.fitting(requirement).map(|(_, resource)| resource.quantity()).sum()
    }

    /// How many of what fits are divisible.
    pub(crate) fn divisible(&self, requirement: &Requirement) -> usize {
        if self.fits_every(requirement) {
            return self.of(&requirement.kind).map(|of_kind| of_kind.divisible).sum();
        }
        self.fitting(requirement).filter(|(_, resource)| resource.description.divisible).count()
    }

    /// Whether the indices say the same as the resources do.
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

/// The more attributes, the more requests it alone can meet: it is given away last, which keeps most options open.
fn special(resource: &Resource) -> usize {
    resource.description.attributes.iter().len()
}
