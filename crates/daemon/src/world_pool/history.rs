//! The root world, its kept revisions and the remembered commits: the durable part of the pool.
//!
//! Each revision shares what it has not changed with the one before, so keeping it costs what it wrote. The result of a commit
//! becomes a record, which the journal writes; a snapshot and the records after it restore the same history.

use super::WorldPoolConfig;
use super::fingerprint::Fingerprint;
use super::looks::{self, TooManyLooks};
use super::memory::{Memory, Reused};
use super::record::{CommitRecord, EntryRecord, FactRecord, Names, PatternRecord, SnapshotRecord, encode, writer_name};
use super::size;
use crate::access::Caller;
use crate::durable_actor::Journaled;
use bytes::Bytes;
use ratn_model::fact::{Change, FactKey, FactPattern};
use ratn_model::id::Revision;
use ratn_model::measurement::Measurement;
use ratn_model::ontology::{Ontology, Violation};
use ratn_model::versioned::DecodeError;
use ratn_storage::{MakeSnapshot, Position, Recovered};
use ratn_world::world::{ChangeError, Fact, World, Written};
use std::collections::{BTreeSet, VecDeque};
use std::sync::Arc;

/// See the module.
#[derive(Debug, Clone)]
pub(super) struct History {
    /// Oldest first; the last is the root. Never empty.
    revisions: VecDeque<Arc<Kept>>,
    /// Number of facts that the kept revisions wrote, without the oldest revision.
    written: usize,
    /// Bytes of the kept revisions besides the root, without the oldest revision.
    bytes: usize,
    commits: Memory<Revision>,
    /// Commits that the journal has not taken yet.
    records: EntryRecord,
    /// Revisions since the last [`History::take_news`].
    news: Vec<Arc<Kept>>,
    /// Revisions that were dropped since the last [`History::take_forgotten`].
    forgotten: Vec<Arc<Kept>>,
    revisions_kept: usize,
    changes_kept: usize,
    revision_bytes: usize,
}

/// The changes of the next revision.
#[derive(Debug, Clone, Default)]
pub(super) struct Commit {
    /// The committing caller; the pool itself where facts expired.
    pub(super) by: Caller,
    /// Unique among the caller's commits; a repeated commit gets its first answer. Empty where facts expired.
    pub(super) id: String,
    pub(super) changes: Vec<Change>,
    /// The number that the next revision has to have.
    pub(super) expected: Option<Revision>,
    pub(super) writer: Option<String>,
    /// Measurements of facts that are written.
    pub(super) evidence: Vec<(FactKey, Measurement)>,
}

/// A fact in two revisions.
pub(super) type Difference = (Arc<FactKey>, Option<Arc<Fact>>, Option<Arc<Fact>>);

/// Two revisions to compare. That may take long, so it is not done in the actor's thread.
#[derive(Debug)]
pub(super) struct Between {
    before: World,
    after: World,
    written: Vec<Arc<Kept>>,
}

impl Between {
    /// The facts that differ, in the order of keys: facts that were written in between and have another value.
    pub(super) fn differences(&self) -> impl Iterator<Item = Difference> {
        let keys: BTreeSet<&Arc<FactKey>> = self.written.iter().flat_map(|kept| kept.written.keys()).collect();
        let shared = |world: &World, key| world.fact(key).map(|fact| Arc::new(fact.clone()));
        let both =
            keys.into_iter().map(move |key| (Arc::clone(key), shared(&self.before, key), shared(&self.after, key)));
        both.filter(|(_, before, after)| before != after)
    }
}

/// A fact from one revision on.
#[derive(Debug, PartialEq)]
pub(super) struct Version {
    pub(super) revision: Revision,
    /// The commit's id; empty where it is not kept any more.
    pub(super) commit: Arc<str>,
    pub(super) fact: Option<Arc<Fact>>,
    /// The node that wrote or deleted it.
    pub(super) writer: Option<Arc<str>>,
}

/// A revision, and its difference from the one before.
#[derive(Debug)]
pub(super) struct Kept {
    pub(super) world: World,
    /// The id of the commit that made it.
    pub(super) commit: Arc<str>,
    /// The node that made it.
    pub(super) writer: Option<Arc<str>>,
    pub(super) written: Written,
    /// Bytes that it takes to keep the revision before as well: the written keys and their former facts.
    bytes: usize,
}

impl Kept {
    /// A revision whose commit is not kept.
    fn given(world: World) -> Arc<Kept> {
        Arc::new(Kept { world, commit: Arc::default(), writer: None, written: Written::new(), bytes: 0 })
    }
}

