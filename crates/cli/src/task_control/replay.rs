//! A run's log, replayed through a new executive: the same events give the same commands, so it then stands where the one that
//! was killed stood. A log that says otherwise is of another program and is refused. Pure.

use super::ledger::Ledger;
use ratn_executive::executive::Executive;
use ratn_executive::protocol::{Command, Event, LogEntry, LogLine, Note};
use ratn_model::id::{InstanceId, StateId};
use ratn_model::program::Program;
use ratn_model::time::Timestamp;
use ratn_world::tolerance::Tolerance;
use std::collections::BTreeMap;
use std::sync::Arc;

/// The version of this program, as logs name it.
pub(super) const VERSION: &str = env!("CARGO_PKG_VERSION");

/// Why a run cannot be resumed from its log.
#[derive(Debug, thiserror::Error, PartialEq)]
pub(crate) enum ReplayError {
    #[error("the log names no run: it was written by an earlier version; run the task again")]
    NoRun,
    #[error("the log was written by ratn {theirs}, and this is {VERSION}: resume it with that version")]
    Version { theirs: String },
    #[error("the log is of the task `{theirs}`, not of `{ours}`")]
    Task { theirs: String, ours: String },
    #[error(
        "the task file has changed since the run began: put the old one back, or run the new one from its beginning"
    )]
    Digest,
    #[error("the run has ended with {outcome}: there is nothing to resume")]
    Ended { outcome: String },
    #[error(
        "line {line}: the log says {theirs}, and this program would have said {ours}: it was written by another program, for \
         another catalogue, or has been edited"
    )]
    Otherwise { line: usize, theirs: String, ours: String },
}

/// Where a run stands.
pub(super) struct Replayed {
    pub(super) executive: Executive,
    pub(super) ledger: Ledger,
    /// Commands of the last event that are not in the log: its writer was killed among them, and has performed none of them.
    pub(super) missing: Vec<Command>,
    /// Which states the instances are of.
    pub(super) states: BTreeMap<InstanceId, StateId>,
}

/// Replays a log.
///
/// # Errors
/// [`ReplayError`]; lines count from 1.
pub(super) fn replay(program: &Arc<Program>, lines: &[LogLine]) -> Result<Replayed, ReplayError> {
    if let Some(LogLine { entry: LogEntry::Event(Event::Started { task, digest, origin, .. }), .. }) = lines.first() {
        if origin.run.is_empty() {
            return Err(ReplayError::NoRun);
        }
        if origin.version != VERSION {
            return Err(ReplayError::Version { theirs: origin.version.clone() });
        }
        if *task != program.name {
            return Err(ReplayError::Task { theirs: task.clone(), ours: program.name.clone() });
        }
        if *digest != program.digest {
            return Err(ReplayError::Digest);
        }
    }
    let mut executive = Executive::new(program.clone(), Tolerance::ROBOT);
    let mut ledger = Ledger::default();
    let mut states = BTreeMap::new();
    let mut missing = Vec::new();
    let mut next = 0;
    while let Some(LogLine { at, entry: LogEntry::Event(event) }) = lines.get(next) {
        next += 1;
        ledger.event(*at, event);
        missing = executive.handle(*at, event.clone());
        let logged = lines[next..].iter().map_while(|line| match &line.entry {
            LogEntry::Command(command) => Some(command),
            LogEntry::Event(_) => None,
        });
        let logged: Vec<&Command> = logged.collect();
        let last = next + logged.len() == lines.len();
        for (index, theirs) in logged.iter().enumerate() {
            let ours = missing.get(index);
            if ours.is_none_or(|ours| !same(ours, theirs)) {
                return Err(otherwise(next + index + 1, Some(theirs), ours));
            }
        }
        if !last && logged.len() < missing.len() {
            return Err(otherwise(next + logged.len() + 1, None, missing.get(logged.len())));
        }
        missing.iter().for_each(|command| follow(&mut states, command));
        if let Some(Command::End { outcome, .. }) = logged.last() {
            return Err(ReplayError::Ended { outcome: outcome.clone() });
        }
        missing.iter().for_each(|command| ledger.command(command));
        missing.drain(..logged.len());
        next += logged.len();
    }
    Ok(Replayed { executive, ledger, missing, states })
}

/// Keeps in mind which state an instance is of, as long as it matters.
pub(super) fn follow(states: &mut BTreeMap<InstanceId, StateId>, command: &Command) {
    match command {
        Command::Note(Note::Expanded { instance, state, .. }) => {
            states.insert(*instance, *state);
        }
        Command::Note(Note::Retired { instance } | Note::Squashed { instance }) => {
            states.remove(instance);
        }
        _ => {}
    }
}

/// As the log has them: what is not a number equals itself there.
fn same(ours: &Command, theirs: &Command) -> bool {
    ours == theirs || text(Some(ours)) == text(Some(theirs))
}

fn otherwise(line: usize, theirs: Option<&Command>, ours: Option<&Command>) -> ReplayError {
    ReplayError::Otherwise { line, theirs: short(text(theirs)), ours: short(text(ours)) }
}

fn text(command: Option<&Command>) -> String {
    command.map_or("nothing".into(), |command| serde_json::to_string(command).unwrap_or_default())
}

/// Enough of it to see what it is.
fn short(text: String) -> String {
    const ENOUGH: usize = 160;
    if text.chars().count() <= ENOUGH { text } else { text.chars().take(ENOUGH).chain(['…']).collect() }
}

/// Whether something of these commands must not leave before the event that led to them is safe: what cannot be undone.
pub(super) fn must_be_durable(program: &Program, states: &BTreeMap<InstanceId, StateId>, commands: &[Command]) -> bool {
    use ratn_model::program::Nature;
    commands.iter().any(|command| match command {
        Command::Commit { .. } | Command::Operate { .. } => true,
        Command::Start { instance, .. } => states
            .get(instance)
            .is_none_or(|state| matches!(program.state(*state).annotations.nature, Nature::Irreversible)),
        _ => false,
    })
}

/// The time of a run that goes on: the wall's, as if task control had been there, and never behind the log.
pub(super) fn now(ledger: &Ledger, unix_ms: u64, speed: f64) -> Timestamp {
    let since = unix_ms.saturating_sub(ledger.origin.began_unix_ms);
    Timestamp::from_seconds(since as f64 / 1e3 * speed).max(ledger.last)
}
