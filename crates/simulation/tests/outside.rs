//! The world changes from outside while a task runs: in both modes the robot then does the same, on the facts as they are when its
//! motions begin.
//!
//! Every motion takes ten seconds and everything else less, so that what is computed ahead is ahead of the change, which comes at
//! five seconds.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may panic")]

use ratn_executive::protocol::{Command, Event, Goal, LogEntry, Mode, Note};
use ratn_model::catalogue::Catalogue;
use ratn_model::fact::{FactKey, Term};
use ratn_model::id::{InstanceId, Revision};
use ratn_model::tolerance::Tolerance;
use ratn_model::value::Value;
use ratn_simulation::run::{Answer, Circumstances, Oracle, Performance, Run, Setup, Trigger, run_under};
use ratn_world::world::World;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

const CATALOGUE: &str = r#"
[resources]
Brain = { class = "process", count = 2 }
Arm = { class = "module", count = 1, actuates = true }
WorldModel = { class = "world", count = 8 }

[providers.brain]
resource = "Brain"
actions.think = { optional = { a = "any" }, outputs = { x = "any" } }

[providers.arm]
resource = "Arm"
actions.move = { optional = { a = "any" } }
"#;

/// `x` is what the world says of the cup; motions are put down with their input.
#[derive(Default)]
struct Cup {
    motions: Vec<String>,
    /// Every motion ends `aborted`.
    aborts: bool,
    /// The first attempt of everything else crashes.
    crashes: bool,
}

impl Oracle for Cup {
    fn perform(&mut self, path: &str, attempt: u32, goal: &Goal, world: &World) -> Performance {
        let x = world.get(&fact("at", "cup")).cloned().unwrap_or_else(|| text("nowhere"));
        if &*goal.provider == "arm" {
            let input = goal.inputs.get("a").map(|a| format!("({a})")).unwrap_or_default();
            self.motions.push(format!("{path}{input}"));
        }
        let outputs = BTreeMap::from([("x".to_owned(), x)]);
        let is_motion = &*goal.provider == "arm";
        let outcome = if is_motion && self.aborts { "aborted" } else { "success" }.to_owned();
        let answer = match attempt {
            1 if self.crashes && !is_motion => Answer::Crashed,
            _ => Answer::Finished { outcome, outputs, measured: Vec::new() },
        };
        Performance { duration_s: goal.expected_s.unwrap_or(1.0), answer }
    }
}

fn fact(predicate: &str, of: &str) -> FactKey {
    FactKey { predicate: predicate.to_owned(), arguments: vec![Term::Name(of.to_owned())] }
}

fn text(text: &str) -> Value {
    Value::String(text.to_owned())
}

/// Runs a task while these facts change at five seconds; its motions in order, and the run.
fn disturbed(states: &str, mode: Mode, facts: &[(FactKey, Option<Value>)]) -> (Vec<String>, Run) {
    disturbed_with(Cup::default(), states, mode, facts)
}

