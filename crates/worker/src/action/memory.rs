//! Remembers which goals a provider has begun, so that no goal is begun twice.
//!
//! A goal is identified by its id, the resource that performs it, and its lease (id and token): nobody can take the id of another's goal.
//! Two requests are for the same goal only if action and inputs are equal, too.
//!
//! There are two memories with different bounds. The **ids** of all goals are kept as long as their lease holds its resource: such a goal,
//! given again, is joined, gets its result, or is refused. Under a lease that is over no goal begins. The guarantee that no goal is begun
//! twice therefore does not depend on how many **results** are kept: of those, only the newest of each resource are.

use super::goal::{Fingerprint, GoalEntry, LeaseKey};
use ratn_model::id::{FencingToken, LeaseId};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;

/// The goals of a server.
#[derive(Debug, Default)]
pub(super) struct Memory {
    /// Goals under way, or with a result that is kept.
    entries: BTreeMap<Key, Arc<GoalEntry>>,
    /// Goals whose results are kept, the oldest first, by resource.
    ended: BTreeMap<String, VecDeque<Key>>,
    /// Ids of the goals begun under each lease of each resource.
    begun: BTreeMap<(String, LeaseKey), BTreeSet<String>>,
}

#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
struct Key {
    resource: String,
    goal: String,
    lease: Option<LeaseKey>,
}

/// The identity of a requested goal.
#[derive(Debug, Clone, Copy)]
pub(super) struct Asked<'a> {
    pub(super) goal: &'a str,
    pub(super) resource: &'a str,
    pub(super) action: &'a str,
    pub(super) inputs: Fingerprint,
    pub(super) lease: Option<LeaseKey>,
    pub(super) session: &'a str,
}

/// What is known of a goal.
#[derive(Debug)]
pub(super) enum Known {
    /// It is under way, or its result is kept.
    Entry(Arc<GoalEntry>),
    /// It was begun, has ended, and its result is not kept any more.
    ResultForgotten(LeaseId),
    /// Another goal has its id; the text says what differs.
    Other(String),
    /// It was not begun under any lease that is still live.
    Never,
}

impl<'a> From<&'a GoalEntry> for Asked<'a> {
    fn from(entry: &'a GoalEntry) -> Asked<'a> {
        Asked {
            goal: &entry.id,
            resource: &entry.resource,
            action: &entry.action,
            inputs: entry.inputs,
            lease: entry.lease,
            session: &entry.session,
        }
    }
}

impl Memory {
    pub(super) fn find(&self, asked: &Asked<'_>) -> Known {
        let key = |lease| Key { resource: asked.resource.to_owned(), goal: asked.goal.to_owned(), lease };
        if let Some(entry) = self.entries.get(&key(asked.lease)) {
            return match difference(asked, entry) {
                None => Known::Entry(Arc::clone(entry)),
                Some(difference) => Known::Other(difference),
            };
        }
        let begun = asked.lease.and_then(|lease| self.begun.get(&(asked.resource.to_owned(), lease)).zip(Some(lease)));
        if let Some((goals, lease)) = begun
            && goals.contains(asked.goal)
        {
            return Known::ResultForgotten(lease.0);
        }
        // Within one session, an id may be used under one lease only. Goals of other sessions do not matter.
        let same_id = self.entries.range(key(None)..).map(|(_, entry)| entry);
        let mut same_id = same_id.take_while(|entry| entry.resource == asked.resource && entry.id == asked.goal);
        match same_id.find(|entry| entry.session == asked.session) {
            Some(entry) => Known::Other(format!(
                "that one was given under {}, and this one is under {}",
                said(entry.lease),
                said(asked.lease)
            )),
            None => Known::Never,
        }
    }

    /// Number of goals begun on a resource under a lease.
    pub(super) fn begun_under(&self, resource: &str, lease: LeaseKey) -> usize {
        self.begun.get(&(resource.to_owned(), lease)).map_or(0, BTreeSet::len)
    }

    /// Records that a goal begins.
    pub(super) fn begin(&mut self, entry: &Arc<GoalEntry>) {
        self.entries.insert(Key::of(entry), Arc::clone(entry));
        let Some(lease) = entry.lease.filter(|_| !entry.resource.is_empty()) else { return };
        self.begun.entry((entry.resource.clone(), lease)).or_default().insert(entry.id.clone());
    }

    /// Records that a goal has ended; keeps `results_kept` results of its resource.
    pub(super) fn end(&mut self, entry: &GoalEntry, results_kept: usize) {
        let ended = self.ended.entry(entry.resource.clone()).or_default();
        ended.push_back(Key::of(entry));
        while ended.len() > results_kept {
            if let Some(forgotten) = ended.pop_front() {
                self.entries.remove(&forgotten);
            }
        }
    }

    /// Forgets the goals begun on a resource under leases that are over: no goal begins under those any more.
    pub(super) fn forget_begun(&mut self, resource: &str, is_over: impl Fn(LeaseKey) -> bool) {
        let least = (resource.to_owned(), (LeaseId(0), FencingToken(0)));
        let of_resource = self.begun.range(least..).map(|(key, _)| key).take_while(|(of, _)| of == resource);
        let over: Vec<(String, LeaseKey)> = of_resource.filter(|(_, lease)| is_over(*lease)).cloned().collect();
        for lease in &over {
            self.begun.remove(lease);
        }
    }
}

