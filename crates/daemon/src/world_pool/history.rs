//! The root world, the revisions of it that are kept, and the commits that are remembered: what is durable of the pool.
//!
//! Every revision shares what it has not changed with the one before it, so keeping one costs what it wrote. What a commit came to
//! is put down as a record, which the journal takes; a snapshot and the records after it make the same history again.

use super::WorldPoolConfig;
use super::memory::{Memory, Reused, fingerprint};
use super::record::{CommitRecord, DecodeError, FactRecord, Names, PatternRecord, SnapshotRecord, decode, encode};
use crate::journal::Journaled;
use bytes::Bytes;
use ratn_model::fact::{Change, FactPattern};
use ratn_model::id::Revision;
use ratn_storage::{MakeSnapshot, Position, Recovered};
use ratn_world::world::{ChangeError, World, Written};
use std::collections::VecDeque;
use std::sync::Arc;

/// See the module.
#[derive(Debug, Clone)]
pub(super) struct History {
    /// The oldest first; the last is the root. Never empty.
    revisions: VecDeque<Arc<Kept>>,
    /// How many facts the kept revisions wrote, the oldest not counted.
    written: usize,
    commits: Memory<Revision>,
    /// Commits since the journal took the last.
    records: Vec<CommitRecord>,
    revisions_kept: usize,
    changes_kept: usize,
}

/// A revision, and what makes it another than the one before.
#[derive(Debug)]
pub(super) struct Kept {
    pub(super) world: World,
    /// The id of the commit that made it.
    pub(super) commit: Arc<str>,
    pub(super) written: Written,
}

/// A commit that was not made; the root is as it was.
#[derive(Debug, PartialEq, thiserror::Error)]
pub(super) enum CommitError {
    #[error("the root is at revision {root}: a commit makes {next}, not {expected}; read the root again")]
    Revision { root: u64, next: u64, expected: u64 },
    #[error(transparent)]
    Change(#[from] ChangeError),
    #[error(transparent)]
    Reused(#[from] Reused),
}

/// A revision that is not kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(super) enum RevisionError {
    #[error("the root is at revision {root}: there is no revision {wanted} yet")]
    Future { root: u64, wanted: u64 },
    #[error("revision {wanted} is no longer kept, the oldest is {oldest}; ask for a later one")]
    Forgotten { wanted: u64, oldest: u64 },
}

/// Why a log is no history.
#[derive(Debug, PartialEq, thiserror::Error)]
pub(super) enum RestoreError {
    #[error("the snapshot means nothing")]
    Snapshot(#[source] DecodeError),
    #[error("entry {position} means nothing")]
    Entry { position: Position, source: DecodeError },
    #[error(
        "a commit makes revision {found}, and {expected} was to be the next: something is missing before it; restore a backup"
    )]
    Gap { found: u64, expected: u64 },
}

impl History {
    /// An empty root at revision 0.
    pub(super) fn new(config: &WorldPoolConfig) -> History {
        History::of(World::default(), config)
    }

    fn of(world: World, config: &WorldPoolConfig) -> History {
        let oldest = Kept { world, commit: Arc::from(""), written: Written::new() };
        History {
            revisions: VecDeque::from([Arc::new(oldest)]),
            written: 0,
            commits: Memory::new(config.remembered_requests),
            records: Vec::new(),
            revisions_kept: config.revisions_kept,
            changes_kept: config.changes_kept,
        }
    }

    /// The history of a snapshot and the entries after it.
    pub(super) fn restore(recovered: Recovered, config: &WorldPoolConfig) -> Result<History, RestoreError> {
        let mut names = Names::default();
        let mut history = History::new(config);
        if let Some(snapshot) = recovered.snapshot {
            let snapshot: SnapshotRecord = decode(&snapshot.payload).map_err(RestoreError::Snapshot)?;
            let facts = snapshot.facts.into_iter().map(|fact| fact.into_fact(&mut names));
            history = History::of(World::of(facts, Revision(snapshot.revision)), config);
            for commit in snapshot.commits {
                history.make_again(commit, &mut names)?;
            }
            for (id, fingerprint, revision) in snapshot.remembered {
                history.commits.insert(&id, fingerprint, Revision(revision));
            }
        }
        for entry in recovered.records {
            let commits: Vec<CommitRecord> =
                decode(&entry.payload).map_err(|source| RestoreError::Entry { position: entry.position, source })?;
            for commit in commits {
                let (id, fingerprint, revision) = (commit.id.clone(), commit.fingerprint, Revision(commit.revision));
                history.make_again(commit, &mut names)?;
                history.commits.insert(&id, fingerprint, revision);
            }
        }
        Ok(history)
    }

    pub(super) fn root(&self) -> &World {
        // One revision is always kept.
        &self.revisions[self.revisions.len() - 1].world
    }

