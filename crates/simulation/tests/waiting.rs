//! What comes at the very moment at which the time of a wait is up: the executive alone, one event after the other.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may panic")]

mod support;

use ratn_executive::executive::Executive;
use ratn_executive::protocol::{Command, Event, Learned, Mode, Note};
use ratn_model::fact::{FactKey, Term};
use ratn_model::id::{FencingToken, InstanceId, LeaseId, ProjectionId, Revision};
use ratn_model::resource::Lease;
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

/// What is true at the end of an event that comes so many seconds after a task has begun, while nobody looked after it.
fn late(task: &str, seconds: f64, fact: &str) -> [Option<Value>; 2] {
    MODES.map(|mode| {
        let (mut executive, _) = begun(task, mode);
        executive.handle(Timestamp::from_seconds(seconds), Event::Woken);
        assert!(executive.has_ended(), "{mode:?}");
        executive.root().get(&support::fact(fact)).cloned()
    })
}

#[test]
fn what_is_over_when_somebody_looks_again_ends_in_the_order_of_its_times() {
    let looks = "
        - looks:
            shared: ['f()', 'c()']
            states:
              - wait_1: { wait: { seconds: 4 } }
              - is_it:
                  condition: f() = 1
                  then: [ yes: { states: [], effects: ['saw() = 1'] } ]
                  else: [ no: { states: [], effects: ['saw() = 0'] } ]";
    let alone = "
        - changes:
            LIMIT
            states:
              - wait_2: { wait: { seconds: 3 } }
              - change: { states: [], effects: ['f() = 1'] }";
    let by_another = "
        - causes:
            shared: ['c()']
            states:
              - wait_2: { wait: { seconds: 3 } }
              - cause: { states: [], effects: ['c() = 1'] }
        - changes:
            LIMIT
            shared: ['c()']
            states:
              - wait_3: { wait: { for: c() = 1 } }
              - change: { states: [], effects: ['f() = 1'] }";
    for others in [alone, by_another] {
        for limit in ["description: plain", "timeout: 100", "routine: true"] {
            let others = others.replace("LIMIT", limit);
            let task = format!(
                "task: t\nworld: ['c() = 0', 'f() = 0']\nstates:\n  - both:\n      concurrency: barrier\n      \
                 regions:{looks}{others}\n"
            );
            assert_eq!(late(&task, 9.0, "saw()"), [1, 1].map(|saw| Some(Value::Int(saw))), "{task}");
        }
    }
}

#[test]
fn what_was_over_before_the_deadline_is_followed_when_somebody_looks_again() {
    let task = |seconds: u32| {
        format!(
            "task: t\ndeadline: 6\nworld: ['f() = 0']\nstates:\n  - both:\n      concurrency: barrier\n      regions:\n        - \
             changes: {{ states: [ wait: {{ wait: {{ seconds: {seconds} }} }}, change: {{ states: [], effects: ['f() = 1'] }}, \
             rest: {{ wait: {{ seconds: 50 }} }} ] }}\n        - other: {{ timeout: 40, states: [ rest_2: {{ wait: {{ seconds: 50 \
             }} }} ] }}\n"
        )
    };
    assert_eq!(late(&task(3), 9.0, "f()"), [1, 1].map(|f| Some(Value::Int(f))));
    for not_before in [6, 7] {
        assert_eq!(late(&task(not_before), 9.0, "f()"), [0, 0].map(|f| Some(Value::Int(f))), "{not_before}");
    }
}

#[test]
fn who_gets_the_next_signal_is_known_before_it_is_sent() {
    for (left, right) in [(0, 0), (2, 1), (1, 2)] {
        for limited in ["left", "right", "neither"] {
            let region = |name: &str, seconds: u32| {
                let limit = if name == limited { "timeout: 100, " } else { "" };
                format!(
                    "        - {name}: {{ {limit}states: [ rest_{name}: {{ wait: {{ seconds: {seconds} }} }}, wait_{name}: {{ \
                         wait: {{ signal: go }} }} ] }}\n"
                )
            };
            let regions = region("left", left) + &region("right", right);
            let task = format!("task: t\nstates:\n  - both:\n      concurrency: barrier\n      regions:\n{regions}");
            for mode in MODES {
                let (mut executive, mut all) = begun(&task, mode);
                assert_eq!(executive.first_waiting_for("stop"), None);
                for second in 1..=2 {
                    all.extend(executive.handle(Timestamp::from_seconds(f64::from(second)), Event::Woken));
                }
                let named = executive.first_waiting_for("go").unwrap();
                let wanted = if left <= right { "wait_left" } else { "wait_right" };
                let is_it = |command: &Command| matches!(command, Command::Note(Note::Expanded { instance, path, .. }) if *instance == named && path.ends_with(wanted));
                assert!(all.iter().any(is_it), "{mode:?} {named} {task}");
                let go = Event::Signalled { signal: "go".to_owned(), value: Value::Null };
                let commands = executive.handle(Timestamp::from_seconds(3.0), go);
                let ends = |command: &Command| matches!(command, Command::Note(Note::Finished { instance, .. }) if *instance == named);
                assert!(commands.iter().any(ends), "{mode:?} {task}");
            }
        }
    }
}

