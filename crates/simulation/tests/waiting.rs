//! What comes at the very moment at which the time of a wait is up: the executive alone, one event after the other.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may panic")]

mod support;

use ratn_executive::executive::Executive;
use ratn_executive::protocol::{Command, Event, Learned, Mode, Note};
use ratn_model::id::{InstanceId, Revision};
use ratn_model::time::Timestamp;
use ratn_model::tolerance::Tolerance;
use ratn_model::value::Value;
use std::collections::BTreeMap;
use std::sync::Arc;
use support::{MODES, NoFiles, load};

/// A run that has just begun.
fn begun(task: &str, mode: Mode) -> (Executive, Vec<Command>) {
    let program = load(task, "task.yaml", &NoFiles);
    let started = Event::Started {
        task: program.name.clone(),
        digest: program.digest.clone(),
        mode,
        parameters: program.bind_parameters(&[]).unwrap(),
        seed: 1,
        world: Vec::new(),
        revision: Revision(0),
        capacity: BTreeMap::new(),
        learned: Learned::default(),
        breakpoints: Box::default(),
        origin: Box::default(),
    };
    let mut executive = Executive::new(Arc::new(program), Tolerance::ROBOT);
    let commands = executive.handle(Timestamp(0), started);
    (executive, commands)
}

/// The instance that waits, and until when.
fn awaiting(commands: &[Command]) -> Option<(InstanceId, Timestamp)> {
    commands.iter().find_map(|command| match command {
        Command::Note(Note::Awaiting { instance, until, .. }) => Some((*instance, until.unwrap_or(Timestamp(0)))),
        _ => None,
    })
}

fn outputs(commands: &[Command]) -> Option<&BTreeMap<String, Value>> {
    commands.iter().find_map(|command| match command {
        Command::End { outputs, .. } => Some(outputs),
        _ => None,
    })
}

#[test]
fn an_answer_that_comes_as_the_time_is_up_is_the_answer() {
    let plain = "  - ask: { ask: { question: So?, choices: [yes, no], default: no, timeout: 5 } }\n";
    let inside = "  - around:\n      routine: true\n      outputs: { answer: ask.answer }\n      states:\n        - ask: { ask: \
                  { question: So?, choices: [yes, no], default: no, timeout: 5 } }\n";
    for (states, from) in [(plain, "ask"), (inside, "around")] {
        let task = format!("task: t\noutputs: {{ answer: {from}.answer }}\nstates:\n{states}");
        for mode in MODES {
            let (mut executive, commands) = begun(&task, mode);
            let (instance, until) = awaiting(&commands).unwrap();
            let commands = executive.handle(until, Event::Answered { instance, choice: "yes".to_owned() });
            let answer = outputs(&commands).and_then(|outputs| outputs.get("answer"));
            assert_eq!(answer, Some(&Value::String("yes".to_owned())), "{mode:?} {from}");
        }
    }
}

#[test]
fn who_loses_a_race_at_this_very_moment_takes_no_signal() {
    // Both have their time at once: the first region wins, and the signal is there for the wait behind.
    let task = "
task: t
states:
  - race:
      concurrency: preemptive
      regions:
        - brief: { wait: { seconds: 5 } }
        - go: { states: [{ wait_go: { wait: { signal: go, timeout: 5 }, transitions: { timeout: success } } }] }
  - next: { wait: { signal: go } }
";
    for mode in MODES {
        let (mut executive, _) = begun(task, mode);
        let value = Value::Null;
        let commands =
            executive.handle(Timestamp::from_seconds(5.0), Event::Signalled { signal: "go".to_owned(), value });
        assert!(outputs(&commands).is_some(), "{mode:?}: {commands:?}");
    }
}

#[test]
fn of_what_ends_several_waits_of_a_race_only_one_is_taken() {
    let task = "
task: t
states:
  - race:
      concurrency: preemptive
      regions:
        - open: { wait: { for: open(door) } }
        - go: { wait: { signal: go } }
  - next: { wait: { signal: go } }
";
    for mode in MODES {
        let (mut executive, _) = begun(task, mode);
        let fact = support::fact("open(door)");
        let facts = vec![(fact, Some(Value::Bool(true)))];
        let commands =
            executive.handle(Timestamp::from_seconds(1.0), Event::WorldChanged { revision: Revision(1), facts });
        assert!(awaiting(&commands).is_some(), "{mode:?}: {commands:?}");
        let go = Event::Signalled { signal: "go".to_owned(), value: Value::Null };
        assert!(outputs(&executive.handle(Timestamp::from_seconds(2.0), go)).is_some(), "{mode:?}");
    }
}
