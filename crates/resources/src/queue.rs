//! The queue of acquires, in the order of their turns, and the reservations of each waiter.

use crate::assignment::grain;
use crate::changed::Touched;
use crate::group::{Family, Group, Key};
use crate::growth::{Growth, Provided};
use crate::id::{SessionId, Slot, WaiterId};
use crate::memory::RequestId;
use crate::resource::Units;
use crate::turn::Turn;
use ratn_model::resource::{Quantity, Requirement};
use ratn_model::time::Timestamp;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Bound;
use std::sync::Arc;
use std::time::Duration;

/// What an acquire asks for; it gets all of it, or waits.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AcquireRequest {
    /// The session that asks; the lease ends with it.
    pub session: SessionId,
    /// Block, consume and exist requirements.
    pub requirements: Vec<Requirement>,
    /// Larger is served first, among requests from about the same time by sessions with about their shares: see `turn.rs`. The bits from 2^60 on are
    /// the urgency, which comes before due times.
    pub priority: i64,
    /// When to give up; `None` waits as long as the session lives.
    pub deadline: Option<Timestamp>,
    /// Maximum holding time of the lease; `None` for as long as the session lives.
    pub hold_for: Option<Duration>,
    /// The purpose, in explanations and events (a run's instance); may be empty.
    pub purpose: String,
    /// Speculative: it may turn out not to be needed. Everything that is certainly needed comes first.
    #[serde(default, skip_serializing_if = "is_false")]
    pub speculative: bool,
    /// The id of an earlier request of the session for the same, which this one replaces; empty for none.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub instead_of: String,
}

fn is_false(value: &bool) -> bool {
    !value
}

/// The place of a waiter: smaller places are served first.
pub(crate) type Place = (Turn, WaiterId);

/// A queued acquire.
#[derive(Debug, Clone)]
pub(crate) struct Waiter {
    pub(crate) request: AcquireRequest,
    pub(crate) turn: Turn,
    /// Since when it, or the request that it replaces, has waited.
    pub(crate) asked: Timestamp,
    /// The same as counted for turns: only while existing resources could satisfy it.
    pub(crate) since: Timestamp,
    /// Since when the replaced request had waited, while existing resources can satisfy this one.
    pub(crate) kept: Option<Timestamp>,
    /// Whether it is one of the first requests of its session (`own_order.rs`), among those that existing resources could satisfy.
    pub(crate) first: bool,
    /// The request id, forgotten if the waiter leaves without a lease, so that the client can ask again.
    pub(crate) request_id: RequestId,
    /// For each requirement, the group in which it waits.
    pub(crate) groups: Vec<Key>,
    /// Whether existing resources would satisfy it if nobody held any. Only then it reserves.
    pub(crate) hopeful: bool,
    /// Since when it has been hopeful.
    pub(crate) hopeful_since: Timestamp,
    /// For each requirement, the reserved units: free, and for nobody else.
    pub(crate) reserved: Vec<Units>,
    /// The families of which it lacks units.
    pub(crate) lacks: BTreeSet<Arc<str>>,
    /// How often a later waiter was served with what this one waits for.
    pub(crate) overtaken: u32,
    /// For each requirement, the amount that was missing when it was last found not to be hopeful.
    pub(crate) missing: Vec<Quantity>,
}

/// Waiters in serving order, and indexed by what they wait for.
#[derive(Debug, Clone, Default)]
pub(crate) struct Queue {
    pub(crate) waiters: BTreeMap<WaiterId, Waiter>,
    pub(crate) order: BTreeSet<Place>,
    pub(crate) groups: BTreeMap<Key, Group>,
    pub(crate) families: BTreeMap<Arc<str>, Family>,
    /// The reservations of all waiters together.
    pub(crate) reserved: Units,
    /// Waiters that lack nothing.
    pub(crate) ready: BTreeSet<Place>,
    /// Changed resources that the groups of their family do not know yet.
    pub(crate) touched: Touched,
    /// Families in which something became free; true if reservations have to be shared out anew.
    pub(crate) changed: BTreeMap<Arc<str>, bool>,
    /// The family that was shared out last; the one after it is next, so that families take turns.
    pub(crate) shared: Option<Arc<str>>,
    /// Where sharing out was interrupted in a family: later waiters have not been examined.
    pub(crate) shared_until: BTreeMap<Arc<str>, Place>,
    /// Waiters whose hopefulness has to be re-examined.
    doubtful: BTreeSet<Place>,
    /// The last of these that was examined, while there are more; the one after it is next, so that waiters take turns.
    doubted: Option<Place>,
    /// Waiters that are not hopeful.
    pub(crate) hopeless: BTreeSet<Place>,
    /// Whether the demand may have changed.
    pub(crate) demand_changed: bool,
    /// The kinds whose demand is of interest to providers.
    pub(crate) provided: Arc<Provided>,
    /// What is waited for although it exists.
    pub(crate) growth: Growth,
    /// Whether a turn had no time left to serve a waiter.
    pub(crate) unserved: bool,
}

