//! Scheduling: which waiting requests are served now.
//!
//! Waiters are served in order. A waiter that cannot be served yet, but could be if holders released, reserves every free unit that it would take:
//! later waiters do not get these, so it is not overtaken more often than [`crate::Limits::overtaken`] allows (until then it reserves nothing, and a
//! later waiter passes only if it is served thereby). A waiter that asks for more than exists reserves nothing, because a missing kind would block
//! everybody else.
//!
//! Families are independent, so the reservations of a waiter in one family do not depend on others: free units go to the first waiter of the family
//! that lacks them. A family is shared out anew only if the order is disturbed (a more urgent waiter arrives, a reserved unit is gone). The work is
//! proportional to the waiters that get something.
//!
//! One turn reads a limited number of resources (`expiry.rs`), plus those of one waiter; the rest is postponed to the next turn, which
//! [`Pool::next_deadline`] requests immediately. Families take turns, and a family that is behind blocks no other. Until all changes of a family are
//! settled, nobody is served past its waiters; only a waiter that also waits for another family that is behind may be passed.

use crate::assignment::{Assignment, Available};
use crate::group::{Key, takes};
use crate::id::{Slot, WaiterId};
use crate::pool::Pool;
use crate::queue::{Place, Waiter};
use crate::resource::{Resource, Units};
use ratn_model::resource::{Quantity, Requirement};
use std::collections::BTreeSet;
use std::ops::Bound;
use std::sync::Arc;

impl Pool {
    /// Grants everything that can be granted.
    pub(crate) fn schedule(&mut self) {
        self.queue.unserved = false;
        loop {
            self.settle_firsts();
            self.catch_up();
            let Some(id) = self.next_served() else { return };
            if self.has_done_enough() {
                self.queue.unserved = true;
                return;
            }
            let Some(waiter) = self.queue.get(id) else { return };
            let taken = waiter.reserved.clone();
            self.ended(taken.iter().map(|units| units.len()).sum::<usize>().max(1));
            self.grant(id, taken);
        }
    }

    /// Settles changes, as far as possible in this turn. Not all of a turn is used for notifying groups, so that time is left for re-examining
    /// waiters and for sharing out.
    fn catch_up(&mut self) {
        while self.worked < self.enough / 8 * 5 && self.settle() {}
        while self.worked < self.enough / 4 * 3
            && let Some(place) = self.queue.next_doubtful()
        {
            self.reconsider(place);
        }
        while !self.has_done_enough()
            && let Some((family, anew)) = self.next_changed()
        {
            self.share_out(&family, anew);
        }
    }

    /// The next family in which something became free and all changes are settled.
    fn next_changed(&mut self) -> Option<(Arc<str>, bool)> {
        let behind = self.queue.shared.clone().map_or(Bound::Unbounded, Bound::Excluded);
        let changed = &self.queue.changed;
        let mut looked_at = 0;
        let mut known = |(family, _): &(&Arc<str>, &bool)| {
            looked_at += 1;
            let doubtful = self.queue.families.get(*family).is_some_and(|family| family.doubtful > 0);
            !doubtful && !self.queue.touched.is_in(family)
        };
        let next = changed.range::<Arc<str>, _>((behind, Bound::Unbounded)).find(&mut known);
        let next = next.or_else(|| changed.iter().find(&mut known)).map(|(family, anew)| (family.clone(), *anew));
        self.worked += looked_at;
        let (family, anew) = next?;
        self.queue.changed.remove(&family);
        self.queue.shared = Some(family.clone());
        Some((family, anew))
    }

    /// The first waiter that lacks nothing and may be granted now.
    fn next_served(&self) -> Option<WaiterId> {
        if !self.may_grant() {
            return None;
        }
        let may_have = |place: &&Place| {
            let Some(waiter) = self.queue.get(place.1) else { return false };
            let session = self.sessions.get(&waiter.request.session);
            session.is_some_and(|session| self.may_grant_to(session))
                && self.queue.is_certain(**place)
                // Reserved before the provider ended; the resource is going to be deleted.
                && !self.resources.is_any_closing(waiter.reserved.iter().flat_map(|units| units.keys()))
        };
        self.queue.ready.iter().find(may_have).map(|(_, id)| *id)
    }

    /// What a request can get immediately: all of it, or `None`. No earlier waiter waits for any of it.
    pub(crate) fn at_once(&self, place: Place, requirements: &[Requirement]) -> Option<Vec<Units>> {
        let behind = |requirement: &Requirement| self.queue.is_behind_in(self.resources.family(&requirement.kind));
        if !self.may_grant() || requirements.iter().any(behind) || self.is_before_others(place, requirements) {
            return None;
        }
        let requirements: Vec<&Requirement> = requirements.iter().collect();
        let assignment = Assignment::of(&self.resources, Available::Free(&self.queue.reserved), &requirements);
        assignment.is_complete().then_some(assignment.taken)
    }

