//! Changes of the world pool from outside of a run: commits of others while it runs, and facts that expire.
//!
//! The executive has a mirror of the root, in which its own commits are real as soon as it decides them. The pool reports every revision, including
//! the run's own, in the order of commits; other commits may come between a decision and its report. So the run's view of a fact that a revision
//! writes is the value in the pool with the run's own unreported commits applied on top: where the mirror differs, the executive is told. Pure.

use super::record::Decided;
use ratn_executive::protocol::Event;
use ratn_model::fact::{Change, FactKey};
use ratn_model::value::Value;
use ratn_proto::types::WorldChange;
use ratn_world::world::{World, increased};
use std::collections::{BTreeMap, VecDeque};

/// The run's own commits that the pool has not reported yet, oldest first, by id.
#[derive(Debug, Default)]
pub(super) struct Outside {
    pending: VecDeque<(String, Vec<Change>)>,
}

impl Outside {
    /// The run has decided this commit.
    pub(super) fn decided(&mut self, run: &str, decided: &Decided) {
        self.pending.push_back((decided.id(run), decided.changes.clone()));
    }

    /// The pool reports a revision. Returns the event for the executive, if it has to be told.
    pub(super) fn told(&mut self, change: WorldChange, mirror: &World) -> Option<Event> {
        if let Some(place) = self.pending.iter().position(|(id, _)| *id == change.commit) {
            self.pending.drain(..=place);
        }
        let written = change.written.into_iter().map(|fact| (fact.key, Some(fact.value)));
        let gone = change.gone.into_iter().map(|key| (key, None));
        let facts: BTreeMap<FactKey, Option<Value>> = written.chain(gone).collect();
        let facts = facts.into_iter().map(|(key, value)| {
            let value = self.with_pending(&key, value);
            (key, value)
        });
        let facts: Vec<_> = facts.filter(|(key, value)| mirror.get(key) != value.as_ref()).collect();
        (!facts.is_empty()).then_some(Event::WorldChanged { revision: change.revision, facts })
    }

    /// The value of a fact with the run's own unreported commits applied.
    fn with_pending(&self, key: &FactKey, mut value: Option<Value>) -> Option<Value> {
        for change in self.pending.iter().flat_map(|(_, changes)| changes) {
            match change {
                Change::Set { fact, value: set } if fact == key => value = Some(set.clone()),
                Change::Delete { pattern } if pattern.matches(key) => value = None,
                // An increase of a value that is not a number will be refused and reported then.
                Change::Increase { fact, by } if fact == key => {
                    value = increased(fact, value.as_ref(), *by).ok().or(value);
                }
                _ => {}
            }
        }
        value
    }
}

