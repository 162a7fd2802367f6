//! What a daemon's state is kept in over a restart: a log of its entries, and from time to time a snapshot in their place.
//!
//! ```text
//!   state ──entries──▶ log ──durable──▶ outbox: what depended on them leaves
//!     └────snapshot──▶ log (in the background, when there is more to replay than is worth it)
//! ```
//! What an entry and a snapshot mean is the state's: [`Journaled`] makes them, a `restore` function reads them back.

use crate::config::StorageConfig;
use crate::metrics;
use ratn_storage::{
    AppendError, CompactError, Durable, Fault, Log, MakeSnapshot, OpenError, Options, Position, Progress, ReadError,
    Recovered, Store, Writer,
};
use std::error::Error;
use std::path::Path;
use std::time::{Instant, SystemTime, UNIX_EPOCH};

/// One entry holds what one turn of an actor changed; larger than any message that asks for it.
const RECORD_BYTES: usize = 64 << 20;
/// What may wait for the disk. The actor takes no more on long before ([`super::outbox::MOST_HELD`]).
const BUFFERED_BYTES: usize = 256 << 20;

/// A state that is kept in a [`Journal`].
pub(crate) trait Journaled {
    /// What has changed since the last call, as one entry; `None` where nothing has.
    fn take_entry(&mut self) -> Option<Vec<u8>>;

    /// All of it as it is after the last entry taken. Cheap: it is made into bytes where it holds nobody up.
    fn snapshot(&self) -> MakeSnapshot;
}

/// The log of a state, and what is known of it.
#[derive(Debug)]
pub(crate) struct Journal {
    role: &'static str,
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
pub(crate) enum JournalError {
    #[error("cannot open the state of the {role}")]
    Open { role: &'static str, source: OpenError },
    #[error("cannot read the state of the {role}")]
    Read { role: &'static str, source: ReadError },
    #[error("the state of the {role} means nothing to this program")]
    Restore { role: &'static str, source: Box<dyn Error + Send + Sync> },
}

/// A floor for what has to be above all of before, also where the end of the log was lost (no durability, a restored backup): the
/// microseconds since 1970. Nothing that begins there may grow by more than one a microsecond: tokens are held back where they would
/// ([`ratn_resources::Pool::above`]), revisions and projections take longer to make.
pub(crate) fn floor() -> u64 {
    #[expect(clippy::disallowed_methods, reason = "a floor: where the clock was set back, what was kept is above it")]
    let now = SystemTime::now();
    let microseconds = now.duration_since(UNIX_EPOCH).map_or(0, |since| since.as_micros());
    u64::try_from(microseconds).unwrap_or(0)
}

impl Journal {
    /// Takes the place of the one writer, and restores the state.
    pub(crate) fn open<T, E: Error + Send + Sync + 'static>(
        role: &'static str,
        config: &StorageConfig,
        directory: &Path,
        restore: impl FnOnce(Recovered) -> Result<T, E>,
    ) -> Result<(T, Journal), JournalError> {
        let begin = Instant::now();
        let options = Options {
            durability: config.durability,
            record_bytes: RECORD_BYTES,
            buffered_bytes: BUFFERED_BYTES,
            ..Options::default()
        };
        let store = Box::new(Log::new(directory, options));
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
            last: recovered.last(),
            compact_bytes: config.compact_bytes,
            since_snapshot: recovered.records.iter().map(|record| record.payload.len() as u64).sum(),
            snapshot_bytes: recovered.snapshot.as_ref().map_or(0, |snapshot| snapshot.payload.len() as u64),
        };
        let entries = recovered.records.len();
        let state = restore(recovered).map_err(|error| JournalError::Restore { role, source: error.into() })?;
        let took_ms = u64::try_from(begin.elapsed().as_millis()).unwrap_or(u64::MAX);
        let place = directory.display();
        tracing::info!(%place, entries, took_ms, durability = %config.durability, "state restored");
        Ok((state, journal))
    }

    /// The state as the log has it: for reading, after writing has failed.
    pub(crate) fn read<T, E: Error + Send + Sync + 'static>(
        &self,
        restore: impl FnOnce(Recovered) -> Result<T, E>,
    ) -> Result<T, JournalError> {
        let role = self.role;
        let recovered = self.store.read().map_err(|source| JournalError::Read { role, source })?;
        restore(recovered).map_err(|error| JournalError::Restore { role, source: error.into() })
    }

    /// Writes down what has changed since the last call. Does not wait for the disk.
    pub(crate) fn write(&mut self, state: &mut impl Journaled) -> Result<(), AppendError> {
        let Some(entry) = state.take_entry() else { return Ok(()) };
        let Some(writer) = &mut self.writer else { return Err(Fault::Closed.into()) };
        self.last = writer.append(&entry)?;
        self.since_snapshot += entry.len() as u64;
        if let Some(metrics) = metrics::get() {
            metrics.journal.entries.inc();
            metrics.journal.bytes.inc_by(entry.len() as u64);
        }
        if self.since_snapshot >= self.compact_bytes.max(2 * self.snapshot_bytes) {
            self.compact(state)?;
        }
        Ok(())
    }

    /// The last entry, durable or not.
    pub(crate) fn last(&self) -> Position {
        self.last
    }

    /// Whether everything through this entry is on the disk.
    pub(crate) fn reached(&self, position: Position) -> bool {
        matches!(self.durable.reached(position), Ok(true))
    }

    /// Returns when more is on the disk, or something went wrong.
    pub(crate) async fn changed(&mut self) -> Result<Progress, Fault> {
        self.durable.changed().await
    }

    /// Waits until everything is on the disk.
    pub(crate) fn close(&mut self) -> Result<(), Fault> {
        self.writer.take().map_or(Ok(()), |writer| writer.close().map(|_| ()))
    }

    /// A snapshot stands for all entries so far; it has to be of the state after the last of them.
    fn compact(&mut self, state: &impl Journaled) -> Result<(), Fault> {
        let Some(writer) = self.writer.as_mut().filter(|_| !self.durable.progress().compacting) else { return Ok(()) };
        match writer.compact(self.last, state.snapshot()) {
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
