//! Growth: what requests have waited for so long that its providers should start more, although existing resources would suffice.
//!
//! A request counts when it has waited for [`Provided::patience`] without interruption for units that others hold, of a kind that a provider grows,
//! and if one more unit of that kind is all that it needs: a request that also waits for an arm would not begin any sooner. Shorter waits start
//! nothing. The queue is examined at intervals of the patience, and only while requests wait, so a wait counts for up to the same time after it has
//! ended.

use crate::group::{Group, Key};
use crate::pool::Pool;
use crate::queue::{Place, Waiter};
use ratn_model::resource::Quantity;
use ratn_model::time::Timestamp;
use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

/// Maximum number of waiters examined per selector; the most urgent ones.
const LOOKED_AT: usize = 64;
/// Maximum number of resources read per examination for waiters of several kinds; the rest counts in the next one.
const RESOURCES: usize = 10_000;

/// What the providers offer to start.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Provided {
    /// The kinds that are started for requests that wait for more than exists.
    pub kinds: BTreeSet<String>,
    /// The kinds among these that are also started for requests that wait for held resources.
    pub growing: BTreeSet<String>,
    /// How long a request has to wait for held resources before it counts.
    pub patience: Duration,
}

/// When the queue is examined, and the result.
#[derive(Debug, Clone, Default)]
pub(crate) struct Growth {
    look_at: Option<Timestamp>,
    is_due: bool,
    /// The last examination found something.
    was_found: bool,
}

/// For each selector, the waiting amount, and the most urgent waiter.
pub(crate) type Queued = BTreeMap<Key, (Quantity, Place)>;

impl Growth {
    pub(crate) fn look_at(&self) -> Option<Timestamp> {
        self.look_at
    }

    /// Schedules the next examination, unless one is scheduled.
    pub(crate) fn look_later(&mut self, now: Timestamp, provided: &Provided) {
        if self.look_at.is_none() && !provided.growing.is_empty() {
            self.look_at = Some(now + provided.patience);
        }
    }

    /// Time passes.
    pub(crate) fn advance(&mut self, now: Timestamp) {
        if self.look_at.is_some_and(|at| at <= now) {
            (self.look_at, self.is_due) = (None, true);
        }
    }

    pub(crate) fn is_due(&self) -> bool {
        self.is_due
    }

    /// The queue was examined; returns whether something is or was found.
    fn looked(&mut self, found: bool) -> bool {
        self.is_due = false;
        std::mem::replace(&mut self.was_found, found) || found
    }
}

impl Pool {
    /// What has been waited for long enough, by selector; and whether it may have changed since the last examination. Schedules the next one while
    /// requests wait.
    pub(crate) fn look_for_growth(&mut self) -> (Queued, bool) {
        let (mut queued, mut somebody, mut resources) = (Queued::new(), false, RESOURCES);
        for (key, group) in &self.queue.groups {
            let Some(first) = group.wanting.first().filter(|_| self.grows(group)) else { continue };
            somebody = true;
            let waiters = group.wanting.iter().take(LOOKED_AT).filter_map(|place| self.queue.get(place.1));
            let amounts = waiters.filter_map(|waiter| self.has_waited_for(waiter, key, group, &mut resources));
            let amount = amounts.fold(Quantity::ZERO, |sum, amount| sum + amount);
            if !amount.is_zero() {
                queued.insert(Key::clone(key), (amount, *first));
            }
        }
        let news = self.queue.growth.looked(!queued.is_empty());
        if somebody {
            self.queue.growth.look_later(self.now, &self.queue.provided);
        }
        (queued, news)
    }

    fn grows(&self, group: &Group) -> bool {
        let growing = &self.queue.provided.growing;
        !growing.is_empty()
            && self.resources.kinds().subclasses(&group.selector.kind).any(|kind| growing.contains(kind))
    }

    /// What a waiter lacks of a selector, if it has waited long enough and lacks nothing else.
    fn has_waited_for(&self, waiter: &Waiter, key: &Key, group: &Group, resources: &mut usize) -> Option<Quantity> {
        if waiter.hopeful_since + self.queue.provided.patience > self.now {
            return None;
        }
        for family in waiter.lacks.iter().filter(|family| **family != group.family) {
            if *resources == 0 {
                return None;
            }
            let (_, assignment) = self.assigned(waiter, family);
            *resources = resources.saturating_sub(assignment.looked_at);
            if !assignment.is_complete() {
                return None;
            }
        }
        Some(waiter.lacks_of(key))
    }
}
