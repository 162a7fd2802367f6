//! Results that get better until they are used: when they are harvested, who comes before them, what they never change.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may panic")]

use ratn_executive::executive::Executive;
use ratn_executive::protocol::{Command, Event, Goal, LogEntry, Mode, Note};
use ratn_model::catalogue::Catalogue;
use ratn_model::id::{FencingToken, InstanceId, LeaseId, Revision};
use ratn_model::load::{Files, load_with};
use ratn_model::program::Program;
use ratn_model::resource::{Lease, LeasedResource};
use ratn_model::time::Timestamp;
use ratn_model::tolerance::Tolerance;
use ratn_model::value::Value;
use ratn_simulation::run::{Answer, Better, Oracle, Performance, Run, Setup, run};
use ratn_world::world::World;
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

struct NoFiles;

impl Files for NoFiles {
    fn read(&self, _: &str, path: &str) -> Result<(String, String), String> {
        Err(format!("there is no {path}"))
    }
}

const CATALOGUE: &str = r#"
[resources]
Arm = { class = "module", count = 1, actuates = true }
Brain = { class = "process", count = BRAINS }

[providers.brain]
resource = "Brain"
[providers.brain.actions.plan]
outputs = { path = "int", end = "int" }
[providers.brain.actions.plan.annotations]
computes = true
reads = []
resources = ["Brain"]
anytime = true

[providers.arm]
resource = "Arm"
[providers.arm.actions.follow]
inputs = { path = "int" }
[providers.arm.actions.follow.annotations]
effects = ["moved()"]
resources = ["Arm"]
[providers.arm.actions.wait]
[providers.arm.actions.wait.annotations]
effects = []
resources = ["Arm"]
"#;

/// Plans take 1 s and get one better every second, from a cost of 100 down; motions take what the test says.
struct Cell {
    motion_s: BTreeMap<&'static str, f64>,
}

impl Oracle for Cell {
    fn perform(&mut self, path: &str, _: u32, goal: &Goal, _: &World) -> Performance {
        let outputs = match &*goal.action {
            "plan" => BTreeMap::from([("path".to_owned(), Value::Int(100)), ("end".to_owned(), Value::Int(7))]),
            _ => BTreeMap::new(),
        };
        let duration_s = self.motion_s.get(path).copied().unwrap_or(1.0);
        Performance {
            duration_s,
            answer: Answer::Finished { outcome: "success".into(), outputs, measured: Vec::new() },
        }
    }

    fn better(&mut self, _: &str, _: u32, _: &Goal, first: &BTreeMap<String, Value>) -> Option<Better> {
        let better = |n: i64| {
            let mut outputs = first.clone();
            outputs.insert("path".to_owned(), Value::Int(100 - n));
            (n as f64, outputs, (100 - n) as f64)
        };
        Some(Better { results: (1..=60).map(better).collect(), end: None })
    }
}

fn loaded(states: &str, brains: u32) -> (Program, Catalogue) {
    let catalogue = Catalogue::from_toml(&CATALOGUE.replace("BRAINS", &brains.to_string())).unwrap();
    let loaded = load_with(&format!("task: t\nstates:\n{states}"), "task.yaml", &catalogue, &NoFiles);
    (loaded.unwrap_or_else(|problems| panic!("{problems:?}")).program, catalogue)
}