/// Tells the executive what comes at a second.
fn at(executive: &mut Executive, second: f64, event: Event) -> Vec<Command> {
    executive.handle(Timestamp::from_seconds(second), event)
}

/// The instance that has just asked for resources gets them.
fn grant(executive: &mut Executive, commands: &[Command], second: f64) -> Vec<Command> {
    let asks = commands.iter().find_map(|command| match command {
        Command::Acquire { instance, .. } => Some(*instance),
        _ => None,
    });
    let instance = asks.unwrap();
    let (id, token) = (LeaseId(instance.0), FencingToken(instance.0));
    let lease = Lease { id, token, resources: Vec::new(), consumed: Vec::new() };
    at(executive, second, Event::Granted { instance, lease })
}

/// The attempts that are started.
fn started(commands: &[Command]) -> Vec<(InstanceId, u32)> {
    let start = |command: &Command| match command {
        Command::Start { instance, attempt, .. } => Some((*instance, *attempt)),
        _ => None,
    };
    commands.iter().filter_map(start).collect()
}

fn cancelled(commands: &[Command]) -> Vec<InstanceId> {
    let cancel = |command: &Command| match command {
        Command::Cancel { instance, .. } => Some(*instance),
        _ => None,
    };
    commands.iter().filter_map(cancel).collect()
}

#[test]
fn watched_motions_end_in_the_order_in_which_they_began_to_move() {
    let task = "
task: t
world: [closed(door)]
states:
  - both:
      concurrency: barrier
      regions:
        - one:
            shared: ['closed(door)', 'first()']
            states:
              - move: { action: arm/move, pia: true, while: [closed(door)], reads: [],
                  effects: { violated: [first() = 1] }, resources: [{ block: Arm }, { block: WorldModel }] }
        - two:
            shared: ['closed(door)', 'first()']
            states:
              - rest: { wait: { seconds: 1 } }
              - turn: { action: head/turn, pia: true, while: [closed(door)], reads: [],
                  effects: { violated: [first() = 2] }, resources: [{ block: Head }] }
";
    let door = FactKey { predicate: "closed".to_owned(), arguments: vec![Term::Name("door".to_owned())] };
    for mode in MODES {
        let (mut executive, mut commands) = begun(task, mode);
        // The first has its resources, and waits for its projection until the second has begun.
        commands = grant(&mut executive, &commands, 0.5);
        let project = commands.iter().find_map(|command| match command {
            Command::Project { instance, attempt, .. } => Some((*instance, *attempt)),
            _ => None,
        });
        let (instance, attempt) = project.unwrap();
        commands = at(&mut executive, 1.0, Event::Woken);
        assert_eq!(started(&grant(&mut executive, &commands, 1.0)).len(), 1, "{mode:?}");
        let projection = ProjectionId(1);
        assert_eq!(started(&at(&mut executive, 1.5, Event::Projected { instance, attempt, projection })).len(), 1);
        let opened = Event::WorldChanged { revision: Revision(9), facts: vec![(door.clone(), None)] };
        assert_eq!(cancelled(&at(&mut executive, 2.0, opened)).last(), Some(&instance), "{mode:?}");
        let first = FactKey { predicate: "first".to_owned(), arguments: Vec::new() };
        assert_eq!(executive.root().get(&first), Some(&Value::Int(1)), "{mode:?}");
    }
}

#[test]
fn the_timeout_of_a_goal_counts_from_when_it_is_given_to_its_provider() {
    let plain =
        "  - move: { action: pen/note, pia: true, reads: [], effects: [], resources: [{ block: Pen }], timeout: 2 }\n";
    let inside = format!("  - around:\n      routine: true\n      states:\n      {plain}");
    for states in [plain, &inside] {
        let task = format!("task: t\nstates:\n{states}");
        for mode in MODES {
            let (mut executive, commands) = begun(&task, mode);
            let (instance, attempt) = started(&grant(&mut executive, &commands, 0.0))[0];
            // Goals that were told to stop have to end first.
            at(&mut executive, 0.1, Event::Delayed { instance, attempt });
            assert_eq!(cancelled(&at(&mut executive, 3.0, Event::Woken)), [], "{mode:?}");
            let given = at(&mut executive, 3.5, Event::Given { instance, attempt });
            assert!(given.contains(&Command::Wake { at: Timestamp::from_seconds(5.5) }), "{mode:?} {given:?}");
            // It is heard of again: the clock goes on.
            at(&mut executive, 4.0, Event::Given { instance, attempt });
            assert_eq!(cancelled(&at(&mut executive, 5.4, Event::Woken)), [], "{mode:?}");
            let late = at(&mut executive, 5.5, Event::Woken);
            assert_eq!(cancelled(&late), [instance], "{mode:?}");
            assert!(executive.has_ended(), "{mode:?}");
        }
    }
}
