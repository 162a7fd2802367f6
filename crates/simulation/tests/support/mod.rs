//! What the tests of simulated runs share: one catalogue, one way to run a task, and what a run's log tells.
#![allow(clippy::unwrap_used, clippy::panic, dead_code, reason = "a test may panic; not every test uses everything")]

pub(crate) mod script;

use ratn_executive::protocol::{Command, Goal, LogEntry, Mode, Note};
use ratn_model::catalogue::{Catalogue, ResourceOffer};
use ratn_model::fact::{FactKey, Term};
use ratn_model::id::InstanceId;
use ratn_model::load::{Files, load_with};
use ratn_model::program::{Nature, Program, State, StateKind};
use ratn_model::resource::{Quantity, ResourceClass};
use ratn_model::tolerance::Tolerance;
use ratn_model::value::Value;
use ratn_simulation::run::{Answer, Circumstances, Oracle, Performance, Run, Setup, run_under};
use ratn_world::world::World;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

/// HSM mode, then CDTN mode.
pub(crate) const MODES: [Mode; 2] = [Mode::Hsm, Mode::Cdtn];

/// What the system of every test offers.
pub(crate) fn catalogue() -> Catalogue {
    Catalogue::from_toml(include_str!("../scenarios/catalogue.toml")).unwrap()
}

/// Where no other file may be read.
pub(crate) struct NoFiles;

impl Files for NoFiles {
    fn read(&self, _: &str, path: &str) -> Result<(String, String), String> {
        Err(format!("there is no {path}"))
    }
}

