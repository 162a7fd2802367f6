//! The interface of a durable log, wherever it is kept: append, read, compact, and one guarded writer.
//!
//! It does not assume files: a service on another host may keep the log.

use crate::durable::Durable;
use crate::error::{AppendError, CompactError, CopyError, Fault, OpenError, ReadError};
use bytes::Bytes;
use std::fmt;
use std::sync::Arc;

/// The position of a record in its log: 1 for the first ever appended, then without gaps. 0 is before the first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct Position(pub u64);

/// A counter of the writers that a log has had: a later writer has a higher epoch than all earlier ones.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct Epoch(pub u64);

/// A record that was read.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Record {
    /// Its position.
    pub position: Position,
    /// What was appended.
    pub payload: Bytes,
}

/// A snapshot, which replaces all records through a position.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Snapshot {
    /// The last record that it contains.
    pub through: Position,
    /// The bytes given to [`Writer::compact`].
    pub payload: Bytes,
}

/// An incomplete end that the last writer left behind; nothing of it had been acknowledged.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TornEnd {
    /// What is torn: a file, for a log in files.
    pub place: String,
    /// The offset of the first byte that is ignored.
    pub offset: u64,
    /// Number of ignored bytes, without zeros after them.
    pub bytes: u64,
}

/// Everything that a log contains. The records are those after the snapshot, in order and without gaps.
#[derive(Debug, Clone, Default)]
pub struct Recovered {
    /// The epoch of the writer: the new one's for [`Store::open`], the latest for [`Store::read`].
    pub epoch: Epoch,
    /// The snapshot that replaces earlier records.
    pub snapshot: Option<Snapshot>,
    /// The records after it.
    pub records: Vec<Record>,
    /// Set if the last writer was stopped in the middle of a write.
    pub torn: Option<TornEnd>,
    /// An older state of the log was restored and accepted, and nothing was appended since: acknowledged records may be missing.
    pub restored: bool,
}

/// Makes the bytes of a snapshot; called where it does not delay appends.
pub type MakeSnapshot = Box<dyn FnOnce() -> Bytes + Send>;

/// Returns how many turns the owner of a writer has taken; the number grows as long as the owner works. `None` before its first turn.
pub type Turns = Arc<dyn Fn() -> Option<u64> + Send + Sync>;

/// A durable log.
pub trait Store: fmt::Debug + Send + Sync {
    /// Takes the writer's place, and reads the log. Blocks.
    ///
    /// # Errors
    /// Another writer has the place, the log is damaged or of a newer format, or reading fails.
    fn open(&self) -> Result<(Recovered, Box<dyn Writer>), OpenError>;

    /// Reads the log, with or without a concurrent writer, and changes nothing. Blocks.
    ///
    /// # Errors
    /// The log is damaged or of a newer format, or reading fails.
    fn read(&self) -> Result<Recovered, ReadError>;

    /// Removes the unfinished mark from a complete copy ([`Writer::mark_complete`] with this text), and returns its last position. `None`
    /// if there is no such copy. Blocks.
    ///
    /// # Errors
    /// Another process writes there, or the mark cannot be read or written.
    fn finish_copy(&self, moved: &str) -> Result<Option<Position>, CopyError>;

    /// The log's place, for people.
    fn place(&self) -> String;
}

/// The one writer of a log. When it is dropped, appended records are written first, and the place becomes free.
pub trait Writer: fmt::Debug + Send {
    /// Appends a record. Does not wait: the record is durable when [`Writer::durable`] says so, and an answer that depends on it has to
    /// wait for that.
    ///
    /// # Errors
    /// The record is too large, too much waits to be written, or the writer has stopped. Nothing was appended then.
    fn append(&mut self, record: &[u8]) -> Result<Position, AppendError>;

    /// The progress of durability. Every clone sees every change.
    fn durable(&self) -> Durable;

    /// Replaces all records through a position by a snapshot, in the background; appends go on. The result is in the [`crate::Progress`].
    ///
    /// # Errors
    /// A compaction is under way, the position is out of range, or the writer has stopped. Nothing was begun then.
    fn compact(&mut self, through: Position, snapshot: MakeSnapshot) -> Result<(), CompactError>;

    /// The writer's place. It is free again when the writer is dropped or closed, even if this value still exists.
    fn place(&self) -> Box<dyn Place>;

    /// From now on the place is kept only as long as the owner takes turns, if another process may take it: an owner that hangs is
    /// superseded. Without standbys this has no effect.
    fn attend(&mut self, turns: Turns) {
        drop(turns);
    }

    /// Marks an empty log as an unfinished copy: until [`Writer::mark_whole`] it cannot be opened or read ([`ReadError::Unfinished`]).
    /// Fails if the place does not belong to this writer any more; durable when this returns. Blocks.
    ///
    /// # Errors
    /// Another writer has the place, or the mark cannot be written.
    fn mark_unfinished(&mut self) -> Result<(), CopyError>;

    /// Marks the copy as complete and durable; it still counts as unfinished. It becomes whole if its source is marked as moved with the
    /// same text ([`Store::finish_copy`]). Blocks.
    ///
    /// # Errors
    /// Another writer has the place, or the mark cannot be written.
    fn mark_complete(&mut self, moved: &str) -> Result<(), CopyError>;

    /// Removes the unfinished mark. Fails if the place does not belong to this writer any more; durable when this returns. Blocks.
    ///
    /// # Errors
    /// Another writer has the place, or the mark cannot be removed.
    fn mark_whole(&mut self) -> Result<(), CopyError>;

    /// Marks the log as moved: it cannot be opened or read any more ([`ReadError::Moved`]). Fails if the place does not belong to this
    /// writer any more; durable when this returns. Blocks.
    ///
    /// # Errors
    /// [`CopyError::SourceLost`] if another writer has the place, or may have it; another error if the mark cannot be written.
    fn mark_moved(&mut self, to: &str) -> Result<(), CopyError>;

    /// Number of bytes that wait to be written; [`AppendError::Full`] is about them.
    fn waiting_bytes(&self) -> usize;

    /// Waits until appended records are durable and the background work has ended, then gives up the place. Blocks.
    ///
    /// # Errors
    /// The reason why the writer had stopped before.
    fn close(self: Box<Self>) -> Result<Position, Fault>;
}

/// The place of the one writer, for checks whether it is still held.
pub trait Place: fmt::Debug + Send + Sync {
    /// Checks whether the place still belongs to the writer. Says nothing about the time after the check. May take as long as the disk
    /// takes to answer.
    ///
    /// # Errors
    /// One for which [`Fault::is_lost_place`] is true if another writer has the place or may have it; another error if the check fails.
    fn check(&self) -> Result<(), Fault>;
}

impl Position {
    /// The next position.
    #[must_use]
    pub fn next(self) -> Position {
        Position(self.0 + 1)
    }
}

impl Recovered {
    /// The last position in the log.
    #[must_use]
    pub fn last(&self) -> Position {
        let snapshot = self.snapshot.as_ref().map_or(Position(0), |snapshot| snapshot.through);
        self.records.last().map_or(snapshot, |record| record.position)
    }
}

impl fmt::Display for Position {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

impl fmt::Display for Epoch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}
