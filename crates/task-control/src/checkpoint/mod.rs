//! Checkpoints of a run, in a file beside its event log, `LOG.checkpoint`: a run is resumed from the newest checkpoint and the log lines after it,
//! however long its log is.
//!
//! A checkpoint holds the state that a replay of the log up to a place gives (`ReplayedState`), and names the log and the place (`Place`). It only
//! saves time: without a checkpoint, or with one that does not match, the whole log is replayed. The log is never changed for a checkpoint.
//!
//! `file` is the file format, `pace` decides when a checkpoint is due, `checkpointer` makes checkpoints during a run, and `writer` writes them in a
//! separate thread.

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

/// This many bytes at the beginning of the log, and before the place, have to be unchanged.
const COMPARED: u64 = 64 << 10;

/// The state of a run after a log line, without the executive's state.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct ReplayedState {
    pub(super) ledger: Ledger,
    /// The state of each instance.
    pub(super) states: BTreeMap<InstanceId, StateId>,
    pub(super) progress: Progress,
}

/// A place in a log, after a whole line and all commands of its event.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Place {
    /// The number of bytes before it.
    pub(super) bytes: u64,
    /// The number of lines before it.
    pub(super) lines: usize,
    /// Digests of the first and of the last [`COMPARED`] bytes before it.
    first: String,
    last: String,
}

impl Place {
    /// The place after `bytes` bytes and `lines` lines of a log.
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
    /// Digest of the task file.
    pub(super) digest: String,
    pub(super) place: Place,
    pub(super) standing: ReplayedState,
    /// The executive's state, in the executive's own format.
    pub(super) executive: Vec<u8>,
}

/// The path of the checkpoint of a log.
pub(super) fn path_of(log: &Path) -> PathBuf {
    let mut name = log.as_os_str().to_owned();
    name.push(".checkpoint");
    name.into()
}
