//! Assigns resources to requirements: a maximum assignment, so that every request that can be served is served.
//!
//! Requirements take greedily, in order, from the resources that fit. If some of them lack something and several requirements fit the same resources
//! (`PathPlanner` beside `PathPlanner{host: a}`), amounts are moved by a maximum flow (`flow.rs`). The nodes of the flow are not resources but
//! signatures: all resources that the same requirements fit are one node, with their total amount. Moved amounts are placed again on the resources of
//! those nodes.
//!
//! A requirement of whole units takes whole units of each resource; only a divisible resource can be taken in parts. The work grows with the number
//! of resources that the requirements select, times the number of requirements.

mod flow;

use crate::group::takes;
use crate::id::Slot;
use crate::resource::{Resource, Units};
use crate::resources::Resources;
use flow::Flow;
use ratn_model::resource::{Quantity, Requirement, ResourceOperation};
use std::cell::Cell;
use std::iter::Peekable;

/// How far the requirements of one request can be served.
#[derive(Debug)]
pub(crate) struct Assignment {
    /// For each requirement, the units that it gets (none for `exists`).
    pub(crate) taken: Vec<Units>,
    /// For each requirement, the missing amount.
    pub(crate) missing: Vec<Quantity>,
    /// Number of resources examined for it, including those that do not fit.
    pub(crate) looked_at: usize,
}

/// What counts as available.
#[derive(Clone, Copy)]
pub(crate) enum Available<'a> {
    /// The free units without the reserved ones.
    Free(&'a Units),
    /// As [`Available::Free`], for a waiter that has reserved some of the units itself.
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
        Assignment::among(resources, available, requirements, None)
    }

    /// The same for one requirement and one resource.
    pub(crate) fn of_one(
        resources: &Resources,
        available: Available<'_>,
        requirement: &Requirement,
        resource: Slot,
    ) -> Assignment {
        Assignment::among(resources, available, &[requirement], Some(resource))
    }

    fn among(
        resources: &Resources,
        available: Available<'_>,
        requirements: &[&Requirement],
        alone: Option<Slot>,
    ) -> Assignment {
        let looked_at = Cell::new(0);
        let mut search = Search {
            resources,
            available,
            alone,
            classes: classes(requirements),
            taken: vec![Units::new(); requirements.len()],
            missing: vec![Quantity::ZERO; requirements.len()],
            looked_at: &looked_at,
        };
        for (index, requirement) in requirements.iter().enumerate() {
            if requirement.operation == ResourceOperation::Exists {
                search.missing[index] = requirement.count.saturating_sub(resources.quantity(requirement));
                let fits_every = resources.fits_every(requirement);
                looked_at.update(|sum| sum + if fits_every { 1 } else { resources.count(&requirement.kind) });
            }
        }
        search.greedy(requirements);
        search.rearrange(requirements);
        Assignment { taken: search.taken, missing: search.missing, looked_at: looked_at.get() }
    }
}

/// Requirements with the same selector and the same grain: for them all resources are alike.
struct Class<'a> {
    selector: &'a Requirement,
    grain: Quantity,
    /// The requirements, by index.
    members: Vec<usize>,
}

struct Search<'a> {
    resources: &'a Resources,
    available: Available<'a>,
    /// Only this resource, if set.
    alone: Option<Slot>,
    classes: Vec<Class<'a>>,
    taken: Vec<Units>,
    missing: Vec<Quantity>,
    looked_at: &'a Cell<usize>,
}

type Candidates<'a> = Box<dyn Iterator<Item = (Slot, &'a Resource)> + 'a>;

impl<'a> Search<'a> {
    /// Each requirement takes what is available, in order.
    fn greedy(&mut self, requirements: &[&Requirement]) {
        let class_of = |index: usize| self.classes.iter().position(|class| class.members.contains(&index));
        let classes: Vec<Option<usize>> = (0..requirements.len()).map(class_of).collect();
        // A resource that one requirement has emptied or cannot use is not examined again for the next one of its class.
        let candidates = self.classes.iter().map(|class| self.candidates(class).peekable());
        let mut candidates: Vec<Peekable<Candidates<'a>>> = candidates.collect();
        let (alone, mut used) = (self.classes.len() == 1, Units::new());
        for (index, class) in classes.into_iter().enumerate() {
            let Some(class) = class else { continue };
            let (grain, mut wanted) = (self.classes[class].grain, requirements[index].count);
            while !wanted.is_zero() {
                let Some((slot, resource)) = candidates[class].peek().copied() else { break };
                let left = self.available(slot, resource);
                let left = left.saturating_sub(used.get(&slot).copied().unwrap_or_default()).floor_to(grain);
                let amount = left.min(wanted);
                if !amount.is_zero() {
                    *self.taken[index].entry(slot).or_default() += amount;
                    wanted = wanted.saturating_sub(amount);
                }
                if amount == left {
                    candidates[class].next();
                }
                // With a single class no other requirement examines the resource, so an emptied one need not be counted.
                if !amount.is_zero() && (amount < left || !alone) {
                    *used.entry(slot).or_default() += amount;
                }
            }
            self.missing[index] = wanted;
        }
    }

