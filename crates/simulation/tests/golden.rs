//! Golden scenarios: one folder in `tests/scenarios` per rule of the window and per element of control flow.
//!
//! `task.yaml` is the task, its description the rule. `script.toml` says what the providers and the user do; what it does not name
//! succeeds after its declared duration (1 s where none is declared) with `x = 1` and `list = []`. `transcript.txt` is what must
//! come of it, in both modes: what the environment and the workers see, and what became of what was computed. `UPDATE=1 cargo test
//! -p ratn-simulation --test golden` writes it anew: read the difference before it is committed.
//!
//! ```toml
//! modes = ["cdtn"]                        # hsm and cdtn unless given
//! [durations]
//! look = 4.0                              # seconds
//! [outcomes]
//! pick = ["aborted", "success"]           # of one try after the other, the last for all further ones; or one for all
//! [outputs.look]
//! x = 2
//! [measured.grasp]
//! "held(box)" = { pose = [0.3, 0, 0] }    # or any other value
//! [crashes]
//! plan = 2                                # so many attempts
//! [[events]]
//! event = "pause"                         # pause, resume, step, abort
//! at = 3.0                                # seconds; or starts = "path", ends = "path"
//! ```

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may panic")]

use ratn_executive::protocol::{Command, Event, Goal, LogEntry, Mode, Note};
use ratn_model::catalogue::{Catalogue, ResourceOffer};
use ratn_model::fact::{FactKey, Term};
use ratn_model::id::InstanceId;
use ratn_model::pose::Pose;
use ratn_model::resource::{Quantity, ResourceClass};
use ratn_model::tolerance::Tolerance;
use ratn_model::value::Value;
use ratn_simulation::run::{Answer, Circumstances, Oracle, Performance, Run, Setup, Trigger, run_under};
use ratn_world::world::World;
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

/// What the system of every scenario offers.
const CATALOGUE: &str = include_str!("scenarios/catalogue.toml");

#[derive(Debug, Clone, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Script {
    modes: Vec<String>,
    durations: BTreeMap<String, f64>,
    outcomes: BTreeMap<String, OneOrMore>,
    outputs: BTreeMap<String, BTreeMap<String, toml::Value>>,
    measured: BTreeMap<String, BTreeMap<String, toml::Value>>,
    crashes: BTreeMap<String, u32>,
    events: Vec<Outside>,
    #[serde(skip)]
    tries: BTreeMap<String, usize>,
    #[serde(skip)]
    worlds: Vec<Option<Vec<String>>>,
}

#[derive(Debug, Clone, Deserialize)]
#[serde(untagged)]
enum OneOrMore {
    One(String),
    More(Vec<String>),
}

#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Outside {
    event: String,
    at: Option<f64>,
    starts: Option<String>,
    ends: Option<String>,
}

impl Script {
    fn events(&self) -> Vec<(Trigger, Event)> {
        let event = |outside: &Outside| {
            let event = match outside.event.as_str() {
                "pause" => Event::PauseRequested,
                "resume" => Event::ResumeRequested,
                "step" => Event::StepRequested,
                "abort" => Event::AbortRequested { reason: "the user wants it so".to_owned() },
                other => panic!("event: pause, resume, step or abort, not {other}"),
            };
            let trigger = match (outside.at, &outside.starts, &outside.ends) {
                (Some(at), None, None) => Trigger::At(at),
                (None, Some(path), None) => Trigger::Starts(path.clone()),
                (None, None, Some(path)) => Trigger::Ends(path.clone()),
                _ => panic!("an event has one of at, starts, ends: {outside:?}"),
            };
            (trigger, event)
        };
        self.events.iter().map(event).collect()
    }
}

impl Oracle for Script {
    fn perform(&mut self, path: &str, attempt: u32, goal: &Goal, world: &World) -> Performance {
        let facts = || world.iter().map(|(key, fact)| format!("{key} = {}", fact.value)).collect();
        self.worlds.push(goal.projection.map(|_| facts()));
        let duration_s = self.durations.get(path).copied().or(goal.expected_s).unwrap_or(1.0);
        if attempt <= self.crashes.get(path).copied().unwrap_or(0) {
            return Performance { duration_s, answer: Answer::Crashed };
        }
        let tries = self.tries.entry(path.to_owned()).or_default();
        *tries += 1;
        let outcome = match self.outcomes.get(path) {
            None => "success",
            Some(OneOrMore::One(outcome)) => outcome,
            Some(OneOrMore::More(all)) => all.get(*tries - 1).or(all.last()).map_or("success", String::as_str),
        };
        let mut outputs = BTreeMap::from([("x".to_owned(), Value::Int(1)), ("list".to_owned(), Value::List(vec![]))]);
        let said = self.outputs.get(path).into_iter().flatten();
        outputs.extend(said.map(|(port, v)| (port.clone(), value(v))));
        let measured = self.measured.get(path).into_iter().flatten();
        let measured = measured.map(|(fact, v)| (key(fact), value(v))).collect();
        Performance { duration_s, answer: Answer::Finished { outcome: outcome.to_owned(), outputs, measured } }
    }
}

fn value(said: &toml::Value) -> Value {
    match said {
        toml::Value::Integer(i) => Value::Int(*i),
        toml::Value::Float(x) => Value::Float(*x),
        toml::Value::Boolean(b) => Value::Bool(*b),
        toml::Value::String(text) => Value::String(text.clone()),
        toml::Value::Array(items) => Value::List(items.iter().map(value).collect()),
        toml::Value::Table(fields) => match fields.get("pose").and_then(toml::Value::as_array) {
            Some(at) => {
                let number = |n: usize| at[n].as_float().or(at[n].as_integer().map(|i| i as f64)).unwrap();
                Value::Pose(Pose::at(number(0), number(1), number(2)))
            }
            None => Value::Map(fields.iter().map(|(name, v)| (name.clone(), value(v))).collect()),
        },
        toml::Value::Datetime(_) => panic!("no value: {said}"),
    }
}

