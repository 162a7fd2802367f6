//! Checkpoints of a run, beside its event log as `LOG.checkpoint`: a run is resumed from the newest one and the lines behind it,
//! however long its log is.
//!
//! A checkpoint holds all that replaying the log up to a place comes to (`ReplayedState`), and says which log and which place in it
//! (`Place`). It only saves time: without one, or with one that does not fit, the whole log is replayed. What the log says is
//! never changed for it.
//!
//! `file` is the form of the file and its reading, `pace` says when one is due, `checkpointer` makes them during a run, and
//! `writer` writes them in a thread of its own.

mod checkpointer;
mod file;
mod pace;
mod writer;

pub(super) use checkpointer::Checkpointer;
pub use file::FileError;
pub(crate) use file::find;
pub use pace::EVERY_EVENTS;

use super::ledger::Ledger;
use super::progress::Progress;
use ratn_model::id::{InstanceId, StateId};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

/// So many bytes at the beginning of the log, and before the place, have to be what they were.
const COMPARED: u64 = 64 << 10;

/// All that a run's log comes to up to a line, but for the executive.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct ReplayedState {
    pub(super) ledger: Ledger,
    /// Which states the instances are of.
    pub(super) states: BTreeMap<InstanceId, StateId>,
    pub(super) progress: Progress,
}

/// A place in a log, behind a whole line and all commands of its event.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Place {
    /// What is before it, in bytes
    pub(super) bytes: u64,
    /// and in lines.
    pub(super) lines: usize,
    /// Digests of the first and of the last [`COMPARED`] bytes before it.
    first: String,
    last: String,
}

impl Place {
    /// The place after so much of a log.
    pub(super) fn of(log: &File, bytes: u64, lines: usize) -> io::Result<Place> {
        let compared = bytes.min(COMPARED);
        let digest = |from: u64| {
            let mut text = vec![0; usize::try_from(compared).unwrap_or_default()];
            log.read_exact_at(&mut text, from)?;
            Ok::<_, io::Error>(blake3::hash(&text).to_string())
        };
        Ok(Place { bytes, lines, first: digest(0)?, last: digest(bytes - compared)? })
    }
}

/// A run's state at a place in its log.
#[derive(Debug, PartialEq)]
pub(crate) struct Checkpoint {
    /// The task file's digest.
    pub(super) digest: String,
    pub(super) place: Place,
    pub(super) standing: ReplayedState,
    /// The executive's state, in a form of its own.
    pub(super) executive: Vec<u8>,
}

/// Where the checkpoint of a log is.
pub(super) fn path_of(log: &Path) -> PathBuf {
    let mut name = log.as_os_str().to_owned();
    name.push(".checkpoint");
    name.into()
}
