//! Stores the pool in its journal, and restores it from a snapshot and the entries after it.

use super::ROLE;
use crate::config::{Durability, StorageConfig};
use crate::durable_actor::{CONFIRMED_FOR, Journal, JournalError, Journaled, floor};
use bytes::Bytes;
use ratn_model::id::Revision;
use ratn_resources::{DecodeError, Limits, Pool, Record, RestoreError, Snapshot, decode, encode};
use ratn_storage::{MakeSnapshot, Position, Recovered, Store};
use std::sync::Arc;

/// Why a log does not contain a valid pool.
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

/// Becomes the only writer, and restores the pool. Without durability, or if a backup was restored, clients may have received revisions that are lost.
pub(super) fn open(
    config: &StorageConfig,
    store: Arc<dyn Store>,
    limits: Limits,
) -> Result<(Pool, Journal), JournalError> {
    let (pool, journal) = Journal::open(ROLE, config, store, |recovered| restore(recovered, limits))?;
    let may_have_lost = config.durability == Durability::None && pool.revision() > Revision(0);
    let floor = if may_have_lost || journal.is_restored() { floor() } else { 0 };
    // A previous process that was superseded may have promised more than it recorded.
    Ok((pool.with_revisions_above(Revision(floor)).with_session_grace(CONFIRMED_FOR), journal))
}

/// Reads the pool from the log.
pub(super) fn read(journal: &Journal, limits: Limits) -> Result<Pool, JournalError> {
    journal.read(|recovered| restore(recovered, limits))
}

/// The pool of a snapshot and the entries after it. Its tokens are above all earlier ones even if the end of the log was lost (no durability, a
/// restored backup): the tokens of a process begin at its start time.
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

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use crate::durable_actor::journal::PutInPlace;
    use ratn_model::resource::{Requirement, ResourceClass, ResourceOperation};
    use ratn_model::time::Timestamp;
    use ratn_resources::{AcquireRequest, ResourceSpec, SessionId};
    use std::path::Path;
    use std::time::{Duration, Instant};

    fn open_at(config: &StorageConfig, directory: &Path) -> (Pool, Journal) {
        open(config, Arc::new(Journal::log(config, directory)), Limits::default()).unwrap()
    }

    #[test]
    fn when_the_state_is_lost_tokens_are_above_all_that_were_handed_out_as_fast_as_can_be() {
        let place = tempfile::tempdir().unwrap();
        let config = StorageConfig { durability: Durability::None, ..StorageConfig::default() };
        let session = SessionId::from("s");
        let mut highest = 0;
        for life in 0..3 {
            // Each starts without the state of the previous one.
            let (mut pool, _journal) = open_at(&config, &place.path().join(life.to_string()));
            let began = Instant::now();
            let now = || Timestamp(u64::try_from(began.elapsed().as_nanos()).unwrap());
            pool.keep_alive(now(), &session, "s", Duration::from_secs(60)).unwrap();
            pool.create(now(), None, ResourceSpec::new(ResourceClass::Module, "Arm")).unwrap();
            let mut tokens = Vec::new();
            for _ in 0..5_000 {
                let arm = Requirement::new(ResourceOperation::Block, "Arm");
                pool.acquire(now(), AcquireRequest::new(session.clone(), vec![arm])).unwrap();
                while pool.leases().is_empty() {
                    pool.advance(now());
                }
                let lease = pool.leases().remove(0);
                tokens.push(lease.token.0);
                pool.release(now(), None, lease.id).unwrap();
                pool.take_notices();
            }
            assert!(tokens.iter().all(|token| *token > highest), "life {life}: {} after {highest}", tokens[0]);
            highest = *tokens.last().unwrap();
        }
    }

    #[test]
    fn where_an_older_state_was_put_in_place_revisions_begin_above_all_of_before_and_stay_there() {
        let place = tempfile::tempdir().unwrap();
        let config = StorageConfig::default();
        let (mut pool, mut journal) = open_at(&config, place.path());
        pool.create(Timestamp(0), None, ResourceSpec::new(ResourceClass::Module, "Tool")).unwrap();
        journal.write(&mut pool).unwrap();
        let told = pool.revision();
        drop(journal);
        let put_in_place = Arc::new(PutInPlace(Journal::log(&config, place.path())));
        let (mut pool, mut journal) = open(&config, put_in_place, Limits::default()).unwrap();
        let first = pool.revision();
        assert!(first.0 > told.0 + 1_000_000, "{first:?}");
        assert!(pool.changes_after(told).is_err());
        journal.write(&mut pool).unwrap();
        drop(journal);
        assert_eq!(open_at(&config, place.path()).0.revision(), first, "the next one knows");
    }

    #[test]
    fn without_durability_a_revision_never_comes_again_after_a_restart() {
        let place = tempfile::tempdir().unwrap();
        for (durability, skips) in [(Durability::None, true), (Durability::Group, false)] {
            let config = StorageConfig { durability, ..StorageConfig::default() };
            let directory = place.path().join(durability.to_string());
            let start = || open_at(&config, &directory);
            let (mut pool, mut journal) = start();
            assert_eq!(pool.revision(), Revision(0), "nobody has heard of any");
            pool.create(Timestamp(0), None, ResourceSpec::new(ResourceClass::Module, "Tool")).unwrap();
            journal.write(&mut pool).unwrap();
            let told = pool.revision();
            drop(journal);
            let (pool, _journal) = start();
            assert_eq!(pool.revision() > told, skips, "{durability}");
            assert_eq!(pool.changes_after(told).is_err(), skips, "{durability}");
        }
    }
}
