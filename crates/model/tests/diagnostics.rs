//! What the findings of a task file say, and that no text makes the loader panic.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may panic")]

mod support;

use insta::assert_snapshot;
use proptest::prelude::*;
use ratn_model::catalogue::Catalogue;
use ratn_model::load::load;
use ratn_model::program::{Nature, Program, StateKind};
use support::unannotated;

const FETCH: &str = include_str!("../../../examples/fetch_boxes.yaml");

/// Everything that is found in a task file, one line each; `fine` for nothing.
fn check(source: &str) -> String {
    let findings = match load(source, "task.yaml", &unannotated()) {
        Ok(loaded) => loaded.warnings,
        Err(findings) => findings,
    };
    if findings.is_empty() {
        return "fine".to_owned();
    }
    findings.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n")
}

fn program(source: &str) -> Program {
    match load(source, "task.yaml", &unannotated()) {
        Ok(loaded) => loaded.program,
        Err(findings) => panic!("{}", findings[0]),
    }
}

/// A task of these states, each line indented as it is.
fn task(states: &str) -> String {
    format!("task: t\nstates:\n{states}")
}

const PLAN: &str = "  - plan: { action: path_planner/plan, in: { start: 'joints(0,0,0,0,0,0,0)', goal: 'pose(1,0,1)' }, computes: true, resources: [{block: PathPlanner}, world_model] }\n";

#[test]
fn a_misspelt_port_is_found_where_it_stands() {
    let follow = "  - go: { action: arm/follow, in: { trajectory: plan.trajektory }, resources: [{block: Arm}] }\n";
    assert_snapshot!(check(&task(&format!("{PLAN}{follow}"))), @"task.yaml:4:49: error[unknown-port] in go: state `plan` has no output port `trajektory`. help: did you mean `trajectory`?");
}

#[test]
fn regions_that_may_mean_one_resource_by_two_kinds_of_the_hierarchy_are_refused() {
    let drop = "{ states: [], resources: [{ delete: SmallPen, class: task }] }";
    let look = "{ states: [], resources: [{ exists: Pen, class: task }] }";
    let regions = format!("      regions:\n        - drop: {drop}\n        - look: {look}\n");
    let source = task(&format!("  - both:\n      concurrency: barrier\n{regions}"));
    let is_refused = |kinds: &[(&str, &str)]| {
        let kinds = kinds.iter().map(|(kind, above)| ((*kind).to_owned(), vec![(*above).to_owned()])).collect();
        let findings = load(&source, "task.yaml", &Catalogue { kinds, ..unannotated() }).err().unwrap_or_default();
        findings.iter().any(|finding| finding.rule == "region-conflict")
    };
    assert!(!is_refused(&[]) && !is_refused(&[("SmallPen", "Small")]));
    assert!(is_refused(&[("SmallPen", "Pen")]) && is_refused(&[("SmallPen", "Small"), ("Pen", "Small")]));
}

#[test]
fn an_error_inside_a_quoted_expression_has_its_own_column() {
    let look = "  - look: { action: pan_tilt/look_at, in: { target: \"pose(1, 2, $heigth)\" }, resources: [{block: PanTilt}] }\n";
    let source = format!("task: t\nparameters: {{height: 1.0}}\nstates:\n{look}");
    assert_snapshot!(check(&source), @"task.yaml:4:65: error[unknown-variable] in look: there is no variable `$heigth` here. help: did you mean `$height`?");
}

#[test]
fn an_expression_that_a_comma_cut_off_wants_quotes() {
    let look = "  - look: { action: pan_tilt/look_at, in: { target: pose(1, 2, 3) }, resources: [{block: PanTilt}] }\n";
    assert!(check(&task(look)).contains("help: quote it"), "{}", check(&task(look)));
}

