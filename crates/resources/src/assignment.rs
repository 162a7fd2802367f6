//! Which resources serve which requirement: a maximum assignment, so that a request that can be served is.
//!
//! Requirements take greedily; where that falls short and several requirements fit the same resources (`PathPlanner` beside
//! `PathPlanner{host: a}`), amounts are moved between them along augmenting paths (Ford and Fulkerson).
//! A requirement of whole units takes whole units of each resource; only of divisible ones it may be less.

use crate::group::takes;
use crate::id::Slot;
use crate::resource::{Resource, Units};
use crate::resources::Resources;
use ratn_model::resource::{Quantity, Requirement, ResourceOperation};
use std::collections::BTreeSet;

/// How far the requirements of one request can be served.
#[derive(Debug)]
pub(crate) struct Assignment {
    /// Per requirement, what it gets (nothing for `exists`).
    pub(crate) taken: Vec<Units>,
    /// Per requirement, what is missing.
    pub(crate) missing: Vec<Quantity>,
}

/// What counts as available.
#[derive(Clone, Copy)]
pub(crate) enum Available<'a> {
    /// What is free without what is reserved.
    Free(&'a Units),
    /// As [`Available::Free`], for a waiter that has some of the reserved itself.
    FreeTo(&'a Units, &'a [Units]),
    /// Everything that exists and is not consumed, whoever holds it.
    Existing,
}

impl Assignment {
    pub(crate) fn is_complete(&self) -> bool {
        self.missing.iter().all(|amount| amount.is_zero())
    }

    /// The maximum assignment of what is available to the requirements.
    pub(crate) fn of(resources: &Resources, available: Available<'_>, requirements: &[&Requirement]) -> Assignment {
        let mut search = Search {
            resources,
            available,
            requirements,
            taken: vec![Units::new(); requirements.len()],
            used: Units::new(),
        };
        let mut missing = vec![Quantity::ZERO; requirements.len()];
        for (index, requirement) in requirements.iter().enumerate() {
            missing[index] = match requirement.operation {
                ResourceOperation::Exists => requirement.count.saturating_sub(resources.quantity(requirement)),
                _ => search.greedy(index),
            };
        }
        for (index, amount) in missing.iter_mut().enumerate() {
            if takes(requirements[index]) && requirements.iter().filter(|other| takes(other)).count() > 1 {
                while !amount.is_zero() {
                    let moved = search.augment(index, *amount, grain(requirements[index]), &mut BTreeSet::new());
                    if moved.is_zero() {
                        break;
                    }
                    *amount = amount.saturating_sub(moved);
                }
            }
        }
        Assignment { taken: search.taken, missing }
    }
}

struct Search<'a> {
    resources: &'a Resources,
    available: Available<'a>,
    requirements: &'a [&'a Requirement],
    taken: Vec<Units>,
    used: Units,
}

impl<'a> Search<'a> {
    /// What is left of a resource, in multiples of `grain`.
    fn left(&self, slot: Slot, resource: &Resource, grain: Quantity) -> Quantity {
        let used = self.used.get(&slot).copied().unwrap_or_default();
        let of = |units: &Units| units.get(&slot).copied().unwrap_or_default();
        let left = match self.available {
            Available::Existing => resource.quantity(),
            Available::Free(reserved) => resource.free().saturating_sub(of(reserved)),
            Available::FreeTo(reserved, own) => {
                let of_others = own.iter().fold(of(reserved), |left, own| left.saturating_sub(of(own)));
                resource.free().saturating_sub(of_others)
            }
        };
        left.saturating_sub(used).floor_to(grain)
    }

    fn take(&mut self, index: usize, slot: Slot, amount: Quantity) {
        *self.used.entry(slot).or_default() += amount;
        *self.taken[index].entry(slot).or_default() += amount;
    }

    fn give_back(&mut self, index: usize, slot: Slot, amount: Quantity) {
        for units in [&mut self.used, &mut self.taken[index]] {
            if let Some(left) = units.get_mut(&slot) {
                *left = left.saturating_sub(amount);
                if left.is_zero() {
                    units.remove(&slot);
                }
            }
        }
    }

    fn candidates(&self, index: usize) -> Box<dyn Iterator<Item = (Slot, &'a Resource)> + 'a> {
        let requirements: &'a [&'a Requirement] = self.requirements;
        match self.available {
            Available::Existing => Box::new(self.resources.fitting(requirements[index])),
            Available::Free(_) | Available::FreeTo(..) => Box::new(self.resources.free(requirements[index])),
        }
    }

    /// Takes what is there; returns what is missing.
    fn greedy(&mut self, index: usize) -> Quantity {
        let requirement = self.requirements[index];
        let (mut wanted, grain) = (requirement.count, grain(requirement));
        for (slot, resource) in self.candidates(index) {
            if wanted.is_zero() {
                break;
            }
            if grain < Quantity::ONE && !resource.description.divisible {
                continue;
            }
            let amount = self.left(slot, resource, grain).min(wanted);
            if !amount.is_zero() {
                self.take(index, slot, amount);
                wanted = wanted.saturating_sub(amount);
            }
        }
        wanted
    }

    /// Up to `wanted` more for a requirement, if need be by moving another requirement to another resource. Returns how much.
    fn augment(&mut self, index: usize, wanted: Quantity, grain: Quantity, visited: &mut BTreeSet<Slot>) -> Quantity {
        let fitting: Vec<(Slot, &Resource)> = self
            .candidates(index)
            .filter(|(_, resource)| {
                self::grain(self.requirements[index]) == Quantity::ONE || resource.description.divisible
            })
            .collect();
        for (slot, resource) in &fitting {
            let amount = self.left(*slot, resource, grain).min(wanted).floor_to(grain);
            if !amount.is_zero() {
                self.take(index, *slot, amount);
                return amount;
            }
        }
        for (slot, _) in fitting {
            if !visited.insert(slot) {
                continue;
            }
            for other in 0..self.requirements.len() {
                let Some(held) = self.taken[other].get(&slot).copied().filter(|_| other != index) else { continue };
                let grain = grain.max(self::grain(self.requirements[other]));
                let moved = self.augment(other, held.min(wanted).floor_to(grain), grain, visited);
                if !moved.is_zero() {
                    self.give_back(other, slot, moved);
                    self.take(index, slot, moved);
                    return moved;
                }
            }
        }
        Quantity::ZERO
    }
}

/// Whole units, unless a part of one is asked for.
fn grain(requirement: &Requirement) -> Quantity {
    if requirement.count.is_whole() { Quantity::ONE } else { Quantity::from_thousandths(1) }
}
