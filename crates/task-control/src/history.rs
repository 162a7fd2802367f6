//! What a run that was killed has left: its event log, and a checkpoint of it. Reading touches nothing.

use super::checkpoint::{self, Checkpoint};
pub use super::replay::ReplayError;
use super::replay::{self, Replayed};
use crate::messages::Messages;
use ratn_event_log::{self as log, Log, LogError, LogWriter};
use ratn_executive::protocol::{Event, LogEntry, LogLine, Mode, Origin};
use ratn_model::program::Program;
use std::path::PathBuf;
use std::sync::Arc;

/// Why a run cannot be resumed.
#[derive(Debug, thiserror::Error)]
pub enum HistoryError {
    /// It does not read.
    #[error(transparent)]
    Log(#[from] LogError),
    /// It does not follow from the task.
    #[error(transparent)]
    Replay(#[from] ReplayError),
    /// Its checkpoint forbids to go on.
    #[error(transparent)]
    Checkpoint(#[from] checkpoint::FileError),
}

/// The log of a run that is gone on with.
pub struct History {
    path: PathBuf,
    /// The event `started`.
    first: LogLine,
    messages: Messages,
}

impl History {
    /// Of a log. Its writer is whoever asks, so that nobody else goes on with it. What is found on the way goes to `messages`.
    ///
    /// # Errors
    /// Where it is no event log.
    pub fn of(writer: &LogWriter, messages: Messages) -> Result<History, LogError> {
        let path = writer.path().to_owned();
        let first = log::first(&path)?;
        Ok(History { path, first, messages })
    }

    /// The task file that it names.
    pub fn task(&self) -> Option<PathBuf> {
        let origin = self.started()?.0;
        (!origin.file.is_empty()).then(|| PathBuf::from(&origin.file))
    }

    /// The state at which the run began, where that was not the first.
    pub fn from(&self) -> Option<String> {
        self.started()?.0.from.clone()
    }

    /// How the run is executed, and what its random choices are derived from.
    pub(crate) fn mode_and_seed(&self) -> (Mode, u64) {
        match &self.first.entry {
            LogEntry::Event(Event::Started { mode, seed, .. }) => (*mode, *seed),
            _ => (Mode::Hsm, 0),
        }
    }

    /// Where the run stands: by its newest checkpoint and what is behind it, else by the whole log.
    ///
    /// # Errors
    /// Where the log is not of this program and this version.
    pub(crate) fn replay(&self, program: &Arc<Program>) -> Result<(Replayed, Log), HistoryError> {
        replay::check(program, &self.first)?;
        let Some(checkpoint) = self.checkpoint()? else {
            return self.replay_whole(program);
        };
        let behind = log::read_behind(&self.path, checkpoint.place.bytes, checkpoint.place.lines)?;
        match replay::replay_behind(program, checkpoint, &behind.lines) {
            Ok(replayed) => {
                let (path, before, read) = (self.path.display(), behind.before, behind.lines.len());
                self.messages
                    .say(format_args!("{path}: a checkpoint after {before} lines, and {read} lines behind it"));
                Ok((replayed, behind))
            }
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
    pub(crate) fn replay_whole(&self, program: &Arc<Program>) -> Result<(Replayed, Log), HistoryError> {
        let whole = log::read(&self.path)?;
        Ok((replay::replay(program, &whole.lines)?, whole))
    }

    /// What is to be said of a checkpoint that is not used.
    pub(crate) fn say(&self, reason: &dyn std::fmt::Display) {
        let path = checkpoint::path_of(&self.path);
        self.messages.say(format_args!("{}: not used, the whole log is replayed: {reason}", path.display()));
    }

    /// Where what people read goes.
    pub(crate) fn messages(&self) -> &Messages {
        &self.messages
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
