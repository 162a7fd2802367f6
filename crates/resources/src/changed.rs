//! Changes of resources, and the waiting requests that they may help.
//!
//! Each group of a family knows how much exists for it and how much of that is free. A change of a resource affects every group that the resource
//! fits, and a family may have thousands of groups. So a change is only noted; turns settle the notes: a few resources of one family for all groups
//! of the family at a time, within the turn's work limit, and family by family. While a family has notes, its resources are not shared out, and no
//! waiter of it is served.
//!
//! What a grant takes is not noted: no group gains by it, and a group itself finds out that a resource has nothing left ([`Group::exhausted`]).

use crate::group::{Family, Group, Seen};
use crate::id::{Slot, WaiterId};
use crate::pool::Pool;
use crate::queue::{Place, Queue, Waiter};
use crate::resources::Resources;
use crate::turn::Turn;
use ratn_model::resource::Quantity;
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Bound;
use std::sync::Arc;

/// The changed resources by family, each as the family's groups know it; `None` if it was not of the family.
#[derive(Debug, Clone, Default)]
pub(crate) struct Touched {
    families: BTreeMap<Arc<str>, BTreeMap<Slot, Option<Seen>>>,
    /// The family that was settled last; the one after it is next.
    settled: Option<Arc<str>>,
}

/// A resource, and what the groups know about it.
type Noted = (Slot, Option<Seen>);
/// The same, with its present state.
type Change = (Slot, Option<Seen>, Option<Seen>);

/// After every place.
const LAST: Place = (Turn::LAST, WaiterId(u64::MAX));

impl Touched {
    pub(crate) fn is_empty(&self) -> bool {
        self.families.is_empty()
    }

    pub(crate) fn is_in(&self, family: &str) -> bool {
        self.families.contains_key(family)
    }

    /// The family no longer exists.
    pub(crate) fn forget(&mut self, family: &str) {
        self.families.remove(family);
    }

    /// Gives a new group the same knowledge as the others of its family.
    pub(crate) fn as_before(&self, resources: &Resources, group: &mut Group) {
        for (slot, before) in self.families.get(&group.family).into_iter().flatten() {
            let now = resources.get(*slot).map(Seen::of);
            let step = Step::of(resources, group, now.as_ref(), before.as_ref());
            step.count(*slot, group);
        }
    }

    /// Takes some resources of the next family: as many as cost at most `work` for all its groups, and at least one.
    fn next(&mut self, families: &BTreeMap<Arc<str>, Family>, work: usize) -> Option<(Arc<str>, Vec<Noted>)> {
        let behind = self.settled.as_ref().map_or(Bound::Unbounded, Bound::Excluded);
        let mut next = self.families.range::<Arc<str>, _>((behind, Bound::Unbounded));
        let family = next.next().map(|(family, _)| family).or_else(|| self.families.keys().next())?.clone();
        let groups = families.get(&family).map_or(0, |family| family.groups.len());
        let most = (work / groups.max(1)).max(1);
        let slots = self.families.get_mut(&family)?;
        let some = (0..most).map_while(|_| slots.pop_first()).collect();
        if slots.is_empty() {
            self.families.remove(&family);
        }
        self.settled = Some(family.clone());
        Some((family, some))
    }
}

/// The effect of one changed resource on one group: what fits of it, before and after.
#[derive(Clone, Copy)]
struct Step {
    free: (Quantity, Quantity),
    quantity: (Quantity, Quantity),
    divisible: (bool, bool),
}

impl Step {
    fn of(resources: &Resources, group: &Group, before: Option<&Seen>, after: Option<&Seen>) -> Step {
        let fits = |seen: &&Seen| group.fits(resources, &seen.description);
        let fitting = before.filter(fits);
        let same =
            matches!((before, after), (Some(one), Some(other)) if Arc::ptr_eq(&one.description, &other.description));
        let fitting = (fitting, if same { after.filter(|_| fitting.is_some()) } else { after.filter(fits) });
        let amounts =
            |seen: Option<&Seen>| seen.map_or((Quantity::ZERO, Quantity::ZERO), |seen| (seen.free, seen.quantity));
        let divisible = |seen: Option<&Seen>| seen.is_some_and(|seen| seen.description.divisible);
        let divisible = (divisible(fitting.0), divisible(fitting.1));
        let (before, after) = (amounts(fitting.0), amounts(fitting.1));
        Step { free: (before.0, after.0), quantity: (before.1, after.1), divisible }
    }