impl Key {
    fn of(entry: &GoalEntry) -> Key {
        Key { resource: entry.resource.clone(), goal: entry.id.clone(), lease: entry.lease }
    }
}

fn difference(asked: &Asked<'_>, known: &GoalEntry) -> Option<String> {
    if asked.action != known.action {
        return Some(format!("that one's action is `{}`, and this one's `{}`", known.action, asked.action));
    }
    (asked.inputs != known.inputs).then(|| "it has other inputs".to_owned())
}

fn said(lease: Option<LeaseKey>) -> String {
    lease.map_or_else(|| "no lease".to_owned(), |(id, token)| format!("{id} ({token})"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::access::Caller;
    use ratn_model::resource::Lease;
    use ratn_proto::types::Goal;

    fn entry(id: &str, resource: &str, lease: u64) -> Arc<GoalEntry> {
        let lease =
            Lease { id: LeaseId(lease), token: FencingToken(lease), resources: Vec::new(), consumed: Vec::new() };
        let session = format!("session-{}", lease.id.0);
        let lease = (lease.id.0 > 0).then_some(lease);
        let goal = Goal { id: id.to_owned(), action: "move".to_owned(), session, lease, ..Goal::default() };
        let giver = Caller { name: "giver".into(), roles: [].as_slice().into() };
        GoalEntry::new(&giver, &goal, Fingerprint::of(None), resource, true)
    }

    fn perform(memory: &mut Memory, id: &str, resource: &str, lease: u64) {
        let entry = entry(id, resource, lease);
        memory.begin(&entry);
        memory.end(&entry, 2);
    }

    fn find(memory: &Memory, id: &str, resource: &str, lease: u64) -> Known {
        memory.find(&Asked::from(&*entry(id, resource, lease)))
    }

    fn key(lease: u64) -> LeaseKey {
        (LeaseId(lease), FencingToken(lease))
    }

    #[test]
    fn of_leases_that_live_every_goal_is_known_though_its_result_is_not() {
        let mut memory = Memory::default();
        for i in 0..10 {
            perform(&mut memory, &format!("a{i}"), "arm", 1);
        }
        assert!(matches!(find(&memory, "a9", "arm", 1), Known::Entry(_)));
        assert!(matches!(find(&memory, "a0", "arm", 1), Known::ResultForgotten(LeaseId(1))));
        assert_eq!((memory.begun_under("arm", key(1)), memory.begun_under("arm", key(2))), (10, 0));
        // The same with another resource under another lease.
        perform(&mut memory, "b", "arm", 2);
        assert!(matches!(find(&memory, "a0", "arm", 1), Known::ResultForgotten(LeaseId(1))));
        memory.forget_begun("arm", |lease| lease == key(1));
        assert!(matches!(find(&memory, "a0", "arm", 1), Known::Never));
        assert!(matches!(find(&memory, "a9", "arm", 1), Known::Entry(_)), "results outlast their lease");
        assert_eq!(memory.begun_under("arm", key(2)), 1);
    }

    #[test]
    fn a_goal_of_another_resource_lease_or_token_is_another_goal() {
        let mut memory = Memory::default();
        perform(&mut memory, "a", "camera", 1);
        assert!(matches!(find(&memory, "a", "arm", 2), Known::Never));
        assert!(matches!(find(&memory, "a", "camera", 2), Known::Never));
        let known = entry("a", "camera", 1);
        let token = Asked { lease: Some((LeaseId(1), FencingToken(9))), session: "", ..Asked::from(&*known) };
        assert!(matches!(memory.find(&token), Known::Never));
    }

    #[test]
    fn what_differs_from_the_goal_of_an_id_is_said() {
        let mut memory = Memory::default();
        perform(&mut memory, "a", "arm", 1);
        let same = entry("a", "arm", 1);
        let differs = |asked: Asked<'_>, why: &str| {
            let known = memory.find(&asked);
            assert!(matches!(&known, Known::Other(said) if said.contains(why)), "{known:?}");
        };
        differs(
            Asked { action: "grasp", ..Asked::from(&*same) },
            "that one's action is `move`, and this one's `grasp`",
        );
        let inputs = [("x".to_owned(), ratn_model::value::Value::Int(1))].into();
        let inputs = Fingerprint::of(Some(&Goal { inputs, ..Goal::default() }.into()));
        differs(Asked { inputs, ..Asked::from(&*same) }, "other inputs");
        let under_another = Asked { lease: Some(key(2)), ..Asked::from(&*same) };
        differs(under_another, "under lease-1 (token-1), and this one is under lease-2");
    }

    #[test]
    fn resources_do_not_take_each_others_place() {
        let mut memory = Memory::default();
        perform(&mut memory, "g", "gripper", 1);
        for i in 0..10 {
            perform(&mut memory, &format!("a{i}"), "arm", 1);
        }
        assert!(matches!(find(&memory, "g", "gripper", 1), Known::Entry(_)));
    }

    #[test]
    fn without_a_lease_only_results_are_kept() {
        let mut memory = Memory::default();
        for id in ["a", "b", "c"] {
            perform(&mut memory, id, "", 0);
        }
        assert!(matches!(find(&memory, "a", "", 0), Known::Never));
        assert!(matches!(find(&memory, "c", "", 0), Known::Entry(_)));
    }
}