impl AcquireRequest {
    /// Without priority, deadline or maximum holding time.
    pub fn new(session: SessionId, requirements: Vec<Requirement>) -> AcquireRequest {
        let (priority, deadline, hold_for, purpose, speculative, instead_of) = Default::default();
        AcquireRequest { session, requirements, priority, deadline, hold_for, purpose, speculative, instead_of }
    }

    /// With this priority.
    #[must_use]
    pub fn priority(mut self, priority: i64) -> AcquireRequest {
        self.priority = priority;
        self
    }

    /// With this deadline.
    #[must_use]
    pub fn deadline(mut self, deadline: Timestamp) -> AcquireRequest {
        self.deadline = Some(deadline);
        self
    }
}

impl Waiter {
    pub(crate) fn place(&self, id: WaiterId) -> Place {
        (self.turn, id)
    }

    /// The amount of a group that was missing when the waiter was last found not to be hopeful.
    pub(crate) fn missing_of(&self, key: &Key) -> Quantity {
        self.groups.iter().zip(&self.missing).filter(|(other, _)| *other == key).map(|(_, amount)| *amount).sum()
    }

    /// The amount of a group that it wants and has not reserved. Fractions do not count for requirements in whole units.
    pub(crate) fn lacks_of(&self, key: &Key) -> Quantity {
        let wanted = self.request.requirements.iter().zip(&self.reserved).zip(&self.groups);
        let of_group = wanted.filter(|(_, other)| *other == key).map(|(wanted, _)| wanted);
        let has = |wanted: &Requirement, amount: &Quantity| amount.floor_to(grain(wanted));
        let lacks = |(wanted, reserved): (&Requirement, &Units)| {
            wanted.count.saturating_sub(reserved.values().map(|amount| has(wanted, amount)).sum())
        };
        of_group.map(lacks).sum()
    }
}

impl Queue {
    pub(crate) fn len(&self) -> usize {
        self.waiters.len()
    }

    pub(crate) fn get(&self, id: WaiterId) -> Option<&Waiter> {
        self.waiters.get(&id)
    }

    /// The waiters in serving order.
    pub(crate) fn iter(&self) -> impl Iterator<Item = (WaiterId, &Waiter)> {
        self.order.iter().filter_map(|(_, id)| self.waiters.get(id).map(|waiter| (*id, waiter)))
    }

    pub(crate) fn unreserve(&mut self, slot: Slot, amount: Quantity) {
        if let Some(reserved) = self.reserved.get_mut(&slot) {
            *reserved = reserved.saturating_sub(amount);
            if reserved.is_zero() {
                self.reserved.remove(&slot);
            }
        }
    }

    /// Whether work was postponed to later turns.
    pub(crate) fn is_behind(&self) -> bool {
        self.unserved || !(self.touched.is_empty() && self.changed.is_empty() && self.doubtful.is_empty())
    }

    /// The same for work that may concern waiters of a family.
    pub(crate) fn is_behind_in(&self, family: &str) -> bool {
        let in_doubt = self.families.get(family).is_some_and(|family| family.doubtful > 0);
        in_doubt || self.touched.is_in(family) || self.changed.contains_key(family)
    }

    /// Whether the reservations of a waiter are still free, and everything else that it asks for exists. While changes are not settled, this is
    /// unknown (false).
    pub(crate) fn is_certain(&self, place: Place) -> bool {
        let Some(waiter) = self.waiters.get(&place.1) else { return false };
        let settled = |family: &str| !self.touched.is_in(family) && self.changed.get(family) != Some(&true);
        let families = waiter.groups.iter().filter_map(|key| self.groups.get(key)).map(|group| &*group.family);
        !self.doubtful.contains(&place) && families.into_iter().all(settled)
    }

    /// The hopefulness of this waiter has to be re-examined.
    pub(crate) fn doubt(&mut self, place: Place) {
        if self.doubtful.insert(place) {
            self.count_doubt(place, |doubtful| *doubtful += 1);
        }
    }

    /// It has been re-examined, or does not matter any more.
    pub(crate) fn doubt_no_more(&mut self, place: Place) {
        if self.doubtful.remove(&place) {
            self.count_doubt(place, |doubtful| *doubtful -= 1);
        }
    }

    fn count_doubt(&mut self, place: Place, count: fn(&mut usize)) {
        for key in self.waiters.get(&place.1).into_iter().flat_map(|waiter| &waiter.groups) {
            let family = self.groups.get(key).and_then(|group| self.families.get_mut(&group.family));
            family.into_iter().for_each(|family| count(&mut family.doubtful));
        }
    }

    /// The next waiter whose hopefulness has to be re-examined.
    pub(crate) fn next_doubtful(&mut self) -> Option<Place> {
        let behind = self.doubted.map_or(Bound::Unbounded, Bound::Excluded);
        let next = self.doubtful.range((behind, Bound::Unbounded)).next().or_else(|| self.doubtful.first()).copied()?;
        self.doubt_no_more(next);
        self.doubted = (!self.doubtful.is_empty()).then_some(next);
        Some(next)
    }