    /// Whether a later waiter waits for something of these requirements, and may have reserved what belongs to this one.
    pub(crate) fn is_before_others(&self, place: Place, requirements: &[Requirement]) -> bool {
        let others = |requirement: &Requirement| {
            let family = self.queue.families.get(self.resources.family(&requirement.kind));
            family.and_then(|family| family.takers.last()).is_some_and(|taker| *taker > place)
        };
        requirements.iter().filter(|r| takes(r)).any(others)
    }

    /// Re-examines whether existing resources could satisfy a waiter.
    fn reconsider(&mut self, place: Place) {
        let Some(waiter) = self.queue.waiters.get_mut(&place.1) else { return };
        let requirements: Vec<&Requirement> = waiter.request.requirements.iter().collect();
        let assignment = Assignment::of(&self.resources, Available::Existing, &requirements);
        self.worked += 1 + assignment.looked_at;
        let hopeful = assignment.is_complete();
        waiter.missing = if hopeful { Vec::new() } else { assignment.missing };
        waiter.kept = waiter.kept.filter(|_| hopeful);
        self.queue.demand_changed |= self.queue.set_hopeless(place, !hopeful) || !hopeful;
        let Some(waiter) = self.queue.waiters.get(&place.1) else { return };
        if hopeful == waiter.hopeful {
            return;
        }
        if !hopeful {
            self.give_up(place.1);
            self.competes_no_more(place.1);
            return;
        }
        let taken: Vec<bool> = waiter.request.requirements.iter().map(takes).collect();
        let (groups, since) = (waiter.groups.clone(), waiter.kept.unwrap_or(self.now));
        let since = self.not_before_served(&waiter.request, since);
        let strict = self.limits.overtaken > 0 && waiter.overtaken >= self.limits.overtaken;
        let mut lacks = BTreeSet::new();
        for (key, _) in groups.iter().zip(taken).filter(|(_, takes)| *takes) {
            let Some(group) = self.queue.groups.get_mut(key) else { continue };
            group.wanting.insert(place);
            let name = group.family.clone();
            if let Some(family) = self.queue.families.get_mut(&name) {
                family.takers.insert(place);
                if strict {
                    family.strict.insert(place);
                }
                let disturbs = family.reserving.last().is_some_and(|behind| *behind > place);
                self.queue.mark(&name, disturbs);
            }
            lacks.insert(name);
        }
        if lacks.is_empty() {
            self.queue.ready.insert(place);
        }
        if let Some(waiter) = self.queue.waiters.get_mut(&place.1) {
            (waiter.hopeful, waiter.lacks, waiter.hopeful_since, waiter.since) = (true, lacks, self.now, since);
        }
        self.competes(place.1);
        self.queue.growth.look_later(self.now, &self.queue.provided);
    }

    /// Gives free units of a family to the waiters that lack them, in order; continues where an earlier turn stopped.
    fn share_out(&mut self, family: &Arc<str>, anew: bool) {
        if self.turns_anew(family) {
            self.queue.mark(family, anew);
            return;
        }
        let Some(known) = self.queue.families.get_mut(family) else { return };
        let stopped_at = self.queue.shared_until.remove(family).filter(|_| !anew);
        if anew {
            for place in std::mem::take(&mut known.reserving) {
                self.worked += 1;
                self.take_back(place, family);
                if self.limits.overtaken > 0 {
                    self.take_back_elsewhere(place, family);
                }
            }
        }
        let Some(known) = self.queue.families.get(family) else { return };
        let behind = stopped_at.map_or(Bound::Unbounded, Bound::Included);
        let first = |key: &Key| {
            let next = self.queue.groups.get(key)?.wanting.range((behind, Bound::Unbounded)).next();
            next.map(|place| (*place, key.clone()))
        };
        let mut heads: BTreeSet<(Place, Key)> = known.groups.iter().filter_map(first).collect();
        self.worked += known.groups.len();
        // At least one waiter is processed each time, and other families get their turn.
        let most = self.enough.min(self.worked + self.enough / 8);
        let mut before = None;
        while let Some((place, key)) = heads.pop_first() {
            if self.worked >= most && before.is_some() && before != Some(place) {
                self.queue.mark(family, false);
                self.queue.shared_until.insert(family.clone(), place);
                return;
            }
            let Some(group) = self.queue.groups.get_mut(&key) else { continue };
            let (exhausted, looked_at) = group.exhausted(&self.resources, &self.queue.reserved);
            self.worked += 1 + looked_at;
            if exhausted {
                continue;
            }
            let next = group.wanting.range((Bound::Excluded(place), Bound::Unbounded)).next();
            heads.extend(next.map(|next| (*next, key)));
            if before != Some(place) {
                self.attempt(place, family);
                before = Some(place);
            }
        }
    }

