//! Replays a run's log through a new executive: the same events give the same commands, so the executive is then in the state of the one that was
//! killed. With a checkpoint only the lines after it are replayed. A log with other commands belongs to another program and is refused. Pure.

use super::checkpoint::{Checkpoint, ReplayedState};
use super::ledger::Ledger;
use super::shell::Ended;
use ratn_executive::executive::Executive;
use ratn_executive::protocol::{Command, Event, LogEntry, LogLine, Note};
use ratn_model::id::{InstanceId, StateId};
use ratn_model::program::Program;
use ratn_model::time::Timestamp;
use ratn_model::tolerance::Tolerance;
use std::collections::BTreeMap;
use std::sync::Arc;

/// The version of this program, as written in logs.
pub(super) const VERSION: &str = env!("CARGO_PKG_VERSION");

/// Why a run cannot be resumed from its log.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum ReplayError {
    /// The first line has no run id.
    #[error("the log names no run: it was written by an earlier version; run the task again")]
    NoRun,
    /// It was written by another version.
    #[error("the log was written by ratn {theirs}, and this is {VERSION}: resume it with that version")]
    Version {
        /// The version that wrote it.
        theirs: String,
    },
    /// It belongs to another task.
    #[error("the log is of the task `{theirs}`, not of `{ours}`")]
    Task {
        /// The name in the log.
        theirs: String,
        /// The name in the task file.
        ours: String,
    },
    /// The task file has changed since the run began.
    #[error(
        "the task file has changed since the run began: put the old one back, or run the new one from its beginning"
    )]
    Digest,
    /// The run has ended, and everything that it did is recorded, or cannot be recorded any more.
    #[error("the run has ended with {outcome}: there is nothing to resume")]
    Ended {
        /// The outcome of the run.
        outcome: String,
    },
    /// The log has another command than this program gives.
    #[error(
        "line {line}: the log says {theirs}, and this program would have said {ours}: it was written by another program, for \
         another catalogue, or has been edited"
    )]
    Otherwise {
        /// The number of the line, from 1.
        line: usize,
        /// The command in the log.
        theirs: String,
        /// The command of this program.
        ours: String,
    },
    /// The executive's state in the checkpoint cannot be restored.
    #[error("the executive's state cannot be restored: {reason}")]
    Restore {
        /// The reason.
        reason: String,
    },
}

/// The state of a run after a replay.
pub(super) struct Replayed {
    pub(super) executive: Executive,
    pub(super) standing: ReplayedState,
    /// Commands of the last event that are missing in the log: the process was killed before it wrote them, and has performed none of them. They have
    /// to be performed, except those that are recorded: these are in the ledger.
    pub(super) missing: Vec<Command>,
    /// How the run has ended, if it has: some of its decisions may not have been performed.
    pub(super) ended: Option<Ended>,
    /// The number of replayed events.
    pub(super) events: u64,
}

/// Checks by its first line that a log belongs to this program, this version, and a run that can be resumed.
///
/// # Errors
/// [`ReplayError`].
pub(super) fn check(program: &Program, first: &LogLine) -> Result<(), ReplayError> {
    let LogEntry::Event(Event::Started { task, digest, origin, .. }) = &first.entry else { return Ok(()) };
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
    Ok(())
}

/// Replays a whole log.
///
/// # Errors
/// [`ReplayError`]; line numbers start at 1.
pub(super) fn replay(program: &Arc<Program>, lines: &[LogLine]) -> Result<Replayed, ReplayError> {
    if let Some(first) = lines.first() {
        check(program, first)?;
    }
    let executive = Executive::new(program.clone(), Tolerance::ROBOT);
    go_on(executive, ReplayedState::default(), 0, lines)
}

/// Replays the lines of a log after a checkpoint.
///
/// # Errors
/// [`ReplayError`]; line numbers start at 1, at the beginning of the log.
pub(super) fn replay_behind(
    program: &Arc<Program>,
    checkpoint: Checkpoint,
    lines: &[LogLine],
) -> Result<Replayed, ReplayError> {
    let Checkpoint { place, standing, executive, .. } = checkpoint;
    let executive = Executive::restore(program.clone(), Tolerance::ROBOT, &executive)
        .map_err(|error| ReplayError::Restore { reason: error.to_string() })?;
    go_on(executive, standing, place.lines, lines)
}

