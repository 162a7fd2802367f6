//! The journal keeps a daemon's state over a restart: a log of entries, which a snapshot replaces from time to time.
//!
//! ```text
//!   state ──entries──▶ log ──durable──▶ outbox: replies that depend on them are sent
//!     └────snapshot──▶ log (in the background, when replaying the entries would take too long)
//! ```
//! The state defines what an entry and a snapshot mean: [`Journaled`] makes them, a `restore` function reads them back.

use super::may_speak::MaySpeak;
use crate::config::StorageConfig;
use crate::details::retry_later;
use crate::metrics::JournalMetrics;
use ratn_storage::etcd::Bounds;
use ratn_storage::{
    AppendError, CompactError, Durable, Fault, Log, MakeSnapshot, OpenError, Options, Position, Progress, ReadError,
    Recovered, Store, Writer,
};
use ratn_worker::panic::exit_on_panic_blocking;
use ratn_worker::vitals::Vitals;
use std::error::Error;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};
use tokio::task::JoinHandle;
use tonic::{Code, Status};

/// Maximum size of an entry. An entry holds what one turn of an actor changed; the limit is larger than any message that causes a change.
const RECORD_BYTES: usize = 64 << 20;
/// Maximum bytes that wait for the disk. The actor refuses new work long before ([`super::outbox::MOST_HELD`]).
const BUFFERED_BYTES: usize = 256 << 20;
/// With more than this waiting for the disk new work is refused. The rest of [`BUFFERED_BYTES`] is for changes that cannot be refused: expiries
/// and releases.
pub(super) const MOST_WAITING_BYTES: usize = 64 << 20;
/// Retry delay of a client that was refused for that.
const BEHIND_RETRY: Duration = Duration::from_millis(500);

/// A state that is kept in a [`Journal`].
pub(crate) trait Journaled {
    /// What has changed since the last call, as one entry; `None` where nothing has changed.
    fn take_entry(&mut self) -> Option<Vec<u8>>;

    /// The whole state after the last entry taken. Cheap: the bytes are made later, where that delays nobody.
    fn snapshot(&self) -> MakeSnapshot;
}

/// The log of a state, and its current position and size.
#[derive(Debug)]
pub(crate) struct Journal {
    role: &'static str,
    store: Arc<dyn Store>,
    /// `None` once closed.
    writer: Option<Box<dyn Writer>>,
    durable: Durable,
    /// An older state was restored, and nothing has been written since.
    restored: bool,
    /// Position of the last entry.
    last: Position,
    /// An entry for which there was no room yet; it is written before the next one.
    unwritten: Option<Vec<u8>>,
    compact_bytes: u64,
    /// Bytes of entries since the last snapshot.
    since_snapshot: u64,
    snapshot_bytes: u64,
    metrics: JournalMetrics,
}

