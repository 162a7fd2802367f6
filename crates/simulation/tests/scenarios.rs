//! One scenario per rule of how instances go from expanded to retired. A transcript is what the environment and the workers
//! see: `seconds  start|end|squash  path`.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may panic")]

use ratn_executive::protocol::{Command, Event, Goal, LogEntry, Mode, Note};
use ratn_model::catalogue::{Catalogue, ResourceOffer};
use ratn_model::fact::{FactKey, Term};
use ratn_model::id::InstanceId;
use ratn_model::pose::Pose;
use ratn_model::resource::{Quantity, ResourceClass};
use ratn_model::tolerance::Tolerance;
use ratn_model::value::Value;
use ratn_simulation::run::{Answer, Oracle, Performance, Run, Setup, run};
use ratn_world::world::World;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

const CATALOGUE: &str = r#"
[resources]
Brain = { class = "process", count = 2 }
Eye = { class = "process", count = 1 }
Arm = { class = "module", count = 1, actuates = true }
Head = { class = "module", count = 1, actuates = true }
WorldModel = { class = "world", count = 8 }
Charge = { class = "module", count = 1, divisible = true, renewable = false }

[providers.brain]
resource = "Brain"
actions.think = { optional = { a = "any", b = "any" }, outputs = { x = "any" } }

[providers.eye]
resource = "Eye"
actions.look = { optional = { a = "any" }, outputs = { x = "any", list = "list<any>" } }

[providers.arm]
resource = "Arm"
actions.move = { optional = { a = "any", b = "any" }, outputs = { x = "any" } }
actions.lift = { outcomes = ["stopped"] }

[providers.head]
resource = "Head"
actions.turn = { optional = { a = "any" }, outputs = { x = "any" } }
"#;

/// Providers that do as they are told, by path; else success after the declared duration with `x = 1`.
#[derive(Default)]
struct Script {
    outputs: BTreeMap<&'static str, Vec<(&'static str, Value)>>,
    outcomes: BTreeMap<&'static str, &'static str>,
    measured: BTreeMap<&'static str, (FactKey, Value)>,
    crashes: BTreeMap<&'static str, u32>,
    worlds: BTreeMap<String, Vec<String>>,
}

impl Oracle for Script {
    fn perform(&mut self, path: &str, attempt: u32, goal: &Goal, world: &World) -> Performance {
        let facts = world.iter().map(|(key, fact)| format!("{key} = {}", fact.value)).collect();
        self.worlds.insert(path.to_owned(), facts);
        let duration_s = goal.expected_s.unwrap_or(1.0);
        if attempt <= self.crashes.get(path).copied().unwrap_or(0) {
            return Performance { duration_s, answer: Answer::Crashed };
        }
        let mut outputs = BTreeMap::from([("x".to_owned(), Value::Int(1)), ("list".to_owned(), Value::List(vec![]))]);
        for (name, value) in self.outputs.get(path).into_iter().flatten() {
            outputs.insert((*name).to_owned(), value.clone());
        }
        let outcome = self.outcomes.get(path).copied().unwrap_or("success").to_owned();
        let measured = self.measured.get(path).cloned().into_iter().collect();
        Performance { duration_s, answer: Answer::Finished { outcome, outputs, measured } }
    }
}