    /// A waiter that passed others because it would be served immediately, and is not, gives back what it passed them for.
    fn take_back_elsewhere(&mut self, place: Place, family: &Arc<str>) {
        let Some(waiter) = self.queue.get(place.1) else { return };
        let of = |key: &Key| self.queue.groups.get(key).map(|group| group.family.clone());
        let others: BTreeSet<Arc<str>> = waiter.groups.iter().filter_map(of).filter(|other| other != family).collect();
        for other in others {
            let Some(known) = self.queue.families.get_mut(&other) else { continue };
            if known.reserving.remove(&place) {
                self.take_back(place, &other);
                self.queue.mark(&other, false);
            }
        }
    }

    /// Releases a waiter's reservations in a family, which it then lacks.
    fn take_back(&mut self, place: Place, family: &Arc<str>) {
        let Some(waiter) = self.queue.waiters.get_mut(&place.1) else { return };
        let mut freed = Vec::new();
        for (index, key) in waiter.groups.iter().enumerate() {
            let Some(group) = self.queue.groups.get_mut(key).filter(|group| group.family == *family) else { continue };
            if takes(&waiter.request.requirements[index]) {
                group.wanting.insert(place);
                freed.extend(std::mem::take(&mut waiter.reserved[index]));
            }
        }
        waiter.lacks.insert(family.clone());
        self.queue.ready.remove(&place);
        self.unreserve(freed, family);
    }

    /// Frees reservations in a family. The slot of a deleted resource may have a resource of another family by now, which the reservation has hidden
    /// from the waiters of that family: these are examined again.
    pub(crate) fn unreserve(&mut self, units: impl IntoIterator<Item = (Slot, Quantity)>, family: &str) {
        for (slot, amount) in units {
            self.queue.unreserve(slot, amount);
            let of = self.resources.get(slot).map(|resource| self.resources.family(&resource.description.kind));
            let other = of.filter(|of| *of != family).and_then(|of| self.queue.families.get_key_value(of));
            if let Some(other) = other.map(|(name, _)| name.clone()) {
                self.queue.mark(&other, false);
            }
        }
    }

    /// Reserves what a waiter lacks in a family, as far as it is free and no earlier waiter is passed for long.
    fn attempt(&mut self, place: Place, family: &Arc<str>) {
        self.take_back(place, family);
        let Some(known) = self.queue.families.get_mut(family) else { return };
        known.reserving.remove(&place);
        let kept = self.limits.overtaken == 0 || known.strict.last().is_some_and(|last| place <= *last);
        let passes = self.passes(place, family);
        let Some(waiter) = self.queue.get(place.1) else { return };
        let (indices, assignment) = self.assigned(waiter, family);
        self.worked += assignment.looked_at;
        let complete = assignment.is_complete();
        if (complete && !passes) || (!complete && kept) {
            let missing = assignment.missing.clone();
            self.reserve(place, family, &indices, assignment);
            self.reserve_parts(place, family, indices.into_iter().zip(missing));
        }
        if complete && self.limits.overtaken > 0 {
            self.reserve_all(place);
        }
    }

    /// Whether an earlier waiter lacks units of the family and reserves nothing: free units pass it. They go only to a waiter that gets everything it
    /// lacks, and so is served immediately. If they were reserved for longer, two waiters could wait for each other, one reserving what the other
    /// lacks.
    fn passes(&self, place: Place, family: &Arc<str>) -> bool {
        if self.limits.overtaken == 0 {
            return false;
        }
        let Some(family) = self.queue.families.get(family) else { return false };
        let from = family.strict.last().map_or(Bound::Unbounded, |last| Bound::Excluded(*last));
        let between = |key: &Key| self.queue.groups.get(key)?.wanting.range((from, Bound::Unbounded)).next();
        family.groups.iter().filter_map(between).any(|other| *other < place)
    }

    /// Reserves what a waiter lacks in every family, if all of it is free.
    fn reserve_all(&mut self, place: Place) {
        let Some(waiter) = self.queue.get(place.1) else { return };
        let mut found = Vec::new();
        for family in &waiter.lacks {
            // Freed units go to earlier waiters first; then this one is examined again.
            if self.queue.changed.contains_key(family) {
                return;
            }
            let (indices, assignment) = self.assigned(waiter, family);
            if !assignment.is_complete() || indices.iter().any(|index| !waiter.reserved[*index].is_empty()) {
                return;
            }
            found.push((family.clone(), indices, assignment));
        }
        for (family, indices, assignment) in found {
            self.reserve(place, &family, &indices, assignment);
        }
    }

