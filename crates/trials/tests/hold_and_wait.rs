//! Nothing asks for resources while it holds some: that, and requests of all or nothing, is why tasks cannot deadlock on what the
//! system has, in either mode, and why `check` need not look for circles of holders.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may panic with its seed")]

use ratn_executive::protocol::{Command, Event, LogEntry, Mode, Note};
use ratn_model::id::{InstanceId, LeaseId};
use ratn_simulation::run::Run;
use ratn_trials::{Conditions, Features, execute, listing, program};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

const PROGRAMS: u64 = 300;
const MAX_EVENTS: usize = 100_000;

/// Whether one of two paths contains the other: a routine and what is inside of it.
fn nested(a: &str, b: &str) -> bool {
    let within = |inner: &str, outer: &str| inner.strip_prefix(outer).is_some_and(|rest| rest.starts_with('/'));
    within(a, b) || within(b, a)
}

/// The first request of something that holds already, and how many requests there were. Commands of one event are one step: what
/// is given back by then is not held.
fn first_hold_and_wait(run: &Run) -> (Option<String>, usize) {
    let mut paths = BTreeMap::<InstanceId, String>::new();
    let mut held = BTreeMap::<LeaseId, InstanceId>::new();
    let mut asking = BTreeSet::<InstanceId>::new();
    let mut requests = 0;
    for line in &run.log {
        match &line.entry {
            LogEntry::Event(event) => {
                for instance in &asking {
                    let Some(path) = paths.get(instance) else { continue };
                    // Another instance at the same path is one that is given up: it waits for nothing.
                    let holder = |holder: &&InstanceId| {
                        *holder == instance || paths.get(holder).is_some_and(|other| nested(path, other))
                    };
                    if let Some(holder) = held.values().find(holder) {
                        return (Some(format!("{path} asks while {} holds", paths[holder])), requests);
                    }
                }
                // What comes twice, or after the request was taken back, grants nothing.
                if let Event::Granted { instance, lease } = event
                    && asking.remove(instance)
                {
                    held.insert(lease.id, *instance);
                }
            }
            LogEntry::Command(Command::Note(Note::Expanded { instance, path, .. })) => {
                paths.insert(*instance, path.clone());
            }
            LogEntry::Command(Command::Release { instance, lease: None, .. }) => {
                asking.remove(instance);
            }
            LogEntry::Command(Command::Release { lease: Some(lease), .. }) => {
                held.remove(lease);
            }
            LogEntry::Command(Command::Acquire { instance, .. }) => {
                requests += 1;
                asking.insert(*instance);
            }
            LogEntry::Command(_) => {}
        }
    }
    (None, requests)
}

#[test]
fn nothing_asks_for_resources_while_it_holds_some() {
    let mut requests = [0, 0];
    for seed in 0..PROGRAMS {
        let features = Features::ALL;
        let (made, conditions) = (Arc::new(program(seed, &features)), Conditions::of(seed, &features));
        for (number, mode) in [Mode::Hsm, Mode::Cdtn].into_iter().enumerate() {
            // Runs without an end are another test's.
            let Ok(run) = execute(&made, &conditions, mode, MAX_EVENTS) else { continue };
            let (found, asked) = first_hold_and_wait(&run);
            assert!(found.is_none(), "seed {seed}, {mode:?}: {}\n{}", found.unwrap(), listing(&made));
            requests[number] += asked;
        }
    }
    assert!(requests.iter().all(|asked| *asked > 1_000), "too few requests to tell: {requests:?}");
}
