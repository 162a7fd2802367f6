//! What a killed run has left: its event log and a checkpoint. Reading changes nothing.

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
    /// The log cannot be read.
    #[error(transparent)]
    Log(#[from] LogError),
    /// The log does not match the task.
    #[error(transparent)]
    Replay(#[from] ReplayError),
    /// The checkpoint forbids resuming.
    #[error(transparent)]
    Checkpoint(#[from] checkpoint::FileError),
}

/// The log of a run that is being resumed.
pub struct History {
    path: PathBuf,
    /// The event `started`.
    first: LogLine,
    messages: Messages,
}

impl History {
    /// The history in a log. The caller holds the log's writer, so that nobody else resumes the run. Findings are sent to `messages`.
    ///
    /// # Errors
    /// The file is not an event log.
    pub fn of(writer: &LogWriter, messages: Messages) -> Result<History, LogError> {
        let path = writer.path().to_owned();
        let first = log::first(&path)?;
        Ok(History { path, first, messages })
    }

    /// The task file that the log names.
    pub fn task(&self) -> Option<PathBuf> {
        let origin = self.started()?.0;
        (!origin.file.is_empty()).then(|| PathBuf::from(&origin.file))
    }

    /// The state at which the run began, if it was not the first.
    pub fn from(&self) -> Option<String> {
        self.started()?.0.from.clone()
    }

    /// The execution mode, and the seed of the run's random choices.
    pub(crate) fn mode_and_seed(&self) -> (Mode, u64) {
        match &self.first.entry {
            LogEntry::Event(Event::Started { mode, seed, .. }) => (*mode, *seed),
            _ => (Mode::Hsm, 0),
        }
    }

    /// The state of the run, from its newest checkpoint and the lines after it, else from the whole log.
    ///
    /// # Errors
    /// The log does not match this program or this version.
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

    /// Like [`History::replay`], without a checkpoint.
    ///
    /// # Errors
    /// The same as there.
    pub(crate) fn replay_whole(&self, program: &Arc<Program>) -> Result<(Replayed, Log), HistoryError> {
        let whole = log::read(&self.path)?;
        Ok((replay::replay(program, &whole.lines)?, whole))
    }

    /// Reports that a checkpoint is not used.
    pub(crate) fn say(&self, reason: &dyn std::fmt::Display) {
        let path = checkpoint::path_of(&self.path);
        self.messages.say(format_args!("{}: not used, the whole log is replayed: {reason}", path.display()));
    }

    /// The receiver of messages for people.
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