/// All differences of a root from a mirror that should be equal to it.
pub(super) fn differences(root: &World, mirror: &World) -> Vec<(FactKey, Option<Value>)> {
    let otherwise = root.iter().filter(|(key, fact)| mirror.get(key) != Some(&fact.value));
    let gone = mirror.iter().filter(|(key, _)| root.get(key).is_none());
    let written = otherwise.map(|(key, fact)| (key.clone(), Some(fact.value.clone())));
    written.chain(gone.map(|(key, _)| (key.clone(), None))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ledger::Began;
    use ratn_model::fact::FactPattern;
    use ratn_model::id::{InstanceId, Revision};
    use ratn_proto::types::FactRecord;

    fn key(name: &str) -> FactKey {
        FactKey { predicate: name.to_owned(), arguments: Vec::new() }
    }

    fn set(name: &str, value: i64) -> Change {
        Change::Set { fact: key(name), value: Value::Int(value) }
    }

    /// A run with a mirror, beside a pool that others write into.
    struct Bench {
        outside: Outside,
        mirror: World,
        pool: World,
        commits: u64,
    }

    impl Bench {
        fn new() -> Bench {
            let world = World::from_facts([(key("a"), Value::Int(1)), (key("b"), Value::Int(1))], Revision(1));
            Bench { outside: Outside::default(), mirror: world.clone(), pool: world, commits: 0 }
        }

        /// The run decides a commit; the pool receives it later.
        fn decides(&mut self, changes: &[Change]) -> (String, Vec<Change>) {
            self.commits += 1;
            let revision = self.mirror.apply(changes).unwrap_or_default();
            let (instance, writer) = (InstanceId(self.commits), String::new());
            let (changes_made, evidence, began) = (changes.to_vec(), Vec::new(), Began::default());
            let (guard, knew, behind) = (None, Revision::default(), 0);
            let decided =
                Decided { instance, writer, changes: changes_made, evidence, revision, began, guard, knew, behind };
            self.outside.decided("run", &decided);
            (decided.id("run"), changes.to_vec())
        }

        /// The pool commits and reports; returns the names of the facts of which the executive is told.
        fn commits(&mut self, (id, changes): (String, Vec<Change>)) -> Vec<String> {
            let written = self.pool.written_by(None, &changes).unwrap_or_default();
            let revision = self.pool.write(&written);
            let mut change = WorldChange { revision, commit: id, written: Vec::new(), gone: Vec::new(), writer: None };
            for (key, fact) in &written {
                match fact {
                    Some(fact) => change.written.push(FactRecord {
                        key: key.as_ref().clone(),
                        value: fact.value.clone(),
                        revision,
                        writer: None,
                        measured: None,
                    }),
                    None => change.gone.push(key.as_ref().clone()),
                }
            }
            let Some(Event::WorldChanged { facts, .. }) = self.outside.told(change, &self.mirror) else {
                return Vec::new();
            };
            self.mirror.overwrite(facts.iter().cloned());
            facts.into_iter().map(|(key, _)| key.predicate).collect()
        }

        fn is_alike(&self) -> bool {
            differences(&self.pool, &self.mirror).is_empty()
        }
    }

    fn other(changes: &[Change]) -> (String, Vec<Change>) {
        ("other".to_owned(), changes.to_vec())
    }

    #[test]
    fn the_runs_own_commits_are_no_news() {
        let mut bench = Bench::new();
        let first = bench.decides(&[set("a", 2), set("c", 3)]);
        let second = bench.decides(&[set("a", 4)]);
        assert!(bench.commits(first).is_empty() && bench.commits(second).is_empty());
        assert!(bench.is_alike() && bench.outside.pending.is_empty());
    }

    #[test]
    fn what_others_write_is_told_unless_the_run_has_written_over_it() {
        let mut bench = Bench::new();
        let own = bench.decides(&[set("a", 2)]);
        assert_eq!(bench.commits(other(&[set("a", 9), set("b", 9)])), ["b"]);
        assert!(!bench.is_alike());
        assert!(bench.commits(own).is_empty());
        assert!(bench.is_alike());
        assert_eq!(bench.commits(other(&[set("a", 9)])), ["a"]);
        assert!(bench.commits(other(&[set("a", 9)])).is_empty(), "the same once more is nothing new");
        assert!(bench.is_alike());
    }

    #[test]
    fn an_increase_that_was_overtaken_is_one_of_what_there_was_then() {
        let mut bench = Bench::new();
        let own = bench.decides(&[Change::Increase { fact: key("a"), by: 1.0 }]);
        assert_eq!(bench.commits(other(&[set("a", 10)])), ["a"]);
        assert_eq!(bench.mirror.get(&key("a")), Some(&Value::Int(11)));
        assert!(bench.commits(own).is_empty());
        assert!(bench.is_alike());
    }

    #[test]
    fn what_expires_is_gone_and_what_is_deleted_comes_back_only_if_it_was_written_after() {
        let mut bench = Bench::new();
        let delete = |name: &str| Change::Delete { pattern: FactPattern::of(&key(name)) };
        assert_eq!(bench.commits((String::new(), vec![delete("a")])), ["a"]);
        let own = bench.decides(&[delete("b")]);
        assert!(bench.commits(other(&[set("b", 5)])).is_empty(), "the run's deletion comes after it");
        assert!(bench.commits(own).is_empty() && bench.is_alike());
        assert_eq!(bench.commits(other(&[set("b", 5)])), ["b"]);
        assert!(bench.is_alike());
    }
}