    fn count(self, slot: Slot, group: &mut Group) {
        group.existing = group.existing.saturating_sub(self.quantity.0) + self.quantity.1;
        group.divisible = (group.divisible + usize::from(self.divisible.1)).saturating_sub(self.divisible.0.into());
        if let Some(slots) = &mut group.free {
            if self.free.1.is_zero() {
                slots.remove(&slot);
            } else {
                slots.insert(slot);
            }
        }
    }
}

impl Queue {
    /// Notes a change of a resource for the groups of its family.
    pub(crate) fn touch(&mut self, slot: Slot, before: Option<&Seen>, after: Option<&Seen>, family: &str) {
        let Some((name, _)) = self.families.get_key_value(family) else { return };
        let (name, reserved) = (name.clone(), self.reserved.get(&slot).copied().unwrap_or_default());
        let same =
            matches!((before, after), (Some(one), Some(other)) if Arc::ptr_eq(&one.description, &other.description));
        let (free_before, free) = (before.map_or(Quantity::ZERO, |b| b.free), after.map_or(Quantity::ZERO, |a| a.free));
        // Waiters that have reserved this resource may have to use something else.
        if reserved > free || (!same && !reserved.is_zero()) {
            self.changed.insert(name.clone(), true);
        }
        let quantity = |seen: Option<&Seen>| seen.map(|seen| seen.quantity);
        if !same || quantity(before) != quantity(after) || free > free_before {
            self.touched.families.entry(name).or_default().entry(slot).or_insert_with(|| before.cloned());
        }
    }
}

impl Pool {
    /// Tells the groups of one family about some of its changed resources; false if there is nothing left.
    pub(crate) fn settle(&mut self) -> bool {
        let queue = &mut self.queue;
        let Some((name, slots)) = queue.touched.next(&queue.families, self.enough / 8) else { return false };
        let Some(family) = queue.families.get(&name) else { return true };
        self.worked += slots.len() * family.groups.len();
        let now = |slot: &Slot| {
            let known = self.resources.get(*slot);
            known.filter(|known| self.resources.family(&known.description.kind) == &*name).map(Seen::of)
        };
        let changes: Vec<Change> = slots.into_iter().map(|(slot, before)| (slot, before, now(&slot))).collect();
        let mut told = Told::default();
        for key in &family.groups {
            let Some(group) = queue.groups.get_mut(key) else { continue };
            told.tell(&self.resources, &queue.waiters, group, &changes);
        }
        queue.demand_changed |= told.other && !queue.hopeless.is_empty();
        told.concerned.into_iter().for_each(|place| queue.doubt(place));
        if told.more_is_free {
            queue.mark(&name, false);
        }
        true
    }
}

/// The effect on the groups that were told of changes.
#[derive(Default)]
struct Told {
    /// More is free of something that fits one of them.
    more_is_free: bool,
    /// There is more or less of something that fits one of them.
    other: bool,
    /// Waiters that may become hopeful, or stop being hopeful.
    concerned: BTreeSet<Place>,
}

impl Told {
    fn tell(
        &mut self,
        resources: &Resources,
        waiters: &BTreeMap<WaiterId, Waiter>,
        group: &mut Group,
        changes: &[Change],
    ) {
        let was = group.existing;
        let (mut other, mut parts) = (false, group.divisible > 0);
        for (slot, before, after) in changes {
            let step = Step::of(resources, group, before.as_ref(), after.as_ref());
            step.count(*slot, group);
            self.more_is_free |= step.free.1 > step.free.0;
            other |= step.quantity.0 != step.quantity.1 || step.divisible.0 != step.divisible.1;
        }
        parts |= group.divisible > 0;
        if !other {
            return;
        }
        self.other = true;
        // For waiters with several requirements in the family, and with fractions of units, counting is not enough.
        self.concerned.extend(&group.several);
        if parts {
            self.concerned.extend(group.by_amount.iter().map(|(_, place)| *place));
            return;
        }
        let (low, high) = (was.min(group.existing), was.max(group.existing));
        let between = group.by_amount.range((Bound::Excluded((low, LAST)), Bound::Included((high, LAST))));
        // An increase makes waiters hopeful, a decrease makes them hopeless.
        let hopeful = was > group.existing;
        let matters = |place: &Place| waiters.get(&place.1).is_some_and(|waiter| waiter.hopeful == hopeful);
        self.concerned.extend(between.map(|(_, place)| *place).filter(matters));
    }
}

impl Pool {
    /// Whether the groups without notes know the true amounts.
    pub(crate) fn groups_agree(&self) -> Result<(), String> {
        for group in self.queue.groups.values().filter(|group| !self.queue.touched.is_in(&group.family)) {
            if !group.knows(&self.resources) {
                return Err("a group does not know what there is".to_owned());
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