/// Gives the events of the lines to an executive and compares its commands; there are `before` lines before these.
fn go_on(
    mut executive: Executive,
    mut standing: ReplayedState,
    before: usize,
    lines: &[LogLine],
) -> Result<Replayed, ReplayError> {
    let ReplayedState { ledger, states, progress } = &mut standing;
    let (mut missing, mut ended) = (Vec::new(), None);
    let (mut next, mut events) = (0, 0);
    while let Some(LogLine { at, entry }) = lines.get(next) {
        let event = match entry {
            LogEntry::Event(event) => event,
            // Every command after an event was compared with it.
            LogEntry::Command(command) => return Err(otherwise(before + next + 1, Some(command), None)),
        };
        next += 1;
        events += 1;
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
                return Err(otherwise(before + next + index + 1, Some(theirs), ours));
            }
        }
        if !last && logged.len() < missing.len() {
            return Err(otherwise(before + next + logged.len() + 1, None, missing.get(logged.len())));
        }
        missing.iter().for_each(|command| follow(states, command));
        if let Some(end @ Command::End { .. }) = logged.last().copied() {
            ended = Ended::of(end.clone(), *at);
        }
        logged.iter().for_each(|command| ledger.command(command));
        progress.catch_up(*at, event, missing.iter());
        missing.drain(..logged.len());
        // None of these was performed, so they are not open items. The recorded ones are added, in order, after those in the log.
        missing.iter().filter(|command| is_recorded(command)).for_each(|command| ledger.command(command));
        next += logged.len();
    }
    Ok(Replayed { executive, standing, missing, ended, events })
}

/// Whether a command is one of those that the ledger keeps in order: commits and operations.
pub(super) fn is_recorded(command: &Command) -> bool {
    matches!(command, Command::Commit { .. } | Command::Operate { .. })
}

/// Tracks the state of each instance, as long as it is needed.
pub(super) fn follow(states: &mut BTreeMap<InstanceId, StateId>, command: &Command) {
    match command {
        Command::Note(Note::Expanded { instance, state, .. }) => {
            states.insert(*instance, *state);
        }
        Command::Note(Note::Retired { instance } | Note::Squashed { instance } | Note::Merged { instance }) => {
            states.remove(instance);
        }
        _ => {}
    }
}

/// Compares commands as written in a log, where NaN equals itself.
fn same(ours: &Command, theirs: &Command) -> bool {
    ours == theirs || text(Some(ours)) == text(Some(theirs))
}

fn otherwise(line: usize, theirs: Option<&Command>, ours: Option<&Command>) -> ReplayError {
    ReplayError::Otherwise { line, theirs: short(text(theirs)), ours: short(text(ours)) }
}

fn text(command: Option<&Command>) -> String {
    command.map_or("nothing".into(), |command| serde_json::to_string(command).unwrap_or_default())
}

/// A prefix that is long enough to recognize the command.
fn short(text: String) -> String {
    const ENOUGH: usize = 160;
    if text.chars().count() <= ENOUGH { text } else { text.chars().take(ENOUGH).chain(['…']).collect() }
}

/// Whether one of these commands is irreversible, so that the event that led to it has to be on disk first.
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

/// The time of a resumed run: wall time, as if task control had never been away, but not before the end of the log.
pub(super) fn now(ledger: &Ledger, unix_ms: u64, speed: f64) -> Timestamp {
    let since = unix_ms.saturating_sub(ledger.origin.began_unix_ms);
    Timestamp::from_seconds(since as f64 / 1e3 * speed).max(ledger.last)
}

