//! Long reads in parts: a request that reads much does so in several turns, with other requests in between.
//!
//! A part is limited in what it reads, not in what it finds. If something changes between two parts, the result may have the old or the new state.

use crate::explain::Explanation;
use crate::id::{SessionId, WaiterId};
use crate::pool::Pool;
use crate::resources::OfKinds;
use crate::session::SessionView;
use ratn_model::resource::{Quantity, Requirement};
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Bound;

/// Searches what a requirement matches: the amount that exists, and the first ids.
#[derive(Debug, Clone)]
pub struct Search {
    requirement: Requirement,
    units: Option<Quantity>,
    ids: BTreeSet<String>,
    most_ids: usize,
    /// The last resource read.
    at: Option<OfKinds>,
}

impl Search {
    /// An empty search, which keeps the first `most_ids` ids in order.
    pub fn new(requirement: Requirement, most_ids: usize) -> Search {
        Search { requirement, units: None, ids: BTreeSet::new(), most_ids, at: None }
    }

    /// The amount found, held or not, without what is consumed.
    pub fn units(&self) -> Quantity {
        self.units.unwrap_or_default()
    }

    /// The first ids found, in order.
    pub fn into_ids(self) -> Vec<String> {
        self.ids.into_iter().collect()
    }

    fn keep(&mut self, id: &str) {
        let full = self.ids.len() >= self.most_ids;
        if full && self.ids.last().is_none_or(|last| **last <= *id) {
            return;
        }
        self.ids.insert(id.to_owned());
        if full {
            self.ids.pop_last();
        }
    }
}

/// Counts for each session the amount that it provides of what a requirement selects.
#[derive(Debug, Clone)]
pub struct ProvidedCount {
    requirement: Requirement,
    of_sessions: BTreeMap<SessionId, Quantity>,
    /// The last resource read.
    at: Option<OfKinds>,
}

impl ProvidedCount {
    /// An empty count.
    pub fn new(requirement: Requirement) -> ProvidedCount {
        ProvidedCount { requirement, of_sessions: BTreeMap::new(), at: None }
    }

    /// The amount that a session provides, held or not.
    pub fn of(&self, session: &SessionId) -> Quantity {
        self.of_sessions.get(session).copied().unwrap_or_default()
    }
}

impl Pool {
    /// Reads at most `resources` more resources of the kinds; returns how many were read, fewer if none are left.
    pub fn count_provided(&self, count: &mut ProvidedCount, resources: usize) -> usize {
        let mut looked_at = 0;
        for (at, resource) in self.resources.all_of_after(&count.requirement.kind, count.at).take(resources) {
            looked_at += 1;
            count.at = Some(at);
            if let Some(owner) = resource.owner.as_ref().filter(|_| resource.description.fits(&count.requirement)) {
                *count.of_sessions.entry(owner.clone()).or_default() += resource.quantity();
            }
        }
        looked_at
    }

    /// Reads at most `resources` more resources of the kinds; returns whether all have been read. If the requirement only names a kind, the first
    /// call counts all units.
    pub fn go_on(&self, search: &mut Search, resources: usize) -> bool {
        let counted = self.resources.fits_every(&search.requirement);
        if search.units.is_none() {
            search.units = Some(if counted { self.resources.quantity(&search.requirement) } else { Quantity::ZERO });
        }
        let kind = search.requirement.kind.clone();
        let mut looked_at = 0;
        for (at, resource) in self.resources.all_of_after(&kind, search.at).take(resources) {
            looked_at += 1;
            search.at = Some(at);
            if resource.description.fits(&search.requirement) {
                if !counted {
                    search.units = search.units.map(|units| units + resource.quantity());
                }
                search.keep(&resource.description.id);
            }
        }
        looked_at < resources
    }

    /// Explains why the first of these waiters wait: as many as fit into `looks` reads of resources and waiters, and at least one. Also returns how
    /// many waiters were processed, including those that do not wait any more.
    pub fn explain_some(&self, waiters: &[WaiterId], looks: usize) -> (Vec<Explanation>, usize) {
        let (mut explanations, mut looked_at, mut done) = (Vec::new(), 0, 0);
        for id in waiters {
            if looked_at >= looks {
                break;
            }
            done += 1;
            looked_at += 1;
            if let Some((explanation, looks)) = self.explained(*id) {
                looked_at += looks;
                explanations.push(explanation);
            }
        }
        (explanations, done)
    }

