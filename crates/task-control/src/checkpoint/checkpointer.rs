//! Makes the checkpoints of a run: follows the state that a replay would give, and hands a copy to the writer when a checkpoint is due.

use super::ReplayedState;
use super::pace::Pace;
use super::writer::{self, Job, Writer};
use crate::ledger::{Confirmed, Ledger};
use crate::progress::Progress;
use ratn_event_log::LogWriter;
use ratn_executive::executive::Executive;
use ratn_executive::protocol::{Command, Event};
use ratn_model::id::{InstanceId, StateId};
use ratn_model::time::Timestamp;
use std::collections::BTreeMap;
use std::io;
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// The checkpoints of one run.
pub(crate) struct Checkpointer {
    log: PathBuf,
    /// Digest of the task file.
    digest: String,
    ledger: Ledger,
    pace: Pace,
    /// When the last event was handled.
    last: Instant,
    /// How long the run was blocked by the last checkpoint.
    stopped: Duration,
    writer: Writer,
}

impl Checkpointer {
    /// The checkpointer of a run that writes this log and has this state, with `events` events since its last checkpoint. `None` if checkpoints are
    /// disabled or impossible: the log is no file, or the thread cannot be started.
    pub(crate) fn start(
        log: &LogWriter,
        digest: &str,
        every_events: u64,
        ledger: Ledger,
        events: u64,
    ) -> Option<Checkpointer> {
        if every_events == 0 || !log.is_on_disk() {
            return None;
        }
        let path = log.path().to_owned();
        let no_thread = |error: &io::Error| tracing::warn!(%error, "the run has no checkpoints: resuming takes longer");
        let writer = Writer::start(&path).inspect_err(no_thread).ok()?;
        let pace = Pace::new(every_events, events, log.written());
        Some(Checkpointer {
            log: path,
            digest: digest.to_owned(),
            ledger,
            pace,
            last: Instant::now(),
            stopped: Duration::ZERO,
            writer,
        })
    }

    /// An event and its commands were logged.
    pub(crate) fn follow(&mut self, at: Timestamp, event: &Event, commands: &[Command]) {
        self.ledger.event(at, event);
        commands.iter().for_each(|command| self.ledger.command(command));
        self.pace.event();
        self.last = Instant::now();
    }

    /// When the next checkpoint is due if nothing happens until then.
    pub(crate) fn due(&mut self, log: &LogWriter) -> Option<Instant> {
        if let Some(took) = self.writer.took() {
            self.pace.took(Instant::now(), self.stopped + took);
        }
        if self.writer.is_busy() { None } else { self.pace.due(self.last, log.written()) }
    }

    /// Makes a checkpoint. All logged commands have been performed.
    pub(crate) fn make(
        &mut self,
        log: &LogWriter,
        executive: &Executive,
        states: &BTreeMap<InstanceId, StateId>,
        progress: &Progress,
        confirmed: Confirmed,
    ) {
        let began = Instant::now();
        self.ledger.forget(confirmed);
        let (ledger, states, progress) = (self.ledger.clone(), states.clone(), progress.clone());
        self.writer.write(Job {
            digest: self.digest.clone(),
            bytes: log.written(),
            lines: log.lines(),
            standing: ReplayedState { ledger, states, progress },
            executive: executive.checkpoint(),
        });
        self.pace.made(log.written());
        self.stopped = began.elapsed();
        tracing::debug!(stopped = ?self.stopped, log = %self.log.display(), "a checkpoint is being written");
    }

    /// The run has ended: removes its checkpoint.
    pub(crate) fn end(self) {
        let Checkpointer { log, writer, .. } = self;
        drop(writer);
        writer::remove(&log);
    }
}

#[cfg(test)]
impl Checkpointer {
    /// Whether a checkpoint is being written.
    pub(crate) fn is_busy(&mut self) -> bool {
        let _ = self.writer.took();
        self.writer.is_busy()
    }
}