/// Why a commit was not made; the root is unchanged.
#[derive(Debug, PartialEq, thiserror::Error)]
pub(super) enum CommitError {
    #[error("the root is at revision {root}: a commit makes {next}, not {expected}; read the root again")]
    Revision { root: u64, next: u64, expected: u64 },
    #[error(transparent)]
    Change(#[from] ChangeError),
    #[error(transparent)]
    Reused(#[from] Reused),
    #[error("{fact} is not among what is written: it has no evidence")]
    Evidence { fact: FactKey },
    #[error(transparent)]
    Violation(#[from] Violation),
    #[error(transparent)]
    TooManyLooks(#[from] TooManyLooks),
}

/// Why a revision is not available.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(super) enum RevisionError {
    #[error("the root is at revision {root}: there is no revision {wanted} yet")]
    Future { root: u64, wanted: u64 },
    #[error("revision {wanted} is no longer kept, the oldest is {oldest}; ask for a later one")]
    Forgotten { wanted: u64, oldest: u64, root: u64 },
}

/// Why a log cannot be restored as a history.
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
        History {
            revisions: VecDeque::from([Kept::given(world)]),
            written: 0,
            bytes: 0,
            commits: Memory::new(config.remembered()),
            records: EntryRecord::default(),
            news: Vec::new(),
            forgotten: Vec::new(),
            revisions_kept: config.revisions_kept,
            changes_kept: config.changes_kept,
            revision_bytes: config.revision_bytes,
        }
    }

    /// Restores the history from a snapshot and the entries after it.
    pub(super) fn restore(recovered: Recovered, config: &WorldPoolConfig) -> Result<History, RestoreError> {
        let mut names = Names::default();
        let mut history = History::new(config);
        if let Some(snapshot) = recovered.snapshot {
            let snapshot = SnapshotRecord::decode(&snapshot.payload).map_err(RestoreError::Snapshot)?;
            let facts = snapshot.facts.into_iter().map(|fact| fact.into_fact(&mut names));
            history = History::of(World::of(facts, Revision(snapshot.revision)), config);
            let mut writers = snapshot.writers.into_iter();
            for commit in snapshot.commits {
                history.make_again(commit, writers.next(), &mut names)?;
            }
            let mut callers = snapshot.callers.into_iter();
            for (id, fingerprint, revision) in snapshot.remembered {
                history.commits.insert(&callers.next().unwrap_or_default(), &id, fingerprint, Revision(revision));
            }
        }
        for entry in recovered.records {
            let EntryRecord { commits, callers, writers } = EntryRecord::decode(&entry.payload)
                .map_err(|source| RestoreError::Entry { position: entry.position, source })?;
            let (mut callers, mut writers) = (callers.into_iter(), writers.into_iter());
            for commit in commits {
                let caller = callers.next().unwrap_or_default();
                let (id, fingerprint, revision) = (commit.id.clone(), commit.fingerprint, Revision(commit.revision));
                let is_leap = commit.is_leap();
                history.make_again(commit, writers.next(), &mut names)?;
                if !is_leap {
                    history.commits.insert(&caller, &id, fingerprint, revision);
                }
            }
        }
        Ok(history)
    }

    /// Continues above `floor`, so that numbers of lost revisions that clients may have heard of are not used again. Earlier
    /// revisions are dropped.
    pub(super) fn with_revisions_above(mut self, floor: Revision) -> History {
        if self.root().revision() < floor {
            self.go_on_from(floor);
            let record = CommitRecord { revision: floor.0, ..CommitRecord::default() };
            self.put_down(&Arc::default(), None, record);
        }
        self
    }

    fn put_down(&mut self, caller: &Arc<str>, writer: Option<&Arc<str>>, record: CommitRecord) {
        self.records.commits.push(record);
        self.records.callers.push(caller.clone());
        self.records.writers.push(writer_name(writer));
    }

    fn go_on_from(&mut self, revision: Revision) {
        let world = self.root().clone().numbered(revision);
        self.revisions = VecDeque::from([Kept::given(world)]);
        (self.written, self.bytes) = (0, 0);
    }

    pub(super) fn root(&self) -> &World {
        // At least one revision is always kept.
        &self.revisions[self.revisions.len() - 1].world
    }

    /// Commits all changes as the next revision, or none of them. A repeated id gets its first answer again.
    pub(super) fn commit(&mut self, commit: &Commit, ontology: Option<&Ontology>) -> Result<Revision, CommitError> {
        let Commit { by, id, changes, expected, writer, evidence } = commit;
        let fingerprint = Fingerprint::of_commit(changes);
        if let Some(revision) = self.commits.recall_for(by, id, fingerprint)? {
            return Ok(revision);
        }
        let (root, next) = (self.root().revision().0, self.root().revision().0 + 1);
        if let Some(expected) = expected.filter(|expected| expected.0 != next) {
            return Err(CommitError::Revision { root, next, expected: expected.0 });
        }
        if let Some(ontology) = ontology {
            ontology.check_changes(changes)?;
        }
        looks::check(self.root(), changes)?;
        let mut written = self.root().written_by(writer.as_deref(), changes)?;
        for (key, measured) in evidence {
            let fact = written.get_mut(key).and_then(Option::as_mut);
            let fact = fact.ok_or_else(|| CommitError::Evidence { fact: key.clone() })?;
            if let Some(ontology) = ontology {
                ontology.check_measurement(key, &fact.value, measured)?;
            }
            Arc::make_mut(fact).measured = Some(Arc::new(measured.clone()));
        }
        let deleted = changes.iter().filter_map(|change| match change {
            Change::Delete { pattern } => Some(PatternRecord::new(pattern)),
            _ => None,
        });
        let record = CommitRecord {
            revision: next,
            id: id.clone(),
            fingerprint,
            deleted: deleted.collect(),
            written: facts_of(&written),
        };
        let writer = writer.as_deref().map(Arc::<str>::from);
        self.put_down(&by.name, writer.as_ref(), record);
        let forgotten = self.push(id, writer, written);
        self.forgotten.extend(forgotten);
        self.news.extend(self.revisions.back().cloned());
        self.commits.insert(&by.name, id, fingerprint, Revision(next));
        Ok(Revision(next))
    }

    /// The revisions that commits since the last call have pushed out, oldest first, each with its successor.
    pub(super) fn take_forgotten(&mut self) -> Vec<(Arc<Kept>, Arc<Kept>)> {
        let forgotten = std::mem::take(&mut self.forgotten);
        let behind = forgotten.iter().skip(1).chain(self.revisions.front()).cloned().collect::<Vec<_>>();
        forgotten.into_iter().zip(behind).collect()
    }

    /// The revision that a commit of this caller has made, as long as it is remembered.
    pub(super) fn commit_of(&self, caller: &Arc<str>, id: &str) -> Option<Revision> {
        self.commits.of(caller, id)
    }

    /// The root as it was at a revision.
    pub(super) fn at(&self, revision: Revision) -> Result<&World, RevisionError> {
        let (root, oldest, wanted) = (self.root().revision().0, self.revisions[0].world.revision().0, revision.0);
        if wanted > root {
            return Err(RevisionError::Future { root, wanted });
        }
        let kept = wanted.checked_sub(oldest).and_then(|index| self.revisions.get(usize::try_from(index).ok()?));
        kept.map(|kept| &kept.world).ok_or(RevisionError::Forgotten { wanted, oldest, root })
    }

    /// The current root as a kept revision.
    pub(super) fn newest(&self) -> Option<&Arc<Kept>> {
        self.revisions.back()
    }

    /// The revisions since the last call.
    pub(super) fn take_news(&mut self) -> Vec<Arc<Kept>> {
        std::mem::take(&mut self.news)
    }

    /// Every revision after `revision`.
    pub(super) fn after(&self, revision: Revision) -> Result<impl Iterator<Item = &Arc<Kept>>, RevisionError> {
        self.at(revision)?;
        let known = self.revisions.iter().skip(1);
        Ok(known.skip_while(move |kept| kept.world.revision() <= revision))
    }

    /// Two revisions, and the revisions between them.
    pub(super) fn between(&self, from: Revision, to: Revision) -> Result<Between, RevisionError> {
        let (before, after) = (self.at(from)?.clone(), self.at(to)?.clone());
        let written = self.after(from.min(to))?.take_while(|kept| kept.world.revision() <= from.max(to));
        Ok(Between { written: written.map(Arc::clone).collect(), before, after })
    }

    /// The versions of a fact, newest first, and the oldest kept revision.
    pub(super) fn versions(&self, key: &FactKey, limit: usize) -> (Vec<Version>, Revision) {
        let oldest = &self.revisions[0].world;
        let written = self.revisions.iter().rev().filter_map(|kept| {
            let (revision, commit) = (kept.world.revision(), Arc::clone(&kept.commit));
            Some(Version { revision, commit, fact: kept.written.get(key)?.clone(), writer: kept.writer.clone() })
        });
        let before = oldest.fact(key).filter(|_| !self.revisions[0].written.contains_key(key));
        let before = before.map(|fact| Version {
            revision: fact.revision,
            commit: Arc::default(),
            writer: fact.writer.clone(),
            fact: Some(Arc::new(fact.clone())),
        });
        (written.chain(before).take(limit).collect(), oldest.revision())
    }

    /// Adds a revision; returns the revisions that it pushes out, oldest first.
    fn push(&mut self, commit: &str, writer: Option<Arc<str>>, written: Written) -> Vec<Arc<Kept>> {
        let mut world = self.root().clone();
        let was = |key: &FactKey| world.fact(key).map_or_else(|| size::of_key(key), |fact| size::of_fact(key, fact));
        let bytes = written.keys().map(|key| was(key)).sum();
        world.write(&written);
        self.written += written.len();
        self.bytes += bytes;
        self.revisions.push_back(Arc::new(Kept { world, commit: Arc::from(commit), writer, written, bytes }));
        let too_much = |history: &History| {
            history.revisions.len() > history.revisions_kept
                || history.written > history.changes_kept
                || history.bytes > history.revision_bytes
        };
        let mut forgotten = Vec::new();
        while self.revisions.len() > 1 && too_much(self) {
            forgotten.extend(self.revisions.pop_front());
            self.written -= self.revisions[0].written.len();
            self.bytes -= self.revisions[0].bytes;
        }
        forgotten
    }

    fn make_again(
        &mut self,
        commit: CommitRecord,
        writer: Option<Arc<str>>,
        names: &mut Names,
    ) -> Result<(), RestoreError> {
        let expected = self.root().revision().0 + 1;
        if commit.is_leap() && commit.revision > expected {
            self.go_on_from(Revision(commit.revision));
            return Ok(());
        }
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
        // Older records have no writer of the commit; it is taken from their facts.
        let of_facts = || written.values().flatten().next()?.writer.clone();
        let writer = writer.map_or_else(of_facts, |name| (!name.is_empty()).then(|| names.share(name)));
        self.push(&commit.id, writer, written);
        Ok(())
    }
}

impl Journaled for History {
    fn take_entry(&mut self) -> Option<Vec<u8>> {
        let records = std::mem::take(&mut self.records);
        (!records.commits.is_empty()).then(|| encode(&records))
    }