    /// Moves amounts that others took, if a requirement lacks something and they can have it elsewhere.
    fn rearrange(&mut self, requirements: &[&Requirement]) {
        let lacking = |class: &Class<'_>| class.members.iter().any(|index| !self.missing[*index].is_zero());
        let family = |class: &Class<'a>| self.resources.family(&class.selector.kind);
        let short: Vec<&str> = self.classes.iter().filter(|class| lacking(class)).map(family).collect();
        let touched = |class: &&Class<'a>| short.contains(&family(class));
        let classes: Vec<&Class<'a>> = self.classes.iter().filter(touched).collect();
        if classes.len() < 2 {
            return;
        }
        let mut flow = Flow::new(classes.iter().map(|class| class.grain).collect());
        for (at, class) in classes.iter().enumerate() {
            for (slot, resource) in self.candidates(class) {
                flow.fits(at, slot, self.available(slot, resource));
            }
        }
        flow.seal();
        for (at, class) in classes.iter().enumerate() {
            for index in &class.members {
                self.taken[*index].iter().for_each(|(slot, amount)| flow.has(at, *slot, *amount));
                flow.wants(at, self.missing[*index]);
            }
        }
        let members: Vec<Vec<usize>> = classes.iter().map(|class| class.members.clone()).collect();
        if !flow.improve() {
            return;
        }
        self.place(requirements, &flow, &members);
    }

    /// Places moved amounts on the resources of their nodes; the rest stays where it was taken.
    fn place(&mut self, requirements: &[&Requirement], flow: &Flow, members: &[Vec<usize>]) {
        for index in members.iter().flatten() {
            self.taken[*index].retain(|slot, _| !flow.is_changed_at(*slot));
            let stays: Quantity = self.taken[*index].values().copied().sum();
            self.missing[*index] = requirements[*index].count.saturating_sub(stays);
        }
        for node in flow.changed() {
            let mut left = flow.members(node).to_vec();
            for (class, amount) in flow.shares(node) {
                self.place_share(&members[class], flow.grain(class), amount, &mut left);
            }
        }
    }

    /// Places an amount for the requirements of one class on the resources of one node; `left` is what is left of each.
    fn place_share(&mut self, members: &[usize], grain: Quantity, amount: Quantity, left: &mut [(Slot, Quantity)]) {
        let (mut amount, mut resources) = (amount, left.iter_mut());
        let mut at = resources.next();
        for index in members {
            while let Some((slot, left)) = &mut at {
                let share = left.floor_to(grain).min(amount).min(self.missing[*index]);
                if !share.is_zero() {
                    *self.taken[*index].entry(*slot).or_default() += share;
                    self.missing[*index] = self.missing[*index].saturating_sub(share);
                    amount = amount.saturating_sub(share);
                    *left = left.saturating_sub(share);
                }
                if self.missing[*index].is_zero() || amount.is_zero() {
                    break;
                }
                at = resources.next();
            }
        }
    }

    /// The amount of a resource that is available to the whole request.
    fn available(&self, slot: Slot, resource: &Resource) -> Quantity {
        let of = |units: &Units| units.get(&slot).copied().unwrap_or_default();
        match self.available {
            Available::Existing => resource.quantity(),
            _ if self.resources.is_kept_back(resource) => Quantity::ZERO,
            Available::Free(reserved) => resource.free().saturating_sub(of(reserved)),
            Available::FreeTo(reserved, own) => {
                let of_others = own.iter().fold(of(reserved), |left, own| left.saturating_sub(of(own)));
                resource.free().saturating_sub(of_others)
            }
        }
    }

    fn candidates(&self, class: &Class<'a>) -> Candidates<'a> {
        let kind = &class.selector.kind;
        let of_kind: Candidates<'a> = match self.available {
            _ if let Some(slot) = self.alone => {
                let is_of_kind = |one: &&Resource| self.resources.kinds().is_a(&one.description.kind, kind);
                Box::new(self.resources.get(slot).filter(is_of_kind).map(|one| (slot, one)).into_iter())
            }
            Available::Existing => Box::new(self.resources.all_of(kind)),
            Available::Free(_) | Available::FreeTo(..) => Box::new(self.resources.free_of(kind)),
        };
        let (looked_at, selector) = (self.looked_at, class.selector);
        let of_kind = of_kind.inspect(|_| looked_at.update(|sum| sum + 1));
        let fitting = Box::new(of_kind.filter(|(_, resource)| resource.description.fits(selector)));
        if class.grain == Quantity::ONE {
            return fitting;
        }
        Box::new(fitting.filter(|(_, resource)| resource.description.divisible))
    }
}

/// The requirements that take something, grouped by selector and grain.
fn classes<'a>(requirements: &[&'a Requirement]) -> Vec<Class<'a>> {
    let mut classes: Vec<Class<'a>> = Vec::new();
    for (index, requirement) in requirements.iter().enumerate().filter(|(_, requirement)| takes(requirement)) {
        let grain = grain(requirement);
        let same = |class: &&mut Class<'a>| class.grain == grain && selects_the_same(class.selector, requirement);
        match classes.iter_mut().find(same) {
            Some(class) => class.members.push(index),
            None => classes.push(Class { selector: requirement, grain, members: vec![index] }),
        }
    }
    classes
}

/// Whether two requirements fit the same resources.
pub(crate) fn selects_the_same(one: &Requirement, other: &Requirement) -> bool {
    one.kind == other.kind
        && one.class == other.class
        && one.attributes == other.attributes
        && one.conditions == other.conditions
}

/// The smallest amount that is taken: whole units, unless a part of a unit is asked for.
pub(crate) fn grain(requirement: &Requirement) -> Quantity {
    if requirement.count.is_whole() { Quantity::ONE } else { Quantity::from_thousandths(1) }
}
