//! Errors, one type per operation. Messages say what, where, and what to do.

use crate::store::Position;
use std::io;
use std::sync::Arc;
use thiserror::Error;

/// Why a log cannot be read.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ReadError {
    /// The system refused.
    #[error("cannot {action} {place}")]
    Io {
        /// What was tried.
        action: &'static str,
        /// On what.
        place: String,
        /// What the system said.
        source: io::Error,
    },
    /// Bytes that once were right no longer are.
    #[error(
        "{place} is damaged at byte {offset}: {what}; what follows it may have been acknowledged, so nothing is left out: restore \
         a backup to another place, and keep this one"
    )]
    Damaged {
        /// In what.
        place: String,
        /// From which byte on.
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
        /// In what.
        place: String,
        /// The version that it says.
        found: u32,
        /// The newest that can be read.
        supported: u32,
    },
    /// The service that keeps the log does not give it.
    #[error("cannot read from {place}: {what}")]
    Remote {
        /// Which service.
        place: String,
        /// What it said, or that it said nothing.
        what: String,
    },
    /// A copy that was interrupted, or is still being made.
    #[error(
        "{place} holds a part of a copy: `ratn state copy` was interrupted there, or is still at work; if it is not, {}empty the place ({how}) \
         and copy again",
        if *complete { "start the same `ratn state copy` again, which lets it count where all of it is there and its source is marked as moved to it; \
         where the source is not marked, " } else { "" }
    )]
    Unfinished {
        /// In what.
        place: String,
        /// All of it may be there.
        complete: bool,
        /// How it is emptied.
        how: String,
    },
    /// All of it is somewhere else.
    #[error(
        "{place} was moved to {to} by `ratn state copy`, and has nothing of what was written since: use a config that names the other place; \
         to go back, stop what writes there and copy it back to an empty place; only if nothing was written there, take the mark away ({how})"
    )]
    Moved {
        /// What.
        place: String,
        /// Where to.
        to: String,
        /// How the mark is taken away.
        how: String,
    },
    /// Something that belongs to the log is not there.
    #[error("{place}: {what}; the log is incomplete: put back what was removed, or restore a backup")]
    Incomplete {
        /// Where.
        place: String,
        /// What is missing.
        what: String,
    },
}

/// Why the writer's place cannot be taken.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum OpenError {
    /// A second writer.
    #[error("{place} has a writer already ({holder}): stop it first, or choose another place")]
    Held {
        /// Which log.
        place: String,
        /// What is known of its writer.
        holder: String,
    },
    /// It cannot be read.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// It cannot be made ready for writing.
    #[error("cannot {action} {place}")]
    Io {
        /// What was tried.
        action: &'static str,
        /// On what.
        place: String,
        /// What the system said.
        source: io::Error,
    },
    /// The service that keeps the log has another one than before.
    #[error(
        "{place} in etcd is older than what this host has seen of it, or of another cluster: an older state of etcd was put in place, and \
         what was acknowledged since then may be gone; see that no robot moves by it, then start one daemon with \
         `storage.accept_restored = {generation}`"
    )]
    Restored {
        /// Which log.
        place: String,
        /// The generation that accepting it begins.
        generation: u64,
    },
    /// The options contradict each other.
    #[error("{what}")]
    Options {
        /// Which, and what they have to be.
        what: String,
    },
}

