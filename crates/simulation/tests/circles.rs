//! Loops that start nothing give up alike in both modes: after as many visits, counted the same way.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may panic")]

mod support;

use ratn_model::value::Value;
use support::{MODES, Providers, simulate};

/// How a task ends in both modes, and why.
fn end_of(states: &str) -> (String, String) {
    let task = format!("task: idle\nvariables: {{ i: 0 }}\nstates:\n{states}");
    let ends = MODES.map(|mode| {
        let run = simulate(&task, mode, &mut Providers(|_: &str, _: u32, _: &_, _: &_| ("success", Value::Int(1))));
        (run.outcome, run.reason)
    });
    // Where exactly the limit is reached may differ: a node that was expanded ahead is not known to start.
    assert_eq!(ends[0].0, ends[1].0, "both modes: {ends:?}");
    assert!(ends[1].1.is_empty() || ends[1].1.contains("goes in circles"), "{}", ends[1].1);
    let [end, _] = ends;
    end
}

/// A loop of so many iterations that do nothing: two visits each.
fn idle(name: &str, iterations: u32) -> String {
    format!("{name}: {{ for: {name}_n in range({iterations}), do: [ {name}_nothing: {{ states: [] }} ] }}")
}

#[test]
fn a_hundred_thousand_visits_that_start_nothing_are_allowed_and_not_one_more() {
    // The task, the loop, and two visits per iteration.
    assert_eq!(end_of(&format!("  - {}", idle("wait", 49_999))), ("success".to_owned(), String::new()));
    let (outcome, reason) = end_of(&format!("  - {}", idle("wait", 50_000)));
    assert_eq!(outcome, "aborted");
    assert!(reason.starts_with("wait: the task goes in circles"), "{reason}");
}

#[test]
fn a_transition_back_goes_in_circles_as_a_loop_does() {
    let (outcome, reason) = end_of(
        "  - part: { states: [ a: { states: [] }, b: { states: [], outcomes: [never], transitions: { success: a, never: success } } ] }",
    );
    assert_eq!(outcome, "aborted");
    assert!(reason.starts_with("part: the task goes in circles"), "{reason}");
}

#[test]
fn an_action_that_is_started_begins_the_count_anew() {
    let go = "go: { action: arm/move, pia: true, reads: [], effects: [], resources: [{ block: Arm }] }";
    let (first, second) = (idle("first", 40_000), idle("second", 40_000));
    assert_eq!(end_of(&format!("  - {first}\n  - {go}\n  - {second}")).0, "success");
    // One that is not started does not.
    let refused = go.replace("effects", "requires: ['at(cup) = table'], transitions: { aborted: second }, effects");
    assert_eq!(end_of(&format!("  - {first}\n  - {refused}\n  - {second}")).0, "aborted");
}

#[test]
fn a_routine_begins_and_ends_with_a_count_of_its_own() {
    let (first, inside, second) = (idle("first", 40_000), idle("inside", 40_000), idle("second", 40_000));
    let within = |routine: &str| {
        end_of(&format!("  - {first}\n  - part:\n      {routine}\n      states:\n        - {inside}\n  - {second}")).0
    };
    assert_eq!(within("routine: true"), "success");
    assert_eq!(within("routine: false"), "aborted");
}

#[test]
fn each_region_has_a_count_of_its_own_and_the_thread_around_goes_on_with_its_own() {
    let regions = format!(
        "  - both:\n      concurrency: barrier\n      regions:\n        - {}\n        - {}",
        idle("left", 40_000),
        idle("right", 40_000)
    );
    assert_eq!(end_of(&format!("  - {}\n{regions}", idle("first", 40_000))).0, "success");
    let around = format!("  - {}\n{regions}\n  - {}", idle("first", 40_000), idle("second", 40_000));
    assert_eq!(end_of(&around).0, "aborted");
}
