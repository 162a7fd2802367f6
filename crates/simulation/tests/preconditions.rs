//! Preconditions are looked at before every try, in both modes: what does not hold any more is not tried again.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may panic")]

mod support;

use ratn_executive::protocol::{Command, Event, Goal, LogEntry, Mode};
use ratn_model::fact::FactKey;
use ratn_model::id::Revision;
use ratn_model::value::Value;
use ratn_simulation::run::{Answer, Circumstances, Oracle, Performance, Run, Trigger, run_under};
use ratn_world::world::World;
use std::collections::BTreeMap;
use support::{NoFiles, fact, load, setup, text};

/// Providers whose motions may fail, and whose first attempts of anything else may crash; the motions are put down.
#[derive(Default)]
struct Cup {
    motions: Vec<String>,
    aborts: bool,
    crashes: bool,
}

impl Oracle for Cup {
    fn perform(&mut self, path: &str, attempt: u32, goal: &Goal, _: &World) -> Performance {
        let is_motion = &*goal.provider == "arm";
        if is_motion {
            self.motions.push(path.to_owned());
        }
        let outcome = if is_motion && self.aborts { "aborted" } else { "success" }.to_owned();
        let outputs = BTreeMap::from([("x".to_owned(), Value::Int(1))]);
        let answer = match attempt {
            1 if self.crashes && !is_motion => Answer::Crashed,
            _ => Answer::Finished { outcome, outputs, measured: Vec::new() },
        };
        Performance { duration_s: goal.expected_s.unwrap_or(1.0), answer }
    }
}

/// Runs a task while these facts change at five seconds; its motions in order, and the run.
fn disturbed_with(mut cup: Cup, states: &str, mode: Mode, facts: &[(FactKey, Option<Value>)]) -> (Vec<String>, Run) {
    let motion = "action: arm/move, pia: true, resources: [{ block: Arm }], duration: 10";
    let task = format!("task: disturbed\nworld: ['at(cup) = table']\n{}", states.replace("MOVE", motion));
    let event = Event::WorldChanged { revision: Revision(99), facts: facts.to_vec() };
    let circumstances = Circumstances { events: vec![(Trigger::At(5.0), event)], ..Circumstances::default() };
    let run = run_under(setup(load(&task, "task.yaml", &NoFiles), mode), &mut cup, circumstances).unwrap();
    (cup.motions, run)
}

/// The cup is taken away at five seconds.
fn no_cup() -> [(FactKey, Option<Value>); 1] {
    [(fact("at(cup)"), Some(text("floor")))]
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
        let (motions, run) = disturbed_with(cup, grasp, mode, &[(fact("at(plate)"), Some(text("floor")))]);
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
