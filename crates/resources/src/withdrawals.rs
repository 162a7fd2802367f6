//! Request ids that were withdrawn before their acquire was heard of: the acquire may still be on its way, and is refused when it arrives.
//! One of an id that was heard of before acquires anew, however often that was withdrawn: so ids that were refused or undone are known, too.
//!
//! Kept as long as answers are (`memory.rs`), bounded for each caller and in all in the same way. Not written down: what was on its way to a
//! process that has ended does not arrive.

use crate::limits::Limits;
use crate::memory::RequestId;
use ratn_model::time::Timestamp;
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

/// Of one caller at the most: its own oldest is forgotten first.
const OF_CALLER: usize = 4_096;

/// By who withdrew.
#[derive(Debug, Clone, Default)]
pub(crate) struct Withdrawals {
    callers: BTreeMap<Arc<str>, OfCaller>,
}

#[derive(Debug, Clone, Default)]
struct OfCaller {
    /// Whether an acquire was heard of.
    ids: BTreeMap<Arc<str>, bool>,
    /// The oldest first.
    order: VecDeque<(Timestamp, Arc<str>)>,
}

impl OfCaller {
    fn forget_oldest(&mut self) {
        if let Some((_, id)) = self.order.pop_front() {
            self.ids.remove(&id);
        }
    }
}

impl Withdrawals {
    /// Whether it was withdrawn, and no acquire was heard of.
    pub(crate) fn is_withdrawn(&self, id: &RequestId) -> bool {
        self.callers.get(&id.caller).and_then(|of_caller| of_caller.ids.get(&id.id)) == Some(&false)
    }

    /// An acquire ended without a lease, or its lease was undone.
    pub(crate) fn heard_of(&mut self, now: Timestamp, limits: &Limits, id: RequestId) {
        if !id.is_empty() {
            self.keep(now, limits, id, true);
        }
    }

    /// No answer is known that this id was given.
    pub(crate) fn withdrawn(&mut self, now: Timestamp, limits: &Limits, id: RequestId) {
        self.keep(now, limits, id, false);
    }

    fn keep(&mut self, now: Timestamp, limits: &Limits, id: RequestId, heard_of: bool) {
        let for_at_most = Duration::from_millis(limits.remember_for_ms);
        for of_caller in self.callers.values_mut() {
            while of_caller.order.front().is_some_and(|(at, _)| *at + for_at_most <= now) {
                of_caller.forget_oldest();
            }
        }
        let own = self.callers.entry(id.caller).or_default();
        if let Some(known) = own.ids.get_mut(&id.id) {
            *known |= heard_of;
        } else {
            own.ids.insert(id.id.clone(), heard_of);
            own.order.push_back((now, id.id));
        }
        if own.order.len() > OF_CALLER {
            own.forget_oldest();
        }
        let in_all: usize = self.callers.values().map(|of_caller| of_caller.order.len()).sum();
        if in_all > limits.remembered_requests.max(1)
            && let Some(most) = self.callers.values_mut().max_by_key(|of_caller| of_caller.order.len())
        {
            most.forget_oldest();
        }
        self.callers.retain(|_, of_caller| !of_caller.order.is_empty());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn id(caller: &str, number: usize) -> RequestId {
        RequestId::new(&caller.into(), &number.to_string())
    }

    #[test]
    fn as_many_are_kept_as_may_be_and_those_of_the_caller_with_the_most_are_forgotten_first() {
        let limits = Limits { remembered_requests: 10, remember_for_ms: 1_000, ..Limits::default() };
        let mut withdrawals = Withdrawals::default();
        let at = |ms: u64| Timestamp(ms * 1_000_000);
        withdrawals.withdrawn(at(0), &limits, id("adam", 0));
        (0..20).for_each(|number| withdrawals.withdrawn(at(500), &limits, id("eve", number)));
        let known = |withdrawals: &Withdrawals| {
            let of_eve = (0..20).filter(|number| withdrawals.is_withdrawn(&id("eve", *number)));
            (withdrawals.is_withdrawn(&id("adam", 0)), of_eve.collect::<Vec<_>>())
        };
        assert_eq!(known(&withdrawals), (true, (11..20).collect()));
        withdrawals.withdrawn(at(1_000), &limits, id("eve", 19));
        assert_eq!(known(&withdrawals), (false, (11..20).collect()));
        withdrawals.withdrawn(at(1_500), &limits, id("adam", 1));
        assert_eq!(known(&withdrawals), (false, vec![]));
        let unbounded = Limits::default();
        (0..=OF_CALLER).for_each(|number| withdrawals.withdrawn(at(1_500), &unbounded, id("eve", number)));
        assert!(!withdrawals.is_withdrawn(&id("eve", 0)) && withdrawals.is_withdrawn(&id("eve", OF_CALLER)));
    }
}
