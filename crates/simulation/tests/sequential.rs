//! What `ratn check` says of what keeps a task sequential.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may panic")]

mod support;

use ratn_model::resource::Quantity;
use ratn_simulation::sequential::{Assumptions, Obstacle, Sequential, makespan_s, sequential};
use std::collections::BTreeMap;
use support::{NoFiles, catalogue, load};

fn check(text: &str) -> Result<Sequential, Obstacle> {
    check_with_brains(text, 2)
}

fn check_with_brains(text: &str, brains: u32) -> Result<Sequential, Obstacle> {
    let program = load(text, "task.yaml", &NoFiles);
    let parameters = program.bind_parameters(&[]).unwrap();
    let units = BTreeMap::from([("Brain".to_owned(), Quantity::whole(brains))]);
    let (durations_s, attributes) = (BTreeMap::new(), BTreeMap::new());
    let assumptions = Assumptions { parameters, elements: 2, durations_s, units, attributes };
    let found = sequential(&program, &catalogue(), &assumptions);
    if let Ok(found) = &found {
        let makespan_s =
            |max_events, goes_on| makespan_s(&program, &catalogue(), &assumptions, max_events, &|| goes_on);
        assert_eq!(makespan_s(usize::MAX, true), Ok(found.cdtn_s));
        assert!(makespan_s(0, true).is_err_and(|obstacle| obstacle.to_string().contains("no end")));
        assert!(
            makespan_s(usize::MAX, false).is_err_and(|obstacle| obstacle.to_string().contains("was ended at 0.000 s"))
        );
    }
    found
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

#[test]
fn a_task_that_asks_for_what_is_not_there_says_what_that_is() {
    let elsewhere = "resources: [{ block: Arm, where: { host: elsewhere } }]";
    let task =
        format!("task: t\nstates:\n{}", move_arm("go", "1", 10).replace("resources: [{ block: Arm }]", elsewhere));
    let said = check(&task).unwrap_err().to_string();
    assert!(said.contains("go waits for `block Arm host=elsewhere`, which nothing that there is grants"), "{said}");
}

#[test]
fn of_two_visits_that_end_together_the_chain_names_the_one_whose_output_is_taken() {
    let task = "task: t\nstates:\n  - for: b in [1, 2]\n    do:
    - plan: { action: brain/think, in: { a: $b }, computes: true, reads: [], resources: [{ block: Brain }], duration: 5 }
    - go: { action: arm/move, in: { a: plan.x }, pia: true, reads: [], effects: [], resources: [{ block: Arm }], duration: 1 }\n";
    let found = check(task).unwrap();
    assert_eq!(found.cdtn_s, 7.0);
    let chain: Vec<(&str, &str)> = found.chain.iter().map(|l| (l.path.as_str(), l.because.as_str())).collect();
    assert_eq!(
        chain,
        [
            ("for_b[0]/plan", "it is the first"),
            ("for_b[0]/go", "it takes an output of the one before"),
            ("for_b[1]/go", "the one before held Arm")
        ]
    );
}

#[test]
fn a_handler_that_is_planned_for_in_vain_could_be_exceptional() {
    let think = |name: &str, input: &str, more: &str| {
        format!(
            "  - {name}: {{ action: brain/think, in: {{ a: {input} }}, computes: true, reads: [], \
             resources: [{{ block: Brain }}], duration: 8{more} }}\n"
        )
    };
    let task = |marked: &str| {
        format!(
            "task: t\nstates:\n  - look: {{ action: eye/look, computes: true, reads: [], resources: [{{ block: Eye }}], duration: 2 }}\n  \
             - go: {{ action: arm/move, in: {{ a: 1 }}, pia: true, reads: [], effects: [], \
             resources: [{{ block: Arm }}], duration: 10, transitions: {{ aborted: rescue }}{marked} }}\n{}{}{}{}",
            think("next", "look.list", ""),
            "  - come: { action: arm/move, in: { a: next.x }, pia: true, reads: [], effects: [], resources: [{ block: Arm }], \
             duration: 1, transitions: { success: success } }\n",
            think("rescue", "3", ""),
            "  - home: { action: arm/move, in: { a: rescue.x }, pia: true, reads: [], effects: [], resources: [{ block: Arm }], \
             duration: 20 }\n"
        )
    };
    let found = check_with_brains(&task(""), 1).unwrap();
    let gains: Vec<(&str, f64)> = found.exceptional.iter().map(|gain| (gain.path.as_str(), gain.alone_s)).collect();
    let marked = check_with_brains(&task(", exceptional: [aborted]"), 1).unwrap();
    assert!(marked.exceptional.is_empty(), "{:?}", marked.exceptional);
    assert_eq!(gains, [("go", found.cdtn_s - marked.cdtn_s)]);
    assert!(found.cdtn_s > marked.cdtn_s, "{} {}", found.cdtn_s, marked.cdtn_s);
}

#[test]
fn what_a_task_waits_for_comes_and_a_wait_is_not_said_to_lack_annotations() {
    let waits = "  - lid: { wait: { for: open(lid) and level(tank) = 3 } }
  - next: { wait: { signal: order }, duration: 4 }
  - which: { ask: { question: Well?, choices: [one, two] }, transitions: { two: again } }\n";
    let task = format!(
        "task: t\nstates:\n{waits}{}  - again: {{ wait: {{ seconds: 2 }} }}\n",
        move_arm("go", "next.value", 10)
    );
    let found = check(&task).unwrap();
    assert_eq!((found.hsm_s, found.cdtn_s, found.gains.len()), (18.0, 18.0, 0), "{:?}", found.gains);
    assert_eq!(found.unknown_durations, ["lid", "which"]);
    let refused = check("task: t\nstates:\n  - cup: { wait: { for: exists at(cup) } }\n").unwrap_err();
    assert!(refused.to_string().contains("what makes `exists at(cup)` hold of cup is not known"), "{refused}");
}

#[test]
fn a_task_that_does_nothing_for_ever_between_two_events_is_given_up_before_memory_is() {
    let text = "task: t
states:
  - for: x in range(1, 9000)
    do:
      - go: { action: arm/move, in: { a: 1 }, pia: true, reads: [], effects: [], resources: [{ block: Arm }] }
      - for: y in range(1, 9900)
        do:
          - condition: $y > 0
            then: []
            else: []
";
    let program = load(text, "task.yaml", &NoFiles);
    let assumptions = Assumptions {
        parameters: program.bind_parameters(&[]).unwrap(),
        elements: 2,
        durations_s: BTreeMap::new(),
        units: BTreeMap::new(),
        attributes: BTreeMap::new(),
    };
    let said = makespan_s(&program, &catalogue(), &assumptions, 2_000, &|| true).unwrap_err().to_string();
    assert!(said.contains("no end after 40000 lines of its event log"), "{said}");
}

#[test]
fn a_timeout_or_an_answer_that_is_planned_for_in_vain_could_be_exceptional() {
    let think = |name: &str, input: &str| {
        format!(
            "  - {name}: {{ action: brain/think, in: {{ a: {input} }}, computes: true, reads: [], \
             resources: [{{ block: Brain }}], duration: 8 }}\n"
        )
    };
    let task = |wait: &str, outcome: &str, marked: &str| {
        format!(
            "task: t\nstates:\n  - look: {{ action: eye/look, computes: true, reads: [], resources: [{{ block: Eye }}], duration: 2 }}\n  \
             - go: {{ {wait}, duration: 10, transitions: {{ {outcome}: rescue }}{marked} }}\n{}{}{}{}",
            think("next", "look.list"),
            "  - come: { action: arm/move, in: { a: next.x }, pia: true, reads: [], effects: [], resources: [{ block: Arm }], \
             duration: 1, transitions: { success: success } }\n",
            think("rescue", "3"),
            "  - home: { action: arm/move, in: { a: rescue.x }, pia: true, reads: [], effects: [], resources: [{ block: Arm }], \
             duration: 20 }\n"
        )
    };
    let question = "ask: { question: On?, choices: [now, never] }";
    for (wait, outcome) in [("wait: { signal: on, timeout: 60 }", "timeout"), (question, "never")] {
        let found = check_with_brains(&task(wait, outcome, ""), 1).unwrap();
        let gains: Vec<_> = found.exceptional.iter().map(|gain| (gain.path.as_str(), gain.alone_s)).collect();
        let key = format!("exceptional: [{outcome}]");
        let marked = check_with_brains(&task(wait, outcome, &format!(", {key}")), 1).unwrap();
        assert!(marked.exceptional.is_empty(), "{:?}", marked.exceptional);
        assert!(found.cdtn_s > marked.cdtn_s, "{wait}: {} {}", found.cdtn_s, marked.cdtn_s);
        assert_eq!(gains, [("go", found.cdtn_s - marked.cdtn_s)], "{wait}");
        assert_eq!(found.exceptional[0].missing, [key.as_str()]);
    }
    // An answer that is assumed is not seldom.
    let assumed = check_with_brains(&task(question, "now", ""), 1).unwrap();
    assert!(assumed.exceptional.is_empty(), "{:?}", assumed.exceptional);
}