#[cfg(test)]
pub(super) mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::super::checkpoint::Place;
    use super::*;
    use crate::task_for_tests::{self, FETCH_BOXES};
    use ratn_executive::protocol::{Mode, Origin};
    use ratn_model::catalogue::Catalogue;
    use ratn_simulation::run::Setup;
    use ratn_simulation::timed::TimedProviders;
    use std::time::Duration;

    pub(crate) fn program(text: &str) -> Arc<Program> {
        Arc::new(task_for_tests::program(text))
    }

    pub(crate) fn fetch_boxes() -> Arc<Program> {
        program(FETCH_BOXES)
    }

    /// A complete run in virtual time, logged as by task control.
    pub(crate) fn log(program: &Arc<Program>, mode: Mode) -> Vec<LogLine> {
        let resources = Catalogue::standard().resources;
        let setup = Setup {
            program: program.clone(),
            mode,
            parameters: program.bind_parameters(&[("boxes".into(), "2".into())]).unwrap(),
            seed: 3,
            resources: resources.into_iter().collect(),
            world: Vec::new(),
            tolerance: Tolerance::ROBOT,
            latency: Duration::from_millis(50),
        };
        let mut lines = ratn_simulation::run::run(setup, &mut TimedProviders { boxes: 2 }).unwrap().log;
        let LogEntry::Event(Event::Started { origin, .. }) = &mut lines[0].entry else { panic!("no start") };
        **origin = Origin { run: "run-1".into(), version: VERSION.into(), ..Origin::default() };
        lines
    }

    #[test]
    fn a_run_that_is_cut_anywhere_goes_on_where_it_was() {
        let program = fetch_boxes();
        for mode in [Mode::Hsm, Mode::Cdtn] {
            let lines = log(&program, mode);
            // The last line is the end of the run.
            for length in 1..lines.len() {
                let Replayed { mut executive, missing, standing, .. } = replay(&program, &lines[..length]).unwrap();
                assert_eq!(standing.ledger.last, lines[length - 1].at);
                // The missing commands equal the lines that were cut off, and so do later ones.
                let mut commands = missing.into_iter();
                for line in &lines[length..] {
                    match &line.entry {
                        LogEntry::Command(command) => assert_eq!(commands.next().as_ref(), Some(command)),
                        LogEntry::Event(event) => {
                            commands = executive.handle(line.at, event.clone()).into_iter();
                        }
                    }
                }
                assert!(executive.has_ended());
            }
            // After the end of a run, its decisions are known.
            let whole = replay(&program, &lines).unwrap();
            assert_eq!(whole.ended.map(|ended| ended.outcome).as_deref(), Some("success"));
            let decided = lines.iter().filter(|line| matches!(line.entry, LogEntry::Command(Command::Commit { .. })));
            assert_eq!(whole.standing.ledger.commits.len(), decided.count());
        }
    }

    #[test]
    fn what_is_missing_of_a_step_that_was_cut_is_recorded_in_the_order_in_which_it_was_decided() {
        let program = fetch_boxes();
        for mode in [Mode::Hsm, Mode::Cdtn] {
            let lines = log(&program, mode);
            let is_event = |line: &LogLine| matches!(line.entry, LogEntry::Event(_));
            let mut operated = 0;
            for step in (1..lines.len()).filter(|cut| is_event(&lines[*cut])) {
                let whole = replay(&program, &lines[..step]).unwrap().standing.ledger;
                let begins = (0..step).rev().find(|line| is_event(&lines[*line])).unwrap_or_default();
                for cut in begins + 1..step {
                    let torn = replay(&program, &lines[..cut]).unwrap().standing.ledger;
                    assert_eq!(torn.commits, whole.commits, "cut at {cut} of {step}");
                    assert_eq!((torn.operations, &torn.operated), (whole.operations, &whole.operated));
                }
                operated = whole.operations;
            }
            assert!(operated > 0);
        }
    }

    const COMPUTING: &str = r#"
task: computing
parameters: { boxes: { type: int, default: 2 } }
variables: { last: 0 }
outputs: { last: $last }
states:
  - routine:
      routine: true
      states:
        - loop:
            for: turn in range(1, 400)
            do:
              - plan:
                  action: path_planner/plan
                  in: { start: "joints(0, 0, 0, 0, 0, 0, 0)", goal: "joints(1, 0, 0, 0, 0, 0, 0)" }
                  assign: { last: turn }