/// The program of a task file, which must be accepted.
pub(crate) fn load(task: &str, file: &str, files: &dyn Files) -> Program {
    let loaded = load_with(task, file, &catalogue(), files).unwrap_or_else(|problems| {
        panic!("{}", problems.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n"))
    });
    loaded.program
}

/// A run of the program on everything that the catalogue offers, but nothing of the system's class.
pub(crate) fn setup(program: Program, mode: Mode) -> Setup {
    let there = |offer: &ResourceOffer| match offer.class {
        ResourceClass::System => ResourceOffer { count: Quantity::ZERO, ..offer.clone() },
        _ => offer.clone(),
    };
    Setup {
        parameters: program.bind_parameters(&[]).unwrap(),
        program: Arc::new(program),
        mode,
        seed: 7,
        resources: catalogue().resources.iter().map(|(kind, offer)| (kind.clone(), there(offer))).collect(),
        world: Vec::new(),
        tolerance: Tolerance::ROBOT,
        latency: Duration::ZERO,
    }
}

/// Providers that end each goal with an outcome and an output `x`, after its declared duration, 1 s where none is declared.
pub(crate) struct Providers<F>(pub(crate) F);

impl<F: FnMut(&str, u32, &Goal, &World) -> (&'static str, Value)> Oracle for Providers<F> {
    fn perform(&mut self, path: &str, attempt: u32, goal: &Goal, world: &World) -> Performance {
        let (outcome, x) = (self.0)(path, attempt, goal, world);
        let outputs = BTreeMap::from([("x".to_owned(), x)]);
        let answer = Answer::Finished { outcome: outcome.to_owned(), outputs, measured: Vec::new() };
        Performance { duration_s: goal.expected_s.unwrap_or(1.0), answer }
    }
}

/// Runs a task that uses no other file.
pub(crate) fn simulate(task: &str, mode: Mode, oracle: &mut dyn Oracle) -> Run {
    run_under(setup(load(task, "task.yaml", &NoFiles), mode), oracle, Circumstances::default()).unwrap()
}

/// `at(cup) = shelf`, in the order of keys.
pub(crate) fn facts(run: &Run) -> Vec<String> {
    run.world.iter().map(|(key, fact)| format!("{key} = {}", fact.value)).collect()
}

/// The paths of all instances that were ever in the window.
pub(crate) fn paths(run: &Run) -> BTreeMap<InstanceId, String> {
    let expanded = |entry: &LogEntry| match entry {
        LogEntry::Command(Command::Note(Note::Expanded { instance, path, .. })) => Some((*instance, path.clone())),
        _ => None,
    };
    run.log.iter().filter_map(|line| expanded(&line.entry)).collect()
}

/// `seconds path` of every goal that was started, in this order.
pub(crate) fn starts(run: &Run) -> Vec<String> {
    let paths = paths(run);
    let started = |entry: &LogEntry| match entry {
        LogEntry::Command(Command::Start { instance, .. }) => Some(paths[instance].clone()),
        _ => None,
    };
    run.log.iter().filter_map(|line| Some(format!("{} {}", line.at.seconds(), started(&line.entry)?))).collect()
}

/// When the first goal of this path was started.
pub(crate) fn started_at(run: &Run, path: &str) -> f64 {
    let started = starts(run);
    let first = started.iter().find_map(|line| line.strip_suffix(path)?.strip_suffix(' '));
    first.unwrap_or_else(|| panic!("no start of `{path}` in {started:#?}")).parse().unwrap()
}

/// Path and reason of everything that was computed again.
pub(crate) fn invalidated(run: &Run) -> Vec<(String, String)> {
    let paths = paths(run);
    let again = |entry: &LogEntry| match entry {
        LogEntry::Command(Command::Note(Note::Invalidated { instance, reason })) => {
            Some((paths[instance].clone(), reason.clone()))
        }
        _ => None,
    };
    run.log.iter().filter_map(|line| again(&line.entry)).collect()
}

/// The goals of PIAs in the order in which they started, with what they were given: `grasp {a: 1}`. By region, because regions have
/// no order among each other; what is in no region is under the empty path.
pub(crate) fn acts(program: &Program, run: &Run) -> BTreeMap<String, Vec<String>> {
    let mut pias: BTreeMap<InstanceId, (String, String)> = BTreeMap::new();
    let mut acts: BTreeMap<String, Vec<String>> = BTreeMap::new();
    for line in &run.log {
        match &line.entry {
            LogEntry::Command(Command::Note(Note::Expanded { instance, state, path, .. })) => {
                let state = program.state(*state);
                let acts = matches!(state.kind, StateKind::Action { .. });
                if acts && state.annotations.nature == Nature::Irreversible {
                    pias.insert(*instance, (region(program, state), path.clone()));
                }
            }
            LogEntry::Command(Command::Start { instance, goal, .. }) => {
                if let Some((region, path)) = pias.get(instance) {
                    acts.entry(region.clone()).or_default().push(format!("{path} {}", inputs(&goal.inputs)));
                }
            }
            _ => {}
        }
    }
    acts
}

/// The path of the innermost region that a state is in.
fn region(program: &Program, state: &State) -> String {
    let mut inner = state;
    while let Some(parent) = inner.parent {
        let outer = program.state(parent);
        if matches!(outer.kind, StateKind::Concurrency { .. }) {
            return inner.path.clone();
        }
        inner = outer;
    }
    String::new()
}

/// `{a: 1, b: [2, 3]}`
pub(crate) fn inputs(inputs: &BTreeMap<String, Value>) -> String {
    let all: Vec<String> = inputs.iter().map(|(port, value)| format!("{port}: {value}")).collect();
    format!("{{{}}}", all.join(", "))
}

/// A fact about individuals and numbers: `held(box)`, `at(3, cup)`.
pub(crate) fn fact(text: &str) -> FactKey {
    let (predicate, rest) = text.split_once('(').unwrap_or_else(|| panic!("no fact: {text}"));
    let arguments = rest.trim_end_matches(')').split(',').map(str::trim).filter(|argument| !argument.is_empty());
    let term = |a: &str| a.parse().map_or_else(|_| Term::Name(a.to_owned()), Term::Int);
    FactKey { predicate: predicate.to_owned(), arguments: arguments.map(term).collect() }
}

/// A text.
pub(crate) fn text(text: &str) -> Value {
    Value::String(text.to_owned())
}
