//! What a step of HSM mode costs does not grow with what has been done before, nor with what the task holds.
//!
//! No clock is read: with a step that copies what the task holds, each of these runs would take minutes instead of a second or two.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may panic")]

use ratn_executive::executive::Executive;
use ratn_executive::protocol::{Command, Event, Learned, Mode};
use ratn_model::catalogue::Catalogue;
use ratn_model::id::{FencingToken, InstanceId, LeaseId, Revision};
use ratn_model::program::Program;
use ratn_model::resource::Lease;
use ratn_model::time::Timestamp;
use ratn_model::tolerance::Tolerance;
use ratn_model::value::Value;
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

fn program(states: &str) -> Program {
    let catalogue = Catalogue::from_toml("[providers.arm]\nresource = \"Arm\"\nactions.move = { optional = { a = \"any\" }, outputs = { x = \"any\" } }\n[resources]\nArm = { class = \"process\", count = 1 }").unwrap();
    let text = format!("task: cost\nvariables: {{ i: 0 }}\nparameters: {{ n: {{ type: int }} }}\nstates:\n{states}");
    ratn_model::load::load(&text, "task.yaml", &catalogue).unwrap_or_else(|problems| panic!("{problems:?}")).program
}

/// A run in HSM mode with the parameter `n`, whose goals all succeed: how many were started.
fn goals(states: &str, n: i64) -> usize {
    let mut executive = Executive::new(Arc::new(program(states)), Tolerance::EXACT);
    let started = Event::Started {
        task: String::new(),
        digest: String::new(),
        mode: Mode::Hsm,
        parameters: BTreeMap::from([("n".to_owned(), Value::Int(n))]),
        seed: 1,
        world: Vec::new(),
        revision: Revision(0),
        capacity: BTreeMap::new(),
        learned: Learned::default(),
        breakpoints: Box::default(),
        origin: Default::default(),
    };
    let mut goals = 0;
    let mut events = VecDeque::from([started]);
    let mut outcome = None;
    while let Some(event) = events.pop_front() {
        for command in executive.handle(Timestamp(0), event) {
            match command {
                Command::Acquire { instance, .. } => events.push_back(granted(instance)),
                Command::Start { instance, attempt, .. } => {
                    goals += 1;
                    events.push_back(finished(instance, attempt));
                }
                Command::End { outcome: end, reason, .. } => outcome = Some((end, reason)),
                _ => {}
            }
        }
    }
    assert_eq!(outcome, Some(("success".to_owned(), String::new())), "{states}");
    goals
}

fn granted(instance: InstanceId) -> Event {
    let lease = Lease { id: LeaseId(1), token: FencingToken(1), resources: Vec::new(), consumed: Vec::new() };
    Event::Granted { instance, lease }
}

fn finished(instance: InstanceId, attempt: u32) -> Event {
    Event::Finished {
        instance,
        attempt,
        outcome: "success".to_owned(),
        outputs: BTreeMap::from([("x".to_owned(), Value::Int(1))]),
        measured: Vec::new(),
        evidence: Default::default(),
        reason: String::new(),
        at_rest: true,
    }
}

const GO: &str = "{ action: arm/move, pia: true, resources: [{ block: Arm }], reads: [], effects: [], in: { a: $k } }";

#[test]
fn a_loop_over_a_hundred_thousand_elements_is_linear() {
    assert_eq!(goals(&format!("  - each: {{ for: k in range($n), do: [ go: {GO} ] }}"), 100_000), 100_000);
}

#[test]
fn regions_do_not_copy_the_variables_around_them() {
    let both = format!("both: {{ concurrency: barrier, regions: [ go: {GO}, no: {{ states: [] }} ] }}");
    let each = format!("each: {{ for: k in $l, do: [ {both} ] }}");
    let states = format!("  - part: {{ variables: {{ l: range($n) }}, states: [ {each} ] }}");
    assert_eq!(goals(&states, 20_000), 20_000);
}