    /// The sessions after an id, in the order of ids; an empty id is before the first. As many as have `most` entries (leases, waiters and resources)
    /// in total, and at least one. At most `named` leases and resources of each are included.
    pub fn sessions_after(&self, id: &str, most: usize, named: usize) -> Vec<SessionView> {
        let behind = (Bound::Excluded(SessionId::from(id)), Bound::Unbounded);
        let mut seen = 0;
        let some = self.sessions.range(behind).take_while(|(_, session)| {
            let goes_on = seen < most;
            let [leases, provides] = [session.leases.len(), session.provides.len()].map(|there| there.min(named));
            seen += 1 + leases + provides + session.waiters.len();
            goes_on
        });
        some.map(|(id, session)| self.session_view(id, session, named)).collect()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use crate::{AcquireRequest, Limits, ResourceSpec};
    use ratn_model::resource::{ResourceClass, ResourceOperation};
    use ratn_model::time::Timestamp;
    use ratn_model::value::Value;
    use std::time::Duration;

    const NOW: Timestamp = Timestamp(0);
    const MANY: usize = 300;

    fn pool() -> Pool {
        let mut pool = Pool::new(Limits::default());
        for name in ["a", "b", "c"] {
            pool.keep_alive(NOW, &SessionId::from(name), name, Duration::from_secs(60)).unwrap();
        }
        for number in 0..MANY as i64 {
            let spec = ResourceSpec::new(ResourceClass::Module, "Tool").attribute("odd", Value::Bool(number % 2 == 1));
            pool.create(NOW, Some(&SessionId::from("b")), spec.id(format!("tool-{number:03}"))).unwrap();
        }
        pool
    }

    fn tools(odd: Option<bool>) -> Requirement {
        let mut tools = Requirement::new(ResourceOperation::Block, "Tool");
        tools.attributes.extend(odd.map(|odd| ("odd".to_owned(), Value::Bool(odd))));
        tools
    }

    #[test]
    fn a_search_looks_at_so_many_resources_at_a_time_and_finds_what_one_look_finds() {
        let pool = pool();
        for (requirement, expected) in [(tools(None), MANY), (tools(Some(true)), MANY / 2)] {
            let mut search = Search::new(requirement.clone(), 5);
            let mut parts = 1;
            while !pool.go_on(&mut search, 70) {
                assert!(expected < MANY || search.units() == pool.exists(&requirement), "counted at once");
                parts += 1;
            }
            assert_eq!((parts, search.units()), (5, Quantity::from(expected as u32)));
            assert_eq!(search.into_ids(), pool.fitting(&requirement)[..5]);
        }
    }

    #[test]
    fn a_search_goes_on_where_it_was_whatever_came_and_went_in_between() {
        let mut pool = pool();
        let mut search = Search::new(tools(Some(true)), 5);
        assert!(!pool.go_on(&mut search, 100));
        // The last resource read has been deleted, and so has one that was not read.
        for id in ["tool-099", "tool-201"] {
            pool.delete(NOW, None, id).unwrap();
        }
        while !pool.go_on(&mut search, 100) {}
        assert_eq!(search.units(), Quantity::from(MANY as u32 / 2 - 1), "what was there when it was looked at");
    }

    #[test]
    fn what_sessions_provide_is_counted_in_parts() {
        let mut pool = pool();
        pool.create(NOW, Some(&SessionId::from("a")), ResourceSpec::new(ResourceClass::Module, "Tool")).unwrap();
        let mut count = ProvidedCount::new(tools(Some(true)));
        let parts: Vec<usize> = std::iter::repeat_with(|| pool.count_provided(&mut count, 70)).take(5).collect();
        assert_eq!(parts, [70, 70, 70, 70, 21]);
        let provided = ["a", "b", "c"].map(|name| count.of(&SessionId::from(name)));
        assert_eq!(provided, [Quantity::ZERO, Quantity::whole(MANY as u32 / 2), Quantity::ZERO]);
    }

    #[test]
    fn a_hundred_waiters_are_explained_in_parts() {
        let mut pool = pool();
        let all = Requirement { count: Quantity::from(MANY as u32), ..tools(None) };
        for _ in 0..101 {
            pool.acquire(NOW, AcquireRequest::new(SessionId::from("a"), vec![all.clone()])).unwrap();
        }
        let waiters = pool.first_waiters(100);
        let (explained, done) = pool.explain_some(&waiters, 1_000);
        assert!((1..10).contains(&done) && explained.len() == done, "{done} at once");
        assert_eq!(pool.explain(waiters[0]).as_ref(), explained.first());
        let (mut rest, mut parts) = (&waiters[done..], 1);
        while !rest.is_empty() {
            let (_, done) = pool.explain_some(rest, 1_000);
            rest = &rest[done..];
            parts += 1;
        }
        assert!(parts > 20, "{parts}");
    }

    #[test]
    fn sessions_are_listed_in_parts_and_name_some_of_what_they_have() {
        let mut pool = pool();
        for _ in 0..20 {
            pool.acquire(NOW, AcquireRequest::new(SessionId::from("a"), vec![tools(None)])).unwrap();
        }
        let names = |views: &[SessionView]| views.iter().map(|view| view.id.as_str().to_owned()).collect::<Vec<_>>();
        let first = pool.sessions_after("", 10, 7);
        assert_eq!(names(&first), ["a", "b"], "the second begins below the bound");
        assert_eq!((first[0].leases.len(), first[1].provides.len()), (7, 7));
        assert_eq!(names(&pool.sessions_after("a", 1, 7)), ["b"]);
        assert_eq!(names(&pool.sessions_after("b", 10, 7)), ["c"]);
        assert!(pool.sessions_after("c", 10, 7).is_empty());
    }
}
