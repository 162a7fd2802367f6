//! Every form of state and every key of a task file becomes what it says in the program.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use insta::assert_snapshot;
use ratn_model::catalogue::{ActionSignature, Catalogue};
use ratn_model::expression::scope::{NothingKnown, WithVariable};
use ratn_model::load::load;
use ratn_model::program::{Exceptions, Program, Retry, State, StateKind, Target};
use ratn_model::value::Value;

/// The standard system, with an eye that may see nothing.
fn catalogue() -> Catalogue {
    let mut catalogue = Catalogue::standard();
    let outputs = [("found".to_owned(), "int".parse().unwrap())].into();
    let look = ActionSignature { outputs, outcomes: vec!["empty".to_owned()], ..ActionSignature::default() };
    let mut eye = catalogue.providers["gripper"].clone();
    eye.actions = [("look".to_owned(), look)].into();
    catalogue.providers.insert("eye".to_owned(), eye);
    catalogue
}

fn program(source: &str) -> Program {
    match load(source, "task.yaml", &catalogue()) {
        Ok(loaded) => loaded.program,
        Err(findings) => panic!("{}", findings.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n")),
    }
}

fn state<'p>(program: &'p Program, path: &str) -> &'p State {
    program.states.iter().find(|state| state.path == path).unwrap_or_else(|| panic!("no state {path}"))
}

/// What is found wrong, one line each.
fn findings(source: &str) -> String {
    let findings = load(source, "task.yaml", &catalogue()).map(|loaded| loaded.warnings);
    findings.unwrap_or_else(|errors| errors).iter().map(ToString::to_string).collect::<Vec<_>>().join("\n")
}

/// `outcome → where it leads` of a state.
fn transitions(program: &Program, path: &str) -> String {
    let lead = |target: &Target| match target {
        Target::State(id) => program.state(*id).path.clone(),
        Target::Outcome(name) => format!("({name})"),
    };
    let all = state(program, path).transitions.iter().map(|(outcome, target)| format!("{outcome} → {}", lead(target)));
    all.collect::<Vec<_>>().join(", ")
}

fn bound(variables: &[(String, ratn_model::expression::Expr)]) -> String {
    variables.iter().map(|(name, value)| format!("{name}: {value}")).collect::<Vec<_>>().join(", ")
}

const LOOK: &str = "action: eye/look, resources: [{ block: Gripper }]";

#[test]
fn what_a_task_says_of_itself_is_in_the_program() {
    let source = "
task: t
horizon: 40
speculation_width: 3
deadline: 600
exceptions: imprecise
outcomes: [nothing_there]
parameters: { most: 3 }
variables: { n: $most + 1 }
states: []
";
    let program = program(source);
    assert_eq!((program.horizon, program.speculation_width, program.deadline_s), (40, 3, Some(600.0)));
    assert_eq!(program.exceptions, Exceptions::Imprecise);
    assert_eq!(program.states[0].outcomes, ["nothing_there"]);
    assert_eq!(bound(&program.states[0].variables), "n: $most + 1");
    let plain = self::program("task: t\nstates: []\n");
    assert_eq!((plain.speculation_width, plain.deadline_s), (Program::DEFAULT_SPECULATION_WIDTH, None));
    assert_eq!(plain.exceptions, Exceptions::Precise);
}

#[test]
fn transitions_lead_to_a_state_beside_or_out_by_an_outcome() {
    let source = format!(
        "
task: t
outcomes: [nothing_there]
states:
  - look: {{ {LOOK}, transitions: {{ aborted: tidy, empty: nothing_there, success: look }} }}
  - tidy: {{ {LOOK}, transitions: {{ empty: success }} }}
  - inner:
      outcomes: [strange]
      transitions: {{ strange: look, aborted: success }}
      states:
        - first: {{ {LOOK}, transitions: {{ empty: strange, preempted: aborted }} }}
"
    );
    let program = program(&source);
    assert_eq!(transitions(&program, "look"), "aborted → tidy, empty → (nothing_there), success → look");
    assert_eq!(transitions(&program, "inner"), "aborted → (success), strange → look");
    assert_eq!(transitions(&program, "inner/first"), "empty → (strange), preempted → (aborted)");
    assert_eq!(state(&program, "look").outcomes, ["empty"]);
}

#[test]
fn the_outcomes_by_which_a_state_is_left_are_its_own() {
    let source = format!(
        "
task: t
outcomes: [done]
states:
  - each:
      for: box in [1, 2]
      transitions: {{ empty: done }}
      do:
        - near: {{ condition: $box > 1, then: [{{ look: {{ {LOOK} }} }}] }}
        - again: {{ {LOOK}, transitions: {{ empty: success }} }}
"
    );
    let program = program(&source);
    let all = program.all_outcomes();
    let of = |path: &str| all[state(&program, path).id.0 as usize].join(" ");
    assert_eq!(of("each/near"), "success empty aborted preempted");
    assert_eq!(of("each"), "success empty aborted preempted");
    assert_eq!(of(""), "success done aborted preempted");
}

