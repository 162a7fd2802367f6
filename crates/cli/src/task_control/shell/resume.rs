//! Going on with a run from its event log: the executive is brought to where it was, what was open is taken up, and the loop goes
//! on as ever.

use super::{Ended, LOOK, Place, Shell, advisor_of, unix_ms};
use crate::interrupt::Interrupt;
use crate::task_control::control::Control;
use crate::task_control::log::LogWriter;
use crate::task_control::performer::{self, Performer};
use crate::task_control::progress::Progress;
use crate::task_control::replay::{self, ReplayError, Replayed};
use crate::task_control::shell::MAX_PENDING_EVENTS;
use anyhow::Context;
use ratn_executive::lookahead::Lookout;
use ratn_executive::protocol::{Command, Event, LogEntry, LogLine, Mode};
use ratn_model::program::Program;
use ratn_worker::robot_clock::RobotClock;
use std::sync::Arc;
use std::time::Instant;
use tokio::sync::mpsc;

/// A run to go on with, as its log has it.
pub(crate) struct Resumption {
    program: Arc<Program>,
    mode: Mode,
    seed: u64,
    replayed: Replayed,
    progress: Progress,
    log: LogWriter,
}

impl Resumption {
    /// Replays what the log says. Touches nothing of the run.
    ///
    /// # Errors
    /// Where the log is not of this program and this version, or the run has ended.
    pub(crate) fn new(program: Program, log: LogWriter, lines: &[LogLine]) -> Result<Resumption, ReplayError> {
        let program = Arc::new(program);
        let replayed = replay::replay(&program, lines)?;
        let mut progress = Progress::new(false);
        progress.catch_up(lines);
        let (mode, seed) = match lines.first().map(|line| &line.entry) {
            Some(LogEntry::Event(Event::Started { mode, seed, .. })) => (*mode, *seed),
            _ => (Mode::Hsm, 0),
        };
        Ok(Resumption { program, mode, seed, replayed, progress, log })
    }
}

/// Goes on with a run whose task control was killed, on the system that it was on.
///
/// # Errors
/// As [`run`]; and where the run cannot go on: its log is of another program, its world is not there any more, another run is
/// under way.
pub(crate) async fn resume(resumption: Resumption, place: &Place, interrupt: &Interrupt) -> anyhow::Result<Ended> {
    let Resumption { program, mode, seed, replayed, progress, log } = resumption;
    let Replayed { executive, mut ledger, missing, states } = replayed;
    performer::check_world(&place.endpoints, &ledger).await?;
    let (events, answers) = mpsc::channel(MAX_PENDING_EVENTS);
    let performer = Performer::connect(place, &ledger.origin.run, &program.name, events).await;
    let shell = Shell {
        executive,
        states,
        timers: std::mem::take(&mut ledger.wakes),
        progress,
        program,
        log,
        clock: RobotClock::going_on(replay::now(&ledger, unix_ms(), place.speed), place.speed),
        control: Control::listen_if_possible(&place.directory),
        advisor: advisor_of(mode, seed),
        lookout: Lookout::default(),
        ask_at: None,
        look_at: Instant::now() + LOOK,
        performer: performer.context("cannot go on with the run")?,
        answers,
    };
    let begin = async |shell: &mut Shell| {
        let mirror = shell.executive.root().clone();
        shell.log.append_commands(ledger.last, &missing)?;
        // Request ids of now on have the number of this resumption: it is in the log before they are used.
        let (now, commands) = shell.decide(&Event::Resumed)?;
        shell.log.make_durable()?;
        ledger.event(now, &Event::Resumed);
        let changed = shell.performer.take_up(ledger, &mirror).await?;
        // Commits are there by now.
        let missing = missing.into_iter().filter(|command| !matches!(command, Command::Commit { .. }));
        let ended = shell.perform(now, missing.chain(commands))?;
        match changed {
            Some(changed) if ended.is_none() => shell.step(changed),
            _ => Ok(ended),
        }
    };
    shell.run_to_its_end(begin, interrupt).await
}
