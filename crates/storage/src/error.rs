//! Errors, one type per operation. Messages say what, where, and what to do.

use crate::store::Position;
use std::io;
use std::sync::Arc;
use thiserror::Error;

/// Why a log cannot be read.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ReadError {
    /// A call of the operating system failed.
    #[error("cannot {action} {place}")]
    Io {
        /// The operation.
        action: &'static str,
        /// The file or directory.
        place: String,
        /// The system's error.
        source: io::Error,
    },
    /// Bytes that had been written correctly have changed.
    #[error(
        "{place} is damaged at byte {offset}: {what}; what follows it may have been acknowledged, so nothing is left out: restore \
         a backup to another place, and keep this one"
    )]
    Damaged {
        /// The damaged file or key.
        place: String,
        /// The offset of the first damaged byte.
        offset: u64,
        /// What is wrong.
        what: String,
    },
    /// It was written by a newer program.
    #[error(
        "{place} has format version {found}, and this program reads up to {supported}: use the newer program, or restore a backup \
         made before it ran"
    )]
    Newer {
        /// The file or key.
        place: String,
        /// The format version found.
        found: u32,
        /// The newest supported version.
        supported: u32,
    },
    /// The service that keeps the log does not return it.
    #[error("cannot read from {place}: {what}")]
    Remote {
        /// The service.
        place: String,
        /// Its answer, or that there was none.
        what: String,
    },
    /// The log is a copy that was interrupted, or is still being made.
    #[error(
        "{place} holds a part of a copy: `ratn state copy` was interrupted there, or is still at work; if it is not, {}empty the place ({how}) \
         and copy again",
        if *complete { "start the same `ratn state copy` again, which lets it count where all of it is there and its source is marked as moved to it; \
         where the source is not marked, " } else { "" }
    )]
    Unfinished {
        /// The place of the copy.
        place: String,
        /// The copy may be complete.
        complete: bool,
        /// How to empty the place.
        how: String,
    },
    /// The log was moved to another place.
    #[error(
        "{place} was moved to {to} by `ratn state copy`, and has nothing of what was written since: use a config that names the other place; \
         to go back, stop what writes there and copy it back to an empty place; only if nothing was written there, take the mark away ({how})"
    )]
    Moved {
        /// The place of the log.
        place: String,
        /// Where it was moved to.
        to: String,
        /// How to remove the mark.
        how: String,
    },
    /// A part of the log is missing.
    #[error("{place}: {what}; the log is incomplete: put back what was removed, or restore a backup")]
    Incomplete {
        /// The place.
        place: String,
        /// What is missing.
        what: String,
    },
}

/// Why the writer's place cannot be taken.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum OpenError {
    /// Another writer has the place.
    #[error("{place} has a writer already ({holder}): stop it first, or choose another place")]
    Held {
        /// The log.
        place: String,
        /// What is known about its writer.
        holder: String,
    },
    /// The log cannot be read.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// The log cannot be prepared for writing.
    #[error("cannot {action} {place}")]
    Io {
        /// The operation.
        action: &'static str,
        /// The file or directory.
        place: String,
        /// The system's error.
        source: io::Error,
    },
    /// The service that keeps the log has another state than before.
    #[error(
        "{place} in etcd is older than what this host has seen of it, or of another cluster: an older state of etcd was put in place, and \
         what was acknowledged since then may be gone; see that no robot moves by it, then start one daemon with \
         `storage.accept_restored = {generation}`"
    )]
    Restored {
        /// The log.
        place: String,
        /// The generation that accepting it begins.
        generation: u64,
    },
    /// The options contradict each other.
    #[error("{what}")]
    Options {
        /// The options, and the rule.
        what: String,
    },
}

/// Why a writer has stopped. It stays stopped: what is on disk is certain again only after it has been read anew.
#[derive(Debug, Clone, Error)]
#[non_exhaustive]
pub enum Fault {
    /// Writing failed. It is not retried: after a failed sync the content of the disk is unknown.
    #[error("cannot {action} {place}, so nothing more is accepted: {}, then start again", advice(source))]
    Io {
        /// The operation.
        action: &'static str,
        /// The file.
        place: String,
        /// The system's error.
        source: Arc<io::Error>,
    },
    /// The service that keeps the log refuses a call.
    #[error("cannot {action} {place}, so nothing more is accepted: {what}")]
    Remote {
        /// The operation.
        action: &'static str,
        /// The service.
        place: String,
        /// The service's answer.
        what: String,
    },
    /// Another writer has taken the place in spite of the lock, or a file of the log was removed or replaced.
    #[error(
        "another writer has taken {place}, or its files were removed or replaced, so nothing more is accepted from this one: see who \
         else uses it, and end one of them"
    )]
    Fenced {
        /// The log.
        place: String,
    },
    /// Another process leads, which is normal if several stand by for one log.
    #[error("another process leads {place} now, so nothing more is accepted from this one")]
    Deposed {
        /// The log.
        place: String,
    },
    /// The writing thread ended because of a defect.
    #[error("the thread that writes {place} has ended, so nothing more is accepted: start again, and report it")]
    Ended {
        /// The log.
        place: String,
    },
    /// The writer was closed.
    #[error("the log is closed")]
    Closed,
}

