//! What `ratn check` says of what keeps a task sequential.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may panic")]

mod support;

use ratn_simulation::sequential::{Assumptions, Obstacle, Sequential, sequential};
use std::collections::BTreeMap;
use support::{NoFiles, catalogue, load};

fn check(text: &str) -> Result<Sequential, Obstacle> {
    let program = load(text, "task.yaml", &NoFiles);
    let parameters = program.bind_parameters(&[]).unwrap();
    let assumptions = Assumptions { parameters, elements: 2, durations_s: BTreeMap::new(), units: BTreeMap::new() };
    sequential(&program, &catalogue(), &assumptions)
}

fn move_arm(name: &str, input: &str, seconds: u32) -> String {
    format!(
        "  - {name}: {{ action: arm/move, in: {{ a: {input} }}, pia: true, reads: [], effects: [], \
         resources: [{{ block: Arm }}], duration: {seconds} }}\n"
    )
}

#[test]
fn a_state_that_says_nothing_costs_what_it_could_do_while_the_arm_moves() {
    let think = "  - think: { action: brain/think, resources: [{ block: Brain }], duration: 6 }\n";
    let task = format!("task: t\nstates:\n{}{think}{}", move_arm("go", "1", 10), move_arm("come", "think.x", 10));
    let found = check(&task).unwrap();
    assert_eq!((found.hsm_s, found.cdtn_s, found.annotated_s), (26.0, 26.0, Some(20.0)));
    let gains: Vec<(&str, f64, f64)> = found.gains.iter().map(|g| (g.path.as_str(), g.alone_s, g.last_s)).collect();
    assert_eq!(gains, [("think", 6.0, 6.0)]);
    assert_eq!(found.gains[0].missing, ["reads", "effects", "computes"]);
    let chain: Vec<(&str, &str)> = found.chain.iter().map(|l| (l.path.as_str(), l.because.as_str())).collect();
    assert_eq!(
        chain,
        [
            ("go", "it is the first"),
            ("think", "it may be irreversible: everything older must have ended"),
            ("come", "it takes an output of the one before")
        ]
    );
}

#[test]
fn two_states_that_say_nothing_gain_only_together() {
    let bare = "  - first: { action: brain/think, resources: [{ block: Brain }], duration: 4 }
  - second: { action: brain/think, in: { a: first.x }, resources: [{ block: Brain }], duration: 4 }\n";
    let task = format!("task: t\nstates:\n{}{bare}{}", move_arm("go", "1", 10), move_arm("come", "second.x", 10));
    let found = check(&task).unwrap();
    assert_eq!((found.cdtn_s, found.annotated_s), (28.0, Some(20.0)));
    let second = found.gains.iter().find(|gain| gain.path == "second").unwrap();
    assert_eq!((second.alone_s, second.last_s), (0.0, 4.0), "{second:?}");
}

#[test]
fn what_blocks_an_arm_is_not_said_to_compute() {
    let task = "task: t\nstates:\n  - go: { action: arm/move, resources: [{ block: Arm }], duration: 3 }\n";
    let found = check(task).unwrap();
    assert_eq!(found.gains[0].missing, ["reads", "effects"]);
    assert_eq!(found.gains[0].alone_s, 0.0);
}

#[test]
fn a_task_that_says_everything_has_nothing_to_gain() {
    let found = check(&format!("task: t\nstates:\n{}", move_arm("go", "1", 5))).unwrap();
    assert!(found.gains.is_empty() && found.unknown_durations.is_empty(), "{found:?}");
}

#[test]
fn the_chain_goes_on_over_what_ended_without_having_begun() {
    let refused = "  - bad: { action: arm/move, requires: [\"door(open) = true\"], reads: [], effects: [], \
         resources: [{ block: Arm }], duration: 3, transitions: { aborted: rescue } }\n";
    let task = format!("task: t\nstates:\n{}{refused}{}", move_arm("go", "1", 3), move_arm("rescue", "2", 1));
    let found = check(&task).unwrap();
    let chain: Vec<&str> = found.chain.iter().map(|link| link.path.as_str()).collect();
    assert_eq!(chain, ["go", "rescue"]);
}

#[test]
fn an_action_without_a_duration_is_named() {
    let found =
        check("task: t\nstates:\n  - go: { action: arm/move, reads: [], effects: [], resources: [{ block: Arm }] }\n");
    assert_eq!(found.unwrap().unknown_durations, ["go"]);
}

#[test]
fn a_loop_over_an_answer_runs_over_as_many_elements_as_are_assumed() {
    let task = format!(
        "task: t\nstates:\n  - look: {{ action: eye/look, computes: true, reads: [], resources: [{{ block: Eye }}], \
         duration: 1 }}\n  - for: thing in look.list\n    do:\n    {}",
        move_arm("go", "$thing", 5)
    );
    let found = check(&task).unwrap();
    assert_eq!(found.hsm_s, 11.0, "{found:?}");
    assert_eq!(found.chain[1].because, "the one before decides whether or how often it comes");
}

#[test]
fn a_task_that_cannot_be_brought_to_its_end_says_why() {
    let task = "task: t\nstates:\n  - go: { action: arm/move, requires: [\"door(open) = true\"], reads: [], effects: [], \
         resources: [{ block: Arm }], duration: 3 }\n";
    let obstacle = check(task).unwrap_err().to_string();
    assert!(obstacle.starts_with("with assumed outputs the task ends in HSM mode with `aborted`"), "{obstacle}");
    assert!(obstacle.contains("door(open)"), "{obstacle}");
}
