//! Golden scenarios: one folder in `tests/scenarios` per rule of the window and per element of control flow.
//!
//! `task.yaml` is the task, its description the rule; an ontology that it names is a file beside it. `script.toml` says what the providers
//! and the user do (`support/script.rs`). `transcript.txt` is what must come of it, in both modes: what the environment and the workers see, and what became of what was
//! computed. `UPDATE=1 cargo test -p ratn-simulation --test golden` writes it anew: read the difference before it is committed.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may panic")]

mod support;

use ratn_executive::protocol::{Command, Event, LogEntry, Mode, Note};
use ratn_model::fact::FactKey;
use ratn_model::id::InstanceId;
use ratn_model::load::Files;
use ratn_model::program::{Nature, Program, StateKind};
use ratn_model::resource::Quantity;
use ratn_model::value::Value;
use ratn_simulation::run::{Run, RunError};
use std::collections::{BTreeMap, BTreeSet};
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use support::script::Script;
use support::{NoFiles, acts, facts, inputs, load};

/// A folder of `tests/scenarios`, and what comes of it in each of its modes.
struct Scenario {
    folder: PathBuf,
    program: Program,
    script: Script,
    runs: Vec<(&'static str, Result<Run, RunError>, Script)>,
}

/// The other files of a task are beside it.
struct Beside<'a>(&'a Path);

impl Files for Beside<'_> {
    fn read(&self, _: &str, path: &str) -> Result<(String, String), String> {
        let text = std::fs::read_to_string(self.0.join(path)).map_err(|error| format!("{path}: {error}"))?;
        Ok((path.to_owned(), text))
    }
}

impl Scenario {
    fn of(folder: PathBuf) -> Scenario {
        let file = folder.join("task.yaml");
        let task = std::fs::read_to_string(&file).unwrap_or_else(|error| panic!("{}: {error}", file.display()));
        let mut program = load(&task, &file.display().to_string(), &Beside(&folder));
        let script = Script::from_toml(&std::fs::read_to_string(folder.join("script.toml")).unwrap_or_default());
        program.kinds.clone_from(&script.kinds);
        let wanted = |name: &str| script.modes.is_empty() || script.modes.iter().any(|wanted| wanted == name);
        let modes = [("hsm", Mode::Hsm), ("cdtn", Mode::Cdtn)].into_iter().filter(|(name, _)| wanted(name));
        let run = |(name, mode)| {
            let mut script = script.clone();
            (name, script.run(&program, mode), script)
        };
        let runs = modes.map(run).collect();
        Scenario { folder, program, script, runs }
    }

    fn name(&self) -> String {
        self.folder.file_name().unwrap().to_string_lossy().into_owned()
    }

    /// What comes of it in all of its modes.
    fn transcript(&self) -> String {
        let told = |(name, run, script): &(&str, Result<Run, RunError>, Script)| {
            let told = run.as_ref().map_or_else(|error| format!("{error}\n"), |run| transcript(run, script));
            format!("== {name}\n{told}")
        };
        self.runs.iter().map(told).collect()
    }

    /// How it ended by the theorem, in each of its modes: outcome, outputs, facts, task resources, and what was started that is a PIA.
    fn ends(&self) -> Vec<Result<End, String>> {
        let end = |run: &Run| {
            let acts = acts(&self.program, run);
            (run.outcome.clone(), run.outputs.clone(), facts(run), run.units.clone(), acts)
        };
        self.runs.iter().map(|(_, run, _)| run.as_ref().map(end).map_err(ToString::to_string)).collect()
    }
}

type End = (String, BTreeMap<String, Value>, Vec<String>, BTreeMap<String, Quantity>, BTreeMap<String, Vec<String>>);