fn simulated(states: &str, brains: u32, mode: Mode, motion_s: &[(&'static str, f64)]) -> Run {
    let (program, catalogue) = loaded(states, brains);
    let setup = Setup {
        parameters: program.bind_parameters(&[]).unwrap(),
        program: Arc::new(program),
        mode,
        seed: 7,
        resources: catalogue.resources.iter().map(|(kind, offer)| (kind.clone(), offer.clone())).collect(),
        world: Vec::new(),
        tolerance: Tolerance::EXACT,
        latency: Duration::ZERO,
    };
    let run = run(setup, &mut Cell { motion_s: motion_s.iter().copied().collect() }).unwrap();
    assert_eq!(run.outcome, "success", "{}", run.reason);
    run
}

fn paths(run: &Run) -> BTreeMap<ratn_model::id::InstanceId, String> {
    let expanded = |entry: &LogEntry| match entry {
        LogEntry::Command(Command::Note(Note::Expanded { instance, path, .. })) => Some((*instance, path.clone())),
        _ => None,
    };
    run.log.iter().filter_map(|line| expanded(&line.entry)).collect()
}

/// What the motions were given as their path.
fn given(run: &Run) -> Vec<i64> {
    let path = |entry: &LogEntry| match entry {
        LogEntry::Command(Command::Start { goal, .. }) => match goal.inputs.get("path")? {
            Value::Int(path) => Some(*path),
            _ => None,
        },
        _ => None,
    };
    run.log.iter().filter_map(|line| path(&line.entry)).collect()
}

/// When a goal was told to stop.
fn cancelled_at(run: &Run, path: &str) -> Option<f64> {
    let paths = paths(run);
    let cancels = |entry: &LogEntry| matches!(entry, LogEntry::Command(Command::Cancel { instance, .. }) if paths[instance] == path);
    run.log.iter().find(|line| cancels(&line.entry)).map(|line| line.at.seconds())
}

const WAIT_AND_FOLLOW: &str = "
  - wait: { action: arm/wait, pia: true }
  - plan: { action: brain/plan }
  - follow: { action: arm/follow, pia: true, in: { path: plan.path } }
";

#[test]
fn a_motion_gets_the_best_result_there_is_when_it_begins() {
    let run = simulated(WAIT_AND_FOLLOW, 1, Mode::Cdtn, &[("wait", 8.5)]);
    // The first after a second, then one every second.
    assert_eq!(given(&run), [93]);
    assert_eq!(cancelled_at(&run, "plan"), Some(8.5));
    assert_eq!(run.end_s, 9.5);
}

#[test]
fn nobody_waits_for_a_better_result() {
    // The motion before is over sooner than the plan.
    let run = simulated(WAIT_AND_FOLLOW, 1, Mode::Cdtn, &[("wait", 0.5)]);
    assert_eq!((given(&run), run.end_s), (vec![100], 2.0));
}

#[test]
fn in_sequence_the_first_result_is_the_last() {
    let run = simulated(WAIT_AND_FOLLOW, 1, Mode::Hsm, &[("wait", 8.5)]);
    assert_eq!(given(&run), [100]);
    let asked =
        |entry: &LogEntry| matches!(entry, LogEntry::Command(Command::Start { goal, .. }) if goal.improves.is_some());
    assert!(!run.log.iter().any(|line| asked(&line.entry)), "a goal may improve what nobody waits for");
}

#[test]
fn what_others_use_ahead_stays_and_they_go_on_with_the_first_result() {
    let states = "
  - wait: { action: arm/wait, pia: true }
  - plan: { action: brain/plan }
  - next: { action: brain/plan, in: {} }
  - follow: { action: arm/follow, pia: true, in: { path: plan.path }, effects: ['at_end(arm) = plan.end'] }
  - then: { action: arm/follow, pia: true, in: { path: next.path } }
";
    let run = simulated(states, 2, Mode::Cdtn, &[("wait", 8.5), ("follow", 4.0)]);
    assert_eq!(given(&run), [93, 89]);
    let kept = |entry: &LogEntry| match entry {
        LogEntry::Command(Command::Start { goal, .. }) => goal.improves.clone(),
        _ => None,
    };
    let kept: Vec<Vec<String>> = run.log.iter().filter_map(|line| kept(&line.entry)).map(Vec::from).collect();
    assert_eq!(kept, [vec!["end".to_owned()], Vec::new()]);
}

#[test]
fn who_computes_comes_before_who_only_improves() {
    let states = "
  - wait: { action: arm/wait, pia: true }
  - plan: { action: brain/plan }
  - next: { action: brain/plan }
  - follow: { action: arm/follow, pia: true, in: { path: plan.path } }
  - then: { action: arm/follow, pia: true, in: { path: next.path } }
";
    let run = simulated(states, 1, Mode::Cdtn, &[("wait", 8.5), ("follow", 4.0)]);
    // The only brain goes on to the next plan as soon as the first has a result.
    assert_eq!(cancelled_at(&run, "plan"), Some(1.0));
    assert_eq!(given(&run), [100, 90]);
}

#[test]
fn a_result_that_a_condition_or_a_computing_state_uses_whole_is_not_improved() {
    let uses = [
        "  - condition: plan.path > 5\n    then: [ more: { action: arm/wait, pia: true } ]\n",
        "  - more: { action: arm/wait, pia: true, requires: [plan.path > 5] }\n",
        "  - more: { action: arm/wait, pia: true, effects: ['made(arm) = plan.path'] }\n",
    ];
    for use_of in uses {
        let states = format!("{WAIT_AND_FOLLOW}{use_of}");
        let run = simulated(&states, 1, Mode::Cdtn, &[("wait", 8.5)]);
        assert_eq!(given(&run), [100], "{use_of}");
    }
}

#[test]
fn what_gets_better_is_stopped_at_the_end_of_the_run() {
    let states = "
  - plan: { action: brain/plan }
  - condition: 1 > 2
    then: [ follow: { action: arm/follow, pia: true, in: { path: plan.path } } ]
  - wait: { action: arm/wait, pia: true }
";
    let run = simulated(states, 1, Mode::Cdtn, &[("wait", 8.5)]);
    assert_eq!(cancelled_at(&run, "plan"), Some(9.5));
    let improved = run.log.iter().filter(|line| matches!(line.entry, LogEntry::Event(Event::Improved { .. })));
    assert_eq!(improved.count(), 9);
}

#[test]
fn a_routine_that_asks_anew_comes_before_who_only_improves() {
    let states = "
  - wait: { action: arm/wait, pia: true }
  - plan: { action: brain/plan }
  - r: { routine: true, states: [ a: { action: brain/plan } ] }
  - follow: { action: arm/follow, pia: true, in: { path: plan.path } }
";
    let (program, catalogue) = loaded(states, 2);
    let mut executive = Executive::new(Arc::new(program), Tolerance::EXACT);
    let started = Event::Started {
        task: "t".to_owned(),
        digest: String::new(),
        mode: Mode::Cdtn,
        parameters: BTreeMap::new(),
        seed: 7,
        world: Vec::new(),
        revision: Revision(0),
        capacity: catalogue.resources.iter().map(|(kind, offer)| (kind.clone(), offer.count)).collect(),
        learned: Default::default(),
        breakpoints: Box::default(),
        origin: Box::default(),
    };
    let mut paths: BTreeMap<InstanceId, String> = BTreeMap::new();
    let (mut events, mut leases, mut now) = (VecDeque::from([started]), 0, Timestamp(0));
    let (mut has_crashed, mut has_waited, mut stopped) = (false, false, Vec::new());
    while let Some(event) = events.pop_front() {
        for command in executive.handle(now, event) {
            match command {
                Command::Note(Note::Expanded { instance, path, .. }) => drop(paths.insert(instance, path)),
                // The worker that died is not replaced, and somebody else has the other one.
                Command::Acquire { .. } if has_crashed => {}
                Command::Acquire { instance, requirements, .. } => {
                    leases += 1;
                    let resource = |kind: String| LeasedResource {
                        id: format!("{kind}-{leases}"),
                        kind,
                        endpoint: String::new(),
                        superclasses: Vec::new(),
                    };
                    let resources = requirements.into_iter().map(|wanted| resource(wanted.kind)).collect();
                    let lease =
                        Lease { id: LeaseId(leases), token: FencingToken(leases), resources, consumed: Vec::new() };
                    events.push_back(Event::Granted { instance, lease });
                }
                Command::Start { instance, attempt, goal } if goal.improves.is_some() => {
                    let outputs = ["path", "end"].map(|port| (port.to_owned(), Value::Int(1))).into();
                    events.push_front(Event::Improved { instance, attempt, outputs, cost_s: 1.0 });
                }
                Command::Start { instance, attempt, .. } if paths[&instance] == "r/a" => {
                    has_crashed = true;
                    events.push_back(Event::Crashed {
                        instance,
                        attempt,
                        reason: "its worker died".to_owned(),
                        unknown: false,
                        refused: false,
                    });
                }
                Command::Cancel { instance, .. } => stopped.push(paths[&instance].clone()),
                _ => {}
            }
        }
        if events.is_empty() && !has_waited {
            assert!(has_crashed && stopped.is_empty(), "{stopped:?}");
            has_waited = true;
            now = now + Duration::from_secs(1);
            events.push_back(Event::Woken);
        }
    }
    assert_eq!(stopped, ["plan"]);
}