fn simulate(task: &str, mode: Mode, script: &mut Script) -> Run {
    let catalogue = Catalogue::from_toml(CATALOGUE).unwrap();
    let loaded = ratn_model::load::load(task, "task.yaml", &catalogue).unwrap_or_else(|problems| {
        panic!("{}", problems.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n"))
    });
    let parameters = loaded.program.bind_parameters(&[]).unwrap();
    // Of the system's class there is nothing here.
    let there = |offer: &ResourceOffer| match offer.class {
        ResourceClass::System => ResourceOffer { count: Quantity::ZERO, ..offer.clone() },
        _ => offer.clone(),
    };
    let setup = Setup {
        program: Arc::new(loaded.program),
        mode,
        parameters,
        seed: 7,
        resources: catalogue.resources.iter().map(|(kind, offer)| (kind.clone(), there(offer))).collect(),
        world: Vec::new(),
        tolerance: Tolerance::ROBOT,
        latency: Duration::ZERO,
    };
    run(setup, script).unwrap()
}

/// `seconds verb path`, in the order of events.
fn transcript(run: &Run) -> Vec<String> {
    let mut paths: BTreeMap<InstanceId, String> = BTreeMap::new();
    let mut lines = Vec::new();
    for line in &run.log {
        let at = line.at.seconds();
        match &line.entry {
            LogEntry::Command(Command::Note(Note::Expanded { instance, path, .. })) => {
                paths.insert(*instance, path.clone());
            }
            LogEntry::Command(Command::Start { instance, .. }) => lines.push(format!("{at} start {}", paths[instance])),
            LogEntry::Command(Command::Note(Note::Squashed { instance })) => {
                lines.push(format!("{at} squash {}", paths[instance]));
            }
            LogEntry::Event(Event::Finished { instance, .. }) => lines.push(format!("{at} end {}", paths[instance])),
            _ => {}
        }
    }
    lines
}

/// What was computed again: paths and reasons.
fn invalidated(run: &Run) -> Vec<(String, String)> {
    let mut paths = BTreeMap::new();
    let mut again = Vec::new();
    for line in &run.log {
        match &line.entry {
            LogEntry::Command(Command::Note(Note::Expanded { instance, path, .. })) => {
                paths.insert(*instance, path.clone());
            }
            LogEntry::Command(Command::Note(Note::Invalidated { instance, reason })) => {
                again.push((paths[instance].clone(), reason.clone()));
            }
            _ => {}
        }
    }
    again
}

fn at(run: &Run, what: &str) -> f64 {
    transcript(run)
        .iter()
        .find_map(|line| line.split_once(' ').filter(|(_, rest)| *rest == what).map(|(at, _)| at.parse().unwrap()))
        .unwrap_or_else(|| panic!("no `{what}` in {:#?}", transcript(run)))
}

fn never(run: &Run, what: &str) {
    assert!(!transcript(run).iter().any(|line| line.ends_with(what)), "`{what}` in {:#?}", transcript(run));
}

#[test]
fn a_machine_without_annotations_runs_as_its_hsm() {
    let task = "
task: bare
states:
  - a: { action: brain/think, resources: [{ block: Brain }], duration: 2 }
  - b: { action: eye/look, resources: [{ block: Eye }], duration: 3 }
  - c: { action: arm/move, in: { a: b.x }, resources: [{ block: Arm }], duration: 4 }
";
    let (hsm, cdtn) =
        (simulate(task, Mode::Hsm, &mut Script::default()), simulate(task, Mode::Cdtn, &mut Script::default()));
    assert_eq!(transcript(&hsm), transcript(&cdtn));
    assert_eq!(hsm.end_s, 9.0);
}

#[test]
fn a_computing_node_runs_ahead_in_the_world_that_older_effects_will_make() {
    let task = "
task: ahead
world: ['at(box) = table']
states:
  - carry: { action: arm/move, pia: true, effects: ['at(box) = shelf'], resources: [{ block: Arm }], duration: 10 }
  - plan: { action: brain/think, computes: true, reads: ['at(?)'], resources: [{ block: Brain }, world_model], duration: 5 }
  - go: { action: arm/move, in: { a: plan.x }, pia: true, reads: [], effects: [], resources: [{ block: Arm }], duration: 1 }
";
    let mut script = Script::default();
    let run = simulate(task, Mode::Cdtn, &mut script);
    assert_eq!(
        transcript(&run),
        ["0 start carry", "0 start plan", "5 end plan", "10 end carry", "10 start go", "11 end go"]
    );
    assert_eq!(script.worlds["plan"], ["at(box) = shelf"]);
    assert_eq!(script.worlds["carry"], ["at(box) = table"]);
}

#[test]
fn an_effect_that_is_not_known_yet_holds_back_only_what_reads_it() {
    let task = "
task: partly
states:
  - look: { action: eye/look, senses: ['light()'], effects: ['at(box) = x'], resources: [{ block: Eye }], duration: 4 }
  - reader: { action: brain/think, computes: true, reads: ['at(box)'], resources: [{ block: Brain }], duration: 1 }
  - other: { action: brain/think, computes: true, reads: ['at(cup)'], resources: [{ block: Brain }], duration: 1 }
";
    let run = simulate(task, Mode::Cdtn, &mut Script::default());
    assert_eq!((at(&run, "start reader"), at(&run, "start other")), (4.0, 0.0));
}

#[test]
fn of_equally_long_ways_to_the_end_the_older_goes_first() {
    let task = "
task: order
states:
  - first: { action: brain/think, computes: true, reads: [], resources: [{ block: Brain, count: 2 }], duration: 2 }
  - second: { action: brain/think, in: { a: first.x }, computes: true, reads: [], resources: [{ block: Brain, count: 2 }], duration: 2 }
  - third: { action: brain/think, computes: true, reads: [], resources: [{ block: Brain, count: 2 }], duration: 2 }
  - move: { action: arm/move, pia: true, effects: [], resources: [{ block: Arm }], duration: 1 }
";
    let run = simulate(task, Mode::Cdtn, &mut Script::default());
    assert_eq!((at(&run, "start first"), at(&run, "start second"), at(&run, "start third")), (0.0, 2.0, 4.0));
}

#[test]
fn an_effect_that_is_overwritten_later_holds_nobody_back() {
    let task = "
task: overwritten
states:
  - plan: { action: brain/think, computes: true, reads: [], resources: [{ block: Brain }], duration: 9 }
  - carry: { action: arm/move, pia: true, reads: [], effects: ['in_gripper(box) = plan.x'], resources: [{ block: Arm }] }
  - put: { action: arm/move, pia: true, reads: [], effects: ['delete in_gripper(box)'], resources: [{ block: Arm }] }
  - next: { action: brain/think, computes: true, reads: ['in_gripper(?)'], resources: [{ block: Brain }], duration: 1 }
";
    assert_eq!(at(&simulate(task, Mode::Cdtn, &mut Script::default()), "start next"), 0.0);
}

#[test]
fn both_branches_are_computed_ahead_but_only_the_taken_one_acts() {
    let task = "
task: branches
states:
  - look: { action: eye/look, senses: ['light()'], effects: [], resources: [{ block: Eye }], duration: 5 }
  - found:
      condition: look.x = 1
      then:
        - plan_carry: { action: brain/think, computes: true, reads: [], resources: [{ block: Brain }], duration: 3 }
        - carry: { action: arm/move, in: { a: plan_carry.x }, pia: true, effects: [], resources: [{ block: Arm }], duration: 2 }
      else:
        - plan_search: { action: brain/think, computes: true, reads: [], resources: [{ block: Brain }], duration: 3 }
        - search: { action: head/turn, in: { a: plan_search.x }, pia: true, effects: [], resources: [{ block: Head }], duration: 2 }
";
    let run = simulate(task, Mode::Cdtn, &mut Script::default());
    assert_eq!(
        transcript(&run),
        [
            "0 start look",
            "0 start found/plan_carry",
            "0 start found/plan_search",
            "3 end found/plan_carry",
            "3 end found/plan_search",
            "5 end look",
            "5 squash found/plan_search",
            "5 squash found/search",
            "5 start found/carry",
            "7 end found/carry"
        ]
    );
}

#[test]
fn a_running_node_of_the_branch_not_taken_is_cancelled_and_gives_back_what_it_holds() {
    let task = "
task: squashed
states:
  - look: { action: eye/look, senses: ['light()'], effects: [], resources: [{ block: Eye }], duration: 1 }
  - found:
      condition: look.x = 2
      then:
        - think: { action: brain/think, computes: true, reads: [], resources: [{ block: Brain, count: 2 }], duration: 100 }
      else:
        - other: { action: brain/think, computes: true, reads: [], resources: [{ block: Brain, count: 2 }], duration: 1 }
";
    let run = simulate(task, Mode::Cdtn, &mut Script::default());
    assert_eq!((at(&run, "squash found/think"), at(&run, "start found/other"), run.end_s), (1.0, 1.0, 2.0));
    never(&run, "end found/think");
}

#[test]
fn a_sensing_node_looks_before_the_motion_that_would_change_what_it_sees() {
    let task = "
task: look_first
world: ['at(arm) = home']
states:
  - slow: { action: brain/think, computes: true, reads: [], resources: [{ block: Brain }], duration: 3 }
  - move: { action: arm/move, in: { a: slow.x }, pia: true, effects: ['at(arm) = away'], resources: [{ block: Arm }], duration: 4 }
  - back: { action: arm/move, pia: true, effects: ['at(arm) = home'], resources: [{ block: Arm }], duration: 4 }
  - look: { action: eye/look, senses: ['at(arm)'], effects: [], resources: [{ block: Eye }], duration: 5 }
";
    let run = simulate(task, Mode::Cdtn, &mut Script::default());
    // At its place in the program the arm is home again; it is home at the start as well. The motion waits for it.
    assert_eq!((at(&run, "start look"), at(&run, "start move")), (0.0, 5.0));
}

#[test]
fn a_sensing_node_waits_until_the_environment_looks_as_at_its_place_in_the_program() {
    let task = "
task: look_after
world: ['at(arm) = home']
states:
  - move: { action: arm/move, pia: true, effects: ['at(arm) = away'], resources: [{ block: Arm }], duration: 4 }
  - look: { action: eye/look, senses: ['at(arm)'], effects: [], resources: [{ block: Eye }], duration: 5 }
";
    assert_eq!(at(&simulate(task, Mode::Cdtn, &mut Script::default()), "start look"), 4.0);
}

#[test]
fn after_a_failure_nothing_younger_has_acted() {
    let task = "
task: precise
states:
  - first: { action: arm/move, pia: true, effects: ['done(first)'], resources: [{ block: Arm }], duration: 2 }
  - second: { action: head/turn, pia: true, effects: ['done(second)'], resources: [{ block: Head }], duration: 2 }
";
    for mode in [Mode::Hsm, Mode::Cdtn] {
        let mut script = Script { outcomes: BTreeMap::from([("first", "aborted")]), ..Script::default() };
        let run = simulate(task, mode, &mut script);
        assert_eq!(run.outcome, "aborted");
        assert!(run.reason.starts_with("first: "), "{}", run.reason);
        never(&run, "start second");
        assert!(run.world.is_empty());
    }
}

#[test]
fn a_computed_failure_counts_only_when_its_turn_comes() {
    let task = "
task: turn
states:
  - act: { action: arm/move, pia: true, effects: ['done(act)'], resources: [{ block: Arm }], duration: 9 }
  - plan: { action: brain/think, computes: true, reads: [], resources: [{ block: Brain }], duration: 1 }
";
    let mut script = Script { outcomes: BTreeMap::from([("plan", "aborted")]), ..Script::default() };
    let run = simulate(task, Mode::Cdtn, &mut script);
    assert_eq!((run.outcome.as_str(), run.end_s, run.world.len()), ("aborted", 9.0, 1));
}

#[test]
fn a_precondition_that_does_not_hold_ends_the_task_and_says_which() {
    let task = "
task: requires
states:
  - grasp: { action: arm/move, pia: true, effects: [], requires: ['hand_empty(gripper)'], resources: [{ block: Arm }] }
";
    for mode in [Mode::Hsm, Mode::Cdtn] {
        let run = simulate(task, mode, &mut Script::default());
        assert_eq!(run.outcome, "aborted");
        assert!(run.reason.contains("the precondition `hand_empty(gripper)` of grasp does not hold"), "{}", run.reason);
        never(&run, "start grasp");
    }
}

#[test]
fn a_precondition_that_an_older_motion_will_establish_only_holds_back() {
    let task = "
task: established
states:
  - open: { action: arm/move, pia: true, effects: ['hand_empty(gripper)'], resources: [{ block: Arm }], duration: 3 }
  - grasp: { action: arm/move, pia: true, effects: [], requires: ['hand_empty(gripper)'], resources: [{ block: Arm }] }
";
    assert_eq!(at(&simulate(task, Mode::Cdtn, &mut Script::default()), "start grasp"), 3.0);
}

#[test]
fn a_worker_that_dies_costs_an_attempt_not_the_task() {
    let task = "
task: crash
states:
  - plan: { action: brain/think, computes: true, reads: [], resources: [{ block: Brain }], duration: 2 }
  - move: { action: arm/move, in: { a: plan.x }, pia: true, effects: [], resources: [{ block: Arm }], duration: 1 }
";
    for mode in [Mode::Hsm, Mode::Cdtn] {
        let twice = simulate(task, mode, &mut Script { crashes: BTreeMap::from([("plan", 2)]), ..Script::default() });
        assert_eq!((twice.outcome.as_str(), twice.end_s), ("success", 7.0));
        let always = simulate(task, mode, &mut Script { crashes: BTreeMap::from([("plan", 9)]), ..Script::default() });
        assert_eq!(always.outcome, "aborted");
        assert!(always.reason.contains("crashed in attempt 3"), "{}", always.reason);
        let moved = simulate(task, mode, &mut Script { crashes: BTreeMap::from([("move", 1)]), ..Script::default() });
        assert_eq!(moved.outcome, "aborted", "what became of the motion is unknown: it is not started again");
    }
}

#[test]
fn a_routine_holds_what_it_contains_and_runs_it_in_order() {
    let task = "
task: routine
states:
  - both:
      routine: true
      states:
        - turn: { action: head/turn, pia: true, effects: [], resources: [{ block: Head }], duration: 2 }
        - move: { action: arm/move, pia: true, effects: [], resources: [{ block: Arm }], duration: 2 }
  - after: { action: arm/move, pia: true, effects: [], resources: [{ block: Arm }], duration: 1 }
";
    let run = simulate(task, Mode::Cdtn, &mut Script::default());
    let acquired: Vec<usize> = run
        .log
        .iter()
        .filter_map(|line| match &line.entry {
            LogEntry::Command(Command::Acquire { requirements, .. }) => Some(requirements.len()),
            _ => None,
        })
        .collect();
    assert_eq!(acquired, [2, 1]);
    assert_eq!((at(&run, "start both/move"), run.end_s), (2.0, 5.0));
}

#[test]
fn a_hierarchy_s_effects_and_resources_happen_once_at_its_exit() {
    let task = "
task: hierarchy
world: ['count() = 0']
states:
  - group:
      requires: ['count() = 0']
      effects: ['increase count() by 1']
      resources: [{ create: Done, class: task }]
      states:
        - a: { action: arm/move, pia: true, effects: [], resources: [{ block: Arm }], duration: 1 }
        - b: { action: arm/move, pia: true, effects: [], resources: [{ block: Arm }], duration: 1 }
  - last: { action: arm/move, pia: true, effects: [], requires: ['count() = 1'], resources: [{ block: Arm }], duration: 1 }
";
    for mode in [Mode::Hsm, Mode::Cdtn] {
        let run = simulate(task, mode, &mut Script::default());
        assert_eq!((run.outcome.as_str(), run.end_s), ("success", 3.0), "{}", run.reason);
        let operations =
            run.log.iter().filter(|l| matches!(l.entry, LogEntry::Command(Command::Operate { .. }))).count();
        assert_eq!(operations, 1);
    }
}

fn grasp_pose(x: f64) -> (FactKey, Value) {
    let key = FactKey { predicate: "held".to_owned(), arguments: vec![Term::Name("box".to_owned())] };
    (key, Value::Pose(Pose::at(x, 0.0, 0.0)))
}

const MEASURED: &str = "
task: measured
states:
  - grasp: { action: arm/move, pia: true, effects: ['held(box) = pose(0.1, 0, 0)'], resources: [{ block: Arm }], duration: 5 }
  - plan: { action: brain/think, computes: true, reads: ['held(?)'], resources: [{ block: Brain }, world_model], duration: 1 }
";

#[test]
fn a_measured_value_within_tolerance_becomes_the_fact() {
    let mut script = Script { measured: BTreeMap::from([("grasp", grasp_pose(0.105))]), ..Script::default() };
    let run = simulate(MEASURED, Mode::Cdtn, &mut script);
    assert_eq!((run.outcome.as_str(), run.end_s), ("success", 5.0));
    let (key, value) = grasp_pose(0.105);
    assert_eq!(run.world.get(&key), Some(&value));
}

#[test]
fn what_was_made_of_a_prediction_beyond_tolerance_is_computed_again() {
    let mut script = Script { measured: BTreeMap::from([("grasp", grasp_pose(0.3))]), ..Script::default() };
    let run = simulate(MEASURED, Mode::Cdtn, &mut script);
    assert_eq!((run.outcome.as_str(), run.end_s), ("success", 6.0));
    let [(path, reason)] = invalidated(&run).try_into().unwrap();
    assert_eq!(path, "plan");
    assert!(reason.starts_with("held(box) was pose(0.100"), "{reason}");
    assert_eq!(script.worlds["plan"], [format!("held(box) = {}", grasp_pose(0.3).1)]);
    let mut script = Script { measured: BTreeMap::from([("grasp", grasp_pose(0.3))]), ..Script::default() };
    assert_eq!(simulate(MEASURED, Mode::Hsm, &mut script).outcome, "success");
}

#[test]
fn a_measured_fact_that_no_effect_declares_is_an_error() {
    let (mut key, value) = grasp_pose(0.1);
    key.predicate = "elsewhere".to_owned();
    for mode in [Mode::Hsm, Mode::Cdtn] {
        let measured = BTreeMap::from([("grasp", (key.clone(), value.clone()))]);
        let run = simulate(MEASURED, mode, &mut Script { measured, ..Script::default() });
        assert_eq!(run.outcome, "aborted");
        assert!(run.reason.contains("none of its effects"), "{}", run.reason);
    }
}

#[test]
fn a_loop_is_unrolled_once_its_list_is_known_and_no_further_than_the_horizon() {
    let task = "
task: unroll
horizon: 4
states:
  - look: { action: eye/look, senses: ['light()'], effects: [], resources: [{ block: Eye }], duration: 1 }
  - for: item in look.list
    do:
      - think: { action: brain/think, in: { a: $item }, computes: true, reads: [], resources: [{ block: Brain }], duration: 1 }
      - move: { action: arm/move, in: { a: think.x }, pia: true, effects: [], resources: [{ block: Arm }], duration: 1 }
";
    let list = Value::List((0..50).map(Value::Int).collect());
    let mut script = Script { outputs: BTreeMap::from([("look", vec![("list", list)])]), ..Script::default() };
    let run = simulate(task, Mode::Cdtn, &mut script);
    assert_eq!(run.outcome, "success");
    let (mut alive, mut most) = (0_i64, 0);
    for line in &run.log {
        match &line.entry {
            LogEntry::Command(Command::Note(Note::Expanded { .. })) => alive += 1,
            LogEntry::Command(Command::Note(Note::Retired { .. })) => alive -= 1,
            _ => {}
        }
        most = most.max(alive);
    }
    assert_eq!((most, at(&run, "start for_item[0]/think"), run.end_s), (4, 1.0, 52.0));
}

#[test]
fn the_outputs_of_the_task_are_those_of_both_modes() {
    let task = "
task: outputs
outputs: { answer: { type: any, value: group.best } }
states:
  - group:
      outputs: { best: think.x }
      states:
        - think: { action: brain/think, computes: true, reads: [], resources: [{ block: Brain }], duration: 1 }
";
    for mode in [Mode::Hsm, Mode::Cdtn] {
        let run = simulate(task, mode, &mut Script::default());
        assert_eq!(run.outputs, BTreeMap::from([("answer".to_owned(), Value::Int(1))]));
    }
}

#[test]
fn what_was_made_of_a_prediction_through_other_effects_is_computed_again() {
    let grasp = "grasp: { action: arm/move, pia: true, effects: ['held(box) = pose(0.1, 0, 0)'], resources: [{ block: Arm }], duration: 5 }";
    let users = [
        // Through the effect of a node between them.
        "- copy: { action: arm/move, pia: true, effects: ['copied(box) = held(box)'], resources: [{ block: Arm }] }
  - user: { action: brain/think, computes: true, reads: ['copied(?)'], resources: [{ block: Brain }], duration: 1 }",
        // Through the outputs of a hierarchy.
        "- user:
      outputs: { where: held(box) }
      states:
        - think: { action: brain/think, computes: true, reads: [], resources: [{ block: Brain }], duration: 1 }
  - use: { action: brain/think, in: { a: user.where }, computes: true, reads: [], resources: [{ block: Brain }], duration: 1 }",
    ];
    for user in users {
        let task = format!("task: chain\nstates:\n  - {grasp}\n  {user}\n");
        let mut script = Script { measured: BTreeMap::from([("grasp", grasp_pose(0.3))]), ..Script::default() };
        assert_eq!(simulate(&task, Mode::Hsm, &mut script).outcome, "success");
        let run = simulate(&task, Mode::Cdtn, &mut script);
        assert_eq!(run.outcome, "success", "{user}");
        let last = user.lines().last().unwrap().trim().trim_start_matches("- ");
        assert_eq!(invalidated(&run).len(), 1, "{user}");
        assert!(last.starts_with(&invalidated(&run)[0].0), "{user}");
        let mut script = Script { measured: BTreeMap::from([("grasp", grasp_pose(0.105))]), ..Script::default() };
        assert_eq!(simulate(&task, Mode::Cdtn, &mut script).outcome, "success");
    }
}

#[test]
fn a_view_of_a_prediction_that_does_not_come_true_is_looked_at_again() {
    let task = "
task: view
world: ['held(box) = pose(0.1, 0, 0)']
states:
  - slow: { action: brain/think, computes: true, reads: [], resources: [{ block: Brain }], duration: 3 }
  - grasp: { action: arm/move, in: { a: slow.x }, pia: true, effects: ['held(box) = pose(0.1, 0, 0)'], resources: [{ block: Arm }] }
  - look: { action: eye/look, senses: ['held(box)'], effects: [], resources: [{ block: Eye }], duration: 1 }
";
    let mut script = Script { measured: BTreeMap::from([("grasp", grasp_pose(0.3))]), ..Script::default() };
    let run = simulate(task, Mode::Cdtn, &mut script);
    assert_eq!(at(&run, "start look"), 0.0);
    assert_eq!(run.outcome, "success");
    assert_eq!(invalidated(&run)[0].0, "look");
}

#[test]
fn a_deviation_matters_only_on_the_branch_that_is_taken() {
    let task = "
task: untaken
states:
  - look: { action: eye/look, senses: ['light()'], effects: [], resources: [{ block: Eye }], duration: 1 }
  - grasp: { action: arm/move, pia: true, effects: ['held(box) = pose(0.1, 0, 0)'], resources: [{ block: Arm }], duration: 5 }
  - measure: { action: eye/look, senses: ['dark()'], effects: [], resources: [{ block: Eye }], duration: 9 }
  - found:
      condition: measure.x = 2
      then:
        - plan: { action: brain/think, computes: true, reads: ['held(?)'], resources: [{ block: Brain }], duration: 1 }
";
    let mut script = Script { measured: BTreeMap::from([("grasp", grasp_pose(0.3))]), ..Script::default() };
    let run = simulate(task, Mode::Cdtn, &mut script);
    assert_eq!(run.outcome, "success", "{}", run.reason);
}

#[test]
fn stepping_back_from_a_motion_is_not_an_attempt_that_crashed() {
    let motions: String = (0..3)
        .map(|n| {
            format!(
                "  - plan{n}: {{ action: brain/think, computes: true, reads: [], resources: [{{ block: Brain }}], duration: 1 }}
  - go{n}: {{ action: arm/move, in: {{ a: plan{n}.x }}, pia: true, reads: [], effects: ['at(arm) = home'], resources: [{{ block: Arm }}], duration: 1 }}
"
            )
        })
        .collect();
    let task = format!(
        "
task: patient
world: ['at(arm) = home']
states:
{motions}
  - wait: {{ action: brain/think, computes: true, reads: [], resources: [{{ block: Brain }}], duration: 9 }}
  - found:
      condition: wait.x = 1
      then:
        - look: {{ action: eye/look, senses: ['at(arm)'], effects: [], resources: [{{ block: Eye }}], duration: 50 }}
"
    );
    let mut script = Script { crashes: BTreeMap::from([("found/look", 4)]), ..Script::default() };
    let run = simulate(&task, Mode::Cdtn, &mut script);
    assert_eq!(run.outcome, "success", "{} {:#?}", run.reason, transcript(&run));
}

#[test]
fn a_hierarchy_that_was_never_entered_does_not_say_what_its_failure_changes() {
    let task = "
task: outside
world: ['ready() = 0']
states:
  - group:
      requires: ['ready() = 1']
      effects: { aborted: ['broken(group)'] }
      states:
        - a: { action: arm/move, pia: true, effects: [], resources: [{ block: Arm }], duration: 1 }
";
    for mode in [Mode::Hsm, Mode::Cdtn] {
        let run = simulate(task, mode, &mut Script::default());
        assert_eq!(run.outcome, "aborted");
        assert_eq!(run.world.len(), 1, "{mode:?}");
    }
}

#[test]
fn a_routine_that_creates_a_resource_runs_at_its_place_in_the_program() {
    let task = "
task: create
states:
  - first: { action: arm/move, pia: true, effects: [], resources: [{ block: Arm }], duration: 5 }
  - note:
      routine: true
      resources: [{ create: Done, class: task }]
      states:
        - think: { action: brain/think, computes: true, reads: [], resources: [{ block: Brain }], duration: 1 }
";
    for mode in [Mode::Hsm, Mode::Cdtn] {
        let mut script = Script { outcomes: BTreeMap::from([("first", "aborted")]), ..Script::default() };
        let run = simulate(task, mode, &mut script);
        let created = run.log.iter().any(|l| matches!(l.entry, LogEntry::Command(Command::Operate { .. })));
        assert!(!created, "{mode:?}: it came to that only after a state that failed");
    }
}

#[test]
fn a_hierarchy_consumes_at_its_exit_in_both_modes() {
    for routine in [false, true] {
        let task = format!(
            "
task: consume
states:
  - make: {{ action: arm/move, pia: true, effects: [], resources: [{{ block: Arm }}, {{ create: Part, class: task, count: 2 }}] }}
  - group:
      routine: {routine}
      resources: [{{ consume: Part, count: 2 }}]
      states:
        - move: {{ action: arm/move, pia: true, effects: [], resources: [{{ block: Arm }}] }}
  - again: {{ action: arm/move, pia: true, effects: [], resources: [{{ block: Arm }}, {{ create: Part, class: task }}] }}
  - last: {{ action: arm/move, pia: true, effects: [], resources: [{{ block: Arm }}, {{ consume: Part, count: 1 }}] }}
"
        );
        for mode in [Mode::Hsm, Mode::Cdtn] {
            let run = simulate(&task, mode, &mut Script::default());
            assert_eq!((run.outcome.as_str(), run.end_s), ("success", 4.0), "{mode:?} {}", run.reason);
            assert_eq!(run.units.get("Part").copied().unwrap_or_default(), 0, "{mode:?}, routine: {routine}");
        }
    }
}

#[test]
fn parts_of_what_is_divisible_are_used_up_and_held_in_both_modes() {
    let task = "
task: paint
states:
  - mix: { action: arm/move, pia: true, effects: [], resources: [{ block: Arm }, { create: Paint, class: task, count: 2.5, divisible: true }] }
  - dip: { action: arm/move, pia: true, effects: [], resources: [{ block: Arm }, { consume: Paint, count: 0.5 }] }
  - left: { action: brain/think, computes: true, reads: [], resources: [{ block: Brain }, { block: Charge, count: 0.375 }], duration: 4 }
  - right: { action: brain/think, computes: true, reads: [], resources: [{ block: Brain }, { block: Charge, count: 0.375 }], duration: 4 }
  - spill: { action: arm/move, pia: true, effects: [], resources: [{ block: Arm }, { delete: Paint, count: 0.125 }] }
  - dry: { action: arm/move, pia: true, effects: [], resources: [{ block: Arm }, { exists: Paint, count: 1.8 }, { consume: Charge, count: 0.25 }] }
";
    for mode in [Mode::Hsm, Mode::Cdtn] {
        let run = simulate(task, mode, &mut Script::default());
        assert_eq!(run.outcome, "success", "{mode:?} {}", run.reason);
        assert_eq!(run.units["Paint"], Quantity::from_thousandths(1_875), "{mode:?}");
    }
    // Each gets its part of the one unit at once, and the whole of it would not be enough for three.
    let run = simulate(task, Mode::Cdtn, &mut Script::default());
    assert_eq!((at(&run, "start left"), at(&run, "start right")), (0.0, 0.0));
    let third = task.replace("count: 0.375", "count: 0.625");
    let run = simulate(&third, Mode::Cdtn, &mut Script::default());
    assert_eq!((at(&run, "start left"), at(&run, "start right")), (0.0, 4.0));
}

#[test]
fn what_a_routine_creates_is_there_only_after_it() {
    let task = "
task: later
states:
  - group:
      routine: true
      states:
        - make: { action: arm/move, pia: true, effects: [], resources: [{ block: Arm }, { create: Part, class: task }], duration: 4 }
  - use: { action: brain/think, computes: true, reads: [], resources: [{ block: Brain }, { exists: Part }], duration: 1 }
  - other: { action: brain/think, computes: true, reads: [], resources: [{ block: Brain, count: 2 }], duration: 1 }
";
    let run = simulate(task, Mode::Cdtn, &mut Script::default());
    let asked = run
        .log
        .iter()
        .filter(|l| matches!(l.entry, LogEntry::Command(Command::Acquire { .. })))
        .map(|l| l.at.seconds());
    assert_eq!(asked.collect::<Vec<_>>(), [0.0, 0.0, 4.0]);
}

#[test]
fn imprecise_motions_run_beside_younger_ones_that_touch_nothing_of_theirs() {
    let task = "
task: together
states:
  - turn: { action: head/turn, pia: true, reads: [], effects: ['head_at(h) = 1'], exceptions: imprecise, resources: [{ block: Head }], duration: 5 }
  - move: { action: arm/move, pia: true, reads: [], effects: ['arm_at(a) = 1'], resources: [{ block: Arm }], duration: 3 }
  - back: { action: arm/move, pia: true, reads: ['arm_at(a)'], effects: ['arm_at(a) = 2'], resources: [{ block: Arm }], duration: 1 }
  - after: { action: arm/move, pia: true, reads: ['head_at(h)'], effects: ['arm_at(a) = 3'], resources: [{ block: Arm }], duration: 1 }
";
    let run = simulate(task, Mode::Cdtn, &mut Script::default());
    assert_eq!((run.outcome.as_str(), run.end_s), ("success", 6.0));
    for (what, when) in [("start turn", 0.0), ("start move", 0.0), ("start back", 3.0), ("start after", 5.0)] {
        assert_eq!(at(&run, what), when, "{what}");
    }
    let precise = task.replace(" exceptions: imprecise,", "");
    assert_eq!(simulate(&precise, Mode::Cdtn, &mut Script::default()).end_s, 10.0);
    // One that fails does not undo the other.
    let mut script = Script { outcomes: BTreeMap::from([("turn", "aborted")]), ..Script::default() };
    let run = simulate(task, Mode::Cdtn, &mut script);
    assert_eq!(run.outcome, "aborted");
    assert_eq!(at(&run, "end back"), 4.0);
    never(&run, "start after");
}

#[test]
fn regions_run_beside_each_other_and_the_decider_says_how_they_ended() {
    let task = "
task: regions
states:
  - both:
      concurrency: barrier
      regions:
        - turn: { action: head/turn, pia: true, reads: [], effects: ['head_at(h) = 1'], resources: [{ block: Head }], duration: 5 }
        - move: { action: arm/move, pia: true, reads: [], effects: ['arm_at(a) = 1'], resources: [{ block: Arm }], duration: 3 }
      decide: { blind: 'turn.outcome = aborted' }
      transitions: { blind: repair }
  - after: { action: arm/move, pia: true, reads: [], effects: [], resources: [{ block: Arm }], transitions: { success: success } }
  - repair: { action: head/turn, pia: true, reads: [], effects: [], resources: [{ block: Head }], duration: 2 }
";
    for mode in [Mode::Hsm, Mode::Cdtn] {
        let run = simulate(task, mode, &mut Script::default());
        assert_eq!((run.outcome.as_str(), run.end_s), ("success", 6.0));
        never(&run, "start repair");
        let mut script = Script { outcomes: BTreeMap::from([("both/turn", "aborted")]), ..Script::default() };
        let run = simulate(task, mode, &mut script);
        assert_eq!((run.outcome.as_str(), run.end_s, at(&run, "start repair")), ("success", 7.0, 5.0));
        never(&run, "start after");
    }
}

#[test]
fn a_barrier_that_aborts_says_in_both_modes_which_regions_did_and_why() {
    let task = "
task: regions
states:
  - both:
      concurrency: barrier
      regions:
        - look: { action: brain/think, resources: [{ block: Brain }] }
        - turn: { action: head/turn, pia: true, reads: [], effects: [], resources: [{ block: Head }] }
        - move: { action: arm/move, pia: true, reads: [], effects: [], resources: [{ block: Arm }] }
";
    let [hsm, cdtn] = [Mode::Hsm, Mode::Cdtn].map(|mode| {
        let outcomes = BTreeMap::from([("both/look", "aborted"), ("both/turn", "aborted")]);
        let run = simulate(task, mode, &mut Script { outcomes, ..Script::default() });
        assert_eq!(run.outcome, "aborted");
        run.reason
    });
    assert!(hsm.contains("both/look") && hsm.contains("both/turn") && !hsm.contains("both/move"), "{hsm}");
    assert_eq!(hsm, cdtn);
}

#[test]
fn the_first_of_preemptive_regions_stops_the_others() {
    let task = "
task: race
states:
  - race:
      concurrency: preemptive
      regions:
        - turn: { action: head/turn, pia: true, reads: [], effects: ['head_at(h) = 1'], resources: [{ block: Head }], duration: 5 }
        - move: { action: arm/move, pia: true, reads: [], effects: ['arm_at(a) = 1'], resources: [{ block: Arm }], duration: 3 }
  - next: { action: head/turn, pia: true, reads: [], effects: [], resources: [{ block: Head }] }
";
    for mode in [Mode::Hsm, Mode::Cdtn] {
        let run = simulate(task, mode, &mut Script::default());
        assert_eq!((run.outcome.as_str(), run.end_s), ("success", 4.0), "{}", run.reason);
        assert_eq!(run.world.len(), 1, "what was stopped has changed nothing");
        never(&run, "end race/turn");
    }
}

#[test]
fn what_aborts_is_tried_again_after_growing_pauses_and_then_handled() {
    let task = "
task: again
states:
  - grasp: { action: arm/move, pia: true, reads: [], effects: [], resources: [{ block: Arm }], duration: 1, retry: { count: 2, backoff: 0.5 }, transitions: { aborted: give_up } }
  - done: { action: arm/move, pia: true, reads: [], effects: [], resources: [{ block: Arm }], transitions: { success: success } }
  - give_up: { action: head/turn, pia: true, reads: [], effects: [], resources: [{ block: Head }], duration: 1 }
";
    for mode in [Mode::Hsm, Mode::Cdtn] {
        let mut script = Script { outcomes: BTreeMap::from([("grasp", "aborted")]), ..Script::default() };
        let run = simulate(task, mode, &mut script);
        let starts: Vec<String> = transcript(&run).into_iter().filter(|line| line.contains("start")).collect();
        assert_eq!(starts, ["0 start grasp", "1.5 start grasp", "3.5 start grasp", "4.5 start give_up"]);
        assert_eq!(run.outcome, "success");
    }
}

#[test]
fn a_goal_that_takes_too_long_has_aborted_and_so_has_a_task() {
    let task = "
task: late
deadline: 7
states:
  - think: { action: brain/think, computes: true, reads: [], resources: [{ block: Brain }], duration: 10, timeout: 2, transitions: { aborted: act } }
  - act: { action: arm/move, pia: true, reads: [], effects: [], resources: [{ block: Arm }], duration: 9 }
";
    for mode in [Mode::Hsm, Mode::Cdtn] {
        let run = simulate(task, mode, &mut Script::default());
        assert_eq!(at(&run, "start act"), 2.0);
        assert_eq!((run.outcome.as_str(), run.end_s), ("aborted", 7.0));
        assert!(run.reason.contains("deadline"), "{}", run.reason);
    }
}

#[test]
fn the_same_visit_on_two_branches_is_computed_once() {
    let task = "
task: twins
states:
  - look: { action: eye/look, senses: ['light()'], effects: [], resources: [{ block: Eye }], duration: 5 }
  - bright:
      condition: look.x = 1
      then:
        - wave: { action: head/turn, pia: true, reads: [], effects: ['waved()'], resources: [{ block: Head }] }
  - plan: { action: brain/think, computes: true, reads: ['table()'], resources: [{ block: Brain }], duration: 3 }
";
    let run = simulate(task, Mode::Cdtn, &mut Script::default());
    let starts = transcript(&run).into_iter().filter(|line| line.ends_with("start plan")).count();
    assert_eq!((starts, run.end_s), (1, 6.0), "{:#?}", transcript(&run));
    assert!(run.log.iter().any(|l| matches!(l.entry, LogEntry::Command(Command::Note(Note::Reused { .. })))));
}

#[test]
fn what_is_speculative_gives_way_to_what_is_needed() {
    let task = "
task: preempted
states:
  - pick: { action: brain/think, computes: true, reads: [], resources: [{ block: Brain }], duration: 1 }
  - look: { action: eye/look, in: { a: pick.x }, senses: ['light()'], effects: [], resources: [{ block: Eye }], duration: 2 }
  - plan: { action: brain/think, in: { a: look.x }, computes: true, reads: [], resources: [{ block: Brain, count: 2 }], duration: 1 }
  - bright:
      condition: look.x = 2
      then:
        - deep: { action: brain/think, computes: true, reads: [], resources: [{ block: Brain }], duration: 20 }
        - go: { action: arm/move, in: { a: deep.x }, pia: true, reads: [], effects: [], resources: [{ block: Arm }] }
  - end: { action: arm/move, in: { a: plan.x }, pia: true, reads: [], effects: [], resources: [{ block: Arm }] }
";
    let run = simulate(task, Mode::Cdtn, &mut Script::default());
    assert_eq!(at(&run, "start bright/deep"), 0.0);
    // Of two brains the speculative one gives its back.
    assert_eq!((at(&run, "start plan"), run.end_s), (3.0, 5.0), "{:#?}", transcript(&run));
}

#[test]
fn a_loop_that_does_nothing_ends_with_where_it_is_and_one_that_counts_does_not() {
    let task = "
task: circles
variables: { i: 0 }
states:
  - wait: { while: '$i < 3', do: [ nothing: { states: [] } ] }
";
    for mode in [Mode::Hsm, Mode::Cdtn] {
        let run = simulate(task, mode, &mut Script::default());
        assert_eq!(run.outcome, "aborted");
        assert!(run.reason.contains("wait") && run.reason.contains("goes in circles"), "{mode:?}: {}", run.reason);
        assert!(run.log.len() < 500_000, "{mode:?}: {} lines of log", run.log.len());
    }
    let counts = "
task: counts
variables: { i: 0 }
states:
  - count: { while: '$i < 5000', do: [ one: { states: [], assign: { i: '$i + 1' } } ] }
";
    for mode in [Mode::Hsm, Mode::Cdtn] {
        let run = simulate(counts, mode, &mut Script::default());
        assert_eq!((run.outcome.as_str(), run.reason.as_str()), ("success", ""), "{mode:?}");
    }
}

#[test]
fn an_emergency_stop_preempts_whoever_has_no_outcome_of_that_name() {
    let task = "
task: stopped
states:
  - first: { action: arm/move, pia: true, effects: [], resources: [{ block: Arm }], retry: 3 }
  - second: { action: head/turn, pia: true, effects: [], resources: [{ block: Head }] }
";
    for mode in [Mode::Hsm, Mode::Cdtn] {
        let mut script = Script { outcomes: [("first", "stopped")].into(), ..Script::default() };
        let run = simulate(task, mode, &mut script);
        assert_eq!(run.outcome, "preempted");
        let starts: Vec<String> = transcript(&run).into_iter().filter(|line| line.contains("start")).collect();
        assert_eq!(starts, ["0 start first"], "not tried again, and nothing after it");
    }
}

#[test]
fn who_has_an_outcome_stopped_is_asked_where_an_emergency_stop_leads() {
    let task = "
task: stopped
states:
  - first: { action: arm/lift, pia: true, effects: [], resources: [{ block: Arm }], transitions: { success: done, stopped: rest } }
  - rest: { action: head/turn, pia: true, effects: [], resources: [{ block: Head }] }
  - done: { action: head/turn, pia: true, effects: [], resources: [{ block: Head }] }
";
    for mode in [Mode::Hsm, Mode::Cdtn] {
        let mut script = Script { outcomes: [("first", "stopped")].into(), ..Script::default() };
        let run = simulate(task, mode, &mut script);
        assert_eq!(at(&run, "start rest"), 1.0);
    }
}