/// `seconds verb path`, in the order in which it happens, and how it ended.
fn transcript(run: &Run, script: &Script) -> String {
    let mut paths: BTreeMap<InstanceId, String> = BTreeMap::new();
    let mut worlds = script.worlds.iter();
    let mut text = String::new();
    let log = if script.ends_only { &[][..] } else { &run.log };
    for line in log {
        let path = |instance: &InstanceId| paths.get(instance).cloned().unwrap_or_default();
        let said = match &line.entry {
            LogEntry::Command(Command::Note(note)) => match note {
                Note::Expanded { instance, path, .. } => {
                    paths.insert(*instance, path.clone());
                    None
                }
                Note::Decided { path, decision, .. } => Some(("decide", format!("{path}: {decision}"))),
                Note::Retired { instance } => Some(("retire", path(instance))),
                Note::Stopped { instance } => Some(("stopped", path(instance))),
                Note::Squashed { instance } => Some(("squash", path(instance))),
                Note::Reused { instance } => Some(("reuse", path(instance))),
                Note::Invalidated { instance, reason } => {
                    Some(("invalidate", format!("{} ({reason})", path(instance))))
                }
                Note::Preempted { instance, by } => {
                    let by = by.as_ref().map_or("another run".to_owned(), &path);
                    Some(("preempt", format!("{} for {by}", path(instance))))
                }
                Note::Awaiting { instance, awaited, until } => {
                    let until = until.map_or_else(String::new, |until| format!(", until {}", until.seconds()));
                    Some(("wait", format!("{} for {awaited}{until}", path(instance))))
                }
                Note::Running { .. } | Note::Finished { .. } | Note::Merged { .. } => None,
            },
            LogEntry::Command(Command::Start { instance, goal, .. }) => {
                let given = if script.inputs { format!(" {}", inputs(&goal.inputs)) } else { String::new() };
                let seen = worlds.next().cloned().flatten();
                let seen = seen.map(|facts| format!("  sees {{{}}}", facts.join(", "))).unwrap_or_default();
                Some(("start", path(instance) + &given + &seen))
            }
            LogEntry::Command(Command::Cancel { instance, .. }) => Some(("cancel", path(instance))),
            LogEntry::Command(Command::Operate { operations, .. }) => {
                let all: Vec<String> = operations
                    .iter()
                    .map(|o| format!("{:?} {} {}", o.operation, o.count, o.kind).to_lowercase())
                    .collect();
                Some(("operate", all.join(", ")))
            }
            LogEntry::Event(event) => match event {
                Event::Finished { instance, outcome, .. } if outcome == "success" => Some(("end", path(instance))),
                Event::Finished { instance, outcome, .. } => Some(("end", format!("{} by {outcome}", path(instance)))),
                Event::Crashed { instance, .. } => Some(("crash", path(instance))),
                Event::Signalled { signal, value } => Some(("signal", format!("{signal} = {value}"))),
                Event::Answered { instance, choice } => Some(("answer", format!("{}: {choice}", path(instance)))),
                Event::PauseRequested => Some(("pause", String::new())),
                Event::ResumeRequested => Some(("resume", String::new())),
                Event::StepRequested => Some(("step", String::new())),
                Event::BreakpointsSet { states } => Some(("break", states.join(", "))),
                Event::WorldChanged { facts, .. } => {
                    let fact = |(key, value): &(FactKey, Option<Value>)| match value {
                        Some(value) => format!("{key} = {value}"),
                        None => format!("no {key}"),
                    };
                    Some(("world", facts.iter().map(fact).collect::<Vec<_>>().join(", ")))
                }
                Event::AbortRequested { reason, .. } => Some(("abort", reason.clone())),
                _ => None,
            },
            LogEntry::Command(_) => None,
        };
        if let Some((verb, what)) = said {
            text += format!("{:<6} {verb:<10} {what}", line.at.seconds()).trim_end();
            text.push('\n');
        }
    }
    let outputs: Vec<String> = run.outputs.iter().map(|(name, value)| format!(" {name} = {value}")).collect();
    let reason = if run.reason.is_empty() { String::new() } else { format!(" ({})", run.reason) };
    text += &format!("{:<6} {}{}{reason}\n", run.end_s, run.outcome, outputs.join(","));
    text += &format!("world  {{{}}}\n", facts(run).join(", "));
    text
}

/// All of them; they are run once for all tests.
fn scenarios() -> &'static [Scenario] {
    static SCENARIOS: OnceLock<Vec<Scenario>> = OnceLock::new();
    SCENARIOS.get_or_init(|| {
        let all = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/scenarios");
        let mut folders: Vec<PathBuf> = std::fs::read_dir(&all).unwrap().map(|entry| entry.unwrap().path()).collect();
        folders.retain(|path| path.is_dir());
        folders.sort();
        folders.into_iter().map(Scenario::of).collect()
    })
}

#[test]
fn every_scenario_goes_as_its_transcript_says() {
    let update = std::env::var_os("UPDATE").is_some();
    let mut different = Vec::new();
    let scenarios = scenarios();
    assert!(scenarios.len() >= 95, "there are only {} scenarios", scenarios.len());
    for scenario in scenarios {
        let actual = scenario.transcript();
        let file = scenario.folder.join("transcript.txt");
        let expected = std::fs::read_to_string(&file).unwrap_or_default();
        if expected != actual {
            if update {
                std::fs::write(&file, &actual).unwrap();
            } else {
                different.push(format!("{}\n-- expected\n{expected}-- is\n{actual}", file.display()));
            }
        }
    }
    assert!(different.is_empty(), "UPDATE=1 rewrites them:\n{}", different.join("\n"));
}

