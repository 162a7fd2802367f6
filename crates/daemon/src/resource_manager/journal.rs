//! The pool in its journal: what it was from a snapshot and the entries after it.

use super::ROLE;
use crate::config::StorageConfig;
use crate::journal::{Journal, JournalError, Journaled, floor};
use bytes::Bytes;
use ratn_resources::{DecodeError, Limits, Pool, Record, RestoreError, Snapshot, decode, encode};
use ratn_storage::{MakeSnapshot, Position, Recovered};
use std::path::Path;

/// Why a log is none of a pool.
#[derive(Debug, thiserror::Error)]
enum NoPool {
    #[error("the snapshot means nothing")]
    Snapshot(#[source] DecodeError),
    #[error("entry {position} means nothing")]
    Entry { position: Position, source: DecodeError },
    #[error("snapshot and entries do not fit together")]
    Restore(#[source] RestoreError),
}

impl Journaled for Pool {
    fn take_entry(&mut self) -> Option<Vec<u8>> {
        let records = self.take_records();
        (!records.is_empty()).then(|| encode(&records))
    }

    fn snapshot(&self) -> MakeSnapshot {
        let snapshot = Pool::snapshot(self);
        Box::new(move || Bytes::from(snapshot.encode()))
    }
}

/// Takes the place of the one writer, and restores the pool.
pub(super) fn open(config: &StorageConfig, directory: &Path, limits: Limits) -> Result<(Pool, Journal), JournalError> {
    Journal::open(ROLE, config, directory, |recovered| restore(recovered, limits))
}

/// The pool as the log has it.
pub(super) fn read(journal: &Journal, limits: Limits) -> Result<Pool, JournalError> {
    journal.read(|recovered| restore(recovered, limits))
}

/// The pool of a snapshot and the entries after it. Its tokens are above all of before, also where the end of the log was lost (no
/// durability, a restored backup): those of one start begin at its time.
fn restore(recovered: Recovered, limits: Limits) -> Result<Pool, NoPool> {
    let snapshot = recovered.snapshot.map(|snapshot| Snapshot::decode(&snapshot.payload)).transpose();
    let snapshot = snapshot.map_err(NoPool::Snapshot)?;
    let mut records: Vec<Record> = Vec::with_capacity(recovered.records.len());
    for entry in recovered.records {
        let decoded = decode(&entry.payload);
        records.extend(decoded.map_err(|source| NoPool::Entry { position: entry.position, source })?);
    }
    let pool = Pool::restore(limits, ratn_model::time::Timestamp(0), snapshot, records).map_err(NoPool::Restore)?;
    Ok(pool.above(floor()))
}
