//! Requests that replace others: repeated after a broken connection, with another priority, or made certain.
//!
//! Such a request keeps the waiting time of the other one if that belongs to the same session, still waits or has left without a lease a moment ago,
//! and wanted the same, which existing resources could satisfy. So nobody gains or loses by leaving and returning, or saves up time with a request
//! that cannot be served. Each waiting time is kept once: two requests do not share it.
//!
//! No waiting time is kept from before the last service of a first request of the session in these families. Accounts (`accounts.rs`) may forget when
//! that was, for a session that has ended or whose account equals a new one. Here it is remembered as long as any request that left before it.

use crate::group::Key;
use crate::id::SessionId;
use crate::memory::RequestId;
use crate::own_order::Families;
use crate::turn::LEAD;
use ratn_model::time::Timestamp;
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

/// Maximum number of requests remembered per caller; its own oldest is forgotten first.
const OF_CALLER: usize = 4_096;

/// A request that waited earlier.
#[derive(Debug, Clone)]
pub(crate) struct Earlier {
    pub(crate) session: SessionId,
    /// Since when it waited; `None` if existing resources could not satisfy it.
    pub(crate) kept: Option<Timestamp>,
    pub(crate) speculative: bool,
    /// What it wanted.
    pub(crate) groups: Vec<Key>,
}

/// Requests that have left the queue without a lease, by caller.
#[derive(Debug, Clone, Default)]
pub(crate) struct Left {
    callers: BTreeMap<Arc<str>, OfCaller>,
    /// When a first request of a session was last served in a family, if recently.
    served: BTreeMap<(SessionId, Arc<str>), Timestamp>,
    /// When old entries were last removed.
    forgotten: Timestamp,
}

#[derive(Debug, Clone, Default)]
struct OfCaller {
    requests: BTreeMap<Arc<str>, (Timestamp, Earlier)>,
    /// Oldest first; some of these requests are no longer remembered.
    order: VecDeque<(Timestamp, Arc<str>)>,
}

impl Earlier {
    /// Since when a request counts as waiting that replaces this one now.
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
    /// A request leaves the queue.
    pub(crate) fn leaves(&mut self, now: Timestamp, id: RequestId, earlier: Earlier) {
        if id.is_empty() {
            return;
        }
        let of_caller = self.callers.entry(id.caller).or_default();
        of_caller.order.push_back((now, id.id.clone()));
        of_caller.requests.insert(id.id, (now, earlier));
        of_caller.forget_old(now);
    }

    /// Takes what is remembered about a request of a session that left recently. It is returned only once.
    pub(crate) fn take(&mut self, now: Timestamp, id: &RequestId, session: &SessionId) -> Option<Earlier> {
        let requests = &mut self.callers.get_mut(&id.caller)?.requests;
        requests.get(&id.id).filter(|(_, earlier)| earlier.session == *session)?;
        let (left, earlier) = requests.remove(&id.id)?;
        (left + LEAD >= now).then_some(earlier)
    }

    /// The first request of a session in these families is served.
    pub(crate) fn first_was_served(&mut self, now: Timestamp, session: &SessionId, families: &Families) {
        // Requests that leave later have this time themselves.
        if self.callers.is_empty() {
            return;
        }
        for family in families {
            self.served.insert((session.clone(), family.clone()), now);
        }
    }

    /// When that was last; 0 if it was long ago.
    pub(crate) fn served(&self, session: &SessionId, family: &str) -> Timestamp {
        if self.served.is_empty() {
            return Timestamp(0);
        }
        self.served.get(&(session.clone(), Arc::from(family))).copied().unwrap_or(Timestamp(0))
    }

    /// Removes old entries from time to time.
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