/// `held(box)`, `at(3, cup)`
fn key(fact: &str) -> FactKey {
    let (predicate, rest) = fact.split_once('(').unwrap_or_else(|| panic!("no fact: {fact}"));
    let arguments = rest.trim_end_matches(')').split(',').map(str::trim).filter(|argument| !argument.is_empty());
    let term = |a: &str| a.parse().map_or_else(|_| Term::Name(a.to_owned()), Term::Int);
    FactKey { predicate: predicate.to_owned(), arguments: arguments.map(term).collect() }
}

fn simulate(folder: &Path, mode: Mode, script: &mut Script) -> Run {
    let catalogue = Catalogue::from_toml(CATALOGUE).unwrap();
    let file = folder.join("task.yaml");
    let task = std::fs::read_to_string(&file).unwrap_or_else(|error| panic!("{}: {error}", file.display()));
    let loaded = ratn_model::load::load(&task, &file.display().to_string(), &catalogue).unwrap_or_else(|problems| {
        panic!("{}", problems.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n"))
    });
    let parameters = loaded.program.bind_parameters(&[]).unwrap();
    // Of the system's class there is nothing here.
    let there = |offer: &ResourceOffer| match offer.class {
        ResourceClass::System => ResourceOffer { count: Quantity::ZERO, ..offer.clone() },
        _ => offer.clone(),
    };
    let setup = Setup {
        program: Arc::new(loaded.program),
        mode,
        parameters,
        seed: 7,
        resources: catalogue.resources.iter().map(|(kind, offer)| (kind.clone(), there(offer))).collect(),
        world: Vec::new(),
        tolerance: Tolerance::ROBOT,
        latency: Duration::ZERO,
    };
    let circumstances = Circumstances { events: script.events(), ..Circumstances::default() };
    run_under(setup, script, circumstances).unwrap_or_else(|error| panic!("{}: {error}", folder.display()))
}

/// `seconds verb path`, in the order in which it happens, and how it ended.
fn transcript(run: &Run, script: &Script) -> String {
    let mut paths: BTreeMap<InstanceId, String> = BTreeMap::new();
    let mut worlds = script.worlds.iter();
    let mut text = String::new();
    for line in &run.log {
        let path = |instance: &InstanceId| paths.get(instance).cloned().unwrap_or_default();
        let said = match &line.entry {
            LogEntry::Command(Command::Note(note)) => match note {
                Note::Expanded { instance, path, .. } => {
                    paths.insert(*instance, path.clone());
                    None
                }
                Note::Decided { path, decision, .. } => Some(("decide", format!("{path}: {decision}"))),
                Note::Retired { instance } => Some(("retire", path(instance))),
                Note::Squashed { instance } => Some(("squash", path(instance))),
                Note::Reused { instance } => Some(("reuse", path(instance))),
                Note::Invalidated { instance, reason } => {
                    Some(("invalidate", format!("{} ({reason})", path(instance))))
                }
                Note::Preempted { instance, by } => Some(("preempt", format!("{} for {}", path(instance), path(by)))),
                Note::Running { .. } | Note::Finished { .. } => None,
            },
            LogEntry::Command(Command::Start { instance, .. }) => {
                let seen = worlds.next().cloned().flatten();
                let seen = seen.map(|facts| format!("  sees {{{}}}", facts.join(", "))).unwrap_or_default();
                Some(("start", path(instance) + &seen))
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
                Event::PauseRequested => Some(("pause", String::new())),
                Event::ResumeRequested => Some(("resume", String::new())),
                Event::StepRequested => Some(("step", String::new())),
                Event::AbortRequested { reason } => Some(("abort", reason.clone())),
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
    let facts: Vec<String> = run.world.iter().map(|(k, fact)| format!("{k} = {}", fact.value)).collect();
    text += &format!("world  {{{}}}\n", facts.join(", "));
    text
}

fn folders() -> Vec<PathBuf> {
    let all = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/scenarios");
    let mut folders: Vec<PathBuf> = std::fs::read_dir(&all).unwrap().map(|entry| entry.unwrap().path()).collect();
    folders.retain(|path| path.is_dir());
    folders.sort();
    folders
}

#[test]
fn every_scenario_goes_as_its_transcript_says() {
    let update = std::env::var_os("UPDATE").is_some();
    let mut different = Vec::new();
    let folders = folders();
    assert!(folders.len() >= 40, "there are only {} scenarios", folders.len());
    for folder in &folders {
        let file = folder.join("script.toml");
        let text = if file.exists() { std::fs::read_to_string(&file).unwrap() } else { String::new() };
        let script: Script = toml::from_str(&text).unwrap_or_else(|error| panic!("{}: {error}", file.display()));
        let mut actual = String::new();
        for (name, mode) in [("hsm", Mode::Hsm), ("cdtn", Mode::Cdtn)] {
            if script.modes.is_empty() || script.modes.iter().any(|wanted| wanted == name) {
                let mut script = script.clone();
                let run = simulate(folder, mode, &mut script);
                actual += &format!("== {name}\n{}", transcript(&run, &script));
            }
        }
        let file = folder.join("transcript.txt");
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

#[test]
fn every_scenario_says_which_rule_it_shows() {
    for folder in folders() {
        let task = std::fs::read_to_string(folder.join("task.yaml")).unwrap();
        assert!(task.contains("\ndescription: "), "{} has no description", folder.display());
    }
}
