//! Requests that take the place of others: asked again after a broken connection, with another priority, or for certain.
//!
//! Such a request keeps the time since which the other one waited, and its turn, where that waits still, or has left without a lease a moment
//! ago, and wanted the same of what would have done for it. So nobody gains by leaving and coming back, nor loses, nor saves up time with a
//! request that cannot be served. Each time is kept once: two requests do not share it.

use crate::group::Key;
use crate::memory::RequestId;
use crate::turn::{LEAD, step};
use ratn_model::time::Timestamp;
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

/// So many of one caller that have left are known at the most; its own oldest is forgotten first.
const OF_CALLER: usize = 4_096;

/// What a request was that waited.
#[derive(Debug, Clone)]
pub(crate) struct Earlier {
    /// What it would keep itself; nothing where what exists would not have done for it.
    pub(crate) kept: Option<Kept>,
    pub(crate) speculative: bool,
    /// What it wanted.
    pub(crate) groups: Vec<Key>,
}

/// What a request keeps of the one that it replaces.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Kept {
    /// Since when that waited.
    pub(crate) since: Timestamp,
    /// The step of its turn, where it was the first of its session.
    pub(crate) step: Option<u32>,
}

/// Requests that have left the queue without a lease, by caller.
#[derive(Debug, Clone, Default)]
pub(crate) struct Left {
    callers: BTreeMap<Arc<str>, OfCaller>,
}

#[derive(Debug, Clone, Default)]
struct OfCaller {
    requests: BTreeMap<Arc<str>, (Timestamp, Earlier)>,
    /// The oldest first; of some nothing is known any more.
    order: VecDeque<(Timestamp, Arc<str>)>,
}

impl Earlier {
    /// What a request keeps that takes its place now.
    pub(crate) fn kept_by(&self, now: Timestamp, speculative: bool, groups: &[Key]) -> Option<Kept> {
        let kept = self.kept.filter(|_| self.groups == groups)?;
        if !self.speculative || speculative {
            return Some(kept);
        }
        // It becomes certain.
        let least = Timestamp(now.0.saturating_sub(LEAD.as_nanos() as u64));
        let step = kept.step.map(|was| was.max(step(least, Duration::ZERO)));
        Some(Kept { since: kept.since.max(least), step })
    }
}

impl OfCaller {
    fn forget_old(&mut self, now: Timestamp) {
        while self.order.front().is_some_and(|(at, _)| *at + LEAD < now) || self.order.len() > OF_CALLER {
            let Some((at, id)) = self.order.pop_front() else { return };
            if self.requests.get(&id).is_some_and(|(left, _)| *left == at) {
                self.requests.remove(&id);
            }
        }
    }
}

impl Left {
    /// One leaves.
    pub(crate) fn leaves(&mut self, now: Timestamp, id: RequestId, earlier: Earlier) {
        if id.is_empty() {
            return;
        }
        let of_caller = self.callers.entry(id.caller).or_default();
        of_caller.order.push_back((now, id.id.clone()));
        of_caller.requests.insert(id.id, (now, earlier));
        of_caller.forget_old(now);
        if self.callers.len() > 1 {
            self.callers.retain(|_, of_caller| of_caller.order.back().is_some_and(|(at, _)| *at + LEAD >= now));
        }
    }

    /// What is known of one that has left no longer ago than a moment. It is not told twice.
    pub(crate) fn take(&mut self, now: Timestamp, id: &RequestId) -> Option<Earlier> {
        let (left, earlier) = self.callers.get_mut(&id.caller)?.requests.remove(&id.id)?;
        (left + LEAD >= now).then_some(earlier)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(seconds: u64) -> Timestamp {
        Timestamp(seconds * 1_000_000_000)
    }

    fn id(caller: &str, number: usize) -> RequestId {
        RequestId::new(&caller.into(), &number.to_string())
    }

    fn earlier(since: u64, speculative: bool) -> Earlier {
        let kept = Some(Kept { since: at(since), step: Some(since as u32 / 10 + 1) });
        Earlier { kept, speculative, groups: vec![Key::from([1].as_slice())] }
    }

    #[test]
    fn what_left_a_moment_ago_is_known_once() {
        let mut left = Left::default();
        left.leaves(at(100), id("a", 1), earlier(5, false));
        left.leaves(at(100), id("a", 2), earlier(6, false));
        let since = left.take(at(110), &id("a", 1)).and_then(|earlier| earlier.kept).map(|kept| kept.since);
        assert_eq!(since, Some(at(5)));
        assert!(left.take(at(110), &id("a", 1)).is_none() && left.take(at(111), &id("a", 2)).is_none());
    }

    #[test]
    fn what_one_caller_leaves_displaces_nothing_of_another() {
        let mut left = Left::default();
        left.leaves(at(200), id("a", 0), earlier(6, false));
        (0..2 * OF_CALLER).for_each(|number| left.leaves(at(200), id("b", number), earlier(6, false)));
        let of = &left.callers["b"];
        assert!(of.order.len() <= OF_CALLER && of.requests.len() <= OF_CALLER);
        assert!(left.take(at(200), &id("b", 0)).is_none() && left.take(at(200), &id("b", OF_CALLER)).is_some());
        assert!(left.take(at(200), &id("a", 0)).is_some());
        left.leaves(at(300), id("a", 1), earlier(6, false));
        assert_eq!(left.callers.len(), 1, "of callers who have left nothing for a while nothing is known");
    }

    #[test]
    fn a_request_keeps_the_turn_of_one_that_wanted_the_same_and_a_certain_one_little_of_a_speculative_one() {
        let same = earlier(5, false).groups;
        let kept = |of: Earlier, speculative| of.kept_by(at(100), speculative, &same);
        for (was, is) in [(false, false), (true, true), (false, true)] {
            assert_eq!(kept(earlier(5, was), is), Some(Kept { since: at(5), step: Some(1) }));
        }
        assert_eq!(kept(earlier(5, true), false), Some(Kept { since: at(90), step: Some(9) }));
        assert_eq!(kept(earlier(95, true), false), Some(Kept { since: at(95), step: Some(10) }));
        assert_eq!(earlier(5, false).kept_by(at(100), false, &[]), None);
        assert_eq!(kept(Earlier { kept: None, ..earlier(5, false) }, false), None, "it could not be served");
    }
}
