//! The root's history as bytes: entries of the log, and the snapshot that replaces them.
//!
//! A commit is recorded as its result (which facts have which values, which are deleted), never as the request: nothing is computed
//! again when it is read.

use super::fingerprint::Fingerprint;
use ratn_model::fact::{FactKey, FactPattern, Term};
use ratn_model::id::Revision;
use ratn_model::measurement::Measurement;
use ratn_model::value::Value;
use ratn_model::versioned::{self, DecodeError};
use ratn_world::world::Fact;
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::sync::Arc;

/// The version that is written, as the first byte. Enums may only get new variants at their end; every other change needs a new number,
/// and older versions are still read.
const FORMAT: u8 = 4;
/// The last version that does not name the writer of a commit that only deletes.
const WITHOUT_WRITERS: u8 = 3;
/// The last version that does not name the callers of commits.
const WITHOUT_CALLERS: u8 = 2;
/// In this version fingerprints are of the debug text of changes, which later versions cannot compare.
const DEBUG_FINGERPRINTS: u8 = 1;
/// What the bytes are, for error messages.
const RECORDS: &str = "records of a world pool";

/// One commit. Without an id and without changes it is a leap: the revisions before it are lost, and numbering continues from it.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct CommitRecord {
    pub(super) revision: u64,
    pub(super) id: String,
    pub(super) fingerprint: Fingerprint,
    /// Matching facts are deleted, unless they are among the facts below.
    pub(super) deleted: Vec<PatternRecord>,
    pub(super) written: Vec<FactRecord>,
}

/// The commits of one entry, and the caller of each in the same order; no callers where they are unknown.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct EntryRecord {
    pub(super) commits: Vec<CommitRecord>,
    pub(super) callers: Vec<Arc<str>>,
    /// The node that made each, in the same order; empty where unknown.
    pub(super) writers: Vec<Arc<str>>,
}

/// The oldest kept revision, the commits since, and the remembered answers, oldest first.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct SnapshotRecord {
    pub(super) revision: u64,
    pub(super) facts: Vec<FactRecord>,
    pub(super) commits: Vec<CommitRecord>,
    pub(super) remembered: Vec<(String, Fingerprint, u64)>,
    /// The callers of the remembered answers, in the same order; missing where they are unknown.
    pub(super) callers: Vec<Arc<str>>,
    /// The nodes that made `commits`, in the same order; empty where unknown.
    pub(super) writers: Vec<Arc<str>>,
}

/// A fact with its writer and revision.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct FactRecord {
    predicate: String,
    arguments: Vec<TermRecord>,
    value: Value,
    revision: u64,
    writer: Option<Arc<str>>,
    measured: Option<Arc<Measurement>>,
}

/// A pattern over keys.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct PatternRecord {
    predicate: String,
    arguments: Vec<Option<TermRecord>>,
}

/// An argument. The bytes alone do not tell its kind.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
enum TermRecord {
    Int(i64),
    Name(String),
}

pub(super) fn encode<T: Serialize>(value: &T) -> Vec<u8> {
    versioned::encode(FORMAT, value)
}

/// Decodes a record of this version or an earlier one, and returns the version: each version appends one more list to the one before.
fn decode<T: for<'a> Deserialize<'a>>(bytes: &[u8]) -> Result<(T, u8), DecodeError> {
    let version = versioned::version(DEBUG_FINGERPRINTS, FORMAT, RECORDS, bytes)?;
    // Empty lists, as postcard encodes them.
    let missing: &[u8] = match version {
        ..=WITHOUT_CALLERS => &[0, 0],
        WITHOUT_WRITERS => &[0],
        _ => &[],
    };
    let record = versioned::decode(version, RECORDS, &[bytes, missing].concat())?;
    Ok((record, version))
}

impl EntryRecord {
    pub(super) fn decode(bytes: &[u8]) -> Result<EntryRecord, DecodeError> {
        let (mut entry, version): (EntryRecord, u8) = decode(bytes)?;
        if version == DEBUG_FINGERPRINTS {
            entry.commits.iter_mut().for_each(|commit| commit.fingerprint = Fingerprint::UNKNOWN);
        }
        Ok(entry)
    }
}

impl SnapshotRecord {
    pub(super) fn decode(bytes: &[u8]) -> Result<SnapshotRecord, DecodeError> {
        let (mut snapshot, version): (SnapshotRecord, u8) = decode(bytes)?;
        if version == DEBUG_FINGERPRINTS {
            snapshot.remembered.iter_mut().for_each(|(_, fingerprint, _)| *fingerprint = Fingerprint::UNKNOWN);
        }
        Ok(snapshot)
    }
}

impl CommitRecord {
    /// Whether it only sets the revision from which numbering continues.
    pub(super) fn is_leap(&self) -> bool {
        self.id.is_empty() && self.deleted.is_empty() && self.written.is_empty()
    }
}

/// The name of a writer in a record; empty without a writer.
pub(super) fn writer_name(writer: Option<&Arc<str>>) -> Arc<str> {
    writer.cloned().unwrap_or_default()
}

impl FactRecord {
    pub(super) fn new(key: &FactKey, fact: &Fact) -> FactRecord {
        FactRecord {
            predicate: key.predicate.clone(),
            arguments: key.arguments.iter().map(TermRecord::new).collect(),
            value: fact.value.clone(),
            revision: fact.revision.0,
            writer: fact.writer.clone(),
            measured: fact.measured.clone(),
        }
    }

    /// The fact; facts of the same writer share its name.
    pub(super) fn into_fact(self, names: &mut Names) -> (Arc<FactKey>, Arc<Fact>) {
        let arguments = self.arguments.into_iter().map(TermRecord::into_term).collect();
        let key = FactKey { predicate: self.predicate, arguments };
        let writer = self.writer.map(|name| names.share(name));
        let (revision, measured) = (Revision(self.revision), self.measured);
        (Arc::new(key), Arc::new(Fact { value: self.value, revision, writer, measured }))
    }
}

impl PatternRecord {
    pub(super) fn new(pattern: &FactPattern) -> PatternRecord {
        let argument = |term: &Option<Term>| term.as_ref().map(TermRecord::new);
        PatternRecord {
            predicate: pattern.predicate.clone(),
            arguments: pattern.arguments.iter().map(argument).collect(),
        }
    }

    pub(super) fn into_pattern(self) -> FactPattern {
        let argument = |term: Option<TermRecord>| term.map(TermRecord::into_term);
        FactPattern { predicate: self.predicate, arguments: self.arguments.into_iter().map(argument).collect() }
    }
}

impl TermRecord {
    fn new(term: &Term) -> TermRecord {
        match term {
            Term::Int(whole) => TermRecord::Int(*whole),
            Term::Name(name) => TermRecord::Name(name.clone()),
        }
    }

    fn into_term(self) -> Term {
        match self {
            TermRecord::Int(whole) => Term::Int(whole),
            TermRecord::Name(name) => Term::Name(name),
        }
    }
}

/// Names that many facts share.
#[derive(Debug, Default)]
pub(super) struct Names(BTreeSet<Arc<str>>);

impl Names {
    /// The shared copy of this name.
    pub(super) fn share(&mut self, name: Arc<str>) -> Arc<str> {
        if let Some(known) = self.0.get(&name) {
            return Arc::clone(known);
        }
        self.0.insert(Arc::clone(&name));
        name
    }
}