    /// Records whether existing resources could satisfy this waiter; returns whether that has changed. The groups of a hopeless waiter learn whether
    /// units of them are missing.
    pub(crate) fn set_hopeless(&mut self, place: Place, hopeless: bool) -> bool {
        let changed = if hopeless { self.hopeless.insert(place) } else { self.hopeless.remove(&place) };
        if !hopeless && !changed {
            return false;
        }
        let Some(waiter) = self.waiters.get(&place.1) else { return changed };
        for key in &waiter.groups {
            let Some(group) = self.groups.get_mut(key) else { continue };
            if hopeless && !waiter.missing_of(key).is_zero() {
                group.lacking.insert(place);
            } else {
                group.lacking.remove(&place);
            }
        }
        changed
    }

    pub(crate) fn mark(&mut self, family: &Arc<str>, anew: bool) {
        *self.changed.entry(family.clone()).or_default() |= anew;
        self.shared_until.remove(family);
    }

    /// Gives a waiter another turn. Reservations may have to move between it and others.
    pub(crate) fn move_to(&mut self, id: WaiterId, turn: Turn) {
        let Some(waiter) = self.waiters.get_mut(&id) else { return };
        let (from, to) = (waiter.place(id), (turn, id));
        waiter.turn = turn;
        let swap = |set: &mut BTreeSet<Place>| {
            if set.remove(&from) {
                set.insert(to);
            }
        };
        [&mut self.order, &mut self.ready, &mut self.doubtful, &mut self.hopeless].into_iter().for_each(swap);
        let mut families = BTreeSet::new();
        for (requirement, key) in waiter.request.requirements.iter().zip(&waiter.groups) {
            let Some(group) = self.groups.get_mut(key) else { continue };
            if group.by_amount.remove(&(requirement.count, from)) {
                group.by_amount.insert((requirement.count, to));
            }
            [&mut group.wanting, &mut group.several, &mut group.lacking].into_iter().for_each(swap);
            families.insert(group.family.clone());
        }
        let between = (Bound::Excluded(from.min(to)), Bound::Excluded(from.max(to)));
        let mut disturbed = Vec::new();
        for name in families {
            let Some(family) = self.families.get_mut(&name) else { continue };
            let wants = |key: &Key| self.groups.get(key)?.wanting.range(between).next();
            let disturbs = match to < from {
                true => waiter.lacks.contains(&name) && family.reserving.range(between).next().is_some(),
                false => family.reserving.contains(&from) && family.groups.iter().any(|key| wants(key).is_some()),
            };
            [&mut family.takers, &mut family.reserving, &mut family.strict].into_iter().for_each(swap);
            disturbed.push((name, disturbs));
        }
        disturbed.iter().for_each(|(name, disturbs)| self.mark(name, *disturbs));
    }

    /// Whether the indices match the waiters.
    pub(crate) fn index_agrees(&self) -> Result<(), String> {
        let ensure = |holds: bool, what: &str| if holds { Ok(()) } else { Err(what.to_owned()) };
        ensure(self.order.len() == self.waiters.len(), "the order of the queue has another length")?;
        let mut reserved = Units::new();
        let mut members = 0;
        for (id, waiter) in &self.waiters {
            let place = waiter.place(*id);
            ensure(self.order.contains(&place), "a waiter has no place in the order")?;
            members += waiter.groups.len();
            for units in &waiter.reserved {
                units.iter().for_each(|(slot, amount)| *reserved.entry(*slot).or_default() += *amount);
            }
            ensure(waiter.hopeful || waiter.reserved.iter().all(BTreeMap::is_empty), "a hopeless waiter reserves")?;
            let ready = waiter.hopeful && waiter.lacks.is_empty();
            ensure(self.ready.contains(&place) == ready, "who is ready is not among them")?;
            let known = self.hopeless.contains(&place) != waiter.hopeful || self.doubtful.contains(&place);
            ensure(known, "who is hopeless is not among them")?;
            let groups = waiter.groups.iter().filter_map(|key| Some((key, self.groups.get(key)?)));
            let hopeless = self.hopeless.contains(&place);
            let lacks = |key| hopeless && !waiter.missing_of(key).is_zero();
            let agrees = groups.into_iter().all(|(key, group)| group.lacking.contains(&place) == lacks(key));
            ensure(agrees, "a group has somebody who lacks nothing of it, or not one who does")?;
        }
        ensure(self.hopeless.len() <= self.waiters.len(), "somebody hopeless has left")?;
        ensure(reserved == self.reserved, "what is reserved is not what waiters have reserved")?;
        ensure(self.groups.values().map(|group| group.members).sum::<usize>() == members, "a group miscounts")?;
        let known = self.groups.values().all(|group| group.lacking.is_subset(&self.hopeless));
        ensure(known, "somebody hopeless has left, and not the group")?;
        ensure(self.groups.is_empty() == self.families.is_empty(), "a family without a group")
    }
}
