//! What the pool is kept in over a restart: a log of its records, and from time to time a snapshot in their place.
//!
//! ```text
//!   pool ──records──▶ log ──durable──▶ outbox: what depended on them leaves
//!     └───snapshot──▶ log (in the background, when there is more to replay than is worth it)
//! ```

use super::config::StorageConfig;
use crate::metrics;
use bytes::Bytes;
use ratn_resources::{DecodeError, Limits, Pool, Record, RestoreError, Snapshot, decode, encode};
use ratn_storage::{
    AppendError, CompactError, Durable, Fault, Log, OpenError, Options, Position, Progress, ReadError, Recovered,
    Store, Writer,
};
use std::path::Path;
use std::time::{Instant, SystemTime, UNIX_EPOCH};

/// One entry holds what one turn of the actor changed; larger than any message that asks for it.
const RECORD_BYTES: usize = 64 << 20;
/// What may wait for the disk. The actor takes no more on long before ([`super::outbox::MOST_HELD`]).
const BUFFERED_BYTES: usize = 256 << 20;

/// The log of a pool, and what is known of it.
#[derive(Debug)]
pub(super) struct Journal {
    store: Box<dyn Store>,
    /// Nothing after the end.
    writer: Option<Box<dyn Writer>>,
    durable: Durable,
    /// The last entry.
    last: Position,
    compact_bytes: u64,
    /// Bytes of entries since the last snapshot.
    since_snapshot: u64,
    snapshot_bytes: u64,
}

/// Why the state of before cannot be had.
#[derive(Debug, thiserror::Error)]
pub(super) enum JournalError {
    #[error("cannot open the resource manager's state")]
    Open(#[source] OpenError),
    #[error("cannot read the resource manager's state")]
    Read(#[source] ReadError),
    #[error("the resource manager's state has a snapshot that means nothing")]
    Snapshot(#[source] DecodeError),
    #[error("entry {position} of the resource manager's state means nothing")]
    Entry { position: Position, source: DecodeError },
    #[error("the resource manager's state does not fit together")]
    Restore(#[source] RestoreError),
}

impl Journal {
    /// Takes the place of the one writer, and restores the pool.
    pub(super) fn open(
        config: &StorageConfig,
        directory: &Path,
        limits: Limits,
    ) -> Result<(Pool, Journal), JournalError> {
        let begin = Instant::now();
        let options = Options {
            durability: config.durability,
            record_bytes: RECORD_BYTES,
            buffered_bytes: BUFFERED_BYTES,
            ..Options::default()
        };
        let store = Box::new(Log::new(directory, options));
        let (recovered, writer) = store.open().map_err(JournalError::Open)?;
        if let Some(torn) = &recovered.torn {
            tracing::warn!(
                place = torn.place,
                offset = torn.offset,
                bytes = torn.bytes,
                "an unfinished write was cut off"
            );
        }
        let journal = Journal {
            store,
            durable: writer.durable(),
            writer: Some(writer),
            last: recovered.last(),
            compact_bytes: config.compact_bytes,
            since_snapshot: recovered.records.iter().map(|record| record.payload.len() as u64).sum(),
            snapshot_bytes: recovered.snapshot.as_ref().map_or(0, |snapshot| snapshot.payload.len() as u64),
        };
        let entries = recovered.records.len();
        let pool = restore(recovered, limits)?;
        let took_ms = u64::try_from(begin.elapsed().as_millis()).unwrap_or(u64::MAX);
        let place = directory.display();
        tracing::info!(%place, entries, took_ms, durability = %config.durability, "state restored");
        Ok((pool, journal))
    }

    /// The pool as the log has it: for reading, after writing has failed.
    pub(super) fn read(&self, limits: Limits) -> Result<Pool, JournalError> {
        restore(self.store.read().map_err(JournalError::Read)?, limits)
    }

    /// Writes down what the pool has changed since the last call. Does not wait for the disk.
    pub(super) fn write(&mut self, pool: &mut Pool) -> Result<(), AppendError> {
        let records = pool.take_records();
        if records.is_empty() {
            return Ok(());
        }
        let Some(writer) = &mut self.writer else { return Err(Fault::Closed.into()) };
        let entry = encode(&records);
        self.last = writer.append(&entry)?;
        self.since_snapshot += entry.len() as u64;
        if let Some(metrics) = metrics::get() {
            metrics.journal.entries.inc();
            metrics.journal.bytes.inc_by(entry.len() as u64);
        }
        if self.since_snapshot >= self.compact_bytes.max(2 * self.snapshot_bytes) {
            self.compact(pool)?;
        }
        Ok(())
    }

    /// The last entry, durable or not.
    pub(super) fn last(&self) -> Position {
        self.last
    }

    /// Whether everything through this entry is on the disk.
    pub(super) fn reached(&self, position: Position) -> bool {
        matches!(self.durable.reached(position), Ok(true))
    }

    /// Returns when more is on the disk, or something went wrong.
    pub(super) async fn changed(&mut self) -> Result<Progress, Fault> {
        self.durable.changed().await
    }

    /// Waits until everything is on the disk.
    pub(super) fn close(&mut self) -> Result<(), Fault> {
        self.writer.take().map_or(Ok(()), |writer| writer.close().map(|_| ()))
    }

    /// A snapshot of the pool stands for all entries so far; it has to be the pool after the last of them.
    fn compact(&mut self, pool: &Pool) -> Result<(), Fault> {
        let Some(writer) = self.writer.as_mut().filter(|_| !self.durable.progress().compacting) else { return Ok(()) };
        let snapshot = pool.snapshot();
        match writer.compact(self.last, Box::new(move || Bytes::from(snapshot.encode()))) {
            Ok(()) => {
                // As long as nothing better is known: the next one is as large as what it stands for.
                (self.snapshot_bytes, self.since_snapshot) = (self.since_snapshot / 2, 0);
                Ok(())
            }
            Err(CompactError::Stopped(fault)) => Err(fault),
            Err(error) => {
                tracing::debug!(%error, "no snapshot now");
                Ok(())
            }
        }
    }
}

/// The pool of a snapshot and the entries after it. Its tokens are above all of before, also where the end of the log was lost (no
/// durability, a restored backup): those of one start begin at its time.
fn restore(recovered: Recovered, limits: Limits) -> Result<Pool, JournalError> {
    let snapshot = recovered.snapshot.map(|snapshot| Snapshot::decode(&snapshot.payload)).transpose();
    let snapshot = snapshot.map_err(JournalError::Snapshot)?;
    let mut records: Vec<Record> = Vec::with_capacity(recovered.records.len());
    for entry in recovered.records {
        let decoded = decode(&entry.payload);
        records.extend(decoded.map_err(|source| JournalError::Entry { position: entry.position, source })?);
    }
    let pool =
        Pool::restore(limits, ratn_model::time::Timestamp(0), snapshot, records).map_err(JournalError::Restore)?;
    #[expect(clippy::disallowed_methods, reason = "a floor: where the clock was set back, what was kept is above it")]
    let now = SystemTime::now();
    let milliseconds = now.duration_since(UNIX_EPOCH).map_or(0, |since| since.as_millis());
    Ok(pool.above(u64::try_from(milliseconds).unwrap_or(0)))
}
