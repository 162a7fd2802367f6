//! Which goals a provider has begun, so that none is begun twice.
//!
//! Two memories with different bounds. Of the goals of the newest lease of each resource every **id** is kept: given again, such a goal is
//! joined, gets its result, or is refused, and under any older lease nothing begins at all (the fence). So that a goal is never begun
//! twice does not depend on how many **results** are kept: of those the newest of each resource are.

use super::goal::GoalEntry;
use ratn_model::id::LeaseId;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;

/// The goals of a server, by id.
#[derive(Debug, Default)]
pub(super) struct Memory {
    /// Under way, or with a result that is kept.
    entries: BTreeMap<String, Arc<GoalEntry>>,
    /// Whose results are kept, the oldest first, by resource.
    ended: BTreeMap<String, VecDeque<String>>,
    /// What was begun under the newest lease of each resource.
    begun: BTreeMap<String, Begun>,
}

#[derive(Debug)]
struct Begun {
    lease: LeaseId,
    goals: BTreeSet<String>,
}

/// What is known of a goal.
#[derive(Debug)]
pub(super) enum Known {
    /// It is under way, or its result is kept.
    Entry(Arc<GoalEntry>),
    /// It was begun, has ended, and its result is not kept any more.
    ResultForgotten(LeaseId),
    /// It was not begun, as far as leases that live go.
    Never,
}

impl Memory {
    pub(super) fn find(&self, goal: &str) -> Known {
        if let Some(entry) = self.entries.get(goal) {
            return Known::Entry(Arc::clone(entry));
        }
        match self.begun.values().find(|begun| begun.goals.contains(goal)) {
            Some(begun) => Known::ResultForgotten(begun.lease),
            None => Known::Never,
        }
    }

    /// How many goals were begun on a resource under a lease, if that is its newest.
    pub(super) fn begun_under(&self, resource: &str, lease: LeaseId) -> usize {
        self.begun.get(resource).filter(|begun| begun.lease == lease).map_or(0, |begun| begun.goals.len())
    }

    /// A goal begins; where it has a lease, that is the newest of its resource.
    pub(super) fn begin(&mut self, entry: &Arc<GoalEntry>) {
        self.entries.insert(entry.id.clone(), Arc::clone(entry));
        let Some(lease) = entry.lease.filter(|_| !entry.resource.is_empty()) else { return };
        let fresh = || Begun { lease, goals: BTreeSet::new() };
        let begun = self.begun.entry(entry.resource.clone()).or_insert_with(fresh);
        if begun.lease != lease {
            *begun = fresh();
        }
        begun.goals.insert(entry.id.clone());
    }

    /// A goal has ended; of its resource so many results are kept.
    pub(super) fn end(&mut self, entry: &GoalEntry, results_kept: usize) {
        let ended = self.ended.entry(entry.resource.clone()).or_default();
        ended.push_back(entry.id.clone());
        while ended.len() > results_kept {
            if let Some(forgotten) = ended.pop_front() {
                self.entries.remove(&forgotten);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ratn_model::id::FencingToken;
    use ratn_model::resource::Lease;
    use ratn_proto::types::Goal;

    fn entry(id: &str, resource: &str, lease: u64) -> Arc<GoalEntry> {
        let lease = Lease { id: LeaseId(lease), token: FencingToken(lease), resources: Vec::new() };
        let goal = Goal { id: id.to_owned(), lease: (lease.id.0 > 0).then_some(lease), ..Goal::default() };
        GoalEntry::new(&goal, resource.to_owned(), true)
    }

    fn perform(memory: &mut Memory, id: &str, resource: &str, lease: u64) {
        let entry = entry(id, resource, lease);
        memory.begin(&entry);
        memory.end(&entry, 2);
    }

    #[test]
    fn of_the_newest_lease_every_goal_is_known_though_its_result_is_not() {
        let mut memory = Memory::default();
        for i in 0..10 {
            perform(&mut memory, &format!("a{i}"), "arm", 1);
        }
        assert!(matches!(memory.find("a9"), Known::Entry(_)));
        assert!(matches!(memory.find("a0"), Known::ResultForgotten(LeaseId(1))));
        assert_eq!((memory.begun_under("arm", LeaseId(1)), memory.begun_under("arm", LeaseId(2))), (10, 0));
        perform(&mut memory, "b", "arm", 2);
        assert!(matches!(memory.find("a0"), Known::Never));
        assert!(matches!(memory.find("a9"), Known::Entry(_)), "results outlast their lease");
        assert_eq!(memory.begun_under("arm", LeaseId(2)), 1);
    }

    #[test]
    fn resources_do_not_take_each_others_place() {
        let mut memory = Memory::default();
        perform(&mut memory, "g", "gripper", 1);
        for i in 0..10 {
            perform(&mut memory, &format!("a{i}"), "arm", 1);
        }
        assert!(matches!(memory.find("g"), Known::Entry(_)));
    }

    #[test]
    fn without_a_lease_only_results_are_kept() {
        let mut memory = Memory::default();
        for id in ["a", "b", "c"] {
            perform(&mut memory, id, "", 0);
        }
        assert!(matches!(memory.find("a"), Known::Never) && matches!(memory.find("c"), Known::Entry(_)));
    }
}
