//! The world changes from outside while a task runs: in both modes the robot then does the same, on the facts as they are when its
//! motions begin.
//!
//! Every motion takes ten seconds and everything else less, so that what is computed ahead is ahead of the change, which comes at
//! five seconds.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may panic")]

mod support;

use ratn_executive::protocol::{Event, Goal, Mode};
use ratn_model::fact::FactKey;
use ratn_model::id::Revision;
use ratn_model::value::Value;
use ratn_simulation::run::{Circumstances, Run, Trigger, run_under};
use ratn_world::world::World;
use support::{NoFiles, Providers, fact, invalidated, load, setup, text};

/// Runs a task while these facts change at five seconds; its motions in order, and the run.
fn disturbed(states: &str, mode: Mode, facts: &[(FactKey, Option<Value>)]) -> (Vec<String>, Run) {
    let long =
        states.replace("MOVE", "action: arm/move, pia: true, resources: [{ block: Arm }], duration: 10").replace(
            "THINK",
            "action: brain/think, computes: true, resources: [{ block: Brain }, world_model], duration: 2",
        );
    let task = format!("task: disturbed\nworld: ['at(cup) = table', 'count() = 1', 'places() = [a]']\n{long}");
    let event = Event::WorldChanged { revision: Revision(99), facts: facts.to_vec() };
    let circumstances = Circumstances { events: vec![(Trigger::At(5.0), event)], ..Circumstances::default() };
    let mut motions = Vec::new();
    // What is computed is where the cup is.
    let mut providers = Providers(|path: &str, _: u32, goal: &Goal, world: &World| {
        if &*goal.provider == "arm" {
            let input = goal.inputs.get("a").map(|a| format!("({a})")).unwrap_or_default();
            motions.push(format!("{path}{input}"));
        }
        ("success", world.get(&fact("at(cup)")).cloned().unwrap_or_else(|| text("nowhere")))
    });
    let run = run_under(setup(load(&task, "task.yaml", &NoFiles), mode), &mut providers, circumstances).unwrap();
    (motions, run)
}

fn check(states: &str, facts: &[(FactKey, Option<Value>)], motions: &[&str]) -> Run {
    let (as_hsm, hsm) = disturbed(states, Mode::Hsm, facts);
    let (as_cdtn, cdtn) = disturbed(states, Mode::Cdtn, facts);
    assert_eq!(as_hsm, motions);
    assert_eq!(as_cdtn, motions, "{:#?}", cdtn.log);
    assert_eq!((&hsm.outcome, support::facts(&hsm)), (&cdtn.outcome, support::facts(&cdtn)));
    cdtn
}

/// The paths of what was computed again.
fn again(run: &Run) -> Vec<String> {
    invalidated(run).into_iter().map(|(path, _)| path).collect()
}

fn cup_at(place: &str) -> [(FactKey, Option<Value>); 1] {
    [(fact("at(cup)"), Some(text(place)))]
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
    assert_eq!(again(&run), ["plan", "think"]);
}

#[test]
fn a_change_that_nothing_depends_on_changes_nothing() {
    let states = "states:
  - go: { MOVE, reads: [], effects: [] }
  - plan: { THINK, reads: ['at(cup)'] }
  - grasp: { MOVE, in: { a: plan.x }, reads: [], effects: ['held() = plan.x'] }";
    let run = check(states, &[(fact("at(plate)"), Some(text("shelf")))], &["go", "grasp(table)"]);
    assert!(again(&run).is_empty());
    assert_eq!(run.world.get(&fact("at(plate)")), Some(&text("shelf")));
}

#[test]
fn a_fact_that_expires_is_gone_for_what_is_computed_ahead() {
    let states = "states:
  - go: { MOVE, reads: [], effects: [] }
  - plan: { THINK, reads: ['at(cup)'] }
  - grasp: { MOVE, in: { a: plan.x }, reads: [], effects: [] }";
    check(states, &[(fact("at(cup)"), None)], &["go", "grasp(nowhere)"]);
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
    assert!(again(&run).is_empty());
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
    let count = |n: Option<i64>| [(fact("count()"), n.map(Value::Int))];
    let states = "states:
  - go: { MOVE, reads: [], effects: [] }
  - each: { while: 'count() < 3', do: [ step: { MOVE, reads: [], effects: ['increase count() by 1'] } ] }
  - home: { MOVE, reads: [], effects: [] }";
    check(states, &count(Some(3)), &["go", "home"]);
    check(states, &count(Some(0)), &["go", "each[0]/step", "each[1]/step", "each[2]/step", "home"]);
}

#[test]
fn the_list_of_a_loop_that_was_known_ahead_is_asked_for_again() {
    let now = Value::List(vec![text("b"), text("c")].into());
    let states = "states:
  - go: { MOVE, reads: [], effects: [] }
  - each:
      for: place in places()
      do: [ step: { MOVE, in: { a: '$place' }, reads: [], effects: [] } ]
  - home: { MOVE, reads: [], effects: [] }";
    check(states, &[(fact("places()"), Some(now))], &["go", "each[0]/step(b)", "each[1]/step(c)", "home"]);
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