    fn snapshot(&self) -> MakeSnapshot {
        let revisions: Vec<Arc<Kept>> = self.revisions.iter().cloned().collect();
        let remembered: Vec<_> =
            self.commits.iter().map(|(caller, id, print, at)| (caller.clone(), id.clone(), print, at.0)).collect();
        Box::new(move || {
            let (oldest, later) = (&revisions[0].world, &revisions[1..]);
            let callers = remembered.iter().map(|(caller, ..)| caller.clone()).collect();
            let remembered = remembered.into_iter().map(|(_, id, print, at)| (id.to_string(), print, at)).collect();
            Bytes::from(encode(&SnapshotRecord {
                revision: oldest.revision().0,
                facts: oldest.iter().map(|(key, fact)| FactRecord::new(key, fact)).collect(),
                commits: later.iter().map(|kept| kept.record()).collect(),
                remembered,
                callers,
                writers: later.iter().map(|kept| writer_name(kept.writer.as_ref())).collect(),
            }))
        })
    }
}

impl Kept {
    /// The changes from the revision before to this one.
    pub(super) fn changes(&self) -> impl Iterator<Item = Change> {
        self.written.iter().map(|(key, fact)| match fact {
            Some(fact) => Change::Set { fact: key.as_ref().clone(), value: fact.value.clone() },
            None => Change::Delete { pattern: FactPattern::of(key) },
        })
    }

