//! The log in files of one directory.
//!
//! To take the writer's place: lock, read everything, then rewrite the last segment under the next epoch, without its torn end. What was
//! read may so far have been only in the system's cache (after a killed process, or a failed sync); rewritten and synced, it is on disk
//! before anything is built upon it. A superseded writer keeps a file that has no name.

mod backup;
mod compaction;
mod contents;
mod directory;
mod files;
mod format;
mod lock;
#[cfg(test)]
mod power_loss;
mod segment;
mod shared;
mod snapshot;
mod syncer;
#[cfg(test)]
mod tests;
mod writer;

pub use backup::{Copied, backup, restore};
pub use files::{Disk, Files, LogFile};

use crate::error::{CopyError, OpenError, ReadError};
use crate::store::{Epoch, Position, Recovered, Store, Writer};
use contents::Contents;
use format::{SegmentHeader, StoreId};
use lock::Lock;
use serde::{Deserialize, Serialize};
use shared::Shared;
use std::fmt;
use std::io;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::Arc;
use syncer::{Active, Syncer};
use writer::LogWriter;

/// Maximum of [`Options::buffered_bytes`]: the size of a frame is a 32-bit number, and its header needs room.
const MOST_BUFFERED_BYTES: usize = 1 << 30;

/// When a record counts as durable.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Durability {
    /// When it was appended: it is written soon, and the system decides when it reaches the disk. Survives no loss of power; the newest
    /// records do not survive the death of the process either.
    None,
    /// When it is on disk; all records that arrive during one sync share the next.
    #[default]
    Group,
    /// When it is on disk, by a sync of its own.
    Each,
}

/// The limits of a log, and when its records count as durable.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Options {
    /// When a record counts as durable.
    pub durability: Durability,
    /// Maximum size of a record, in bytes.
    pub record_bytes: usize,
    /// Maximum bytes that wait to be written. As many again may be in writing.
    pub buffered_bytes: usize,
    /// When a segment reaches this size, in bytes, a new one begins.
    pub segment_bytes: u64,
}

/// A log in a directory.
#[derive(Debug)]
pub struct Log {
    directory: PathBuf,
    options: Options,
    files: Arc<dyn Files>,
}

impl Default for Options {
    fn default() -> Self {
        Options {
            durability: Durability::default(),
            record_bytes: 4 << 20,
            buffered_bytes: 64 << 20,
            segment_bytes: 64 << 20,
        }
    }
}

impl Options {
    fn check(&self) -> Result<(), OpenError> {
        let rule =
            |kept: bool, what: &str| if kept { Ok(()) } else { Err(OpenError::Options { what: what.to_owned() }) };
        let overhead = format::FRAME_HEADER + format::RECORD_HEADER;
        rule(self.record_bytes >= 1, "record_bytes has to be at least 1")?;
        rule(self.buffered_bytes <= MOST_BUFFERED_BYTES, "buffered_bytes can be at most 1 GiB")?;
        let holds = self.buffered_bytes.checked_sub(overhead).is_some_and(|room| room >= self.record_bytes);
        rule(holds, "buffered_bytes has to hold at least one record of record_bytes and 24 bytes beside it")
    }
}

impl Log {
    /// The log in a directory, which [`Store::open`] creates if it does not exist.
    #[must_use]
    pub fn new(directory: impl Into<PathBuf>, options: Options) -> Log {
        Log { directory: directory.into(), options, files: Arc::new(Disk) }
    }

    /// Uses these file operations for writing instead of the system's: slow or failing ones, for tests. Reading uses the system's.
    #[must_use]
    pub fn on(self, files: Arc<dyn Files>) -> Log {
        Log { files, ..self }
    }

    /// The log's directory.
    #[must_use]
    pub fn directory(&self) -> &Path {
        &self.directory
    }