/// The theorem, scenario by scenario, whatever the transcripts say: the same end, and the same PIAs with the same inputs.
#[test]
fn both_modes_end_alike() {
    let mut different = Vec::new();
    for scenario in scenarios() {
        let ends = scenario.ends();
        let [hsm, cdtn] = ends.as_slice() else { continue };
        let name = scenario.name();
        match &scenario.script.differs {
            None if hsm.is_err() || hsm != cdtn => {
                different.push(format!("{name}\n   hsm {hsm:?}\n  cdtn {cdtn:?}"));
            }
            Some(why) if hsm == cdtn => different.push(format!("{name}: they end alike, although {why}")),
            _ => {}
        }
    }
    assert!(different.is_empty(), "{} scenarios differ:\n{}", different.len(), different.join("\n"));
}

/// The next holder of what a motion held finds the world as the motion leaves it.
#[test]
fn no_motion_gives_back_what_it_holds_before_its_effects_are_real() {
    let mut early = Vec::new();
    for scenario in scenarios() {
        for (mode, run, _) in &scenario.runs {
            let Ok(run) = run else { continue };
            let (mut motions, mut without) = (BTreeMap::new(), BTreeSet::new());
            for line in &run.log {
                match &line.entry {
                    LogEntry::Command(Command::Note(Note::Expanded { instance, state, path, .. })) => {
                        let state = scenario.program.state(*state);
                        let is_action = matches!(state.kind, StateKind::Action { .. }) && !state.is_pause();
                        if is_action && state.annotations.nature == Nature::Irreversible {
                            motions.insert(*instance, path.clone());
                        }
                    }
                    LogEntry::Command(Command::Release { instance, lease: Some(_), .. }) => {
                        without.insert(*instance);
                    }
                    LogEntry::Event(Event::Granted { instance, .. }) => {
                        without.remove(instance);
                    }
                    LogEntry::Command(Command::Commit { instance, .. }) if without.contains(instance) => {
                        let motion = motions.get(instance).map(|path| format!("{} ({mode}): {path}", scenario.name()));
                        early.extend(motion);
                    }
                    _ => {}
                }
            }
        }
    }
    assert!(early.is_empty(), "they gave back too early: {early:?}");
}

/// The first line of the log that is otherwise when the executive is made anew from a checkpoint after every so many events.
fn otherwise_from_checkpoints(scenario: &Scenario, name: &str, plain: &Run, every: usize) -> Option<String> {
    let mode = if name == "hsm" { Mode::Hsm } else { Mode::Cdtn };
    let mut script = scenario.script.clone();
    script.checkpoint_every = NonZeroUsize::new(every);
    let again = match script.run(&scenario.program, mode) {
        Ok(again) => again,
        Err(problem) => return Some(problem.to_string()),
    };
    let differ = plain.log.iter().zip(&again.log).find(|(plain, again)| plain != again);
    differ
        .map(|(plain, again)| format!("{plain:?}\nis now\n{again:?}"))
        .or_else(|| (plain != &again).then(|| "the ends".to_owned()))
}

#[test]
fn every_scenario_goes_the_same_from_checkpoints() {
    let mut different = Vec::new();
    for scenario in scenarios() {
        for (name, plain, _) in &scenario.runs {
            let Ok(plain) = plain else { continue };
            for every in [1, 2, 3, 7] {
                if let Some(what) = otherwise_from_checkpoints(scenario, name, plain, every) {
                    different.push(format!("{} in mode {name}, after every {every}:\n{what}", scenario.name()));
                }
            }
        }
    }
    assert!(different.is_empty(), "{} runs differ:\n{}", different.len(), different.join("\n"));
}

#[test]
fn a_loop_of_waits_that_are_over_at_once_goes_in_circles() {
    let task = "task: t\nworld: [open(door)]\nstates:\n  - again:\n      while: open(door)\n      do:\n        - nothing: { wait: \
                { seconds: 0 } }\n        - open: { wait: { for: open(door) } }\n";
    let program = load(task, "task.yaml", &NoFiles);
    for mode in [Mode::Hsm, Mode::Cdtn] {
        let run = Script::default().run(&program, mode).unwrap();
        assert!(run.outcome == "aborted" && run.reason.contains("goes in circles"), "{mode:?}: {}", run.reason);
    }
}

#[test]
fn every_scenario_says_which_rule_it_shows() {
    for scenario in scenarios() {
        let task = std::fs::read_to_string(scenario.folder.join("task.yaml")).unwrap();
        assert!(task.contains("\ndescription: "), "{} has no description", scenario.name());
    }
}