    /// All changes as the next revision, or none. An id committed before gets its answer again.
    pub(super) fn commit(
        &mut self,
        id: &str,
        changes: &[Change],
        expected: Option<Revision>,
    ) -> Result<Revision, CommitError> {
        let fingerprint = fingerprint(&changes);
        if let Some(revision) = self.commits.recall(id, fingerprint)? {
            return Ok(revision);
        }
        let (root, next) = (self.root().revision().0, self.root().revision().0 + 1);
        if let Some(expected) = expected.filter(|expected| expected.0 != next) {
            return Err(CommitError::Revision { root, next, expected: expected.0 });
        }
        let written = self.root().written_by(None, changes)?;
        let deleted = changes.iter().filter_map(|change| match change {
            Change::Delete { pattern } => Some(PatternRecord::new(pattern)),
            _ => None,
        });
        self.records.push(CommitRecord {
            revision: next,
            id: id.to_owned(),
            fingerprint,
            deleted: deleted.collect(),
            written: facts_of(&written),
        });
        let revision = self.push(id, written);
        self.commits.insert(id, fingerprint, revision);
        Ok(revision)
    }

    /// The root as it was at a revision.
    pub(super) fn at(&self, revision: Revision) -> Result<&World, RevisionError> {
        let (root, oldest, wanted) = (self.root().revision().0, self.revisions[0].world.revision().0, revision.0);
        if wanted > root {
            return Err(RevisionError::Future { root, wanted });
        }
        let kept = wanted.checked_sub(oldest).and_then(|index| self.revisions.get(usize::try_from(index).ok()?));
        kept.map(|kept| &kept.world).ok_or(RevisionError::Forgotten { wanted, oldest })
    }

    fn push(&mut self, commit: &str, written: Written) -> Revision {
        let mut world = self.root().clone();
        let revision = world.write(&written);
        self.written += written.len();
        self.revisions.push_back(Arc::new(Kept { world, commit: Arc::from(commit), written }));
        let too_much = |history: &History| {
            history.revisions.len() > history.revisions_kept || history.written > history.changes_kept
        };
        while self.revisions.len() > 1 && too_much(self) {
            self.revisions.pop_front();
            self.written -= self.revisions[0].written.len();
        }
        revision
    }

    fn make_again(&mut self, commit: CommitRecord, names: &mut Names) -> Result<(), RestoreError> {
        let expected = self.root().revision().0 + 1;
        if commit.revision != expected {
            return Err(RestoreError::Gap { found: commit.revision, expected });
        }
        let mut written = Written::new();
        for pattern in commit.deleted {
            let pattern = pattern.into_pattern();
            written.extend(self.root().matching(&pattern).map(|(key, _)| (Arc::new(key.clone()), None)));
        }
        written.extend(commit.written.into_iter().map(|fact| {
            let (key, fact) = fact.into_fact(names);
            (key, Some(fact))
        }));
        self.push(&commit.id, written);
        Ok(())
    }
}

impl Journaled for History {
    fn take_entry(&mut self) -> Option<Vec<u8>> {
        let records = std::mem::take(&mut self.records);
        (!records.is_empty()).then(|| encode(&records))
    }

    fn snapshot(&self) -> MakeSnapshot {
        let revisions: Vec<Arc<Kept>> = self.revisions.iter().cloned().collect();
        let remembered: Vec<_> = self.commits.iter().map(|(id, print, at)| (Arc::clone(id), print, at.0)).collect();
        Box::new(move || {
            let (oldest, later) = (&revisions[0].world, &revisions[1..]);
            Bytes::from(encode(&SnapshotRecord {
                revision: oldest.revision().0,
                facts: oldest.iter().map(|(key, fact)| FactRecord::new(key, fact)).collect(),
                commits: later.iter().map(|kept| kept.record()).collect(),
                remembered: remembered.into_iter().map(|(id, print, at)| (id.to_string(), print, at)).collect(),
            }))
        })
    }
}

impl Kept {
    /// As it was written down; its fingerprint is among what is remembered, if it still is.
    fn record(&self) -> CommitRecord {
        let gone = self.written.iter().filter(|(_, fact)| fact.is_none());
        CommitRecord {
            revision: self.world.revision().0,
            id: self.commit.to_string(),
            fingerprint: 0,
            deleted: gone.map(|(key, _)| PatternRecord::new(&FactPattern::of(key))).collect(),
            written: facts_of(&self.written),
        }
    }
}

