//! Requests that take the place of others: asked again after a broken connection, with another priority, or for certain.
//!
//! Such a request keeps the time since which the other one waited, where that is of the same session, waits still, or has left without a
//! lease a moment ago, and wanted the same of what would have done for it. So nobody gains by leaving and coming back, nor loses, nor saves up
//! time with a request that cannot be served. Each time is kept once: two requests do not share it.
//!
//! No time is kept from before the last request was served that was the first of the session there. Accounts (`accounts.rs`) may forget when
//! that was: of a session that has ended, and of one that is where anybody begins. Here it is known for as long as a request is that has left
//! before.

use crate::group::Key;
use crate::id::SessionId;
use crate::memory::RequestId;
use crate::own_order::Families;
use crate::turn::LEAD;
use ratn_model::time::Timestamp;
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

/// So many of one caller that have left are known at the most; its own oldest is forgotten first.
const OF_CALLER: usize = 4_096;

/// What a request was that waited.
#[derive(Debug, Clone)]
pub(crate) struct Earlier {
    pub(crate) session: SessionId,
    /// Since when it waited; nothing where what exists would not have done for it.
    pub(crate) kept: Option<Timestamp>,
    pub(crate) speculative: bool,
    /// What it wanted.
    pub(crate) groups: Vec<Key>,
}

/// Requests that have left the queue without a lease, by caller.
#[derive(Debug, Clone, Default)]
pub(crate) struct Left {
    callers: BTreeMap<Arc<str>, OfCaller>,
    /// When the last first request of a session was served in a family, where that was a moment ago.
    served: BTreeMap<(SessionId, Arc<str>), Timestamp>,
    /// When what is old was forgotten.
    forgotten: Timestamp,
}

#[derive(Debug, Clone, Default)]
struct OfCaller {
    requests: BTreeMap<Arc<str>, (Timestamp, Earlier)>,
    /// The oldest first; of some nothing is known any more.
    order: VecDeque<(Timestamp, Arc<str>)>,
}

impl Earlier {
    /// Since when a request has waited that takes its place now.
    pub(crate) fn kept_by(&self, now: Timestamp, speculative: bool, groups: &[Key]) -> Option<Timestamp> {
        let kept = self.kept.filter(|_| self.groups == groups)?;
        if !self.speculative || speculative {
            return Some(kept);
        }
        // It becomes certain.
        Some(kept.max(Timestamp(now.0.saturating_sub(LEAD.as_nanos() as u64))))
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
    }

    /// What is known of one of a session that has left no longer ago than a moment. It is not told twice.
    pub(crate) fn take(&mut self, now: Timestamp, id: &RequestId, session: &SessionId) -> Option<Earlier> {
        let requests = &mut self.callers.get_mut(&id.caller)?.requests;
        requests.get(&id.id).filter(|(_, earlier)| earlier.session == *session)?;
        let (left, earlier) = requests.remove(&id.id)?;
        (left + LEAD >= now).then_some(earlier)
    }

    /// The first request of a session in some families is served.
    pub(crate) fn first_was_served(&mut self, now: Timestamp, session: &SessionId, families: &Families) {
        // What leaves from now on knows it by itself.
        if self.callers.is_empty() {
            return;
        }
        for family in families {
            self.served.insert((session.clone(), family.clone()), now);
        }
    }

    /// When that was last; of long ago nothing is known.
    pub(crate) fn served(&self, session: &SessionId, family: &str) -> Timestamp {
        if self.served.is_empty() {
            return Timestamp(0);
        }
        self.served.get(&(session.clone(), Arc::from(family))).copied().unwrap_or(Timestamp(0))
    }

    /// What is old is forgotten, now and then.
    pub(crate) fn forget(&mut self, now: Timestamp) {
        if self.forgotten + LEAD >= now {
            return;
        }
        self.forgotten = now;
        self.callers.retain(|_, of_caller| {
            of_caller.forget_old(now);
            !of_caller.order.is_empty()
        });
        self.served.retain(|_, at| *at + LEAD >= now);
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
        let groups = vec![Key::from([1].as_slice())];
        Earlier { session: SessionId::from("s"), kept: Some(at(since)), speculative, groups }
    }

    fn take(left: &mut Left, now: u64, id: &RequestId) -> Option<Earlier> {
        left.take(at(now), id, &SessionId::from("s"))
    }

    #[test]
    fn what_left_a_moment_ago_is_known_once_and_to_its_session() {
        let mut left = Left::default();
        left.leaves(at(100), id("a", 1), earlier(5, false));
        left.leaves(at(100), id("a", 2), earlier(6, false));
        assert!(left.take(at(110), &id("a", 1), &SessionId::from("other")).is_none());
        assert_eq!(take(&mut left, 110, &id("a", 1)).and_then(|earlier| earlier.kept), Some(at(5)));
        assert!(take(&mut left, 110, &id("a", 1)).is_none() && take(&mut left, 111, &id("a", 2)).is_none());
    }

    #[test]
    fn what_one_caller_leaves_displaces_nothing_of_another() {
        let mut left = Left::default();
        left.leaves(at(200), id("a", 0), earlier(6, false));
        (0..2 * OF_CALLER).for_each(|number| left.leaves(at(200), id("b", number), earlier(6, false)));
        let of = &left.callers["b"];
        assert!(of.order.len() <= OF_CALLER && of.requests.len() <= OF_CALLER);
        assert!(take(&mut left, 200, &id("b", 0)).is_none() && take(&mut left, 200, &id("b", OF_CALLER)).is_some());
        assert!(take(&mut left, 200, &id("a", 0)).is_some());
    }

    #[test]
    fn what_is_old_is_forgotten_though_nobody_leaves_any_more() {
        let (mut left, session, arm) = (Left::default(), SessionId::from("s"), Families::from([Arc::from("Arm")]));
        left.first_was_served(at(199), &session, &arm);
        assert_eq!(left.served(&session, "Arm"), at(0), "nothing has left before");
        left.leaves(at(200), id("a", 0), earlier(6, false));
        left.first_was_served(at(205), &session, &arm);
        left.forget(at(210));
        assert_eq!((left.callers.len(), left.served(&session, "Arm")), (1, at(205)));
        left.forget(at(300));
        assert!(left.callers.is_empty() && left.served.is_empty());
    }

    #[test]
    fn a_request_keeps_the_time_of_one_that_wanted_the_same_and_a_certain_one_little_of_a_speculative_one() {
        let same = earlier(5, false).groups;
        let kept = |of: Earlier, speculative| of.kept_by(at(100), speculative, &same);
        for (was, is) in [(false, false), (true, true), (false, true)] {
            assert_eq!(kept(earlier(5, was), is), Some(at(5)));
        }
        assert_eq!(kept(earlier(5, true), false), Some(at(90)));
        assert_eq!(kept(earlier(95, true), false), Some(at(95)));
        assert_eq!(earlier(5, false).kept_by(at(100), false, &[]), None);
        assert_eq!(kept(Earlier { kept: None, ..earlier(5, false) }, false), None, "it could not be served");
    }
}