/// Why the earlier state cannot be loaded.
#[derive(Debug, thiserror::Error)]
pub(crate) enum JournalError {
    #[error("cannot open the state of the {role}")]
    Open { role: &'static str, source: OpenError },
    #[error("cannot read the state of the {role}")]
    Read { role: &'static str, source: ReadError },
    #[error("the journal of the {role} is closed")]
    Closed { role: &'static str },
    #[error("cannot start a thread for the journal of the {role}")]
    Thread { role: &'static str, source: std::io::Error },
    #[error("the state of the {role} means nothing to this program")]
    Restore { role: &'static str, source: Box<dyn Error + Send + Sync> },
}

/// Microseconds since 1970: a lower bound for numbers that have to be above all earlier ones, also where the end of the log was lost (no
/// durability, a restored backup). Numbers that begin there may grow by one per microsecond at most: tokens are held back where they would grow
/// faster ([`ratn_resources::Pool::above`]), revisions and projections take longer than that to make.
pub(crate) fn floor() -> u64 {
    #[expect(clippy::disallowed_methods, reason = "a floor: where the clock was set back, what was kept is above it")]
    let now = SystemTime::now();
    let microseconds = now.duration_since(UNIX_EPOCH).map_or(0, |since| since.as_micros());
    u64::try_from(microseconds).unwrap_or(0)
}

impl Journal {
    /// The log of a journal that is kept in files.
    pub(crate) fn log(config: &StorageConfig, directory: &Path) -> Log {
        let options = Options {
            durability: config.durability,
            record_bytes: RECORD_BYTES,
            buffered_bytes: BUFFERED_BYTES,
            ..Options::default()
        };
        Log::new(directory, options)
    }

    /// Size limits of a journal in etcd.
    pub(crate) fn bounds() -> Bounds {
        Bounds { record: RECORD_BYTES, buffered: BUFFERED_BYTES, ..Bounds::default() }
    }

    /// Becomes the one writer, and restores the state. Blocks.
    pub(crate) fn open<T, E: Error + Send + Sync + 'static>(
        role: &'static str,
        config: &StorageConfig,
        store: Arc<dyn Store>,
        restore: impl FnOnce(Recovered) -> Result<T, E>,
    ) -> Result<(T, Journal), JournalError> {
        let begin = Instant::now();
        let (recovered, writer) = store.open().map_err(|source| JournalError::Open { role, source })?;
        if let Some(torn) = &recovered.torn {
            tracing::warn!(
                place = torn.place,
                offset = torn.offset,
                bytes = torn.bytes,
                "an unfinished write was cut off"
            );
        }
        let journal = Journal {
            role,
            store,
            durable: writer.durable(),
            writer: Some(writer),
            restored: recovered.restored,
            last: recovered.last(),
            unwritten: None,
            compact_bytes: config.compact_bytes,
            since_snapshot: recovered.records.iter().map(|record| record.payload.len() as u64).sum(),
            snapshot_bytes: recovered.snapshot.as_ref().map_or(0, |snapshot| snapshot.payload.len() as u64),
            metrics: JournalMetrics::default(),
        };
        let entries = recovered.records.len();
        let state = restore(recovered).map_err(|error| JournalError::Restore { role, source: error.into() })?;
        let took_ms = u64::try_from(begin.elapsed().as_millis()).unwrap_or(u64::MAX);
        tracing::info!(place = journal.store.place(), entries, took_ms, durability = %config.durability, "state restored");
        Ok((state, journal))
    }

    /// The state according to the log: for reading, after writing has failed.
    pub(crate) fn read<T, E: Error + Send + Sync + 'static>(
        &self,
        restore: impl FnOnce(Recovered) -> Result<T, E>,
    ) -> Result<T, JournalError> {
        let role = self.role;
        let recovered = self.store.read().map_err(|source| JournalError::Read { role, source })?;
        restore(recovered).map_err(|error| JournalError::Restore { role, source: error.into() })
    }

    /// Writes what has changed since the last call, and returns the position of the last entry. Does not wait for the disk.
    ///
    /// Where there is no room ([`AppendError::Full`]) the entry is kept and written at a later call.
    pub(crate) fn write(&mut self, state: &mut impl Journaled) -> Result<Position, AppendError> {
        while let Some(entry) = self.unwritten.take().or_else(|| state.take_entry()) {
            match self.append(&entry) {
                Ok(()) => {}
                Err(full @ AppendError::Full { .. }) => {
                    self.unwritten = Some(entry);
                    return Err(full);
                }
                Err(error) => return Err(error),
            }
        }
        if self.since_snapshot >= self.compact_bytes.max(2 * self.snapshot_bytes) {
            self.compact(state)?;
        }
        Ok(self.last)
    }

    fn append(&mut self, entry: &[u8]) -> Result<(), AppendError> {
        let Some(writer) = &mut self.writer else { return Err(Fault::Closed.into()) };
        self.last = writer.append(entry)?;
        self.since_snapshot += entry.len() as u64;
        self.metrics.entries.inc();
        self.metrics.bytes.inc_by(entry.len() as u64);
        Ok(())
    }

    /// Counts in `metrics` from now on.
    #[must_use]
    pub(crate) fn counting(self, metrics: &JournalMetrics) -> Journal {
        Journal { metrics: metrics.clone(), ..self }
    }

    /// Whether an older state had been restored when the journal was opened, with nothing written since: revisions that clients know of may be
    /// missing.
    pub(crate) fn is_restored(&self) -> bool {
        self.restored
    }

    pub(super) fn metrics(&self) -> &JournalMetrics {
        &self.metrics
    }

    /// The refusal of new work while the disk cannot keep up.
    pub(crate) fn behind(&self) -> Option<Status> {
        let waiting = self.writer.as_ref()?.waiting_bytes() + self.unwritten.as_ref().map_or(0, Vec::len);
        if waiting <= MOST_WAITING_BYTES && self.unwritten.is_none() {
            return None;
        }
        let stalled = self.durable.progress().stalled;
        let why = stalled.as_deref().unwrap_or("see what slows its disk down");
        let message = format!(
            "the storage of the {} does not keep up: {waiting} bytes wait to be written, and nothing is taken on while more than \
             {MOST_WAITING_BYTES} do; ask again; {why}",
            self.role
        );
        Some(retry_later(Code::ResourceExhausted, "STORAGE_BEHIND", message, BEHIND_RETRY))
    }

    /// Starts the thread that checks whether this is still the one writer. The writer keeps its place only while the core takes turns.
    pub(super) fn may_speak(&mut self, vitals: Vitals) -> Result<MaySpeak, JournalError> {
        let role = self.role;
        let Some(writer) = &mut self.writer else { return Err(JournalError::Closed { role }) };
        let turns = vitals.clone();
        writer.attend(Arc::new(move || turns.beats()));
        MaySpeak::begin(writer.place(), vitals).map_err(|source| JournalError::Thread { role, source })
    }

    /// Whether every entry up to this position is on the disk.
    pub(crate) fn reached(&self, position: Position) -> bool {
        matches!(self.durable.reached(position), Ok(true))
    }

    /// Whether every entry is on the disk.
    pub(super) fn is_written(&self) -> bool {
        self.unwritten.is_none() && self.reached(self.last)
    }

    /// Returns when more is on the disk, or when writing failed.
    pub(crate) async fn changed(&mut self) -> Result<Progress, Fault> {
        self.durable.changed().await
    }

    /// Waits until everything is on the disk, for as long as the disk (or etcd) hangs; runs in a thread that may block.
    pub(super) fn close(&mut self) -> JoinHandle<Result<(), Fault>> {
        let writer = self.writer.take();
        let close = move || writer.map_or(Ok(()), |writer| writer.close().map(|_| ()));
        tokio::task::spawn_blocking(|| exit_on_panic_blocking("what closes the state", close))
    }

    /// A snapshot replaces all entries so far, so it has to be of the state after the last of them.
    fn compact(&mut self, state: &impl Journaled) -> Result<(), Fault> {
        let Some(writer) = self.writer.as_mut().filter(|_| !self.durable.progress().compacting) else { return Ok(()) };
        match writer.compact(self.last, state.snapshot()) {
            Ok(()) => {
                // Estimate until the size is known: the snapshot is as large as the entries that it replaces.
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

/// A log that was restored in place of a newer one, for tests.
#[cfg(test)]
#[derive(Debug)]
pub(crate) struct PutInPlace(pub(crate) Log);

#[cfg(test)]
impl Store for PutInPlace {
    fn open(&self) -> Result<(Recovered, Box<dyn Writer>), OpenError> {
        self.0.open().map(|(recovered, writer)| (Recovered { restored: true, ..recovered }, writer))
    }

    fn read(&self) -> Result<Recovered, ReadError> {
        self.0.read()
    }

    fn finish_copy(&self, moved: &str) -> Result<Option<Position>, ratn_storage::CopyError> {
        self.0.finish_copy(moved)
    }

    fn place(&self) -> String {
        self.0.place()
    }
}