"#;

    #[test]
    fn what_is_kept_of_a_routine_does_not_grow_with_the_parts_that_have_ended() {
        let program = program(COMPUTING);
        for mode in [Mode::Hsm, Mode::Cdtn] {
            let mut lines = log(&program, mode);
            let LogEntry::Event(Event::Started { origin, .. }) = &mut lines[0].entry else { panic!("no start") };
            origin.natures.changes_at_exit = vec!["routine".to_owned()];
            let starts = |line: &&LogLine| matches!(line.entry, LogEntry::Command(Command::Start { .. }));
            assert_eq!(lines.iter().filter(starts).count(), 399);
            let kept = |cut: usize| {
                let ReplayedState { ledger, states, .. } = replay(&program, &lines[..cut]).unwrap().standing;
                let Ledger { beginnings, goals, projecting, .. } = ledger;
                let text = serde_json::to_string(&(beginnings, goals, projecting, &states)).unwrap();
                (states.len(), text.len())
            };
            let ((early, early_bytes), (late, late_bytes)) = (kept(lines.len() / 4), kept(lines.len() - 20));
            assert!(late <= early.max(4) && late < 8, "{mode:?}: {early}, then {late} instances");
            assert!(late_bytes <= early_bytes + 200, "{mode:?}: {early_bytes}, then {late_bytes} bytes");
        }
    }

    /// A checkpoint after these events of a log, as made by a running run.
    fn checkpoint(program: &Arc<Program>, lines: &[LogLine]) -> Checkpoint {
        let Replayed { executive, standing, missing, .. } = replay(program, lines).unwrap();
        assert_eq!(missing, []);
        let log = tempfile::NamedTempFile::new().unwrap();
        let place = Place::of(log.as_file(), 0, lines.len()).unwrap();
        Checkpoint { digest: program.digest.clone(), place, standing, executive: executive.checkpoint() }
    }

    #[test]
    fn with_a_checkpoint_behind_any_event_a_cut_run_stands_where_it_stands_without() {
        let program = fetch_boxes();
        for mode in [Mode::Hsm, Mode::Cdtn] {
            let lines = log(&program, mode);
            let mut newest = None;
            for cut in 1..lines.len() {
                let whole = replay(&program, &lines[..cut]).unwrap();
                // Only between two events, when all commands of the last one are there.
                if matches!(lines[cut].entry, LogEntry::Event(_)) {
                    newest = Some(checkpoint(&program, &lines[..cut]).encode().unwrap());
                }
                let Some(newest) = &newest else { continue };
                let checkpoint = Checkpoint::decode(newest).unwrap();
                let before = checkpoint.place.lines;
                let behind = replay_behind(&program, checkpoint, &lines[before..cut]).unwrap();
                assert_eq!(behind.standing, whole.standing, "cut at {cut}, checkpoint at {before}");
                assert_eq!(behind.missing, whole.missing);
                assert!(behind.events <= 1);
                // Both go on identically.
                let (mut one, mut other) = (whole.executive, behind.executive);
                for LogLine { at, entry } in &lines[cut..] {
                    if let LogEntry::Event(event) = entry {
                        assert_eq!(one.handle(*at, event.clone()), other.handle(*at, event.clone()));
                    }
                }
                assert!(one.has_ended() && other.has_ended());
            }
        }
    }

    #[test]
    fn the_rest_of_a_log_goes_with_a_checkpoint_behind_any_event_of_it() {
        let program = fetch_boxes();
        let lines = log(&program, Mode::Cdtn);
        let cut = lines.len() - 1;
        let whole = replay(&program, &lines[..cut]).unwrap();
        for place in (1..cut).filter(|place| matches!(lines[*place].entry, LogEntry::Event(_))) {
            let behind = replay_behind(&program, checkpoint(&program, &lines[..place]), &lines[place..cut]).unwrap();
            assert_eq!((&behind.standing, &behind.missing), (&whole.standing, &whole.missing));
            // The end is found, too, and a wrong line is refused with its number in the whole log.
            let ended = replay_behind(&program, checkpoint(&program, &lines[..place]), &lines[place..]).unwrap().ended;
            assert_eq!(ended.map(|ended| ended.outcome).as_deref(), Some("success"));
            let refused = replay_behind(&program, checkpoint(&program, &lines[..place]), &lines[place - 1..]).err();
            if matches!(lines[place - 1].entry, LogEntry::Command(_)) {
                assert!(
                    matches!(refused, Some(ReplayError::Otherwise { line, .. }) if line == place + 1),
                    "{refused:?}"
                );
            }
        }
    }

    #[test]
    fn whatever_is_answered_after_the_cut_is_open_at_the_cut_and_nothing_else_is() {
        let program = fetch_boxes();
        let lines = log(&program, Mode::Cdtn);
        let mut checked = 0;
        for cut in (1..lines.len()).filter(|cut| matches!(lines[*cut].entry, LogEntry::Event(_))) {
            let ledger = replay(&program, &lines[..cut]).unwrap().standing.ledger;
            let (mut goals, mut projecting, mut waiting) = (ledger.goals, ledger.projecting, ledger.waiting);
            projecting.retain(|_, asked| asked.named.is_none());
            // Requests after the cut are answered after the cut, too, and were not open.
            let mut asked: Vec<InstanceId> = Vec::new();
            for line in &lines[cut..] {
                match &line.entry {
                    LogEntry::Command(
                        Command::Start { instance, .. }
                        | Command::Project { instance, .. }
                        | Command::Acquire { instance, .. },
                    ) => asked.push(*instance),
                    LogEntry::Event(Event::Finished { instance, attempt, .. }) if !asked.contains(instance) => {
                        assert_eq!(goals.remove(instance).map(|goal| goal.0), Some(*attempt));
                    }
                    LogEntry::Event(Event::Projected { instance, .. }) if !asked.contains(instance) => {
                        assert!(projecting.remove(instance).is_some());
                    }
                    LogEntry::Event(Event::Granted { instance, .. }) if !asked.contains(instance) => {
                        assert!(waiting.remove(instance).is_some());
                    }
                    _ => continue,
                }
                checked += 1;
            }
            assert!(goals.is_empty() && projecting.is_empty() && waiting.is_empty(), "cut at {cut}");
        }
        assert!(checked > 100);
    }

    #[test]
    fn a_log_that_says_otherwise_is_refused_with_its_line() {
        let program = fetch_boxes();
        let mut lines = log(&program, Mode::Cdtn);
        let is_start = |line: &LogLine| matches!(line.entry, LogEntry::Command(Command::Start { .. }));
        let at = lines.iter().position(is_start).unwrap();
        lines[at].entry = LogEntry::Command(Command::Wake { at: Timestamp(1) });
        let refused = replay(&program, &lines).err().unwrap();
        assert!(matches!(refused, ReplayError::Otherwise { line, .. } if line == at + 1), "{refused}");
        // A missing command in the middle.
        let mut lines = log(&program, Mode::Cdtn);
        lines.remove(at);
        assert!(matches!(replay(&program, &lines).err().unwrap(), ReplayError::Otherwise { .. }));
    }

    #[test]
    fn a_log_of_something_else_is_refused_for_what_it_is() {
        let program = fetch_boxes();
        let lines = log(&program, Mode::Hsm);
        let changed = |change: fn(&mut Origin, &mut String)| {
            let mut lines = lines.clone();
            if let LogEntry::Event(Event::Started { origin, task, .. }) = &mut lines[0].entry {
                change(origin, task);
            }
            replay(&program, &lines).err().unwrap().to_string()
        };
        assert!(changed(|origin, _| origin.run.clear()).contains("names no run"));
        assert!(changed(|origin, _| origin.version = "0.0.1".into()).contains("written by ratn 0.0.1"));
        assert!(changed(|_, task| *task = "other".into()).contains("of the task `other`, not of `fetch_boxes`"));
        let edited = FETCH_BOXES.replace("duration: 7.7", "duration: 7.8");
        assert_eq!(replay(&self::program(&edited), &lines).err(), Some(ReplayError::Digest));
    }

    #[test]
    fn what_cannot_be_undone_must_be_durable_before() {
        let program = fetch_boxes();
        let lines = log(&program, Mode::Cdtn);
        let (mut states, mut durable, mut starts) = (BTreeMap::new(), 0, 0);
        for line in &lines {
            let LogEntry::Command(command) = &line.entry else { continue };
            follow(&mut states, command);
            let must_be = must_be_durable(&program, &states, std::slice::from_ref(command));
            match command {
                Command::Start { goal, .. } => {
                    let moves = ["arm", "gripper", "pan_tilt"].contains(&&*goal.provider);
                    assert_eq!(must_be, moves, "{command:?}");
                    (durable, starts) = (durable + usize::from(must_be), starts + 1);
                }
                Command::Commit { .. } | Command::Operate { .. } => assert!(must_be),
                _ => assert!(!must_be),
            }
        }
        assert!(durable > 0 && durable < starts);
    }
}
