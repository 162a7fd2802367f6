//! The trait of a durable log, wherever it is kept: append, read, compact, and one guarded writer.
//!
//! Nothing here speaks of files: a log may as well be kept by a service of another host.

use crate::durable::Durable;
use crate::error::{AppendError, CompactError, CopyError, Fault, OpenError, ReadError};
use bytes::Bytes;
use std::fmt;
use std::sync::Arc;

/// Where a record stands in its log: 1 for the first ever appended, then without gaps. 0 is before the first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct Position(pub u64);

/// Counts the writers that a log has had. A younger writer has a higher epoch than all before it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct Epoch(pub u64);

/// A record that was read.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Record {
    /// Where it stands.
    pub position: Position,
    /// What was appended.
    pub payload: Bytes,
}

/// What stands for all records through a position.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Snapshot {
    /// The last record that it contains.
    pub through: Position,
    /// What was given to [`Writer::compact`].
    pub payload: Bytes,
}

/// An incomplete end that the last writer left behind: nothing of it had been acknowledged.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TornEnd {
    /// What is torn: a file, for a log in files.
    pub place: String,
    /// The byte from which on it is left out.
    pub offset: u64,
    /// How many bytes are left out, without zeros behind them.
    pub bytes: u64,
}

/// Everything that a log holds. The records are those after the snapshot, in order and without gaps.
#[derive(Debug, Clone, Default)]
pub struct Recovered {
    /// The epoch of the writer: the new one's for [`Store::open`], the latest for [`Store::read`].
    pub epoch: Epoch,
    /// What stands for the records that are no longer there.
    pub snapshot: Option<Snapshot>,
    /// The records after it.
    pub records: Vec<Record>,
    /// Set where the last writer was stopped in the middle of a write.
    pub torn: Option<TornEnd>,
    /// An older state was put in place of the log and accepted, and nothing was appended since: what was acknowledged may be missing.
    pub restored: bool,
}

/// Makes the bytes of a snapshot; called where it does not hold up appends.
pub type MakeSnapshot = Box<dyn FnOnce() -> Bytes + Send>;

/// Says how many turns the owner of a writer has taken: it grows as long as the owner is at work. Nothing before its first turn.
pub type Turns = Arc<dyn Fn() -> Option<u64> + Send + Sync>;

/// A durable log.
pub trait Store: fmt::Debug + Send + Sync {
    /// Takes the writer's place, and reads what is there. Blocks.
    ///
    /// # Errors
    /// Where another writer has the place, where what is there is damaged or of a newer format, or where reading fails.
    fn open(&self) -> Result<(Recovered, Box<dyn Writer>), OpenError>;

    /// Reads what is there, beside a writer or without one, and changes nothing. Blocks.
    ///
    /// # Errors
    /// Where what is there is damaged or of a newer format, or where reading fails.
    fn read(&self) -> Result<Recovered, ReadError>;

    /// Lets a copy count of which all is there ([`Writer::mark_complete`] with this text), and says its last position. Nothing where there is
    /// no such copy. Blocks.
    ///
    /// # Errors
    /// Where somebody writes there, or it cannot be read or written.
    fn finish_copy(&self, moved: &str) -> Result<Option<Position>, CopyError>;

    /// Where it is, for people.
    fn place(&self) -> String;
}

/// The one writer of a log. When it is dropped, what was appended is written first, and the place becomes free.
pub trait Writer: fmt::Debug + Send {
    /// Puts a record behind all others. Does not wait: the record is durable when [`Writer::durable`] says so, and an answer that
    /// depends on it has to wait for that.
    ///
    /// # Errors
    /// Where the record is too large, too much waits to be written, or the writer has stopped. Nothing was appended then.
    fn append(&mut self, record: &[u8]) -> Result<Position, AppendError>;

    /// Says how far the log is durable. Every clone sees every change.
    fn durable(&self) -> Durable;

    /// Lets a snapshot stand for all records through a position, in the background; appends go on. How it ended is in the
    /// [`crate::Progress`].
    ///
    /// # Errors
    /// Where a compaction is under way, the position makes no sense, or the writer has stopped. Nothing was begun then.
    fn compact(&mut self, through: Position, snapshot: MakeSnapshot) -> Result<(), CompactError>;

    /// The writer's place. It is free again when the writer is dropped or closed, whoever still has this.
    fn place(&self) -> Box<dyn Place>;

    /// From now on the place is kept only as long as the owner takes turns, where another process may take it: an owner that hangs is got
    /// past. Where nobody stands by for the place this says nothing.
    fn attend(&mut self, turns: Turns) {
        drop(turns);
    }

    /// Says of a log that is empty that it will be a part of a copy for now: until [`Writer::mark_whole`] nobody opens or reads it
    /// ([`ReadError::Unfinished`]). Only where the place is still this writer's, and durable when this returns. Blocks.
    ///
    /// # Errors
    /// Where another writer has the place, or it cannot be written.
    fn mark_unfinished(&mut self) -> Result<(), CopyError>;

    /// All of the copy is there and durable; it still counts as unfinished. It is whole where its source is marked as moved with the same
    /// text ([`Store::finish_copy`]). Blocks.
    ///
    /// # Errors
    /// Where another writer has the place, or it cannot be written.
    fn mark_complete(&mut self, moved: &str) -> Result<(), CopyError>;

    /// The copy is whole. Only where the place is still this writer's, and durable when this returns. Blocks.
    ///
    /// # Errors
    /// Where another writer has the place, or it cannot be written.
    fn mark_whole(&mut self) -> Result<(), CopyError>;

    /// Says of the log that all of it was moved: nobody opens or reads it any more ([`ReadError::Moved`]). Only where the place is still
    /// this writer's, and durable when this returns. Blocks.
    ///
    /// # Errors
    /// [`CopyError::SourceLost`] where another writer has the place, or may have it; otherwise where it cannot be written.
    fn mark_moved(&mut self, to: &str) -> Result<(), CopyError>;

    /// How many bytes wait to be written; [`AppendError::Full`] is about them.
    fn waiting_bytes(&self) -> usize;

    /// Waits until what was appended is durable and the background work has ended, and gives up the place. Blocks.
    ///
    /// # Errors
    /// The reason for which the writer had stopped before.
    fn close(self: Box<Self>) -> Result<Position, Fault>;
}

/// The place of the one writer, as those see it who ask whether it is still held.
pub trait Place: fmt::Debug + Send + Sync {
    /// Whether it is still the writer's. Says nothing of the moment after the look. May take as long as the disk takes to answer.
    ///
    /// # Errors
    /// One that [`Fault::is_lost_place`] where somebody else has it or may have; another one where it cannot be seen.
    fn check(&self) -> Result<(), Fault>;
}

impl Position {
    /// The next one.
    #[must_use]
    pub fn next(self) -> Position {
        Position(self.0 + 1)
    }
}

impl Recovered {
    /// The last position that the log holds.
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