#[test]
fn of_joints_of_the_wrong_number_in_the_default_of_a_parameter_it_is_warned() {
    let check_with = |default: &str, states: &str| {
        let parameters =
            "home: { type: joints, default: \"DEFAULT\" }, all: { type: list<joints>, default: \"[DEFAULT]\" }";
        let parameters = parameters.replace("DEFAULT", default);
        let states = states.replace("GO", "action: arm/move_to, resources: [{block: Arm}]");
        check(&format!("task: t\nparameters: {{ {parameters} }}\nstates:\n{states}\n"))
    };
    let (six, seven) = ("joints(0, 0, 0, 0, 0, 0)", "joints(0, 0, 0, 0, 0, 0, 0)");
    for input in ["$home", "$all[0]"] {
        let go = format!("  - go: {{ GO, in: {{ joints: \"{input}\" }} }}");
        let told = check_with(six, &go);
        let words = format!(
            "warning[invalid-constant] in go: `{input}`, with what parameters are by default: `arm` has 7 joints, and these are the \
             positions of 6. help: write a default that fits, or give the run another value (`--set`)"
        );
        assert!(told.lines().count() == 1 && told.ends_with(&words), "{told}");
        assert_eq!(check_with(seven, &go), "fine");
    }
    // It is another variable.
    let looped = format!("  - for: home in [\"{seven}\"]\n    do:\n      - go: {{ GO, in: {{ joints: $home }} }}");
    assert!(!check_with(six, &looped).contains("joints, and these"), "{}", check_with(six, &looped));
    // It may be another value by then.
    let assigned = format!(
        "  - get: {{ GO, in: {{ joints: \"{seven}\" }}, assign: {{ home: end }} }}\n  - go: {{ GO, in: {{ joints: $home }} }}"
    );
    assert!(!check_with(six, &assigned).contains("joints, and these"), "{}", check_with(six, &assigned));
}

#[test]
fn what_is_created_over_and_over_is_enough_for_any_number() {
    let make = "{ action: gripper/release, resources: [Gripper, { create: Token, class: task }] }";
    let wanted = "  - use: { action: gripper/release, resources: [Gripper, { consume: Token, count: 3 }] }\n";
    let over_and_over = format!("  - for: n in [1, 2, 3]\n    do:\n      - make: {make}\n{wanted}");
    assert!(!check(&task(&over_and_over)).contains("too-many-resources"), "{}", check(&task(&over_and_over)));
    let twice = format!("  - make: {make}\n  - again: {make}\n{wanted}");
    assert!(check(&task(&twice)).contains("the task creates at most 2"), "{}", check(&task(&twice)));
}

#[test]
fn a_cycle_of_flows_is_told_from_a_wrong_order() {
    assert_snapshot!(check(include_str!("../../../tests/bad-tasks/unservable-flow.yaml")), @"task.yaml:5:39: error[unservable-flow] in move: `plan.trajectory` is written by `plan`, which comes later. help: move `plan` before `move`");
    assert_snapshot!(check(include_str!("../../../tests/bad-tasks/unservable-flow-cycle.yaml")), @"task.yaml:7:13: error[unservable-flow] in there: `back.end` is written by `back`, which comes later. help: each waits for the next: there → back → there; break the cycle");
}

