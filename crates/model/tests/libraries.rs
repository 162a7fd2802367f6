//! A task file as a state of another.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod support;

use ratn_model::catalogue::Catalogue;
use ratn_model::diagnostic::Diagnostic;
use ratn_model::expression::Expr;
use ratn_model::id::StateId;
use ratn_model::load::{Files, Loaded, load_beginning, load_with};
use ratn_model::program::{StateKind, Target};
use ratn_model::value::Value;
use std::collections::BTreeMap;
use support::unannotated;

/// Files by name.
struct Shelf(BTreeMap<&'static str, &'static str>);

impl Files for Shelf {
    fn read(&self, _: &str, path: &str) -> Result<(String, String), String> {
        let text = self.0.get(path).ok_or("there is no such file")?;
        Ok((path.to_owned(), (*text).to_owned()))
    }
}

const PART: &str = "
task: part
parameters: { times: 2, what: { type: string } }
outcomes: [empty]
outputs: { last: look.pan }
states:
  - look:
      action: pan_tilt/look_at
      in: { target: 'pose(1, 0, 0)' }
      resources: [{ block: PanTilt }]
      transitions: { aborted: give_up }
  - for: i in range($times)
    do:
      - grasp: { action: gripper/grasp, in: { object: $what }, resources: [{ block: Gripper }, { block: Arm }] }
    transitions: { success: success }
  - give_up: { action: gripper/release, resources: [{ block: Gripper }], transitions: { success: empty } }
";