fn disturbed_with(mut cup: Cup, states: &str, mode: Mode, facts: &[(FactKey, Option<Value>)]) -> (Vec<String>, Run) {
    let long =
        states.replace("MOVE", "action: arm/move, pia: true, resources: [{ block: Arm }], duration: 10").replace(
            "THINK",
            "action: brain/think, computes: true, resources: [{ block: Brain }, world_model], duration: 2",
        );
    let task = format!("task: disturbed\nworld: ['at(cup) = table', 'count() = 1', 'places() = [a]']\n{long}");
    let catalogue = Catalogue::from_toml(CATALOGUE).unwrap();
    let loaded = ratn_model::load::load(&task, "task.yaml", &catalogue).unwrap_or_else(|problems| {
        panic!("{}", problems.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n"))
    });
    let setup = Setup {
        parameters: loaded.program.bind_parameters(&[]).unwrap(),
        program: Arc::new(loaded.program),
        mode,
        seed: 7,
        resources: catalogue.resources.into_iter().collect(),
        world: Vec::new(),
        tolerance: Tolerance::EXACT,
        latency: Duration::ZERO,
    };
    let event = Event::WorldChanged { revision: Revision(99), facts: facts.to_vec() };
    let circumstances = Circumstances { events: vec![(Trigger::At(5.0), event)], ..Circumstances::default() };
    let run = run_under(setup, &mut cup, circumstances).unwrap();
    (cup.motions, run)
}

fn check(states: &str, facts: &[(FactKey, Option<Value>)], motions: &[&str]) -> Run {
    let (as_hsm, hsm) = disturbed(states, Mode::Hsm, facts);
    let (as_cdtn, cdtn) = disturbed(states, Mode::Cdtn, facts);
    assert_eq!(as_hsm, motions);
    assert_eq!(as_cdtn, motions, "{:#?}", cdtn.log);
    let values = |run: &Run| run.world.iter().map(|(k, f)| format!("{k} = {}", f.value)).collect::<Vec<_>>();
    assert_eq!((&hsm.outcome, values(&hsm)), (&cdtn.outcome, values(&cdtn)));
    cdtn
}

fn notes(run: &Run, of: fn(&Note) -> Option<InstanceId>) -> Vec<String> {
    let mut paths = BTreeMap::new();
    let mut found = Vec::new();
    for line in &run.log {
        if let LogEntry::Command(Command::Note(note)) = &line.entry {
            if let Note::Expanded { instance, path, .. } = note {
                paths.insert(*instance, path.clone());
            }
            found.extend(of(note).map(|instance| paths[&instance].clone()));
        }
    }
    found
}

fn invalidated(note: &Note) -> Option<InstanceId> {
    match note {
        Note::Invalidated { instance, .. } => Some(*instance),
        _ => None,
    }
}

fn cup_at(place: &str) -> [(FactKey, Option<Value>); 1] {
    [(fact("at", "cup"), Some(text(place)))]
}

#[test]
fn what_was_computed_of_a_fact_is_computed_again_and_what_was_made_of_that_too() {
    let states = "states:
  - go: { MOVE, reads: [], effects: [] }
  - plan: { THINK, reads: ['at(cup)'] }
  - think: { THINK, in: { a: plan.x }, reads: [] }
  - other: { THINK, reads: ['count()'] }
  - grasp: { MOVE, in: { a: plan.x }, reads: [], effects: ['held() = plan.x'] }";
    let run = check(states, &cup_at("shelf"), &["go", "grasp(shelf)"]);
    assert_eq!(notes(&run, invalidated), ["plan", "think"]);
}

#[test]
fn a_change_that_nothing_depends_on_changes_nothing() {
    let states = "states:
  - go: { MOVE, reads: [], effects: [] }
  - plan: { THINK, reads: ['at(cup)'] }
  - grasp: { MOVE, in: { a: plan.x }, reads: [], effects: ['held() = plan.x'] }";
    let run = check(states, &[(fact("at", "plate"), Some(text("shelf")))], &["go", "grasp(table)"]);
    assert!(notes(&run, invalidated).is_empty());
    assert_eq!(run.world.get(&fact("at", "plate")), Some(&text("shelf")));
}

#[test]
fn a_fact_that_expires_is_gone_for_what_is_computed_ahead() {
    let states = "states:
  - go: { MOVE, reads: [], effects: [] }
  - plan: { THINK, reads: ['at(cup)'] }
  - grasp: { MOVE, in: { a: plan.x }, reads: [], effects: [] }";
    check(states, &[(fact("at", "cup"), None)], &["go", "grasp(nowhere)"]);
}

#[test]
fn a_condition_that_was_decided_ahead_is_decided_again() {
    let states = "states:
  - go: { MOVE, reads: [], effects: [] }
  - where:
      condition: at(cup) = table
      then: [ plan: { THINK, reads: ['at(cup)'] }, low: { MOVE, in: { a: plan.x }, reads: [], effects: [] } ]
      else: [ high: { MOVE, reads: [], effects: [] } ]
  - home: { MOVE, reads: [], effects: [] }";
    check(states, &cup_at("shelf"), &["go", "where/high", "home"]);
    // As it was: nothing is expanded again.
    let run = check(states, &cup_at("table"), &["go", "where/low(table)", "home"]);
    assert!(notes(&run, invalidated).is_empty());
}

#[test]
fn a_condition_on_what_was_computed_is_decided_again() {
    let states = "states:
  - go: { MOVE, reads: [], effects: [] }
  - plan: { THINK, reads: ['at(cup)'] }
  - where:
      condition: plan.x = table
      then: [ low: { MOVE, reads: [], effects: [] } ]
      else: [ high: { MOVE, reads: [], effects: [] } ]
  - home: { MOVE, reads: [], effects: [] }";
    check(states, &cup_at("shelf"), &["go", "where/high", "home"]);
}

#[test]
fn a_loop_that_was_tested_ahead_is_tested_again() {
    let count = |n: Option<i64>| [(FactKey { predicate: "count".to_owned(), arguments: vec![] }, n.map(Value::Int))];
    let states = "states:
  - go: { MOVE, reads: [], effects: [] }
  - each: { while: 'count() < 3', do: [ step: { MOVE, reads: [], effects: ['increase count() by 1'] } ] }
  - home: { MOVE, reads: [], effects: [] }";
    check(states, &count(Some(3)), &["go", "home"]);
    check(states, &count(Some(0)), &["go", "each[0]/step", "each[1]/step", "each[2]/step", "home"]);
}

#[test]
fn the_list_of_a_loop_that_was_known_ahead_is_asked_for_again() {
    let places = FactKey { predicate: "places".to_owned(), arguments: vec![] };
    let now = Value::List(vec![text("b"), text("c")]);
    let states = "states:
  - go: { MOVE, reads: [], effects: [] }
  - each:
      for: place in places()
      do: [ step: { MOVE, in: { a: '$place' }, reads: [], effects: [] } ]
  - home: { MOVE, reads: [], effects: [] }";
    check(states, &[(places, Some(now))], &["go", "each[0]/step(b)", "each[1]/step(c)", "home"]);
}

#[test]
fn a_motion_whose_precondition_is_gone_does_not_begin() {
    let states = "states:
  - go: { MOVE, reads: [], effects: [] }
  - grasp: { MOVE, requires: ['at(cup) = table'], reads: [], effects: [] }";
    let run = check(states, &cup_at("shelf"), &["go"]);
    assert_eq!(run.outcome, "aborted");
}

#[test]
fn what_is_behind_the_join_of_regions_is_computed_again() {
    let states = "states:
  - both:
      concurrency: barrier
      regions:
        - left: { states: [ go: { MOVE, reads: [], effects: ['gone()'] } ] }
        - right: { states: [ plan: { THINK, reads: ['at(cup)'] } ] }
  - after: { THINK, reads: ['at(cup)', 'gone()'] }
  - grasp: { MOVE, in: { a: after.x }, reads: [], effects: [] }";
    check(states, &cup_at("shelf"), &["both/left/go", "grasp(shelf)"]);
}

/// The cup is taken away at five seconds.
fn no_cup() -> [(FactKey, Option<Value>); 1] {
    [(fact("at", "cup"), Some(text("floor")))]
}

#[test]
fn a_motion_is_not_tried_again_when_its_precondition_has_gone() {
    let grasp = "
states:
  - grasp: { MOVE, requires: ['at(cup) = table'], reads: [], effects: [], retry: 2 }
";
    // The change comes during the pause.
    let pause = "
states:
  - grasp: { action: arm/move, pia: true, resources: [{ block: Arm }], duration: 4, requires: ['at(cup) = table'],
      reads: [], effects: [], retry: { count: 2, backoff: 3 } }
";
    for (task, end_s) in [(grasp, 10.0), (pause, 7.0)] {
        for mode in [Mode::Hsm, Mode::Cdtn] {
            let cup = Cup { aborts: true, ..Cup::default() };
            let (motions, run) = disturbed_with(cup, task, mode, &no_cup());
            assert_eq!(motions, ["grasp"], "{mode:?}");
            assert_eq!((run.outcome.as_str(), run.end_s), ("aborted", end_s), "{mode:?}");
            assert!(run.reason.contains("precondition"), "{mode:?}: {}", run.reason);
        }
    }
}

#[test]
fn a_motion_is_tried_again_while_its_precondition_holds() {
    let grasp = "
states:
  - grasp: { MOVE, requires: ['at(cup) = table'], reads: [], effects: [], retry: 2 }
";
    for mode in [Mode::Hsm, Mode::Cdtn] {
        let cup = Cup { aborts: true, ..Cup::default() };
        let (motions, run) = disturbed_with(cup, grasp, mode, &[(fact("at", "plate"), Some(text("floor")))]);
        assert_eq!((motions.len(), run.end_s), (3, 30.0), "{mode:?}");
    }
}

#[test]
fn an_attempt_that_crashed_asks_for_nothing_again_when_its_precondition_has_gone() {
    let task = "
states:
  - plan: { action: brain/think, computes: true, resources: [{ block: Brain }, world_model], duration: 6, requires: ['at(cup) = table'], reads: [] }
";
    let in_routine = "
states:
  - both:
      routine: true
      states:
        - move: { action: arm/move, pia: true, resources: [{ block: Arm }], duration: 1, reads: [], effects: [] }
        - plan: { action: brain/think, computes: true, resources: [{ block: Brain }, world_model], duration: 6, requires: ['at(cup) = table'], reads: [] }
";
    for task in [task, in_routine] {
        for mode in [Mode::Hsm, Mode::Cdtn] {
            let (_, run) = disturbed_with(Cup { crashes: true, ..Cup::default() }, task, mode, &no_cup());
            assert_eq!(run.outcome, "aborted", "{mode:?}: {}", run.reason);
            assert!(run.reason.contains("precondition"), "{mode:?}: {}", run.reason);
            let acquires = run.log.iter().filter(|l| matches!(l.entry, LogEntry::Command(Command::Acquire { .. })));
            assert_eq!(acquires.count(), 1, "{mode:?}");
        }
    }
}