impl Fault {
    /// Whether another writer has the place, or may have it.
    #[must_use]
    pub fn is_lost_place(&self) -> bool {
        matches!(self, Fault::Fenced { .. } | Fault::Deposed { .. })
    }
}

/// Why a record was not appended.
#[derive(Debug, Clone, Error)]
#[non_exhaustive]
pub enum AppendError {
    /// The record exceeds the size limit.
    #[error("a record of {bytes} bytes, and at most {most} are accepted")]
    TooLarge {
        /// Its size in bytes.
        bytes: usize,
        /// The limit in bytes.
        most: usize,
    },
    /// The disk is too slow: too many bytes wait.
    #[error("{buffered} bytes wait to be written, and at most {most} may: try again when some of them are durable")]
    Full {
        /// Bytes that wait.
        buffered: usize,
        /// The limit in bytes.
        most: usize,
    },
    /// The writer has stopped.
    #[error(transparent)]
    Stopped(#[from] Fault),
}

/// Why a compaction was not begun.
#[derive(Debug, Clone, Error)]
#[non_exhaustive]
pub enum CompactError {
    /// Another compaction is under way.
    #[error("a compaction is under way")]
    Busy,
    /// The snapshot is for records that were not appended.
    #[error("a snapshot through {through}, and the last record is {last}")]
    Ahead {
        /// The position asked for.
        through: Position,
        /// The last position appended.
        last: Position,
    },
    /// The snapshot is older than the present one.
    #[error("a snapshot through {through}, and there is one through {compacted}")]
    Behind {
        /// The position asked for.
        through: Position,
        /// The position of the present snapshot.
        compacted: Position,
    },
    /// The writer has stopped.
    #[error(transparent)]
    Stopped(#[from] Fault),
}

/// Why a compaction failed. Nothing is lost, and the log goes on; another compaction may be tried.
#[derive(Debug, Clone, Error)]
#[error("no snapshot through {through}: cannot {action} {place}")]
pub struct CompactionFailure {
    /// The position through which the snapshot would have replaced records.
    pub through: Position,
    /// The operation.
    pub action: &'static str,
    /// The file or key.
    pub place: String,
    /// The system's error.
    pub source: Arc<io::Error>,
}

/// Why a backup could not be made, or restored. A partial copy has been removed.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum CopyError {
    /// The source is not a complete log.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// The writer's place of a log cannot be taken.
    #[error(transparent)]
    Open(#[from] OpenError),
    /// The copy cannot be written.
    #[error("the copy cannot be written")]
    Write(#[from] AppendError),
    /// The copy has no snapshot.
    #[error("the copy gets no snapshot: {0}")]
    Snapshot(String),
    /// There is no log to copy.
    #[error("there is no log in {place}")]
    Nothing {
        /// The place that was read.
        place: String,
    },
    /// Another writer may have written to the source during the copy.
    #[error(
        "while it was copied the source was taken by another writer, or may have been: throw the copy away, and see who writes there"
    )]
    SourceLost(#[source] Fault),
    /// The target is not empty, and nothing is overwritten.
    #[error("{place} is not empty: nothing is overwritten, choose one that is empty or not there yet")]
    NotEmpty {
        /// The target.
        place: String,
    },
    /// A call of the operating system failed.
    #[error("cannot {action} {place}")]
    Io {
        /// The operation.
        action: &'static str,
        /// The file or directory.
        place: String,
        /// The system's error.
        source: io::Error,
    },
}

impl From<Fault> for CopyError {
    fn from(fault: Fault) -> CopyError {
        CopyError::Write(fault.into())
    }
}

fn advice(source: &io::Error) -> &'static str {
    match source.kind() {
        io::ErrorKind::StorageFull => "free space on this disk",
        io::ErrorKind::QuotaExceeded => "free space, or raise the quota",
        io::ErrorKind::FileTooLarge => "raise the limit of a file's size, or make segments smaller",
        io::ErrorKind::ReadOnlyFilesystem => "see why this disk became read-only",
        _ => "see what is wrong with this disk",
    }
}