    /// Prepares the log for writing, after it was read.
    fn take_over(&self, contents: &Contents) -> Result<Active, OpenError> {
        let io = |(action, path, source): (&'static str, PathBuf, io::Error)| OpenError::Io {
            action,
            place: path.display().to_string(),
            source,
        };
        let epoch = Epoch(contents.epoch().0 + 1);
        let store = contents.store.map_or_else(|| crate::draw::number().map(StoreId), Ok).map_err(|source| {
            OpenError::Io { action: "draw a number for", place: self.directory.display().to_string(), source }
        })?;
        let fresh = SegmentHeader { store, number: 1, first: Position(1), epoch };
        let (header, frames) = match contents.segments.last() {
            None => (fresh, &[][..]),
            // The log ends before the snapshot does. Without syncs, a loss of power can cause that.
            Some(segment) if segment.end() <= contents.through() => {
                let header = SegmentHeader {
                    number: segment.header.number + 1,
                    first: contents.through().next(),
                    epoch,
                    ..segment.header
                };
                (header, &[][..])
            }
            Some(segment) => (SegmentHeader { epoch, ..segment.header }, &segment.frames[..]),
        };
        let active = syncer::begin(&*self.files, &self.directory, header, frames).map_err(io)?;
        let through = contents.through();
        let mut superfluous = contents.listing.unfinished.clone();
        let first = contents.segments.first().map_or(header.number, |segment| segment.header.number);
        let (segments, snapshots) = (&contents.listing.segments, &contents.listing.snapshots);
        superfluous
            .extend(segments.iter().filter(|number| **number < first).map(|n| directory::segment(&self.directory, *n)));
        superfluous.extend(
            snapshots.iter().filter(|other| **other < through).map(|at| directory::snapshot(&self.directory, *at)),
        );
        // The segment that was just begun may have replaced one of these files.
        superfluous.retain(|path| path.exists());
        compaction::remove(&*self.files, &self.directory, &superfluous).map_err(io)?;
        Ok(active)
    }
}

impl Store for Log {
    fn open(&self) -> Result<(Recovered, Box<dyn Writer>), OpenError> {
        self.options.check()?;
        let failed = |action| {
            let place = self.directory.display().to_string();
            move |source| OpenError::Io { action, place, source }
        };
        make_directory(&*self.files, &self.directory).map_err(failed("make"))?;
        let mut lock = Lock::take(&self.directory)?;
        let contents = contents::read(&self.directory)?;
        let active = self.take_over(&contents)?;
        lock.describe(active.header.epoch);
        let segment = directory::segment(&self.directory, active.header.number);
        lock.writes(segment).map_err(failed("look at the segment of"))?;
        let recovered = Recovered { epoch: active.header.epoch, ..contents.recovered() };
        let mut segments: Vec<_> =
            contents.segments.iter().map(|segment| (segment.header.number, segment.header.first)).collect();
        if segments.last().is_none_or(|(number, _)| *number != active.header.number) {
            segments.push((active.header.number, active.header.first));
        }
        let shared = Shared::new(self.directory.clone(), contents.last(), contents.through(), segments);
        let store = active.header.store;
        let syncer = Syncer {
            shared: Arc::new(shared),
            files: self.files.clone(),
            lock,
            active,
            durability: self.options.durability,
            segment_bytes: self.options.segment_bytes,
        };
        let writer = LogWriter::start(syncer, store, self.options.clone()).map_err(failed("start a thread for"))?;
        Ok((recovered, Box::new(writer)))
    }

    fn read(&self) -> Result<Recovered, ReadError> {
        Ok(contents::read(&self.directory)?.recovered())
    }

    fn finish_copy(&self, moved: &str) -> Result<Option<Position>, CopyError> {
        let mark = self.directory.join(directory::UNFINISHED_COPY);
        let failed = |action| {
            let place = mark.display().to_string();
            move |source| CopyError::Io { action, place, source }
        };
        if !mark.exists() {
            return Ok(None);
        }
        let _lock = Lock::take(&self.directory)?;
        if std::fs::read(&mark).map_err(failed("read"))? != moved.as_bytes() {
            return Ok(None);
        }
        let removed = self.files.remove(&mark).and_then(|()| self.files.sync_directory(&self.directory));
        removed.map_err(failed("remove"))?;
        Ok(Some(contents::read(&self.directory)?.last()))
    }

    fn place(&self) -> String {
        self.directory.display().to_string()
    }
}

impl FromStr for Durability {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, Self::Err> {
        match name {
            "none" => Ok(Durability::None),
            "group" => Ok(Durability::Group),
            "each" => Ok(Durability::Each),
            other => Err(format!("durability is none, group or each, not {other:?}")),
        }
    }
}

impl fmt::Display for Durability {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Durability::None => "none",
            Durability::Group => "group",
            Durability::Each => "each",
        })
    }
}

/// Makes a directory and its parents; each is durable in its own parent.
fn make_directory(files: &dyn Files, path: &Path) -> io::Result<()> {
    if path.is_dir() {
        return Ok(());
    }
    let parent = path.parent().filter(|parent| !parent.as_os_str().is_empty());
    if let Some(parent) = parent {
        make_directory(files, parent)?;
    }
    files.create_directory(path).or_else(|error| if path.is_dir() { Ok(()) } else { Err(error) })?;
    files.sync_directory(parent.unwrap_or(Path::new(".")))
}