#[test]
fn what_leads_nowhere_or_cannot_happen_is_refused_with_what_there_is() {
    let task = |states: &str| findings(&format!("task: t\noutcomes: [nothing]\nstates:\n{states}"));
    let look = |transitions: &str| task(&format!("  - look: {{ {LOOK}, transitions: {{ {transitions} }} }}\n"));
    assert_snapshot!(look("aborted: nothin"), @"task.yaml:4:88: error[unknown-target] in look: `nothin` is neither a state beside this one nor an outcome of the state around it. help: did you mean `nothing`?");
    assert_snapshot!(look("emty: nothing"), @"task.yaml:4:79: error[unknown-outcome] in look: this state has no outcome `emty`. help: did you mean `empty`?");
    assert_snapshot!(look("aborted: [a]"), @"task.yaml:4:88: error[invalid-name] in look: expected a state or an outcome, a name, found a list");
    // An inner state sees the outcomes of what is around it, and no state of another list.
    let inside = format!(
        "  - when: {{ condition: true, then: [{{ look: {{ {LOOK}, transitions: {{ aborted: nothing }} }} }}] }}\n"
    );
    assert_snapshot!(task(&inside), @"task.yaml:4:122: error[unknown-target] in when/look: `nothing` is neither a state beside this one nor an outcome of the state around it. help: there is `aborted`, `look`, `preempted`, `success`");
    let exceptional = format!("  - look: {{ {LOOK}, exceptional: [strange] }}\n");
    assert_snapshot!(task(&exceptional), @"task.yaml:4:78: error[unknown-outcome] in look: this state has no outcome `strange`. help: there is `aborted`, `empty`, `preempted`, `success`");
}

#[test]
fn loops_on_a_predicate_say_when_they_begin() {
    let body = format!("index: i, do: [{{ look: {{ {LOOK} }} }}]");
    let source = format!(
        "
task: t
states:
  - before: {{ while: $i < 3 and exists at(cup), {body} }}
  - after: {{ do_while: look.found > $i, {body} }}
  - until: look.found > 2
    do: [{{ look: {{ {LOOK} }} }}]
"
    );
    let program = program(&source);
    let printed = |path: &str| {
        let StateKind::While { predicate, body_first, index, body, .. } = &state(&program, path).kind else {
            panic!("a loop")
        };
        format!("{predicate} {body_first} {index:?} {}", program.state(body[0]).path)
    };
    assert_eq!(printed("before"), "$i < 3 and exists at(cup) false Some(\"i\") before/look");
    assert_eq!(printed("after"), "s4.found > $i true Some(\"i\") after/look");
    assert_eq!(printed("until"), "not s6.found > 2 true None until/look");
}

#[test]
fn regions_decide_by_their_outcomes() {
    let source = format!(
        "
task: t
outcomes: [lost]
variables: {{ seen: 0 }}
states:
  - both:
      concurrency: barrier
      outcomes: [lost]
      decide: {{ lost: left.outcome = empty and exists at(cup), success: 'right.outcome in [success, aborted]' }}
      outputs: {{ found: {{ type: int, value: left.found, default: 0 }} }}
      assign: {{ seen: found }}
      effects: {{ success: ['seen() = found'], lost: [] }}
      regions:
        - left: {{ {LOOK}, shared: ['at(cup)'] }}
        - right: {{ states: [{{ look: {{ {LOOK} }} }}] }}
  - first: {{ concurrency: preemptive, regions: [{{ a: {{ {LOOK} }} }}, {{ b: {{ states: [] }} }}], transitions: {{ empty: lost }} }}
"
    );
    let program = program(&source);
    let both = state(&program, "both");
    let StateKind::Concurrency { regions, preemptive, decide, outputs, .. } = &both.kind else {
        panic!("a concurrency")
    };
    assert_eq!((regions.len(), *preemptive, both.annotations.routine), (2, false, false));
    assert_eq!(bound(decide), "lost: s2.outcome = empty and exists at(cup), success: s3.outcome in [success, aborted]");
    assert_eq!((outputs[0].name.as_str(), both.defaults["found"].to_string().as_str()), ("found", "0"));
    assert_eq!(bound(&both.assign), "seen: found");
    assert_eq!(state(&program, "both/left").annotations.shared[0].to_string(), "at(cup)");
    let first = state(&program, "first");
    assert!(matches!(first.kind, StateKind::Concurrency { preemptive: true, .. }));
    assert_eq!(transitions(&program, "first"), "empty → (lost)");
}

#[test]
fn a_region_removes_nothing_that_another_one_sees() {
    let said = |first: &str, second: &str| {
        findings(&format!(
            "task: t\nstates:\n  - make: {{ action: gripper/release, pia: true, effects: [], resources: [{{ block: Gripper }}, {{ create: Token, class: task, with: {{ colour: red }} }}] }}\n  - both:\n      concurrency: barrier\n      regions:\n        - left: {{ action: gripper/release, pia: true, effects: [], resources: [{{ block: Gripper }}, {{ {first} }}] }}\n        - right: {{ action: pan_tilt/look_at, in: {{ target: \"pose(1, 0, 0)\" }}, pia: true, effects: [], resources: [{{ block: PanTilt }}, {{ {second} }}] }}\n"
        ))
    };
    for (first, second, is_refused) in [
        ("delete: Token, class: task", "block: Token", true),
        ("exists: Token", "delete: Token, class: task", true),
        ("create: Token, class: task", "exists: Token", true),
        ("create: Token, class: task", "block: Token", false),
        ("block: Token", "block: Token", false),
        ("delete: Token, class: task, where: { colour: red }", "block: Token, where: { colour: red }", true),
        ("delete: Token, class: task, where: { colour: red }", "block: Token, where: { colour: blue }", false),
    ] {
        let found = said(first, second);
        assert_eq!(found.contains("region-conflict"), is_refused, "{first} beside {second}: {found}");
    }
}