fn facts_of(written: &Written) -> Vec<FactRecord> {
    written.iter().filter_map(|(key, fact)| Some(FactRecord::new(key, fact.as_deref()?))).collect()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use proptest::collection::vec;
    use proptest::prelude::*;
    use ratn_model::fact::{FactKey, Term};
    use ratn_model::value::Value;
    use ratn_storage::{Record, Snapshot};

    fn config() -> WorldPoolConfig {
        WorldPoolConfig { revisions_kept: 5, changes_kept: 12, remembered_requests: 7, ..WorldPoolConfig::default() }
    }

    fn key(n: i64) -> FactKey {
        FactKey { predicate: "at".to_owned(), arguments: vec![Term::Int(n % 2), Term::Name(format!("thing-{n}"))] }
    }

    fn change() -> impl Strategy<Value = Change> {
        prop_oneof![
            4 => (0..6_i64, any::<i32>()).prop_map(|(n, x)| Change::Set { fact: key(n), value: Value::Int(x.into()) }),
            2 => (0..6_i64, 0..9).prop_map(|(n, x)| Change::Increase { fact: key(n), by: f64::from(x) / 2.0 }),
            1 => (0..2_i64).prop_map(|n| Change::Delete {
                pattern: FactPattern { predicate: "at".to_owned(), arguments: vec![Some(Term::Int(n)), None] },
            }),
        ]
    }

    /// What the log of a pool holds.
    #[derive(Default)]
    struct Kept {
        entries: Vec<Vec<u8>>,
        snapshot: Option<Vec<u8>>,
    }

    impl Kept {
        fn recovered(&self) -> Recovered {
            let snapshot = self.snapshot.clone().map(|bytes| Snapshot { through: Position(0), payload: bytes.into() });
            let records = self.entries.iter().enumerate();
            let records =
                records.map(|(i, entry)| Record { position: Position(i as u64 + 1), payload: entry.clone().into() });
            Recovered { snapshot, records: records.collect(), ..Recovered::default() }
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 64, failure_persistence: None, ..ProptestConfig::default() })]

        #[test]
        fn a_history_restored_at_any_moment_is_the_same_history(
            steps in vec((vec(change(), 0..5), 0..5_u8), 1..25)
        ) {
            let mut history = History::new(&config());
            let (mut kept, mut worlds, mut made) = (Kept::default(), vec![World::default()], Vec::new());
            for (number, (changes, then)) in steps.into_iter().enumerate() {
                let id = format!("commit-{number}");
                let revision = history.commit(&id, &changes, None).unwrap();
                let mut world = worlds[worlds.len() - 1].clone();
                world.apply(&changes).unwrap();
                worlds.push(world);
                made.push((id, changes, revision));
                kept.entries.extend(history.take_entry());
                if then == 0 {
                    kept = Kept { snapshot: Some(history.snapshot()().to_vec()), entries: Vec::new() };
                }
                if then <= 1 {
                    history = History::restore(kept.recovered(), &config()).unwrap();
                }
                prop_assert_eq!(history.root(), &worlds[worlds.len() - 1]);
                prop_assert!(history.revisions.len() <= 5 && (history.written <= 12 || history.revisions.len() == 1));
                let counted: usize = history.revisions.iter().skip(1).map(|kept| kept.written.len()).sum();
                prop_assert_eq!(history.written, counted);
                for kept in &history.revisions {
                    let revision = kept.world.revision();
                    prop_assert_eq!(history.at(revision).unwrap(), &worlds[revision.0 as usize]);
                }
                for (id, changes, revision) in made.iter().rev().take(7) {
                    prop_assert_eq!(history.commit(id, changes, None), Ok(*revision), "asked again, made once");
                }
            }
        }

        #[test]
        fn no_bytes_make_reading_panic(bytes in vec(any::<u8>(), 0..200)) {
            let entry = [vec![1], bytes].concat();
            let _ = History::restore(Kept { entries: vec![entry.clone()], snapshot: None }.recovered(), &config());
            let _ = History::restore(Kept { entries: Vec::new(), snapshot: Some(entry) }.recovered(), &config());
        }
    }

    #[test]
    fn a_log_with_a_gap_or_of_another_version_is_refused() {
        let mut history = History::new(&config());
        let mut kept = Kept::default();
        for n in 0..3 {
            history.commit(&n.to_string(), &[Change::Set { fact: key(n), value: Value::Null }], None).unwrap();
            kept.entries.extend(history.take_entry());
        }
        let mut gap = Kept { entries: kept.entries.clone(), snapshot: None };
        gap.entries.remove(1);
        let refused = History::restore(gap.recovered(), &config()).unwrap_err();
        assert_eq!(refused, RestoreError::Gap { found: 3, expected: 2 });
        kept.entries[2][0] = 9;
        let refused = History::restore(kept.recovered(), &config()).unwrap_err();
        assert!(matches!(refused, RestoreError::Entry { source: DecodeError::Version { found: 9 }, .. }));
    }
}
