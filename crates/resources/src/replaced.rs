//! Requests that take the place of others: asked again after a broken connection, with another priority, or for certain.
//!
//! Such a request keeps the time at which the other one was asked, where that waits still, or has left without a lease a moment ago, and
//! wanted the same. So nobody gains by leaving and coming back, nor loses. Each time is kept once: two requests do not share it.

use crate::group::Key;
use crate::memory::RequestId;
use crate::turn::LEAD;
use ratn_model::time::Timestamp;
use std::collections::{BTreeMap, VecDeque};

/// So many that have left are known at the most; the oldest is forgotten first.
const LEFT: usize = 4_096;

/// What a request was that waited.
#[derive(Debug, Clone)]
pub(crate) struct Earlier {
    pub(crate) asked: Timestamp,
    pub(crate) speculative: bool,
    /// What it wanted.
    pub(crate) groups: Vec<Key>,
}

/// Requests that have left the queue without a lease.
#[derive(Debug, Clone, Default)]
pub(crate) struct Left {
    requests: BTreeMap<RequestId, (Timestamp, Earlier)>,
    /// The oldest first; of some nothing is known any more.
    order: VecDeque<(Timestamp, RequestId)>,
}

impl Earlier {
    /// When a request was asked, by this count, that takes its place now.
    pub(crate) fn asked_for(&self, now: Timestamp, speculative: bool, groups: &[Key]) -> Option<Timestamp> {
        let becomes_certain = self.speculative && !speculative;
        let least = if becomes_certain { now.0.saturating_sub(LEAD.as_nanos() as u64) } else { 0 };
        (self.groups == groups).then(|| self.asked.max(Timestamp(least)))
    }
}

impl Left {
    /// One leaves.
    pub(crate) fn leaves(&mut self, now: Timestamp, id: RequestId, earlier: Earlier) {
        if id.is_empty() {
            return;
        }
        self.order.push_back((now, id.clone()));
        self.requests.insert(id, (now, earlier));
        while self.order.front().is_some_and(|(at, _)| *at + LEAD < now) || self.order.len() > LEFT {
            let Some((at, id)) = self.order.pop_front() else { return };
            if self.requests.get(&id).is_some_and(|(left, _)| *left == at) {
                self.requests.remove(&id);
            }
        }
    }

    /// What is known of one that has left no longer ago than a moment. It is not told twice.
    pub(crate) fn take(&mut self, now: Timestamp, id: &RequestId) -> Option<Earlier> {
        let (left, earlier) = self.requests.remove(id)?;
        (left + LEAD >= now).then_some(earlier)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(seconds: u64) -> Timestamp {
        Timestamp(seconds * 1_000_000_000)
    }

    fn id(number: usize) -> RequestId {
        RequestId::new(&"caller".into(), &number.to_string())
    }

    fn earlier(asked: u64, speculative: bool) -> Earlier {
        Earlier { asked: at(asked), speculative, groups: vec![Key::from([1].as_slice())] }
    }

    #[test]
    fn what_left_a_moment_ago_is_known_once() {
        let mut left = Left::default();
        left.leaves(at(100), id(1), earlier(5, false));
        left.leaves(at(100), id(2), earlier(6, false));
        assert_eq!(left.take(at(110), &id(1)).map(|earlier| earlier.asked), Some(at(5)));
        assert!(left.take(at(110), &id(1)).is_none() && left.take(at(111), &id(2)).is_none());
        (0..2 * LEFT).for_each(|number| left.leaves(at(200), id(number), earlier(6, false)));
        assert!(left.order.len() <= LEFT && left.requests.len() <= LEFT);
        assert!(left.take(at(200), &id(0)).is_none() && left.take(at(200), &id(LEFT)).is_some());
    }

    #[test]
    fn a_request_keeps_the_time_of_one_that_wanted_the_same_and_a_certain_one_little_of_a_speculative_one() {
        let same = earlier(5, false).groups;
        let asked = |of: Earlier, speculative| of.asked_for(at(100), speculative, &same);
        assert_eq!(asked(earlier(5, false), false), Some(at(5)));
        assert_eq!(asked(earlier(5, true), true), Some(at(5)));
        assert_eq!(asked(earlier(5, false), true), Some(at(5)));
        assert_eq!(asked(earlier(5, true), false), Some(at(90)));
        assert_eq!(asked(earlier(95, true), false), Some(at(95)));
        assert_eq!(earlier(5, false).asked_for(at(100), false, &[]), None);
    }
}