#[test]
fn what_computes_and_does_not_say_what_it_reads_may_read_what_another_region_changes() {
    let said = |reads: &str| {
        findings(&format!(
            "task: t\nstates:\n  - both:\n      concurrency: barrier\n      regions:\n        - left: {{ action: pan_tilt/look_at, in: {{ target: \"pose(1, 0, 0)\" }}, pia: true, effects: ['seen() = 1'], resources: [{{ block: PanTilt }}] }}\n        - right: {{ action: eye/look, computes: true{reads}, resources: [world_model] }}\n"
        ))
    };
    assert!(said("").contains("region-conflict"), "{}", said(""));
    assert!(said("").contains("`both/right` says no `reads`"), "{}", said(""));
    assert!(!said(", reads: ['weight(?)']").contains("region-conflict"), "{}", said(", reads: ['weight(?)']"));
}

#[test]
fn a_region_leads_nowhere_and_its_outcome_is_seen_where_all_have_ended() {
    let both = |left: &str, more: &str| {
        let regions = format!("[{{ left: {{ {LOOK}{left} }} }}, {{ right: {{ states: [] }} }}]");
        findings(&format!("task: t\nstates:\n  - both: {{ concurrency: barrier, regions: {regions}, {more} }}\n"))
    };
    assert_snapshot!(both(", transitions: { empty: right }", ""), @"task.yaml:3:119: error[invalid-state] in both/left: a region has no transitions: all regions are waited for. help: use its outcome in `decide`");
    assert_snapshot!(both("", "decide: { lost: true }"), @"task.yaml:3:47: warning[region-unannotated] in both/left: `both/left` says neither what it reads nor what it changes, and runs beside other regions. help: give it `reads` and `effects`: then check can tell whether the regions get in each other's way");
    assert_snapshot!(both("", "requires: [left.outcome = aborted]"), @r#"
    task.yaml:3:47: warning[region-unannotated] in both/left: `both/left` says neither what it reads nor what it changes, and runs beside other regions. help: give it `reads` and `effects`: then check can tell whether the regions get in each other's way
    task.yaml:3:149: error[unservable-flow] in both: `left.outcome` is written inside of this state, which needs it to start. help: take it from a state before this one
    "#);
    assert_snapshot!(both("", "decide: { aborted: left.outcom = aborted }"), @"task.yaml:3:157: error[unknown-port] in both: state `left` has no output port `outcom`. help: there is `found`");
    assert_snapshot!(findings("task: t\nstates:\n  - a: { concurrency: all, regions: [], decide: [a] }\n  - b: { states: [], shared: ['at(?)'] }\n"), @r#"
    task.yaml:3:23: error[invalid-state] in a: `concurrency` is `barrier`, `preemptive`, or how many regions have to succeed
    task.yaml:3:49: error[invalid-state] in a: `decide` is a mapping, found a list. help: write `decide: { failed: left.outcome = aborted }`
    task.yaml:4:30: error[invalid-state] in b: `shared` is what two regions may both touch. help: say it of a region of a `concurrency`
    "#);
}

#[test]
fn scoped_variables_are_bound_assigned_and_told_from_others() {
    let source = format!(
        "
task: t
parameters: {{ most: 2 }}
variables: {{ n: 0 }}
states:
  - part:
      variables: {{ m: $n + $most, near: exists at(cup) }}
      outputs: {{ all: $m }}
      assign: {{ n: all + $m }}
      states:
        - look: {{ {LOOK}, assign: {{ m: $m + found, n: look.found }}, reads: [] }}
"
    );
    let program = program(&source);
    let part = state(&program, "part");
    assert_eq!(bound(&part.variables), "m: $n + $most, near: exists at(cup)");
    assert_eq!(bound(&part.assign), "n: all + $m");
    assert_eq!(bound(&state(&program, "part/look").assign), "m: $m + found, n: found");

    let wrong = |what: &str| {
        let look = format!("{{ {LOOK}, assign: {{ {what} }} }}");
        findings(&format!(
            "task: t\nparameters: {{ most: 2 }}\nvariables: {{ tries: 0 }}\nstates:\n  - for: b in [1]\n    do: [{{ look: {look} }}]\n"
        ))
    };
    assert_snapshot!(wrong("trys: 1"), @"task.yaml:6:81: error[unknown-variable] in for_b/look: there is no scoped variable `trys` around this state. help: did you mean `tries`?");
    assert_snapshot!(wrong("most: 1"), @"task.yaml:6:81: error[unknown-variable] in for_b/look: there is no scoped variable `most` around this state. help: there is `tries`");
    assert_snapshot!(wrong("b: 1"), @"task.yaml:6:81: error[unknown-variable] in for_b/look: there is no scoped variable `b` around this state. help: there is `tries`");
    assert_snapshot!(findings("task: t\nparameters: { n: 1 }\nvariables: { n: 2, 'a b': 4 }\nstates:\n  - { while: false, index: n, do: [] }\n  - a: { states: [], variables: [n] }\n"), @r#"
    task.yaml:3:14: error[duplicate-name]: the variable `$n` exists already around this state. help: give one of both another name
    task.yaml:3:20: error[invalid-name]: `a b` cannot be a variable's name. help: use letters, digits and _, beginning with a letter
    task.yaml:5:14: error[duplicate-name] in while: the variable `$n` exists already around this state. help: give one of both another name
    task.yaml:6:33: error[invalid-state] in a: `variables` is a mapping, found a list. help: write `variables: { tries: 0 }`
    "#);
}

#[test]
fn how_a_state_fails_and_is_tried_again_is_among_its_annotations() {
    let source = format!(
        "
task: t
states:
  - one: {{ {LOOK}, retry: 2, timeout: 5, exceptional: [empty], deterministic: true, transitions: {{ empty: success }} }}
  - two: {{ {LOOK}, retry: {{ count: 1, backoff: 0.5 }}, exceptions: precise, out: {{ found: {{ type: int, default: 7 }} }}, transitions: {{ empty: success }} }}
  - three:
      exceptions: imprecise
      resources: [{{ block: Gripper, hold: true }}]
      states:
        - four: {{ action: eye/look, resources: [{{ block: Gripper, unordered: true }}], transitions: {{ empty: success }} }}
"
    );
    let program = program(&source);
    let annotations = |path: &str| &state(&program, path).annotations;
    let one = annotations("one");
    assert_eq!((one.retry, one.timeout_s), (Some(Retry { count: 2, backoff_s: 0.0 }), Some(5.0)));
    assert_eq!((one.deterministic, one.exceptional.as_slice()), (true, &["empty".to_owned()][..]));
    assert_eq!(one.exceptions, None);
    assert_eq!(annotations("two").retry, Some(Retry { count: 1, backoff_s: 0.5 }));
    assert_eq!(annotations("two").exceptions, Some(Exceptions::Precise));
    assert_eq!(state(&program, "two").defaults["found"].to_string(), "7");
    // Held throughout, it is a routine; what it says of exceptions holds for what it contains.
    assert!(annotations("three").routine);
    assert_eq!(annotations("three/four").exceptions, Some(Exceptions::Imprecise));
    assert!(annotations("three/four").resources[0].unordered && !annotations("one").resources[0].unordered);
}

#[test]
fn numbers_and_words_that_are_none_are_refused() {
    let source = "
task: t
speculation_width: 0
deadline: -1
exceptions: sloppy
outcomes: [success, a b, x, x]
states:
  - a: { action: gripper/release, retry: { backoff: 1 }, timeout: soon, resources: [{ block: Gripper }] }
  - b: { action: gripper/release, retry: 0, deterministic: maybe, resources: [{ consume: Gripper, unordered: true }] }
  - c: { states: [], outputs: { n: { type: int, value: 1, default: many } }, retry: 1 }
";
    assert_snapshot!(findings(source), @r#"
    task.yaml:3:20: error[type-mismatch]: `speculation_width` is a whole number of at least 1
    task.yaml:4:11: error[type-mismatch]: `deadline` is a number of seconds, from 0 to 1000000000
    task.yaml:5:13: error[type-mismatch]: `exceptions` is `precise` or `imprecise`
    task.yaml:6:21: error[invalid-name]: expected an outcome, a name, found text
    task.yaml:8:42: error[type-mismatch] in a: `retry` is a whole number of at least 1
    task.yaml:8:67: error[type-mismatch] in a: `timeout` is a number of seconds, from 0 to 1000000000
    task.yaml:9:42: error[type-mismatch] in b: `retry` is a whole number of at least 1
    task.yaml:9:60: error[type-mismatch] in b: expected true or false, found text
    task.yaml:9:110: error[conflicting-annotations] in b: `unordered` is said of a `block`. help: leave it out: nothing of it is held while the state runs
    task.yaml:10:68: error[type-mismatch] in c: the default of `n` is string, not int
    "#);
}

#[test]
fn a_resource_is_selected_by_attributes_or_by_conditions_on_them() {
    let source = "
task: t
parameters: { load: 2.0 }
states:
  - equal: { action: eye/look, resources: [{ block: Gripper, where: { payload: 3, host: compute } }] }
  - each:
      action: eye/look
      resources: [{ block: Gripper, where: [payload >= $load + 0.5, \"tool in [gripper, welder]\", has camera, host != sim] }]
  - one: { action: eye/look, resources: [{ block: Gripper, where: mass < 4 }] }
";
    let program = program(source);
    let load_of_two = WithVariable { outer: &NothingKnown, name: "load", value: Some(&Value::Int(2)) };
    let bound = |path: &str| state(&program, path).annotations.resources[0].bind(&load_of_two).unwrap().to_string();
    assert_snapshot!(bound("equal"), @"block Gripper host=compute payload=3");
    assert_snapshot!(bound("each"), @"block Gripper (payload >= 2.5) (tool in [gripper, welder]) (has camera) (host != sim)");
    assert_snapshot!(bound("one"), @"block Gripper (mass < 4)");
}

#[test]
fn what_is_no_condition_on_an_attribute_is_refused_with_its_place() {
    for (wrong, column) in [("payload", 66), ("1 < 2", 66), ("a < 1 and b < 2", 66), ("has a b", 70)] {
        let source = format!(
            "task: t\nstates:\n  - a: {{ action: eye/look, resources: [{{ block: Gripper, where: [{wrong}] }}] }}\n"
        );
        let found = findings(&source);
        assert!(found.contains(&format!("task.yaml:3:{column}")), "{found}");
        assert!(found.contains("payload >= 2.5") || wrong == "has a b", "{found}");
    }
    let source = "task: t\nstates:\n  - a: { action: eye/look, resources: [{ block: Gripper }, { create: P, class: task, where: [a < 1] }] }\n";
    assert!(findings(source).contains("what is created is not chosen by conditions"), "{}", findings(source));
}

#[test]
fn waits_and_questions_become_states_that_the_executive_waits_in() {
    use ratn_model::wait::{Question, Wait};
    let source = "
task: t
states:
  - wait: { action: eye/look, resources: [{ block: Gripper }] }
  - wait: { for: open(lid) and level(tank) = 3, timeout: 5 }
    transitions: { timeout: go_on }
  - go: { wait: { signal: go }, transitions: { success: again } }
  - go_on:
      ask: { question: Go on?, choices: [yes, no, later], default: later, timeout: 7 }
      transitions: { no: aborted }
  - again: { wait: { seconds: 2 } }
  - late: { wait: { until: 9.5 }, description: then }
";
    let program = program(source);
    let lid = state(&program, "wait_2");
    let Some(Wait::Condition(condition)) = lid.wait() else { panic!("{:?}", lid.kind) };
    assert_eq!(condition.to_string(), "open(lid) and level(tank) = 3");
    assert_eq!((lid.outcomes.as_slice(), lid.annotations.timeout_s), (&["timeout".to_owned()][..], Some(5.0)));
    let foreseen: Vec<String> = lid.annotations.effects["success"].iter().map(ToString::to_string).collect();
    assert_eq!(foreseen, ["set open(lid) = true", "set level(tank) = 3"]);
    assert!(!state(&program, "wait").is_pause(), "a state that is called so and does something else");
    assert_eq!(state(&program, "go").wait(), Some(Wait::Signal("go")));
    let Some(Wait::Answer(Question { choices, default, .. })) = state(&program, "go_on").wait() else { panic!() };
    assert_eq!((choices, default), (vec!["yes", "no", "later"], Some("later")));
    assert_eq!(
        state(&program, "go_on").outcomes,
        ["no"],
        "only what is connected, and no timeout where there is a default"
    );
    assert!(matches!(state(&program, "again").wait(), Some(Wait::Seconds(_))));
    assert!(matches!(state(&program, "late").wait(), Some(Wait::Until(_))));
}

#[test]
fn what_is_wrong_with_a_wait_is_said() {
    let found = |state: &str| findings(&format!("task: t\nstates:\n  - {state}\n"));
    assert_eq!(found("wait: { for: level(tank) > 3 and open(lid) }"), "", "somebody else says so");
    let wrong = "task: t\nworld: [hand_empty(gripper)]\nstates:\n  - wait: { for: hand_emtpy(gripper) }\n";
    assert!(findings(wrong).contains("did you mean `hand_empty`?"), "{}", findings(wrong));
    assert_snapshot!(found("wait: 5"), @"task.yaml:3:11: error[invalid-state] in wait: `wait` is a mapping, found a number. help: write `wait: { for: door_open(front) }`, or one of `seconds`, `until`, `signal` for `for`");
    assert_snapshot!(found("wait: { for: open(lid), signal: go }"), @"task.yaml:3:11: error[invalid-state] in wait: a state waits by `for` or by `signal`, not by both. help: write `wait: { for: door_open(front) }`, or one of `seconds`, `until`, `signal` for `for`");
    assert_snapshot!(found("wait: { seconds: 3, timeout: 5 }"), @"task.yaml:3:34: error[invalid-state] in wait: a wait for a time is over by itself. help: leave `timeout` out");
    assert_snapshot!(found("ask: { question: Well?, choices: [good, bad], default: god, timeout: 3 }"), @"task.yaml:3:60: error[invalid-state] in ask: the default is none of the choices. help: did you mean `good`?");
    assert_snapshot!(found("ask: { question: Well?, choices: [success] }"), @"task.yaml:3:39: error[invalid-name] in ask: `success` is an outcome of every state or of a wait, and no choice. help: give the choice another name");
    assert_snapshot!(found("ask: { question: Well?, choices: [good], default: good }"), @"task.yaml:3:55: error[invalid-state] in ask: a default without a timeout is never taken. help: add `timeout: …`, in seconds: after it the default is the answer");
}

#[test]
fn a_call_of_a_function_of_the_file_is_what_would_stand_there() {
    let source = "
task: t
functions:
  double($x): 2 * $x
  both($a, $b): double($a) + double($b)
  free($thing): not exists held($thing)
  some($list, $least): len(filter($each in $list, $each > $least)) > 0
  any_at($place): 'exists (at(?thing) = ?where, ?where = $place)'
states:
  - total: { condition: 'both(1, double(3)) = 14', then: [] }
  - held: { condition: free(cup), then: [] }
  - inner: { condition: 'len(filter($each in [1, 2], some([1, 2, 3], $each))) = 2', then: [] }
  - outer: { condition: 'exists (at(?thing) = ?p, any_at(?p))', then: [] }
";
    let program = program(source);
    let predicate = |path: &str| match &state(&program, path).kind {
        StateKind::Condition { predicate, .. } => predicate.clone(),
        _ => panic!("{path} is no condition"),
    };
    assert_eq!(predicate("total").evaluate(&NothingKnown), Ok(Value::Bool(true)));
    assert_eq!(predicate("held").to_string(), "not exists held(cup)");
    // Elements of the function and of its argument are not taken for each other.
    assert_eq!(predicate("inner").evaluate(&NothingKnown), Ok(Value::Bool(true)));
    assert_eq!(predicate("outer").to_string().matches("?thing of any_at").count(), 1);
}

#[test]
fn what_is_wrong_with_a_function_is_said() {
    let found = |function: &str| findings(&format!("task: t\nfunctions:\n  {function}\nstates: []\n"));
    assert_snapshot!(found("near: 3"), @"task.yaml:3:3: error[invalid-state]: `near` is no function with its parameters. help: write `near($a, $b): distance($a, $b) < 0.1` below `functions`");
    assert_snapshot!(found("len($a): 3"), @"task.yaml:3:3: error[invalid-name]: the function `len` is built in. help: give it another name");
    assert_snapshot!(found("f($a, $a): 3"), @"task.yaml:3:3: error[duplicate-name]: `f` has two parameters `$a`. help: rename one of them");
    assert_snapshot!(found("f($a): $b + 1"), @"task.yaml:3:10: error[unknown-variable]: a function sees its own parameters, and `$b` is none of them. help: did you mean `$a`?");
    assert_snapshot!(found("f($a): f($a) + 1"), @"task.yaml:3:10: error[recursive-function]: the function `f` uses itself: f → f. help: say what is done over and over as a loop, or with `map`");
    let twice = "g($x): $x + $x + $x\n  h($x): g(g(g(g(g(g(g($x)))))))";
    assert!(found(twice).contains("more than 2000 parts"), "{}", found(twice));
    let source = "task: t\nfunctions:\n  near($a): $a\nstates:\n  - a: { action: gripper/release, effects: [near(cup)], resources: [{ block: Gripper }] }\n";
    assert_snapshot!(findings(source), @"task.yaml:5:45: error[invalid-expression] in a: `near` is a function of this file, and here a fact is wanted. help: give the function or the fact another name");
    let source = "task: t\nfunctions:\n  near($a, $b): $a\nstates:\n  - a: { condition: near(cup), then: [] }\n";
    assert_snapshot!(findings(source), @"task.yaml:5:21: error[invalid-expression] in a: `near` takes 2 arguments, and is given 1. help: write `near($a, $b)`");
}

/// Random functions that call each other, beside an evaluation that binds values to parameters and knows no text.
mod random_functions {
    use super::{NothingKnown, StateKind, Value, state};
    use std::fmt;

    #[derive(Debug, Clone)]
    enum Term {
        Int(i64),
        Parameter(usize),
        /// The element of the comprehension that many further out.
        Element(usize),
        Add(Box<Term>, Box<Term>),
        Minus(Box<Term>, Box<Term>),
        /// `if(a < b, c, d)`
        If([Box<Term>; 4]),
        /// The sum of the body over `[0, 1, 2]`.
        Sum(Box<Term>),
        Call(usize, Vec<Term>),
    }

    /// A term as text; all comprehensions at one depth name their elements alike, in functions and around calls.
    struct Text<'a>(&'a Term, usize);

    impl fmt::Display for Text<'_> {
        fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
            let depth = self.1;
            let of = |term| Text(term, depth);
            match self.0 {
                Term::Int(n) => write!(f, "({n})"),
                Term::Parameter(n) => write!(f, "$p{n}"),
                Term::Element(outwards) => write!(f, "$e{}", depth - 1 - outwards),
                Term::Add(a, b) => write!(f, "({} + {})", of(a), of(b)),
                Term::Minus(a, b) => write!(f, "({} - {})", of(a), of(b)),
                Term::If([a, b, c, d]) => write!(f, "if({} < {}, {}, {})", of(a), of(b), of(c), of(d)),
                Term::Sum(body) => write!(f, "sum(map($e{depth} in [0, 1, 2], {}))", Text(body, depth + 1)),
                Term::Call(function, arguments) => {
                    let arguments: Vec<String> = arguments.iter().map(|argument| of(argument).to_string()).collect();
                    write!(f, "f{function}({})", arguments.join(", "))
                }
            }
        }
    }

    struct Dice(u64);

    impl Dice {
        fn below(&mut self, bound: u64) -> u64 {
            self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (self.0 >> 33) % bound
        }

        fn term(&mut self, size: u32, parameters: usize, elements: usize, functions: usize) -> Term {
            if size == 0 {
                return match self.below(3) {
                    0 if parameters > 0 => Term::Parameter(self.below(parameters as u64) as usize),
                    1 if elements > 0 => Term::Element(self.below(elements as u64) as usize),
                    _ => Term::Int(self.below(9) as i64 - 4),
                };
            }
            let chosen = self.below(8);
            let mut inner = |elements| Box::new(self.term(size - 1, parameters, elements, functions));
            match chosen {
                0 => Term::If([inner(elements), inner(elements), inner(elements), inner(elements)]),
                1 | 2 => Term::Sum(inner(elements + 1)),
                3 => Term::Minus(inner(elements), inner(elements)),
                4..=6 if functions > 0 => {
                    let function = self.below(functions as u64) as usize;
                    let arguments = (0..2).map(|_| self.term(size - 1, parameters, elements, functions)).collect();
                    Term::Call(function, arguments)
                }
                _ => Term::Add(inner(elements), inner(elements)),
            }
        }
    }

    fn value(term: &Term, functions: &[Term], parameters: &[i64], elements: &[i64]) -> i64 {
        let of = |term: &Term| value(term, functions, parameters, elements);
        match term {
            Term::Int(n) => *n,
            Term::Parameter(n) => parameters[*n],
            Term::Element(outwards) => elements[elements.len() - 1 - outwards],
            Term::Add(a, b) => of(a) + of(b),
            Term::Minus(a, b) => of(a) - of(b),
            Term::If([a, b, c, d]) => {
                if of(a) < of(b) {
                    of(c)
                } else {
                    of(d)
                }
            }
            Term::Sum(body) => (0..3).map(|n| value(body, functions, parameters, &[elements, &[n]].concat())).sum(),
            Term::Call(function, arguments) => {
                let given: Vec<i64> = arguments.iter().map(of).collect();
                value(&functions[*function], functions, &given, &[])
            }
        }
    }

    #[test]
    fn a_call_is_worth_what_the_function_is_with_its_arguments() {
        let mut compared = 0;
        for seed in 0..300 {
            let mut dice = Dice(seed * 7_919 + 1);
            let functions: Vec<Term> = (0..3).map(|number| dice.term(2, 2, 0, number)).collect();
            let asked = dice.term(2, 0, 0, functions.len());
            let wanted = value(&asked, &functions, &[], &[]);
            let defined: Vec<String> = functions
                .iter()
                .enumerate()
                .map(|(number, body)| format!("  f{number}($p0, $p1): '{}'", Text(body, 0)))
                .collect();
            let source = format!(
                "task: t\nfunctions:\n{}\nstates:\n  - a: {{ condition: '{} = {wanted}', then: [] }}\n",
                defined.join("\n"),
                Text(&asked, 0)
            );
            let program = match ratn_model::load::load(&source, "t.yaml", &super::catalogue()) {
                Ok(loaded) => loaded.program,
                // A call that comes to too much is refused, and that is all that is wrong.
                Err(found) => {
                    assert!(
                        found.iter().all(|one| one.message.contains("parts") || one.message.contains("too large")),
                        "{found:?}\n{source}"
                    );
                    continue;
                }
            };
            let StateKind::Condition { predicate, .. } = &state(&program, "a").kind else { panic!("a condition") };
            assert_eq!(predicate.evaluate(&NothingKnown), Ok(Value::Bool(true)), "{source}");
            compared += 1;
        }
        assert!(compared > 200, "only {compared} of 300 are compared");
    }
}

#[test]
fn what_must_hold_meanwhile_and_times() {
    let task = "
task: t
world: [closed(door), closed(lid) = false]
outcomes: [locked]
states:
  - move: { action: gripper/release, pia: true, while: [closed(door), not closed(lid)], effects: { violated: [at(arm) = 0] }, resources: [{ block: Gripper }] }
  - both:
      while: closed(door)
      timeout: 20
      outputs: { n: 1 }
      effects: { success: [done(both)], aborted: [done(none)], violated: [at(arm) = 1] }
      states: [{ step: { states: [] } }]
      transitions: { aborted: success, violated: last }
  - each: { for: i in range(2), timeout: 5, do: [{ step: { states: [] } }], transitions: { aborted: success } }
  - last: { action: gripper/release, while: [closed(door)], resources: [{ block: Gripper }], transitions: { aborted: success } }
";
    let program = program(task);
    let moved = state(&program, "move");
    let shown =
        |all: &[ratn_model::expression::Expr]| all.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ");
    assert_eq!(shown(&moved.annotations.holds), "closed(door), not closed(lid)");
    assert_eq!(transitions(&program, "move"), "violated → (aborted)");
    assert!(program.is_exceptional(moved.id, "violated") && moved.outcomes == ["violated"]);
    // A hierarchy, its watch and its limit race each other.
    let StateKind::Concurrency { regions, preemptive: true, outputs, .. } = &state(&program, "both").kind else {
        panic!()
    };
    let paths: Vec<&str> = regions.iter().map(|id| program.state(*id).path.as_str()).collect();
    assert_eq!(paths, ["both/while", "both/timeout", "both/body"]);
    assert_eq!(outputs.len(), 1);
    assert_eq!(transitions(&program, "both"), "aborted → (success), violated → last");
    let effects = |path: &str| state(&program, path).annotations.effects.keys().cloned().collect::<Vec<_>>().join(" ");
    assert_eq!((effects("both").as_str(), effects("both/body").as_str()), ("aborted success violated", "success"));
    assert!(!program.is_exceptional(state(&program, "both").id, "violated"));
    assert_eq!(state(&program, "both/body").outcomes, Vec::<String>::new());
    assert_eq!(transitions(&program, "last"), "aborted → (success), violated → (success)");
    assert!(state(&program, "each/timeout").is_watch());
}

#[test]
fn conditions_and_times_that_cannot_be_are_refused() {
    let refused = |key: &str| findings(&format!("task: t\nstates:\n  - a: {{ {key} }}\n"));
    let act = "action: gripper/release, resources: [{ block: Gripper }]";
    for (keys, rule) in [
        (format!("{act}, while: []"), "error[invalid-state] in a: nothing has to hold meanwhile"),
        (format!("{act}, while: [1 < 2]"), "error[invalid-state] in a: this condition looks up no fact"),
        (format!("{act}, while: [len(near(x))]"), "error[type-mismatch] in a"),
        ("states: [], timeout: 0".to_owned(), "error[type-mismatch] in a: `timeout` is a number of seconds above 0"),
        ("wait: { seconds: 1 }, while: [p()]".to_owned(), "error[unknown-key] in a"),
        (format!("{act}, transitions: {{ violated: success }}"), "error[unknown-outcome] in a"),
    ] {
        assert!(refused(&keys).contains(rule), "{keys}: {}", refused(&keys));
    }
    let race = "task: t\nstates:\n  - around:\n      variables: { n: 0 }\n      states:\n        - a: { while: [p($n)], states: [{ b: { states: [], assign: { n: 1 } } }] }\n";
    assert!(findings(race).contains("error[region-conflict]"), "{}", findings(race));
}

/// Every state in its place with where it leads.
fn outlined(program: &Program) -> Vec<String> {
    let shown = |state: &State| {
        let kind = match &state.kind {
            StateKind::Condition { predicate, .. } => format!(" if {predicate}"),
            _ => String::new(),
        };
        format!("{}{kind}: {}", state.path, transitions(program, &state.path))
    };
    program.states.iter().skip(1).map(shown).collect()
}

#[test]
fn a_switch_is_conditions_in_each_other() {
    let task = "
task: t
parameters: { kind: { type: string } }
outcomes: [unknown]
states:
  - which:
      switch: $kind
      outcomes: [none]
      cases:
        cup: [{ a: { states: [] } }]
        two words: [{ b: { states: [], transitions: { success: none } } }]
        3: []
      default: [{ c: { states: [], transitions: { success: none } } }]
      transitions: { none: unknown }
  - switch: $kind
    cases: { cup: [{ d: { fallback: [{ e: { states: [] } }] } }] }
";
    assert_eq!(
        outlined(&program(task)),
        [
            "which if $kind = cup: none → (unknown)",
            "which/a: ",
            "which/else if $kind = \"two words\": ",
            "which/else/b: success → (none)",
            "which/else/else if $kind = 3: ",
            "which/else/else/c: success → (none)",
            "condition if $kind = cup: ",
            "condition/d: ",
            "condition/d/e: success → (success)",
        ]
    );
}

#[test]
fn of_a_fallback_each_state_leads_to_the_next_when_it_fails() {
    let act = "action: gripper/release, resources: [{ block: Gripper }]";
    let task = format!(
        "task: t\nworld: [closed(door)]\nstates:\n  - grip:\n      fallback:\n        - first: {{ {act}, while: [closed(door)] }}\n        - \
         second: {{ {act}, transitions: {{ preempted: success }} }}\n        - last: {{ fallback: [{{ only: {{ {act} }} }}] }}\n"
    );
    assert_eq!(
        outlined(&program(&task)),
        [
            "grip: ",
            "grip/first: aborted → grip/second, success → (success), violated → grip/second",
            "grip/second: aborted → grip/last, preempted → (success), success → (success)",
            "grip/last: success → (success)",
            "grip/last/only: success → (success)",
        ]
    );
}

#[test]
fn regions_that_are_alike_differ_in_a_variable() {
    let task = "
task: t
states:
  - both:
      concurrency: barrier
      regions:
        for: which in [left, 2]
        outcomes: [none]
        do:
          - a: { states: [], effects: ['done($which)'] }
";
    let program = program(task);
    assert_eq!(outlined(&program), ["both: ", "both/left: ", "both/left/a: ", "both/which_2: ", "both/which_2/a: "]);
    let effects = |path: &str| {
        let state = program.states.iter().find(|state| state.path == path).unwrap();
        state.annotations.effects["success"].iter().map(ToString::to_string).collect::<Vec<_>>()
    };
    let all = [effects("both/left/a"), effects("both/which_2/a")].concat();
    assert_eq!(all, ["set done(left) = true", "set done(2) = true"]);
}

#[test]
fn switches_and_fallbacks_that_cannot_be_are_refused() {
    for (keys, message) in [
        ("switch: 3, cases: { a: [] }", "a `switch` looks at an expression"),
        ("switch: $x", "a `switch` has 1 to 24 cases"),
        ("switch: $x, cases: {}", "a `switch` has 1 to 24 cases"),
        ("switch: $x, cases: { 'a\"b': [] }", "is no value that a case can be for"),
        ("fallback: []", "there is nothing to try"),
        ("fallback: [{ states: [] }]", "each state of a `fallback` has a name"),
        (
            "fallback: [{ b: { states: [], transitions: { aborted: success } } }]",
            "where `aborted` leads the `fallback` says",
        ),
        ("fallback: 3", "expected a list of states"),
        ("fallback: [{ success: { states: [] } }]", "a state of a `fallback` is not called `success`"),
        (
            "concurrency: barrier, regions: { for: x in $l, do: [] }",
            "regions are a list of states, or `for` a variable",
        ),
        (
            "concurrency: barrier, regions: { for: 'x in []', do: [] }",
            "there are 1 to 64 regions that are alike, and not 0",
        ),
        ("concurrency: barrier, regions: { for: 'x in [a, a]', do: [] }", "`a`"),
        (
            "concurrency: barrier, regions: { for: 'x in [a]', do: [{ for: 'x in [1]', do: [] }] }",
            "another variable inside is called `x`",
        ),
        (
            "concurrency: barrier, regions: { for: 'x in [a]', do: [{ b: { states: [], effects: ['p(len(map($x in [1], $x)))'] } }] }",
            "another variable inside is called `x`",
        ),
        (
            "concurrency: barrier, regions: { for: 'x in [a]', outputs: { y: 'any( $x  in [1], $x = 1)' }, do: [] }",
            "another variable inside is called `x`",
        ),
        ("selector: []", "there is no form `selector`"),
    ] {
        let found = findings(&format!("task: t\nstates:\n  - a: {{ {keys} }}\n"));
        assert!(found.contains(message), "{keys}: {found}");
    }
}
