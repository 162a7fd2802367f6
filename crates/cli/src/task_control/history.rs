//! What a run that was killed has left: its event log, and a checkpoint of it. Reading touches nothing.

use super::checkpoint::{self, Checkpoint};
use super::log::{self, Log, LogError, LogWriter};
use super::replay::{self, ReplayError, Replayed};
use crate::output;
use ratn_executive::protocol::{Event, LogEntry, LogLine, Mode, Origin};
use ratn_model::program::Program;
use std::path::PathBuf;
use std::sync::Arc;

/// Why a run cannot be resumed.
#[derive(Debug, thiserror::Error)]
pub(crate) enum HistoryError {
    #[error(transparent)]
    Log(#[from] LogError),
    #[error(transparent)]
    Replay(#[from] ReplayError),
    #[error(transparent)]
    Checkpoint(#[from] checkpoint::FileError),
}

/// The log of a run that is gone on with.
pub(crate) struct History {
    path: PathBuf,
    /// The event `started`.
    first: LogLine,
}

impl History {
    /// Of a log. Its writer is whoever asks, so that nobody else goes on with it.
    ///
    /// # Errors
    /// Where it is no event log.
    pub(crate) fn of(writer: &LogWriter) -> Result<History, LogError> {
        let path = writer.path().to_owned();
        let first = log::first(&path)?;
        Ok(History { path, first })
    }

    /// The task file that it names.
    pub(crate) fn task(&self) -> Option<PathBuf> {
        let origin = self.started()?.0;
        (!origin.file.is_empty()).then(|| PathBuf::from(&origin.file))
    }

    /// How the run is executed, and what its random choices are derived from.
    pub(super) fn mode_and_seed(&self) -> (Mode, u64) {
        match &self.first.entry {
            LogEntry::Event(Event::Started { mode, seed, .. }) => (*mode, *seed),
            _ => (Mode::Hsm, 0),
        }
    }

    /// Where the run stands: by its newest checkpoint and what is behind it, else by the whole log.
    ///
    /// # Errors
    /// Where the log is not of this program and this version, or the run has ended.
    pub(super) fn replay(&self, program: &Arc<Program>) -> Result<(Replayed, Log), HistoryError> {
        replay::check(program, &self.first)?;
        let Some(checkpoint) = self.checkpoint()? else {
            return self.replay_whole(program);
        };
        let behind = log::read_behind(&self.path, checkpoint.place.bytes, checkpoint.place.lines)?;
        match replay::replay_behind(program, checkpoint, &behind.lines) {
            Ok(replayed) => {
                let (path, before, read) = (self.path.display(), behind.before, behind.lines.len());
                output::progress(format_args!("{path}: a checkpoint after {before} lines, and {read} lines behind it"));
                Ok((replayed, behind))
            }
            Err(error @ ReplayError::Ended { .. }) => Err(error.into()),
            Err(error) => {
                self.say(&error);
                self.replay_whole(program)
            }
        }
    }

    /// As [`History::replay`], without a checkpoint.
    ///
    /// # Errors
    /// As there.
    pub(super) fn replay_whole(&self, program: &Arc<Program>) -> Result<(Replayed, Log), HistoryError> {
        let whole = log::read(&self.path)?;
        Ok((replay::replay(program, &whole.lines)?, whole))
    }

    /// What is to be said of a checkpoint that is not used.
    pub(super) fn say(&self, reason: &dyn std::fmt::Display) {
        let path = checkpoint::path_of(&self.path);
        output::progress(format_args!("{}: not used, the whole log is replayed: {reason}", path.display()));
    }

    fn checkpoint(&self) -> Result<Option<Checkpoint>, HistoryError> {
        let Some((origin, digest)) = self.started() else { return Ok(None) };
        match checkpoint::find(&self.path, origin, digest) {
            Err(error) if error.refuses() => Err(error.into()),
            Err(error) => {
                self.say(&error);
                Ok(None)
            }
            Ok(found) => Ok(found),
        }
    }

    fn started(&self) -> Option<(&Origin, &str)> {
        match &self.first.entry {
            LogEntry::Event(Event::Started { origin, digest, .. }) => Some((origin, digest)),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests;