    /// The record of the revision, without its fingerprint: that one is kept with the remembered commits.
    fn record(&self) -> CommitRecord {
        let gone = self.written.iter().filter(|(_, fact)| fact.is_none());
        CommitRecord {
            revision: self.world.revision().0,
            id: self.commit.to_string(),
            fingerprint: Fingerprint::UNKNOWN,
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
    use ratn_model::fact::Term;
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

    fn commit(id: &str, changes: &[Change]) -> Commit {
        commit_as("adam", id, changes)
    }

    fn commit_as(name: &str, id: &str, changes: &[Change]) -> Commit {
        let by = Caller { name: name.into(), ..Caller::default() };
        Commit { by, id: id.to_owned(), changes: changes.to_vec(), ..Commit::default() }
    }

    /// The contents of a pool's log.
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

    /// Compares every fact.
    fn difference(before: &World, after: &World) -> Vec<Difference> {
        let keys: BTreeSet<&FactKey> = before.iter().chain(after.iter()).map(|(key, _)| key).collect();
        let fact = |world: &World, key| world.fact(key).map(|fact| Arc::new(fact.clone()));
        let both = keys.into_iter().map(|key| (Arc::new(key.clone()), fact(before, key), fact(after, key)));
        both.filter(|(_, before, after)| before != after).collect()
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
                let revision = history.commit(&commit(&id, &changes), None).unwrap();
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
                let later = || history.revisions.iter().skip(1);
                prop_assert_eq!(history.written, later().map(|kept| kept.written.len()).sum::<usize>());
                prop_assert_eq!(history.bytes, later().map(|kept| kept.bytes).sum::<usize>());
                for kept in &history.revisions {
                    let revision = kept.world.revision();
                    prop_assert_eq!(history.at(revision).unwrap(), &worlds[revision.0 as usize]);
                    for (from, to) in [(revision, history.root().revision()), (history.root().revision(), revision)] {
                        let expected = difference(&worlds[from.0 as usize], &worlds[to.0 as usize]);
                        let between = history.between(from, to).unwrap();
                        prop_assert_eq!(between.differences().collect::<Vec<_>>(), expected);
                    }
                    let after: Vec<Revision> =
                        history.after(revision).unwrap().map(|kept| kept.world.revision()).collect();
                    let expected: Vec<Revision> = (revision.0 + 1..worlds.len() as u64).map(Revision).collect();
                    prop_assert_eq!(after, expected, "no gap, in order");
                }
                for n in 0..6 {
                    let (versions, oldest) = history.versions(&key(n), 100);
                    prop_assert_eq!(oldest, history.revisions[0].world.revision());
                    for (at, world) in worlds.iter().enumerate().skip(oldest.0 as usize) {
                        let then = versions.iter().find(|version| version.revision.0 as usize <= at);
                        prop_assert_eq!(then.and_then(|version| version.fact.as_deref()), world.fact(&key(n)));
                    }
                }
                for (id, changes, revision) in made.iter().rev().take(7) {
                    prop_assert_eq!(history.commit(&commit(id, changes), None), Ok(*revision), "asked again, made once");
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
    fn revisions_are_forgotten_for_the_bytes_that_they_take_besides_the_root() {
        const MIB: usize = 1 << 20;
        let config = WorldPoolConfig { revision_bytes: 4 * MIB, ..WorldPoolConfig::default() };
        let large = |n: i64| [Change::Set { fact: key(n), value: Value::Bytes(vec![n as u8; MIB]) }];
        let mut history = History::new(&config);
        for n in 0..9 {
            history.commit(&commit(&format!("new-{n}"), &large(n)), None).unwrap();
        }
        assert_eq!(history.revisions.len(), 10, "all of it is in the root: an older one takes nothing besides");
        let mut kept = Kept::default();
        for round in 0..20 {
            history.commit(&commit(&format!("over-{round}"), &large(0)), None).unwrap();
            assert!(history.bytes <= 4 * MIB);
        }
        assert_eq!(history.revisions.len(), 4, "three values of before, and a little for each");
        history.commit(&commit("small", &[Change::Set { fact: key(1), value: Value::Null }]), None).unwrap();
        assert_eq!(history.revisions.len(), 4, "what was replaced counts, not what replaces it");
        // The same holds after a restart.
        kept.entries.extend(history.take_entry());
        let again = History::restore(kept.recovered(), &config).unwrap();
        assert_eq!((again.revisions.len(), again.bytes), (history.revisions.len(), history.bytes));
        // A revision that is larger than the limit is made all the same.
        let none = WorldPoolConfig { revision_bytes: 0, ..WorldPoolConfig::default() };
        let mut history = History::new(&none);
        for n in 0..3 {
            history.commit(&commit(&n.to_string(), &large(0)), None).unwrap();
        }
        assert_eq!((history.revisions.len(), history.root().revision()), (1, Revision(3)));
    }

    #[test]
    fn whose_a_commit_is_is_known_from_entries_and_from_a_snapshot_and_not_from_those_of_an_earlier_version() {
        let changes = [Change::Set { fact: key(1), value: Value::Int(1) }];
        let mut history = History::new(&config());
        history.commit(&commit_as("a", "r", &changes), None).unwrap();
        let entry = history.take_entry().unwrap();
        let snapshot = history.snapshot()().to_vec();
        // In an earlier version the record ends before the lists of callers and writers.
        let earlier = |bytes: &[u8]| [&[2], &bytes.strip_suffix(&[1, 1, b'a', 1, 0]).unwrap()[1..]].concat();
        let of_entry = |entry: Vec<u8>| Kept { entries: vec![entry], snapshot: None };
        let of_snapshot = |bytes: Vec<u8>| Kept { entries: Vec::new(), snapshot: Some(bytes) };
        for kept in [of_entry(entry.clone()), of_snapshot(snapshot.clone())] {
            let mut again = History::restore(kept.recovered(), &config()).unwrap();
            assert_eq!(again.commit(&commit_as("a", "r", &changes), None), Ok(Revision(1)));
            assert_eq!(again.commit(&commit_as("b", "r", &changes), None), Ok(Revision(2)), "another caller's");
        }
        for kept in [of_entry(earlier(&entry)), of_snapshot(earlier(&snapshot))] {
            let mut again = History::restore(kept.recovered(), &config()).unwrap();
            assert_eq!(again.commit(&commit_as("b", "r", &changes), None), Ok(Revision(1)), "whoever asks the same");
            assert_eq!(again.commit(&commit_as("b", "r", &[]), None), Ok(Revision(2)), "something else");
        }
    }

    #[test]
    fn whose_a_revision_is_that_only_deletes_is_known_after_a_restart_too() {
        let as_node = |id: &str, changes: &[Change], writer: Option<&str>| Commit {
            writer: writer.map(str::to_owned),
            ..commit(id, changes)
        };
        let delete = [Change::Delete { pattern: FactPattern::of(&key(1)) }];
        let mut history = History::new(&config());
        history.commit(&as_node("r", &[Change::Set { fact: key(1), value: Value::Int(1) }], Some("n")), None).unwrap();
        history.commit(&as_node("d", &delete, Some("m")), None).unwrap();
        history.commit(&as_node("e", &delete, None), None).unwrap();
        let writers = |history: &History| -> Vec<Option<String>> {
            history.revisions.iter().map(|kept| kept.writer.as_deref().map(str::to_owned)).collect()
        };
        let made = vec![None, Some("n".to_owned()), Some("m".to_owned()), None];
        assert_eq!(writers(&history), made);
        let gone = &history.versions(&key(1), 9).0[0];
        assert_eq!((gone.revision, gone.writer.as_deref()), (Revision(2), Some("m")));
        let (entry, snapshot) = (history.take_entry().unwrap(), history.snapshot()().to_vec());
        let of_entry = |entry: Vec<u8>| Kept { entries: vec![entry], snapshot: None };
        let of_snapshot = |bytes: Vec<u8>| Kept { entries: Vec::new(), snapshot: Some(bytes) };
        for kept in [of_entry(entry.clone()), of_snapshot(snapshot.clone())] {
            assert_eq!(writers(&History::restore(kept.recovered(), &config()).unwrap()), made);
        }
        // In version 3 the record ends before the list of writers: only facts name their writer.
        let earlier = |bytes: &[u8]| [&[3], &bytes.strip_suffix(&[3, 1, b'n', 1, b'm', 0]).unwrap()[1..]].concat();
        for kept in [of_entry(earlier(&entry)), of_snapshot(earlier(&snapshot))] {
            let again = History::restore(kept.recovered(), &config()).unwrap();
            assert_eq!(writers(&again), [None, Some("n".to_owned()), None, None]);
        }
    }

    #[test]
    fn a_log_with_a_gap_or_of_another_version_is_refused() {
        let mut history = History::new(&config());
        let mut kept = Kept::default();
        for n in 0..3 {
            let changes = [Change::Set { fact: key(n), value: Value::Null }];
            history.commit(&commit(&n.to_string(), &changes), None).unwrap();
            kept.entries.extend(history.take_entry());
        }
        let mut gap = Kept { entries: kept.entries.clone(), snapshot: None };
        gap.entries.remove(1);
        let refused = History::restore(gap.recovered(), &config()).unwrap_err();
        assert_eq!(refused, RestoreError::Gap { found: 3, expected: 2 });
        kept.entries[2][0] = 9;
        let refused = History::restore(kept.recovered(), &config()).unwrap_err();
        assert!(matches!(refused, RestoreError::Entry { source: DecodeError::Version { found: 9, .. }, .. }));
    }
}