    /// What a waiter could get of a family now, besides reservations; and the indices of the requirements.
    pub(crate) fn assigned(&self, waiter: &Waiter, family: &Arc<str>) -> (Vec<usize>, Assignment) {
        let of_family = |key: &Key| self.queue.groups.get(key).is_some_and(|group| group.family == *family);
        let indices: Vec<usize> = (0..waiter.groups.len())
            .filter(|index| takes(&waiter.request.requirements[*index]) && of_family(&waiter.groups[*index]))
            .collect();
        let requirements: Vec<&Requirement> =
            indices.iter().map(|index| &waiter.request.requirements[*index]).collect();
        let available = Available::Free(&self.queue.reserved);
        let assignment = Assignment::of(&self.resources, available, &requirements);
        (indices, assignment)
    }

    fn reserve(&mut self, place: Place, family: &Arc<str>, indices: &[usize], assignment: Assignment) {
        let Some(waiter) = self.queue.waiters.get_mut(&place.1) else { return };
        let complete = assignment.is_complete();
        let mut some = false;
        for (index, units) in indices.iter().zip(assignment.taken) {
            for (slot, amount) in &units {
                *self.queue.reserved.entry(*slot).or_default() += *amount;
                some = true;
            }
            waiter.reserved[*index] = units;
            if complete && let Some(group) = self.queue.groups.get_mut(&waiter.groups[*index]) {
                group.wanting.remove(&place);
            }
        }
        if some && let Some(family) = self.queue.families.get_mut(family) {
            family.reserving.insert(place);
        }
        if complete {
            waiter.lacks.remove(family);
            if waiter.lacks.is_empty() {
                self.queue.ready.insert(place);
            }
        }
    }

    /// Reserves, for each whole unit that a waiter lacks, fractions of divided units, so that whole units become available: those with the largest
    /// free fraction.
    fn reserve_parts(&mut self, place: Place, family: &Arc<str>, missing: impl Iterator<Item = (usize, Quantity)>) {
        for (index, missing) in missing.filter(|(_, missing)| !missing.is_zero()) {
            let Some(waiter) = self.queue.waiters.get_mut(&place.1) else { return };
            let requirement = &waiter.request.requirements[index];
            let divisible = self.queue.groups.get(&waiter.groups[index]).is_some_and(|group| group.divisible > 0);
            if !divisible || !requirement.count.is_whole() {
                continue;
            }
            let (reserved, resources) = (&self.queue.reserved, &self.resources);
            let left = |(slot, resource): (Slot, &Resource)| {
                let fits = resource.description.divisible && resource.description.fits(requirement);
                let of_others = reserved.get(&slot).copied().unwrap_or_default();
                let left = resource.free().saturating_sub(of_others);
                (fits && !resources.is_kept_back(resource) && !left.is_zero()).then_some((left, slot))
            };
            let mut parts: Vec<(Quantity, Slot)> = resources.free_of(&requirement.kind).filter_map(left).collect();
            self.worked += parts.len();
            parts.sort_by_key(|(left, _)| std::cmp::Reverse(*left));
            parts.truncate(missing.units() as usize);
            for (left, slot) in &parts {
                *self.queue.reserved.entry(*slot).or_default() += *left;
                *waiter.reserved[index].entry(*slot).or_default() += *left;
            }
            if !parts.is_empty()
                && let Some(family) = self.queue.families.get_mut(family)
            {
                family.reserving.insert(place);
            }
        }
    }

    /// Counts an overtaking for the waiters before `place` that lack what is now taken. When a waiter reaches the limit, it and all before it reserve
    /// what is free.
    pub(crate) fn overtake(&mut self, place: Place, taken: &[Units]) {
        if self.limits.overtaken == 0 || self.queue.families.is_empty() {
            return;
        }
        let mut passed = BTreeSet::new();
        for slot in taken.iter().flat_map(|units| units.keys()) {
            let Some(resource) = self.resources.get(*slot) else { continue };
            let family = self.resources.family(&resource.description.kind);
            for key in self.queue.families.get(family).into_iter().flat_map(|family| &family.groups) {
                let Some(group) = self.queue.groups.get(key) else { continue };
                if group.fits(&self.resources, &resource.description) {
                    passed.extend(group.wanting.range(..place).copied());
                }
            }
        }
        for place in passed {
            let Some(waiter) = self.queue.waiters.get_mut(&place.1) else { continue };
            waiter.overtaken = waiter.overtaken.saturating_add(1);
            if waiter.overtaken < self.limits.overtaken {
                continue;
            }
            for key in &waiter.groups {
                let Some(group) = self.queue.groups.get(key) else { continue };
                let Some(family) = self.queue.families.get_mut(&group.family) else { continue };
                if family.strict.insert(place) {
                    self.queue.changed.insert(group.family.clone(), true);
                }
            }
        }
    }
}
