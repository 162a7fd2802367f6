//! Request ids that were withdrawn before their acquire arrived: the acquire may still be under way, and is refused when it arrives. An acquire whose
//! id was received before acquires anew, however often that id was withdrawn: so ids of refused or undone acquires are kept, too.
//!
//! Kept as long as answers (`memory.rs`), limited per caller and in total in the same way; ids of either sort displace none of the other sort of
//! their caller. Not persistent: calls under way to a process that has ended do not arrive.

use crate::id::SessionId;
use crate::limits::Limits;
use crate::memory::RequestId;
use ratn_model::time::Timestamp;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;
use std::time::Duration;

/// Maximum number per caller and sort: the caller's own oldest is forgotten first.
const OF_CALLER: usize = 4_096;

/// By the caller who withdrew.
#[derive(Debug, Clone, Default)]
pub(crate) struct Withdrawals {
    callers: BTreeMap<Arc<str>, OfCaller>,
}

#[derive(Debug, Clone, Default)]
struct OfCaller {
    /// Only for this session: in another session of the caller the id is free.
    withdrawn: Ids<(Arc<str>, SessionId)>,
    heard_of: Ids<Arc<str>>,
}

#[derive(Debug, Clone)]
struct Ids<T> {
    known: BTreeSet<T>,
    /// Oldest first.
    order: VecDeque<(Timestamp, T)>,
}

impl<T> Default for Ids<T> {
    fn default() -> Ids<T> {
        Ids { known: BTreeSet::new(), order: VecDeque::new() }
    }
}

impl<T: Ord + Clone> Ids<T> {
    fn keep(&mut self, now: Timestamp, id: T) {
        if self.known.insert(id.clone()) {
            self.order.push_back((now, id));
        }
        if self.order.len() > OF_CALLER {
            self.forget_oldest();
        }
    }

    fn forget_oldest(&mut self) {
        if let Some((_, id)) = self.order.pop_front() {
            self.known.remove(&id);
        }
    }

    fn forget_until(&mut self, until: impl Fn(Timestamp) -> bool) {
        while self.order.front().is_some_and(|(at, _)| until(*at)) {
            self.forget_oldest();
        }
    }
}

impl OfCaller {
    fn len(&self) -> usize {
        self.withdrawn.order.len() + self.heard_of.order.len()
    }

    /// Forgets the oldest id of the sort that has more.
    fn forget_oldest(&mut self) {
        if self.heard_of.order.len() >= self.withdrawn.order.len() {
            self.heard_of.forget_oldest();
        } else {
            self.withdrawn.forget_oldest();
        }
    }
}

impl Withdrawals {
    /// Whether the id was withdrawn in this session, before its acquire arrived.
    pub(crate) fn is_withdrawn(&self, id: &RequestId, session: &SessionId) -> bool {
        self.callers.get(&id.caller).is_some_and(|own| {
            !own.heard_of.known.contains(&id.id) && own.withdrawn.known.contains(&(id.id.clone(), session.clone()))
        })
    }

    /// An acquire was refused, ended without a lease, or its lease was undone.
    pub(crate) fn heard_of(&mut self, now: Timestamp, limits: &Limits, id: RequestId) {
        if !id.is_empty() {
            self.callers.entry(id.caller).or_default().heard_of.keep(now, id.id);
            self.forget(now, limits);
        }
    }

    /// The id was withdrawn, and no answer to it is known.
    pub(crate) fn withdrawn(&mut self, now: Timestamp, limits: &Limits, id: RequestId, session: &SessionId) {
        self.callers.entry(id.caller).or_default().withdrawn.keep(now, (id.id, session.clone()));
        self.forget(now, limits);
    }

    fn forget(&mut self, now: Timestamp, limits: &Limits) {
        let for_at_most = Duration::from_millis(limits.remember_for_ms);
        for of_caller in self.callers.values_mut() {
            of_caller.withdrawn.forget_until(|at| at + for_at_most <= now);
            of_caller.heard_of.forget_until(|at| at + for_at_most <= now);
        }
        let in_all: usize = self.callers.values().map(OfCaller::len).sum();
        if in_all > limits.remembered_requests.max(1)
            && let Some(most) = self.callers.values_mut().max_by_key(|of_caller| of_caller.len())
        {
            most.forget_oldest();
        }
        self.callers.retain(|_, of_caller| of_caller.len() > 0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn id(caller: &str, number: usize) -> RequestId {
        RequestId::new(&caller.into(), &number.to_string())
    }

    fn session() -> SessionId {
        SessionId::from("s")
    }

    #[test]
    fn as_many_are_kept_as_may_be_and_those_of_the_caller_with_the_most_are_forgotten_first() {
        let limits = Limits { remembered_requests: 10, remember_for_ms: 1_000, ..Limits::default() };
        let mut withdrawals = Withdrawals::default();
        let at = |ms: u64| Timestamp(ms * 1_000_000);
        withdrawals.withdrawn(at(0), &limits, id("adam", 0), &session());
        (0..20).for_each(|number| withdrawals.withdrawn(at(500), &limits, id("eve", number), &session()));
        let known = |withdrawals: &Withdrawals| {
            let of_eve = (0..20).filter(|number| withdrawals.is_withdrawn(&id("eve", *number), &session()));
            (withdrawals.is_withdrawn(&id("adam", 0), &session()), of_eve.collect::<Vec<_>>())
        };
        assert_eq!(known(&withdrawals), (true, (11..20).collect()));
        withdrawals.withdrawn(at(1_000), &limits, id("eve", 19), &session());
        assert_eq!(known(&withdrawals), (false, (11..20).collect()));
        withdrawals.withdrawn(at(1_500), &limits, id("adam", 1), &session());
        assert_eq!(known(&withdrawals), (false, vec![]));
        let unbounded = Limits::default();
        (0..=OF_CALLER).for_each(|number| withdrawals.withdrawn(at(1_500), &unbounded, id("eve", number), &session()));
        let is_known = |withdrawals: &Withdrawals, number| withdrawals.is_withdrawn(&id("eve", number), &session());
        assert!(!is_known(&withdrawals, 0) && is_known(&withdrawals, OF_CALLER));
        // Many refused ids displace none of these.
        (9_000..20_000).for_each(|number| withdrawals.heard_of(at(1_500), &unbounded, id("eve", number)));
        assert!(is_known(&withdrawals, 1) && is_known(&withdrawals, OF_CALLER));
    }
}