#[test]
fn several_findings_come_in_the_order_of_the_file() {
    let source = "
task: t
colour: blue
parameters: { n: { type: int, default: three } }
states:
  - plan: { action: path_planner/plam, resources: [{ block: PathPlaner }] }
  - while: true
  - release: { action: gripper/release, attempts: 0, duration: at(x), resources: [{ block: Gripper, count: x }] }
  - 3
";
    assert_snapshot!(check(source), @r#"
    task.yaml:3:1: error[unknown-key]: there is no key `colour` here. help: there is `deadline`, `description`, `exceptions`, `functions`, `horizon`, `ontology`, `outcomes`, `outputs`, `parameters`, `speculation_width`, `states`, `task`, `tolerance`, `variables`, `world`
    task.yaml:4:40: error[type-mismatch]: the default of `n` is string, not int
    task.yaml:7:5: error[invalid-state] in while: there is no `do`. help: list its states there
    task.yaml:8:51: error[type-mismatch] in release: `attempts` is a whole number of at least 1
    task.yaml:8:64: error[invalid-expression] in release: an estimated duration cannot look up facts. help: use a parameter
    task.yaml:8:108: error[type-mismatch] in release: `count` is a number, found text. help: write an amount such as 2 or 0.5
    task.yaml:9:5: error[invalid-state]: expected `name: {…}`, found a number. help: each state is one list item `- name: {…}`; mind the indentation of what belongs to it
    "#);
}

#[test]
fn rules_of_a_program_that_reads_are_applied_together() {
    let source = "
task: t
world: []
states:
  - plan: { action: path_planner/plam, resources: [{ block: PathPlaner }] }
  - look:
      action: pan_tilt/look_at
      in: { goal: 3, target: 1 + 1 }
      senses: [at(cup)]
      requires: [lit(room), 1 + 1]
      effects: { done: [] }
      resources: [{ block: PanTilt, count: 2 }, { consume: Battery }]
  - far:
      condition: 3
      then: []
      else: []
";
    assert_snapshot!(check(source), @r#"
    task.yaml:5:21: error[unknown-action] in plan: `path_planner` has no action `plam`. help: did you mean `plan`?
    task.yaml:5:21: error[provider-not-blocked] in plan: an action of `path_planner` needs the resource `PathPlanner`, which this state does not block. help: add `resources: [{block: PathPlanner}]`
    task.yaml:5:52: error[unknown-resource] in plan: no template or module of the system provides `PathPlaner`. help: did you mean `PathPlanner`?
    task.yaml:8:13: error[unknown-port] in look: `pan_tilt/look_at` has no input port `goal`. help: there is `target`
    task.yaml:8:22: error[type-mismatch] in look: `target` is pose; `1 + 1` is int
    task.yaml:10:29: error[type-mismatch] in look: `requires` is bool; `1 + 1` is int
    task.yaml:11:18: error[unknown-outcome] in look: this state has no outcome `done`. help: there is `aborted`, `preempted`, `success`
    task.yaml:12:19: error[too-many-resources] in look: this asks for 2 of `PanTilt` at once; the system can have 1. help: ask for fewer, or offer more
    task.yaml:12:19: error[computes-actuates] in look: a state that senses cannot block `PanTilt`, which moves the robot. help: make it a PIA (`pia: true`), or leave the resource out
    task.yaml:12:49: error[computes-actuates] in look: a state that senses cannot consume `Battery`. help: make it a PIA (`pia: true`), or leave the resource out
    task.yaml:14:18: error[type-mismatch] in far: `condition` is bool; `3` is int
    "#);
}

#[test]
fn a_precondition_that_nothing_establishes_is_a_warning_when_the_world_is_not_declared() {
    let release = "  - release: { action: gripper/release, requires: [hand_full(gripper)], effects: [], resources: [{block: Gripper}] }\n";
    assert_snapshot!(check(&task(release)), @"task.yaml:3:52: warning[unestablished-precondition] in release: `hand_full(gripper)` is required, and nothing before establishes `hand_full(gripper)`. help: say in the task's `world` what holds at the start");
    // An older state without declared effects may have established anything.
    let first = "  - first: { action: gripper/release, resources: [{block: Gripper}] }\n";
    assert_eq!(check(&task(&format!("{first}{release}"))), "fine");
}

#[test]
fn what_would_end_at_once_or_decide_by_no_boolean_is_refused() {
    let source = "
task: t
deadline: 0
states:
  - release: { action: gripper/release, timeout: 0, resources: [{ block: Gripper }] }
";
    assert_snapshot!(check(source), @r#"
    task.yaml:3:11: error[type-mismatch]: `deadline` is a number of seconds above 0. help: leave it out
    task.yaml:5:50: error[type-mismatch] in release: `timeout` is a number of seconds above 0. help: leave it out
    "#);
    let source = "
task: t
variables: { n: 0 }
states:
  - again:
      while: $round + 1
      index: round
      do: []
  - both:
      concurrency: barrier
      regions: []
      decide: { failed: 1 + 1 }
";
    assert_snapshot!(check(source), @r#"
    task.yaml:6:14: error[type-mismatch] in again: `while` is bool; `$round + 1` is int
    task.yaml:12:17: error[type-mismatch] in both: `decide` is bool; `1 + 1` is int
    "#);
}

#[test]
fn what_a_later_state_establishes_holds_where_control_flow_leads_back() {
    let source = "
task: t
world: []
variables: { n: 0 }
states:
  - ready:
      condition: $n > 0
      then:
        - open: { action: gripper/release, requires: [held(cup)], effects: [], resources: [{ block: Gripper }] }
  - grasp:
      action: gripper/grasp
      in: { object: cup }
      effects: [held(cup)]
      resources: [{ block: Gripper }, { block: Arm }]
      assign: { n: $n + 1 }
";
    let forwards = check(source);
    assert_snapshot!(forwards, @"task.yaml:9:55: error[unestablished-precondition] in ready/open: `held(cup)` is required, and nothing before establishes `held(cup)`. help: add it to the `world` of the task, or to the effects of an older state");
    assert_eq!(check(&format!("{source}      transitions: {{ success: ready, aborted: success }}\n")), "fine");
}

#[test]
fn what_is_no_yaml_is_said_with_its_place() {
    assert_snapshot!(check("task: t\nstates: [\n"), @"task.yaml:2:9: error[invalid-yaml]: unclosed bracket '['");
    assert_snapshot!(check("task: t\ntask: u\n"), @"task.yaml:2:1: error[invalid-yaml]: duplicate mapping key: task");
    assert_snapshot!(check("- task\n"), @"task.yaml:1:1: error[invalid-yaml]: a task file is a mapping, found a list. help: begin it with `task: name`");
    assert_snapshot!(check(""), @"task.yaml:1:1: error[invalid-yaml]: a task file is a mapping, found nothing. help: begin it with `task: name`");
}

#[test]
fn hierarchies_loops_and_conditions_see_what_they_should() {
    let source = "
task: t
world: ['arm_at(arm) = joints(0, 0, 0, 0, 0, 0, 0)']
states:
  - look:
      action: detector/segment
      in: { region: { pose: 'pose(1, 0, 1)', size: [1, 1] } }
      out: { boxes }
      senses: ['at(?)']
      effects: [{ for: b in boxes, set: 'at($b.id) = $b.pose' }]
      resources: [{ block: Detector }, { block: Camera }]
  - each:
      for: box in look.boxes
      index: i
      do:
        - think:
            outputs: { way: plan.trajectory }
            resources: [{ block: PathPlanner }]
            states:
              - plan:
                  action: path_planner/plan
                  in: { start: arm_at(arm), goal: grasp_pose($box), budget_s: null }
                  computes: true
                  reads: [scene]
                  resources: [world_model]
        - near:
            condition: $i < 2 and not exists in_gripper(?)
            then:
              - go: { action: arm/follow, in: { trajectory: think.way }, resources: [{ block: Arm }] }
            else: []
";
    assert_eq!(check(source), "fine");
    let program = program(source);
    let paths: Vec<&str> = program.states.iter().map(|s| s.path.as_str()).collect();
    assert_eq!(paths, ["", "look", "each", "each/think", "each/think/plan", "each/near", "each/near/go"]);
    let state = |path: &str| program.states.iter().find(|s| s.path == path).unwrap();
    let reads = |path: &str| {
        let reads = state(path).annotations.reads.as_ref();
        reads.map(|facts| facts.iter().map(ToString::to_string).collect::<Vec<_>>().join(" "))
    };
    assert_eq!(reads("each/think/plan").as_deref(), Some("at(?) shape(?) in_gripper(?) in_gripper(?, ?) on(?, ?)"));
    assert_eq!(reads("each/near").as_deref(), Some(""));
    assert_eq!(reads("each/near/go"), None);
    assert_eq!(
        state("look").annotations.nature,
        Nature::Senses(vec![ratn_model::expression::FactExpr { predicate: "at".into(), arguments: vec![None] }])
    );
    assert!(state("each/near/go").annotations.effects.is_empty());
    assert_eq!(state("each/think/plan").annotations.effects.values().flatten().count(), 0);
    let StateKind::Action { inputs, .. } = &state("each/near/go").kind else { panic!("an action") };
    assert_eq!(inputs[0].1.flows().into_iter().collect::<Vec<_>>(), [state("each/think").id]);
}

#[test]
fn a_program_survives_json() {
    let program = load(FETCH, "task.yaml", &Catalogue::standard()).unwrap().program;
    let json = serde_json::to_string(&program).unwrap();
    assert_eq!(serde_json::from_str::<Program>(&json).unwrap(), program);
}

#[test]
fn parameters_are_read_by_their_type() {
    let program = program(
        "task: t\nparameters: {n: 3, far: 1.5, slow: false, who: {type: string}, goal: {type: pose, default: 'pose(0,0,1)'}}\nstates: []\n",
    );
    let bind = |set: &[(&str, &str)]| {
        let set: Vec<_> = set.iter().map(|(n, v)| ((*n).to_owned(), (*v).to_owned())).collect();
        match program.bind_parameters(&set) {
            Ok(values) => values.iter().map(|(n, v)| format!("{n}={v}")).collect::<Vec<_>>().join(" "),
            Err(error) => error.to_string(),
        }
    };
    assert_snapshot!(bind(&[("who", "a b"), ("n", "-2"), ("far", "2")]), @"far=2 goal=pose(0.000, 0.000, 1.000; 0.000, 0.000, 0.000, 1.000) n=-2 slow=false who=a b");
    assert_snapshot!(bind(&[]), @"task `t` needs parameter `who` (string): set it with `--set who=…`");
    assert_snapshot!(bind(&[("who", "x"), ("n", "2.5")]), @"parameter `n` is int; `2.5` is none");
    assert_snapshot!(bind(&[("who", "x"), ("m", "1")]), @"task `t` has no parameter `m`: did you mean `n`?");
    assert_snapshot!(bind(&[("who", "x"), ("who", "y")]), @"parameter `who` is set twice");
    assert_snapshot!(bind(&[("who", "x"), ("goal", "pose(1)")]), @"parameter `goal` is pose; `pose(1)` is none");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(256))]

    #[test]
    fn no_text_makes_the_loader_panic(text in "(task|states|do|for|in|x|: |- |\n|\n  |\n    |\\{|\\}|\\[|\\]|, |\"|'|\\$|#|&a |\\*a|\\?|PathPlanner|[a-z]{1,3}|[0-9]){0,60}") {
        let _ = check(&text);
    }

    #[test]
    fn no_damage_to_a_real_task_makes_the_loader_panic(
        at in 0..FETCH.len(), length in 0..200_usize, inserted in "\\PC{0,8}|[ \\n\\[\\]{}:,?*&'\"$()-]{0,6}"
    ) {
        let clip = |mut i: usize| { while !FETCH.is_char_boundary(i) { i -= 1; } i };
        let (from, to) = (clip(at), clip((at + length).min(FETCH.len())));
        let damaged = format!("{}{inserted}{}", &FETCH[..from], &FETCH[to..]);
        let _ = load(&damaged, "task.yaml", &Catalogue::standard());
    }
}

#[test]
fn where_the_system_has_no_world_model_a_state_that_reads_facts_is_told_that_it_is_for_these() {
    let mut catalogue = unannotated();
    catalogue.resources.remove("WorldModel");
    let task = |reads: &str| {
        format!(
            "task: t\nstates:\n  - plan: {{ action: path_planner/plan, computes: true,{reads} resources: [PathPlanner] }}\n"
        )
    };
    let found = |reads: &str| {
        let findings = load(&task(reads), "task.yaml", &catalogue).err().unwrap_or_default();
        findings.iter().map(ToString::to_string).filter(|one| one.contains("unknown-resource")).collect::<Vec<_>>()
    };
    let [told] = &found("")[..] else { panic!("{:?}", found("")) };
    assert!(told.contains("the state reads facts") && told.contains("`reads: []`"), "{told}");
    assert_eq!(found(" reads: [],"), [""; 0]);
}