fn load(task: &str, part: &'static str) -> Result<Loaded, String> {
    let shelf = Shelf(BTreeMap::from([
        ("part.yaml", part),
        ("self.yaml", "task: s\nstates:\n  - a: { library: self.yaml }\n"),
    ]));
    load_with(task, "task.yaml", &unannotated(), &shelf)
        .map_err(|findings| findings.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n"))
}

#[test]
fn the_states_of_a_library_stand_below_the_state_that_uses_it() {
    let task = "
task: whole
states:
  - first: { library: part.yaml, with: { what: cup }, transitions: { empty: second } }
  - second: { library: part.yaml, with: { what: bowl, times: 1 }, transitions: { empty: success } }
  - turn: { action: pan_tilt/look_at, in: { target: 'pose(second.last, 0, 0)' }, resources: [{ block: PanTilt }] }
";
    let program = load(task, PART).unwrap().program;
    let paths: Vec<&str> = program.states.iter().map(|state| state.path.as_str()).collect();
    assert!(paths.contains(&"first/look") && paths.contains(&"second/for_i/grasp"), "{paths:?}");
    for (number, state) in program.states.iter().enumerate() {
        assert_eq!(state.id, StateId(number as u64));
        for child in state.children() {
            assert_eq!(program.state(child).parent, Some(state.id), "{}", state.path);
        }
        for target in state.transitions.values() {
            if let Target::State(to) = target {
                assert_eq!(program.state(*to).parent, state.parent, "{}", state.path);
            }
        }
    }
    let second = &program.states[2];
    assert_eq!(second.outcomes, ["empty"]);
    let StateKind::Sequence { outputs, .. } = &second.kind else { panic!("a hierarchy") };
    let Expr::Port { state, port } = &outputs[0].value else { panic!("an output of a state") };
    assert_eq!((program.state(*state).path.as_str(), port.as_str()), ("second/look", "pan"));
    let bound: Vec<_> = second.variables.iter().map(|(name, value)| (name.as_str(), value.clone())).collect();
    let literal = |value| Expr::Literal(value);
    assert_eq!(bound, [("times", literal(Value::Int(1))), ("what", literal(Value::String("bowl".into())))]);
    let other = load(
        task,
        "task: part\nparameters: { times: 2, what: { type: string } }\noutputs: { last: 1 }\noutcomes: [empty]\nstates: []\n",
    );
    assert_ne!(other.unwrap().program.digest, program.digest, "a library's text is part of the task's");
}

#[test]
fn what_is_wrong_in_a_library_is_said_with_its_own_name() {
    let task = "task: t\nstates:\n  - a: { library: part.yaml, with: { what: cup } }\n";
    let refusal =
        load(task, "task: part\nparameters: { what: cup }\nstates:\n  - x: { action: arm/wave }\n").unwrap_err();
    assert!(refusal.contains("part.yaml:4:") && refusal.contains("task.yaml:3:"), "{refusal}");
}

#[test]
fn a_library_that_is_missing_or_uses_itself_or_lacks_a_parameter_is_refused() {
    for (step, said) in [
        ("library: nowhere.yaml", "there is no such file"),
        ("library: self.yaml", "uses itself"),
        ("library: part.yaml", "needs its parameter `what`"),
        ("library: part.yaml, with: { what: cup, time: 3 }", "no parameter `time`"),
    ] {
        let refusal = load(&format!("task: t\nstates:\n  - a: {{ {step} }}\n"), PART).unwrap_err();
        assert!(refusal.contains(said), "{step}: {refusal}");
    }
}

#[test]
fn a_library_has_variables_of_its_own_whatever_they_are_called() {
    let part = "
task: part
parameters: { box: 7 }
variables: { twice: $box * 2 }
states:
  - for: n in range($twice)
    do:
      - grasp:
          action: gripper/grasp
          in: { object: 'concat($box, $n)' }
          effects: [{ for: 'each in [1]', set: 'seen($each, $box)' }]
          resources: [{ block: Gripper }, { block: Arm }]
          assign: { twice: $n }
";
    let task = "
task: whole
parameters: { n: 3 }
variables: { twice: 0 }
states:
  - for: box in range($n)
    do:
      - part: { library: part.yaml, with: { box: $box + $twice } }
";
    let program = load(task, part).unwrap().program;
    let state = |path: &str| program.states.iter().find(|state| state.path == path).unwrap();
    let part = state("for_box/part");
    let bound: Vec<String> = part.variables.iter().map(|(name, value)| format!("{name}: {value}")).collect();
    // What is given is read outside, and so is what begins with it.
    assert_eq!(bound, ["for_box/part/box: $box + $twice", "for_box/part/twice: ($box + $twice) * 2"]);
    let StateKind::ForEach { variable, collection, .. } = &state("for_box/part/for_n").kind else { panic!("a loop") };
    assert_eq!(
        (variable.as_str(), collection.to_string()),
        ("for_box/part/n", "range($for_box/part/twice)".to_owned())
    );
    let grasp = state("for_box/part/for_n/grasp");
    let StateKind::Action { inputs, .. } = &grasp.kind else { panic!("an action") };
    assert_eq!(inputs[0].1.to_string(), "concat($for_box/part/box, $for_box/part/n)");
    assert_eq!(
        (grasp.assign[0].0.as_str(), grasp.assign[0].1.to_string()),
        ("for_box/part/twice", "$for_box/part/n".into())
    );
    let effects = &grasp.annotations.effects["success"];
    assert!(format!("{effects:?}").contains("for_box/part/box") && format!("{effects:?}").contains("\"each\""));
}

#[test]
fn libraries_are_read_once_and_bounded() {
    struct Nested(std::cell::Cell<u32>);
    impl Files for Nested {
        fn read(&self, _: &str, path: &str) -> Result<(String, String), String> {
            self.0.set(self.0.get() + 1);
            let level: u32 = path.trim_end_matches(".yaml").parse().unwrap();
            let uses: String = (0..300).map(|i| format!("  - s{i}: {{ library: {}.yaml }}\n", level + 1)).collect();
            Ok((path.to_owned(), format!("task: t\nstates:\n{uses}")))
        }
    }
    let files = Nested(0.into());
    let refused = load_with("task: t\nstates:\n  - a: { library: 0.yaml }\n", "t.yaml", &unannotated(), &files);
    assert!(refused.unwrap_err().iter().any(|finding| finding.message.contains("at most 8 deep")));
    assert!(files.0.get() < 300 * 10, "{} files were read", files.0.get());
    let many: String = (0..200).map(|i| format!("  - s{i}: {{ library: part.yaml, with: {{ what: x }} }}\n")).collect();
    let wide: String = (0..200).map(|i| format!("  - w{i}: {{ states: [] }}\n")).collect();
    let wide: &'static str =
        Box::leak(format!("task: part\nparameters: {{ what: {{ type: string }} }}\nstates:\n{wide}").into());
    let refusal = load(&format!("task: t\nstates:\n{many}"), wide).unwrap_err();
    assert!(refusal.contains("at most 20000 states of libraries"), "{refusal}");
}

#[test]
fn what_a_library_is_given_is_of_the_type_it_says() {
    let refusal = load("task: t\nstates:\n  - a: { library: part.yaml, with: { what: 3 } }\n", PART).unwrap_err();
    assert!(
        refusal.contains("error[type-mismatch] in a: the library's parameter `what` is string, not int"),
        "{refusal}"
    );
}

#[test]
fn what_depends_on_where_a_library_is_used_is_said_there_and_all_else_once() {
    let part = "
task: part
states:
  - release: { action: gripper/release, requires: [ready(arm)], effects: [], resources: [{ block: Gripper }] }
  - both:
      concurrency: barrier
      regions:
        - arm: { action: arm/move_to, in: { joints: 'joints(0, 0, 0, 0, 0, 0, 0)' }, resources: [{ block: Arm }] }
";
    let task = |world: &str| format!("task: t\n{world}states:\n  - a: {{ library: part.yaml }}\n");
    let warned: Vec<String> =
        load(&task(""), part).unwrap().warnings.iter().map(|w| format!("{} {} {}", w.file, w.path, w.rule)).collect();
    assert_eq!(warned, ["part.yaml both/arm region-unannotated", "task.yaml a/release unestablished-precondition"]);
    let warned: Vec<String> =
        load(&task("world: [ready(arm)]\n"), part).unwrap().warnings.into_iter().map(|w| w.rule).collect();
    assert_eq!(warned, ["region-unannotated"]);
}

#[test]
fn a_variable_of_a_library_has_nothing_to_do_with_the_task_s_parameter_of_that_name() {
    let task = "task: t\nparameters: { what: 3 }\nstates:\n  - a: { library: part.yaml, with: { what: 'concat(cup, $what)' } }\n";
    assert!(load(task, PART).is_ok());
}

#[test]
fn what_of_a_library_is_not_applied_is_said_where_it_is_used() {
    let part = "
task: part
deadline: 5
world: [ready(arm)]
outputs: { n: { type: int, value: 1, default: 0 } }
states: []
";
    let loaded = load("task: t\nstates:\n  - a: { library: part.yaml }\n", part).unwrap();
    let warned: Vec<String> = loaded.warnings.iter().map(|w| format!("{} {} {}", w.file, w.path, w.message)).collect();
    assert_eq!(
        warned,
        ["world", "deadline"]
            .map(|key| format!("task.yaml a the `{key}` of `part.yaml` counts only where that is run by itself"))
    );
    assert!(loaded.program.initial.is_empty() && loaded.program.deadline_s.is_none());
    assert_eq!(loaded.program.states[1].defaults["n"], Value::Int(0));
}

#[test]
fn what_a_library_is_given_is_a_mapping() {
    let refusal = load("task: t\nstates:\n  - a: { library: part.yaml, with: 3 }\n", PART).unwrap_err();
    assert!(refusal.contains("error[invalid-state] in a: `with` is a mapping, found a number"), "{refusal}");
}

#[test]
fn a_run_may_begin_at_a_state_in_the_middle_in_the_world_as_it_is() {
    let task = "
task: t
world: [lit(lamp)]
states:
  - first: { action: gripper/release, resources: [{ block: Gripper }] }
  - begin: { action: pan_tilt/look_at, in: { target: 'pose(0.80, 0, 0.70)' }, resources: [{ block: PanTilt }] }
  - any: { condition: begin.pan > 0, then: [] }
  - last: { states: [] }
";
    let begins = |from: &str| {
        let loaded = load_beginning(task, "t.yaml", &Catalogue::standard(), &Shelf(BTreeMap::new()), Some(from));
        loaded.map(|loaded| loaded.program).map_err(|findings| findings[0].to_string())
    };
    let program = begins("begin").unwrap();
    assert!(program.initial.is_empty());
    let paths: Vec<&str> = program.states.iter().skip(1).map(|state| state.path.as_str()).collect();
    assert_eq!(paths[..2], ["begin_2", "first"]);
    assert!(begins("any").unwrap_err().contains("`begin.pan` is not there: the run begins behind `begin`"));
    assert!(begins("lst").unwrap_err().contains("no state `lst` in its own list"));
    assert_ne!(begins("begin").unwrap().digest, begins("last").unwrap().digest);
}

#[test]
fn a_run_may_begin_inside_of_a_state_that_is_begun_once_and_in_one_way() {
    let task = "
task: t
states:
  - look: { states: [] }
  - cups:
      states:
        - find: { states: [] }
        - begin:
            states:
              - open: { states: [] }
              - close: { states: [] }
        - again: { retry: { times: 2 }, states: [pick: { states: [] }] }
        - each: { for: 'n in [1, 2]', do: [fill: { states: [] }] }
        - full: { condition: lit(lamp), then: [put: { states: [] }] }
        - both: { concurrency: barrier, regions: [left: { states: [wash: { states: [] }] }] }
        - part: { library: part.yaml, with: { what: cup } }
  - bowls: { states: [stack: { states: [] }] }
  - back: { condition: lit(lamp), then: [], else: [], outcomes: [more], transitions: { more: bowls } }
";
    let begins = |from: &str| {
        let shelf = Shelf([("part.yaml", PART)].into());
        let loaded = load_beginning(task, "t.yaml", &Catalogue::standard(), &shelf, Some(from));
        let texts = |findings: Vec<Diagnostic>| findings.iter().map(ToString::to_string).collect::<String>();
        loaded.map(|loaded| loaded.program).map_err(texts)
    };
    let program = begins("cups/begin/close").unwrap();
    let added = program.states.iter().filter(|state| state.name == "begin_2");
    let added: Vec<&str> = added.map(|state| state.path.as_str()).collect();
    assert_eq!(added, ["begin_2", "cups/begin_2", "cups/begin/begin_2"]);
    for (from, why) in [
        ("cups/again/pick", "inside of `cups/again`: it is retried from its own beginning"),
        ("cups/each/fill", "it is a loop, and which pass is meant is not said"),
        ("cups/full/put", "only its condition says which way it goes"),
        ("cups/both/left/wash", "its regions begin all at once"),
        ("cups/part/a", "what it does stands in another file"),
        ("cups/find/a", "`cups/find` has no state `a` in its own list"),
        ("bowls/stack", "a transition leads back to it or before it"),
        ("cups/lst", "`cups` has no state `lst` in its own list"),
    ] {
        let refusal = begins(from).unwrap_err();
        assert!(refusal.contains(why), "{from}: {refusal}");
    }
}