/// Why a writer has stopped. It stays stopped: what is on the disk is certain again only after it has been read anew.
#[derive(Debug, Clone, Error)]
#[non_exhaustive]
pub enum Fault {
    /// Writing failed. It is not tried again: after a failed sync nobody knows what the disk has.
    #[error("cannot {action} {place}, so nothing more is accepted: {}, then start again", advice(source))]
    Io {
        /// What was tried.
        action: &'static str,
        /// On what.
        place: String,
        /// What the system said.
        source: Arc<io::Error>,
    },
    /// The service that keeps the log refuses.
    #[error("cannot {action} {place}, so nothing more is accepted: {what}")]
    Remote {
        /// What was tried.
        action: &'static str,
        /// On what.
        place: String,
        /// What the service said.
        what: String,
    },
    /// Another writer has taken the place, past the lock; or a file of the log was removed or replaced.
    #[error(
        "another writer has taken {place}, or its files were removed or replaced, so nothing more is accepted from this one: see who \
         else uses it, and end one of them"
    )]
    Fenced {
        /// Which log.
        place: String,
    },
    /// Another process leads, as it may where several stand by for one log.
    #[error("another process leads {place} now, so nothing more is accepted from this one")]
    Deposed {
        /// Which log.
        place: String,
    },
    /// The thread that writes has ended by a defect.
    #[error("the thread that writes {place} has ended, so nothing more is accepted: start again, and report it")]
    Ended {
        /// Which log.
        place: String,
    },
    /// The writer was closed.
    #[error("the log is closed")]
    Closed,
}

impl Fault {
    /// Whether somebody else has the writer's place, or may have it.
    #[must_use]
    pub fn is_lost_place(&self) -> bool {
        matches!(self, Fault::Fenced { .. } | Fault::Deposed { .. })
    }
}

/// Why a record was not appended.
#[derive(Debug, Clone, Error)]
#[non_exhaustive]
pub enum AppendError {
    /// A record above the bound.
    #[error("a record of {bytes} bytes, and at most {most} are accepted")]
    TooLarge {
        /// How large it is.
        bytes: usize,
        /// How large it may be.
        most: usize,
    },
    /// The disk does not keep up.
    #[error("{buffered} bytes wait to be written, and at most {most} may: try again when some of them are durable")]
    Full {
        /// How many wait.
        buffered: usize,
        /// How many may.
        most: usize,
    },
    /// Nothing is accepted any more.
    #[error(transparent)]
    Stopped(#[from] Fault),
}

/// Why a compaction was not begun.
#[derive(Debug, Clone, Error)]
#[non_exhaustive]
pub enum CompactError {
    /// One at a time.
    #[error("a compaction is under way")]
    Busy,
    /// A snapshot of what was not appended.
    #[error("a snapshot through {through}, and the last record is {last}")]
    Ahead {
        /// What was asked for.
        through: Position,
        /// What there is.
        last: Position,
    },
    /// A snapshot older than the one that there is.
    #[error("a snapshot through {through}, and there is one through {compacted}")]
    Behind {
        /// What was asked for.
        through: Position,
        /// What there is.
        compacted: Position,
    },
    /// Nothing is accepted any more.
    #[error(transparent)]
    Stopped(#[from] Fault),
}

/// Why a compaction that was begun came to nothing. Nothing is lost, and the log goes on; another may be tried.
#[derive(Debug, Clone, Error)]
#[error("no snapshot through {through}: cannot {action} {place}")]
pub struct CompactionFailure {
    /// What the snapshot would have stood for.
    pub through: Position,
    /// What was tried.
    pub action: &'static str,
    /// On what.
    pub place: String,
    /// What the system said.
    pub source: Arc<io::Error>,
}

/// Why there is no backup, or why it was not restored. What was begun has been removed.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum CopyError {
    /// What would be copied is not a whole log.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// A place cannot be taken.
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
        /// Where one was looked for.
        place: String,
    },
    /// What was copied may have been written by another one meanwhile.
    #[error(
        "while it was copied the source was taken by another writer, or may have been: throw the copy away, and see who writes there"
    )]
    SourceLost(#[source] Fault),
    /// Nothing is overwritten.
    #[error("{place} is not empty: nothing is overwritten, choose one that is empty or not there yet")]
    NotEmpty {
        /// Where the copy was to go.
        place: String,
    },
    /// The system refused.
    #[error("cannot {action} {place}")]
    Io {
        /// What was tried.
        action: &'static str,
        /// On what.
        place: String,
        /// What the system said.
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
