//! HSM mode: the sequential interpreter over every element of a task program, in virtual time. A transcript is what the
//! providers see, `seconds start path`; the provider `note` writes down what it is told, which shows what a state has read.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may panic")]

use ratn_executive::executive::Executive;
use ratn_executive::protocol::{Command, Event, Goal, Learned, LogEntry, Mode, Note, Origin};
use ratn_model::catalogue::Catalogue;
use ratn_model::expression::Expr;
use ratn_model::fact::{FactKey, Term};
use ratn_model::id::{FencingToken, InstanceId, LeaseId, Revision};
use ratn_model::measurement::{Certainty, Measurement};
use ratn_model::program::{Program, StateKind, Target};
use ratn_model::resource::Lease;
use ratn_model::time::Timestamp;
use ratn_model::tolerance::Tolerance;
use ratn_model::value::Value;
use ratn_simulation::run::{Answer, Oracle, Performance, Run, Setup, run};
use ratn_world::world::World;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

const CATALOGUE: &str = r#"
[resources]
Brain = { class = "process", count = 4 }
Arm = { class = "module", count = 1, actuates = true }
Head = { class = "module", count = 1, actuates = true }
Pen = { class = "process", count = 4 }

[providers.brain]
resource = "Brain"
actions.think = { optional = { a = "any" }, outputs = { x = "any" }, outcomes = ["empty"] }

[providers.arm]
resource = "Arm"
actions.move = { optional = { a = "any" }, outputs = { x = "any" }, outcomes = ["empty"] }

[providers.head]
resource = "Head"
actions.turn = { optional = { a = "any" }, outputs = { x = "any" } }

[providers.pen]
resource = "Pen"
actions.note = { inputs = { value = "any" } }
"#;

/// Providers that do as they are told, by the path of the visit; else success after a second with `x` = 1.
#[derive(Default)]
struct Script {
    /// By path, one per attempt; the last one stays.
    outcomes: BTreeMap<&'static str, Vec<&'static str>>,
    outputs: BTreeMap<&'static str, Value>,
    durations: BTreeMap<&'static str, f64>,
    seeds: Vec<(String, u64)>,
    notes: Vec<(String, Value)>,
}

impl Oracle for Script {
    fn perform(&mut self, path: &str, attempt: u32, goal: &Goal, _: &World) -> Performance {
        self.seeds.push((path.to_owned(), goal.seed));
        if &*goal.provider == "pen" {
            self.notes.push((path.to_owned(), goal.inputs["value"].clone()));
        }
        let all = self.outcomes.get(path).map_or(&[][..], Vec::as_slice);
        let outcome = all.get(attempt as usize - 1).or(all.last()).copied().unwrap_or("success");
        let duration_s = self.durations.get(path).copied().or(goal.expected_s).unwrap_or(1.0);
        if outcome == "crash" {
            return Performance { duration_s, answer: Answer::Crashed };
        }
        let x = self.outputs.get(path).cloned().unwrap_or(Value::Int(1));
        let outputs = if outcome == "aborted" { BTreeMap::new() } else { BTreeMap::from([("x".to_owned(), x)]) };
        Performance { duration_s, answer: Answer::Finished { outcome: outcome.to_owned(), outputs, measured: vec![] } }
    }
}

fn loaded(task: &str) -> (Catalogue, Program) {
    let catalogue = Catalogue::from_toml(CATALOGUE).unwrap();
    let loaded = ratn_model::load::load(task, "task.yaml", &catalogue).unwrap_or_else(|problems| {
        panic!("{}", problems.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n"))
    });
    (catalogue, loaded.program)
}

fn execute(task: &str, mode: Mode, script: &mut Script) -> Run {
    execute_program(loaded(task), mode, script)
}

fn execute_program((catalogue, program): (Catalogue, Program), mode: Mode, script: &mut Script) -> Run {
    let parameters = program.bind_parameters(&[]).unwrap();
    let setup = Setup {
        program: Arc::new(program),
        mode,
        parameters,
        seed: 7,
        resources: catalogue.resources.clone().into_iter().collect(),
        world: Vec::new(),
        tolerance: Tolerance::EXACT,
        latency: Duration::ZERO,
    };
    run(setup, script).unwrap()
}

/// In HSM mode; CDTN mode must come to the same outcome, outputs and world.
fn simulate(task: &str, script: &mut Script) -> Run {
    simulate_program(loaded(task), script)
}

fn simulate_program(program: (Catalogue, Program), script: &mut Script) -> Run {
    let mut other = Script {
        outcomes: script.outcomes.clone(),
        outputs: script.outputs.clone(),
        durations: script.durations.clone(),
        ..Script::default()
    };
    let hsm = execute_program(program.clone(), Mode::Hsm, script);
    let cdtn = execute_program(program, Mode::Cdtn, &mut other);
    let end = |run: &Run| (run.outcome.clone(), run.outputs.clone(), facts(run));
    assert_eq!(end(&hsm), end(&cdtn), "the modes differ; hsm: {}; cdtn: {}", hsm.reason, cdtn.reason);
    hsm
}

fn facts(run: &Run) -> Vec<String> {
    run.world.iter().map(|(key, fact)| format!("{key} = {}", fact.value)).collect()
}

/// `seconds start path`, in the order of events.
fn transcript(run: &Run) -> Vec<String> {
    let mut paths: BTreeMap<InstanceId, String> = BTreeMap::new();
    let mut lines = Vec::new();
    for line in &run.log {
        match &line.entry {
            LogEntry::Command(Command::Note(Note::Expanded { instance, path, .. })) => {
                paths.insert(*instance, path.clone());
            }
            LogEntry::Command(Command::Start { instance, .. }) => {
                lines.push(format!("{} {}", line.at.seconds(), paths[instance]));
            }
            _ => {}
        }
    }
    lines
}

fn decisions(run: &Run) -> Vec<String> {
    let decided = |entry: &LogEntry| match entry {
        LogEntry::Command(Command::Note(Note::Decided { path, decision, .. })) => Some(format!("{path} {decision}")),
        _ => None,
    };
    run.log.iter().filter_map(|line| decided(&line.entry)).collect()
}

fn told(script: &Script) -> Vec<String> {
    script.notes.iter().map(|(path, value)| format!("{path} {value}")).collect()
}

const THINK: &str = "action: brain/think, resources: [{ block: Brain }]";
const MOVE: &str = "action: arm/move, resources: [{ block: Arm }]";
const TURN: &str = "action: head/turn, resources: [{ block: Head }]";
const NOTE: &str = "action: pen/note, resources: [{ block: Pen }]";

/// A task's text with its actions written short.
fn task(text: &str) -> String {
    let long = text.replace("THINK", THINK).replace("MOVE", MOVE).replace("TURN", TURN).replace("NOTE", NOTE);
    format!("task: t\n{long}")
}

#[test]
fn a_transition_leads_to_any_sibling_and_the_second_visit_has_a_path_of_its_own() {
    let text = task(
        "states:
  - try: { THINK, transitions: { aborted: mend } }
  - use: { MOVE, transitions: { success: success } }
  - mend: { TURN, transitions: { success: try } }",
    );
    let mut script = Script::default();
    script.outcomes.insert("try", vec!["aborted"]);
    script.outcomes.insert("try#2", vec!["aborted"]);
    let run = simulate(&text, &mut script);
    assert_eq!(run.outcome, "success");
    assert_eq!(transcript(&run), ["0 try", "1 mend", "2 try#2", "3 mend#2", "4 try#3", "5 use"]);
}

#[test]
fn an_outcome_of_an_action_leaves_hierarchies_until_it_is_connected() {
    let text = task(
        "outcomes: [nothing_there]
states:
  - outer:
      outcomes: [none]
      transitions: { none: after }
      states:
        - inner:
            outcomes: [empty]
            transitions: { empty: none }
            states: [ look: { THINK, transitions: { empty: empty } }, never: { MOVE } ]
        - never: { MOVE }
  - never: { MOVE }
  - after: { TURN, transitions: { success: nothing_there } }",
    );
    let mut script = Script::default();
    script.outcomes.insert("outer/inner/look", vec!["empty"]);
    let run = simulate(&text, &mut script);
    assert_eq!(run.outcome, "nothing_there");
    assert_eq!(transcript(&run), ["0 outer/inner/look", "1 after"]);
}

#[test]
fn an_outcome_that_is_not_connected_ends_the_task_with_its_reason() {
    let text = task("states: [ part: { states: [ look: { THINK }, never: { MOVE } ] }, never: { MOVE } ]");
    let mut script = Script::default();
    script.outcomes.insert("part/look", vec!["aborted"]);
    let run = simulate(&text, &mut script);
    assert_eq!((run.outcome.as_str(), transcript(&run).len()), ("aborted", 1));
    assert!(run.reason.contains("part/look"), "{}", run.reason);
}

#[test]
fn a_while_asks_before_each_iteration_and_a_do_while_not_before_the_first() {
    let text = task(
        "variables: { n: 0 }
states:
  - count: { while: '$n < 2', index: i, do: [ add: { NOTE, in: { value: $i }, assign: { n: '$n + 1' } } ] }
  - once: { do_while: '$n < 2', do: [ add: { NOTE, in: { value: $n } } ] }
  - up_to: { until: '$n = 4', do: [ add: { NOTE, in: { value: $n }, assign: { n: '$n + 1' } } ] }",
    );
    let mut script = Script::default();
    let run = simulate(&text, &mut script);
    assert_eq!(run.outcome, "success", "{}", run.reason);
    let expect = ["count[0]/add 0", "count[1]/add 1", "once[0]/add 2", "up_to[0]/add 2", "up_to[1]/add 3"];
    assert_eq!(told(&script), expect);
    let expect =
        ["count[0] again", "count[1] again", "count[2] done", "once[1] done", "up_to[1] again", "up_to[2] done"];
    assert_eq!(decisions(&run), expect);
}

#[test]
fn an_outcome_out_of_a_body_ends_the_loop_and_success_begins_the_next_iteration() {
    let text = task(
        "states:
  - each:
      for: e in [1, 2, 3]
      outcomes: [found]
      do:
        - look: { THINK, transitions: { empty: found } }
        - go_on: { NOTE, in: { value: $e } }
      transitions: { found: grasp, success: aborted }
  - grasp: { MOVE }",
    );
    let mut script = Script::default();
    script.outcomes.insert("each[1]/look", vec!["empty"]);
    let run = simulate(&text, &mut script);
    assert_eq!(run.outcome, "success");
    assert_eq!(transcript(&run), ["0 each[0]/look", "1 each[0]/go_on", "2 each[1]/look", "3 grasp"]);
}

#[test]
fn null_counts_as_false_for_a_while() {
    let text = task(
        "states:
  - look: { THINK }
  - loop: { while: look.x, do: [ never: { MOVE } ] }",
    );
    let mut script = Script::default();
    script.outputs.insert("look", Value::Null);
    let run = simulate(&text, &mut script);
    assert_eq!((run.outcome.as_str(), transcript(&run).len()), ("success", 1), "{}", run.reason);
}

#[test]
fn regions_run_beside_each_other_and_their_outcomes_decide() {
    let text = task(
        "outcomes: [odd]
states:
  - both:
      concurrency: barrier
      regions: [ left: { MOVE }, right: { states: [ a: { TURN }, b: { TURN } ] } ]
      decide: { half: 'left.outcome = aborted and right.outcome = success' }
      outcomes: [half]
      outputs: { how: left.outcome }
      transitions: { half: say }
  - never: { MOVE }
  - say: { NOTE, in: { value: both.how }, transitions: { success: odd } }",
    );
    let mut script = Script::default();
    script.outcomes.insert("both/left", vec!["aborted"]);
    let run = simulate(&text, &mut script);
    assert_eq!(run.outcome, "odd", "{}", run.reason);
    assert_eq!(transcript(&run), ["0 both/left", "0 both/right/a", "1 both/right/b", "2 say"]);
    assert_eq!(told(&script), ["say aborted"]);
    assert_eq!(decisions(&run), ["both half"]);
}

#[test]
fn without_a_decider_a_barrier_aborts_if_a_region_did_and_still_waits_for_the_others() {
    let text = task(
        "states:
  - both:
      concurrency: barrier
      regions: [ left: { MOVE }, right: { TURN } ]
      transitions: { aborted: after }
  - never: { MOVE }
  - after: { MOVE }",
    );
    let mut script = Script::default();
    script.outcomes.insert("both/left", vec!["aborted"]);
    script.durations.insert("both/right", 4.0);
    assert_eq!(transcript(&simulate(&text, &mut script)), ["0 both/left", "0 both/right", "4 after"]);
}

#[test]
fn the_first_region_of_a_preemptive_concurrency_stops_the_others_and_its_outcome_counts() {
    let text = task(
        "states:
  - race:
      concurrency: preemptive
      regions: [ left: { MOVE }, right: { states: [ a: { TURN }, b: { TURN } ] } ]
      outcomes: [empty]
      outputs: { how: right.outcome }
      transitions: { empty: say }
  - never: { MOVE }
  - say: { NOTE, in: { value: race.how } }
  - again: { TURN }",
    );
    let mut script = Script::default();
    script.outcomes.insert("race/left", vec!["empty"]);
    script.durations.insert("race/left", 1.5);
    let run = simulate(&text, &mut script);
    assert_eq!(run.outcome, "success", "{}", run.reason);
    // What the stopped region held is free again: `again` turns the head, too.
    assert_eq!(transcript(&run), ["0 race/left", "0 race/right/a", "1 race/right/b", "1.5 say", "2.5 again"]);
    assert_eq!(told(&script), ["say preempted"]);
}

#[test]
fn a_preempted_hierarchy_does_what_it_declares_for_being_preempted() {
    let text = task(
        "world: ['way(head) = home']
states:
  - race:
      concurrency: preemptive
      regions:
        - left: { MOVE, effects: [] }
        - right: { effects: { preempted: ['way(head) = unknown'], success: [] }, states: [ a: { TURN, effects: [] }, b: { TURN, effects: [] } ] }",
    );
    let mut script = Script::default();
    script.durations.insert("race/right/a", 5.0);
    assert_eq!(facts(&simulate(&text, &mut script)), ["way(head) = unknown"]);
    let mut script = Script::default();
    script.durations.insert("race/left", 5.0);
    assert_eq!(facts(&simulate(&text, &mut script)), ["way(head) = home"]);
}

#[test]
fn assign_gives_the_innermost_variable_of_its_name_a_value_from_there_on() {
    let text = task(
        "variables: { n: 1, m: 10 }
outputs: { n: $n, m: $m }
states:
  - part:
      variables: { k: '$n + 4' }
      assign: { m: '$m + $k' }
      states:
        - a: { NOTE, in: { value: $k }, assign: { k: '$k + 1', n: 3 } }
        - b: { NOTE, in: { value: $k + $n } }
  - c: { NOTE, in: { value: $m } }",
    );
    let mut script = Script::default();
    let run = simulate(&text, &mut script);
    assert_eq!(run.outcome, "success", "{}", run.reason);
    assert_eq!(told(&script), ["part/a 5", "part/b 9", "c 16"]);
    assert_eq!(run.outputs, BTreeMap::from([("m".to_owned(), Value::Int(16)), ("n".to_owned(), Value::Int(3))]));
}

#[test]
fn a_failed_state_assigns_nothing() {
    let text = task(
        "variables: { n: 1 }
states:
  - a: { THINK, assign: { n: 2 }, transitions: { aborted: c } }
  - c: { NOTE, in: { value: $n } }",
    );
    let mut script = Script::default();
    script.outcomes.insert("a", vec!["aborted"]);
    simulate(&text, &mut script);
    assert_eq!(told(&script), ["c 1"]);
}

#[test]
fn what_regions_assign_is_seen_behind_them() {
    let text = task(
        "variables: { n: 1, m: 1 }
states:
  - both:
      concurrency: barrier
      regions: [ left: { MOVE, assign: { n: 2 } }, right: { TURN, assign: { m: 3 } } ]
  - c: { NOTE, in: { value: '[$n, $m]' } }",
    );
    let mut script = Script::default();
    simulate(&text, &mut script);
    assert_eq!(told(&script), ["c [2, 3]"]);
}

#[test]
fn a_port_is_its_default_until_written_and_again_in_a_new_activation() {
    let text = task(
        "states:
  - twice:
      for: i in [0, 1]
      do:
        - part:
            states:
              - first: { NOTE, in: { value: look.x } }
              - look: { THINK, out: { x: { default: none } } }
              - then: { NOTE, in: { value: look.x } }
        - after: { NOTE, in: { value: seen.x } }
        - seen: { THINK, out: { x: { default: none } } }",
    );
    let mut script = Script::default();
    script.outputs.insert("twice[0]/seen", Value::Int(8));
    simulate(&text, &mut script);
    let expect = [
        "twice[0]/part/first none",
        "twice[0]/part/then 1",
        "twice[0]/after none",
        // A new activation of `part`, but the same of the loop's body.
        "twice[1]/part/first none",
        "twice[1]/part/then 1",
        "twice[1]/after 8",
    ];
    assert_eq!(told(&script), expect);
}

#[test]
fn an_output_without_a_value_is_left_out_unless_the_outcome_is_success() {
    let text = task(
        "outcomes: [none]
states:
  - part:
      outcomes: [none]
      outputs: { x: look.x, y: look.x }
      states:
        - look: { THINK, transitions: { empty: none, success: success } }
        - later: { THINK, transitions: { success: look } }
      transitions: { none: say, success: say }
  - say: { NOTE, in: { value: part.y }, transitions: { success: none } }",
    );
    // `check` refuses an output that is not written on every way; a program need not come through it.
    let (catalogue, mut program) = loaded(&text.replace("success: success", "success: later"));
    let later = program.states.iter().find(|state| state.name == "later").unwrap().id;
    let StateKind::Sequence { outputs, .. } = &mut program.states[1].kind else { panic!("`part` is a hierarchy") };
    outputs[0].value = Expr::Port { state: later, port: "x".to_owned() };
    let look = &mut program.states.iter_mut().find(|state| state.name == "look").unwrap().transitions;
    look.insert("success".to_owned(), Target::Outcome("success".to_owned()));
    let program = (catalogue, program);
    let mut script = Script::default();
    script.outcomes.insert("part/look", vec!["empty"]);
    let run = simulate_program(program.clone(), &mut script);
    assert_eq!((run.outcome.as_str(), told(&script)), ("none", vec!["say 1".to_owned()]), "{}", run.reason);
    let run = simulate_program(program, &mut Script::default());
    assert_eq!(run.outcome, "aborted");
    assert!(run.reason.contains("output `x`"), "{}", run.reason);
}

#[test]
fn a_retry_waits_twice_as_long_each_time_and_has_a_seed_of_its_own() {
    let text = task("states: [ look: { THINK, retry: { count: 3, backoff: 0.5 } }, then: { MOVE } ]");
    let mut script = Script::default();
    script.outcomes.insert("look", vec!["aborted", "aborted", "success"]);
    let run = simulate(&text, &mut script);
    assert_eq!(transcript(&run), ["0 look", "1.5 look", "3.5 look", "4.5 then"]);
    let seeds: Vec<u64> = script.seeds.iter().filter(|(path, _)| path == "look").map(|(_, seed)| *seed).collect();
    assert!(seeds[0] != seeds[1] && seeds[1] != seeds[2] && seeds[0] != seeds[2], "{seeds:?}");
}

#[test]
fn a_deterministic_state_is_tried_again_with_the_same_seed() {
    let text = task("states: [ look: { THINK, computes: true, reads: [], deterministic: true, retry: 1 } ]");
    let mut script = Script::default();
    script.outcomes.insert("look", vec!["aborted", "aborted"]);
    let run = execute(&text, Mode::Hsm, &mut script);
    assert_eq!((run.outcome.as_str(), transcript(&run)), ("aborted", vec!["0 look".to_owned(), "1 look".to_owned()]));
    assert_eq!(script.seeds[0].1, script.seeds[1].1);
}

#[test]
fn a_goal_that_takes_too_long_is_cancelled_and_tried_again() {
    let text = task(
        "states: [ look: { THINK, timeout: 2, retry: 1, transitions: { aborted: mend } }, never: { MOVE }, mend: { TURN } ]",
    );
    let mut script = Script::default();
    script.durations.insert("look", 9.0);
    let run = simulate(&text, &mut script);
    assert_eq!(transcript(&run), ["0 look", "2 look", "4 mend"]);
    let cancelled = run.log.iter().filter(|l| matches!(l.entry, LogEntry::Command(Command::Cancel { .. }))).count();
    assert_eq!(cancelled, 2);
}

#[test]
fn what_a_goal_that_took_too_long_has_changed_is_not_known() {
    let text = task(
        "world: ['at(arm) = home']
states:
  - go: { MOVE, timeout: 2, effects: { success: ['at(arm) = there'], aborted: ['at(arm) = near'] }, transitions: { aborted: mend } }
  - mend: { TURN, effects: [] }",
    );
    let mut script = Script::default();
    script.durations.insert("go", 9.0);
    assert_eq!(facts(&simulate(&text, &mut script)), ["at(arm) = home"]);
}

#[test]
fn a_task_that_takes_longer_than_its_deadline_ends_aborted_and_says_so() {
    let text = task("deadline: 2.5\nstates: [ a: { MOVE }, b: { MOVE }, c: { MOVE }, never: { MOVE } ]");
    let run = simulate(&text, &mut Script::default());
    assert_eq!((run.outcome.as_str(), run.end_s, transcript(&run).len()), ("aborted", 2.5, 3));
    assert!(run.reason.contains("deadline of 2.5 s"), "{}", run.reason);
}

#[test]
fn what_cannot_be_evaluated_is_aborted_and_can_be_handled() {
    for (state, what) in [
        ("bad: { NOTE, in: { value: '1 / look.x' }, transitions: { aborted: mend } }", "an input"),
        ("bad: { condition: look.x, then: [], transitions: { aborted: mend } }", "a predicate"),
        ("bad: { while: look.x, do: [], transitions: { aborted: mend } }", "the predicate of a loop"),
        ("bad: { for: i in look.x, do: [], transitions: { aborted: mend } }", "a list"),
        ("bad: { THINK, requires: ['look.x = 7'], transitions: { aborted: mend } }", "a precondition"),
        (
            "bad: { requires: ['look.x = 7'], states: [ inside: { MOVE } ], transitions: { aborted: mend } }",
            "a hierarchy's",
        ),
        (
            "bad: { variables: { v: '1 / look.x' }, states: [ inside: { MOVE } ], transitions: { aborted: mend } }",
            "a variable",
        ),
        ("bad: { outputs: { v: '1 / look.x' }, states: [], transitions: { aborted: mend } }", "an output"),
        (
            "bad: { concurrency: barrier, outcomes: [o], regions: [ l: { states: [] } ], decide: { o: look.x }, transitions: { aborted: mend } }",
            "a decider",
        ),
    ] {
        let text = task(&format!("states: [ look: {{ THINK }}, {state}, never: {{ MOVE }}, mend: {{ TURN }} ]"));
        let mut script = Script::default();
        script.outputs.insert("look", Value::Int(0));
        let run = simulate(&text, &mut script);
        assert_eq!(run.outcome, "success", "{what}: {}", run.reason);
        assert_eq!(transcript(&run), ["0 look", "1 mend"], "{what}");
    }
}

#[test]
fn effects_are_those_of_the_outcome_by_which_a_composite_is_left() {
    let text = task(
        "world: ['state(part) = new']
states:
  - part:
      effects: { success: ['state(part) = done'], aborted: ['state(part) = broken'], none: ['state(part) = empty'] }
      outcomes: [none]
      states: [ look: { THINK, effects: { success: [], empty: [], aborted: [] }, transitions: { empty: none } } ]
      transitions: { none: end, aborted: end }
  - end: { TURN, effects: [] }",
    );
    for (outcome, fact) in [("success", "done"), ("empty", "empty"), ("aborted", "broken")] {
        let mut script = Script::default();
        script.outcomes.insert("part/look", vec![outcome]);
        assert_eq!(facts(&simulate(&text, &mut script)), [format!("state(part) = {fact}")]);
    }
}

/// The executive with this test as its shell.
struct Bench {
    executive: Executive,
    now: u64,
    commands: Vec<Command>,
}

impl Bench {
    fn new(text: &str, mode: Mode) -> Bench {
        let (_, program) = loaded(&task(text));
        let program = Arc::new(program);
        let mut bench =
            Bench { executive: Executive::new(program.clone(), Tolerance::EXACT), now: 0, commands: Vec::new() };
        bench.tell(Event::Started {
            task: program.name.clone(),
            digest: program.digest.clone(),
            mode,
            parameters: BTreeMap::new(),
            seed: 7,
            world: Vec::new(),
            revision: Revision(0),
            capacity: BTreeMap::new(),
            learned: Learned::default(),
            origin: Origin::default(),
        });
        bench
    }

    fn tell(&mut self, event: Event) {
        self.now += 1;
        let commands = self.executive.handle(Timestamp(self.now * 1_000_000_000), event);
        self.commands.extend(commands);
    }

    /// Takes the commands since the last time, as short words.
    fn heard(&mut self) -> Vec<String> {
        let word = |command: Command| match command {
            Command::Acquire { instance, .. } => Some(format!("acquire {}", instance.0)),
            Command::Release { lease, .. } => Some(format!("release {}", lease.map_or(0, |lease| lease.0))),
            Command::Start { instance, attempt, goal } => {
                Some(format!("start {}.{attempt} under {}", instance.0, goal.lease.map_or(0, |lease| lease.id.0)))
            }
            Command::End { outcome, .. } => Some(format!("end {outcome}")),
            _ => None,
        };
        std::mem::take(&mut self.commands).into_iter().filter_map(word).collect()
    }

    fn grant(&mut self, instance: u64, lease: u64) {
        let lease = Lease { id: LeaseId(lease), token: FencingToken(lease), resources: Vec::new() };
        self.tell(Event::Granted { instance: InstanceId(instance), lease });
    }

    fn finish(&mut self, instance: u64, attempt: u32) {
        self.tell(Event::Finished {
            instance: InstanceId(instance),
            attempt,
            outcome: "success".to_owned(),
            outputs: BTreeMap::from([("x".to_owned(), Value::Int(1))]),
            measured: Vec::new(),
            evidence: Vec::new(),
            reason: String::new(),
        });
    }

    fn crash(&mut self, instance: u64, attempt: u32) {
        self.tell(Event::Crashed { instance: InstanceId(instance), attempt, reason: "its worker died".to_owned() });
    }
}

#[test]
fn while_paused_no_pia_begins_and_what_computes_goes_on() {
    let text = "states:
  - look: { THINK, computes: true, reads: [] }
  - go: { MOVE }
  - go_on: { MOVE }
  - look_on: { THINK, computes: true, reads: [] }";
    let mut bench = Bench::new(text, Mode::Hsm);
    bench.tell(Event::PauseRequested);
    assert_eq!(bench.heard(), ["acquire 1"]);
    bench.grant(1, 1);
    bench.finish(1, 1);
    assert_eq!(bench.heard(), ["start 1.1 under 1", "release 1"]);
    bench.tell(Event::StepRequested);
    bench.grant(2, 2);
    bench.finish(2, 1);
    assert_eq!(bench.heard(), ["acquire 2", "start 2.1 under 2", "release 2"]);
    bench.tell(Event::ResumeRequested);
    bench.grant(3, 3);
    bench.tell(Event::PauseRequested);
    bench.finish(3, 1);
    assert_eq!(bench.heard(), ["acquire 3", "start 3.1 under 3", "acquire 4", "release 3"]);
}

#[test]
fn a_pia_that_gets_its_resources_during_a_pause_begins_when_the_pause_ends() {
    let mut bench = Bench::new("states: [ go: { MOVE } ]", Mode::Hsm);
    bench.tell(Event::PauseRequested);
    bench.grant(1, 1);
    assert_eq!(bench.heard(), ["acquire 1"]);
    bench.tell(Event::ResumeRequested);
    bench.finish(1, 1);
    assert_eq!(bench.heard(), ["start 1.1 under 1", "release 1", "end success"]);
}

#[test]
fn a_lease_lost_during_a_pause_is_asked_for_again_when_the_pause_ends() {
    let mut bench = Bench::new("states: [ go: { MOVE } ]", Mode::Hsm);
    bench.tell(Event::PauseRequested);
    bench.grant(1, 1);
    bench.crash(1, 1);
    bench.tell(Event::StepRequested);
    assert_eq!(bench.heard(), ["acquire 1", "release 1", "acquire 1"]);
    bench.grant(1, 2);
    assert_eq!(bench.heard(), ["start 1.2 under 2"]);
}

#[test]
fn a_step_lets_one_of_several_regions_begin() {
    let text = "states: [ both: { concurrency: barrier, regions: [ left: { MOVE }, right: { TURN } ] } ]";
    let mut bench = Bench::new(text, Mode::Hsm);
    bench.tell(Event::PauseRequested);
    bench.tell(Event::StepRequested);
    bench.grant(2, 1);
    bench.grant(1, 2);
    assert_eq!(bench.heard(), ["acquire 1", "acquire 2", "start 2.1 under 1"]);
    bench.tell(Event::StepRequested);
    assert_eq!(bench.heard(), ["start 1.1 under 2"]);
}

#[test]
fn a_routine_whose_worker_died_asks_anew_when_none_of_its_regions_uses_its_lease() {
    let text = "states:
  - both:
      routine: true
      states:
        - fork:
            concurrency: barrier
            regions:
              - left: { THINK, computes: true, reads: [] }
              - right: { THINK, computes: true, reads: [] }";
    let mut bench = Bench::new(text, Mode::Cdtn);
    bench.grant(1, 1);
    assert_eq!(bench.heard(), ["acquire 1", "start 3.1 under 1", "start 4.1 under 1"]);
    bench.crash(3, 1);
    assert_eq!(bench.heard(), [""; 0]);
    bench.crash(4, 1);
    assert_eq!(bench.heard(), ["acquire 3", "release 1"]);
    bench.grant(3, 2);
    bench.finish(3, 2);
    bench.finish(4, 2);
    assert_eq!(bench.heard(), ["start 3.2 under 2", "start 4.2 under 2", "release 2", "end success"]);
}

#[test]
fn in_a_race_a_region_whose_worker_died_does_not_wait_for_the_others() {
    let text = "states:
  - race:
      concurrency: preemptive
      regions:
        - left: { THINK, computes: true, reads: [] }
        - right: { THINK, computes: true, reads: [] }";
    let mut bench = Bench::new(text, Mode::Cdtn);
    bench.grant(1, 1);
    assert_eq!(bench.heard(), ["acquire 1", "start 4.1 under 1", "start 5.1 under 1"]);
    bench.crash(4, 1);
    assert_eq!(bench.heard(), ["start 4.2 under 1"]);
    bench.finish(4, 2);
    assert_eq!(bench.heard(), ["release 1", "end success"]);
}

#[test]
fn what_was_measured_is_committed_with_who_wrote_it_and_how_sure_it_is() {
    let text = "states:
  - part:
      effects: { success: ['done() = true'] }
      states: [ look: { THINK, senses: [], effects: ['seen(cup) = 1', 'guessed(cup) = 2'] } ]
  - go: { MOVE }";
    let cup = |predicate: &str| FactKey { predicate: predicate.to_owned(), arguments: vec![Term::Name("cup".into())] };
    let certainty = Some(Certainty::Confidence(0.75));
    let evidence = vec![(cup("seen"), Measurement { source: "camera-1".to_owned(), certainty })];
    for mode in [Mode::Hsm, Mode::Cdtn] {
        let mut bench = Bench::new(text, mode);
        let asked = bench.commands.iter().find_map(|command| match command {
            Command::Acquire { instance, .. } => Some(instance.0),
            _ => None,
        });
        let look = asked.unwrap();
        bench.grant(look, 1);
        bench.tell(Event::Finished {
            instance: InstanceId(look),
            attempt: 1,
            outcome: "success".to_owned(),
            outputs: BTreeMap::from([("x".to_owned(), Value::Int(1))]),
            measured: vec![(cup("seen"), Value::Int(3))],
            evidence: evidence.clone(),
            reason: String::new(),
        });
        let committed = std::mem::take(&mut bench.commands).into_iter().filter_map(|command| match command {
            Command::Commit { writer, changes, evidence, .. } => Some((writer, changes.len(), evidence)),
            _ => None,
        });
        let expected = [("part/look".to_owned(), 2, evidence.clone()), ("part".to_owned(), 1, Vec::new())];
        assert_eq!(committed.collect::<Vec<_>>(), expected, "{mode:?}");
    }
}

/// Executes a task in HSM mode; its outcome, and the reason.
fn end_of(states: &str) -> (String, String) {
    let task = format!("task: idle\nvariables: {{ i: 0 }}\nstates:\n{states}");
    let run = execute(&task, Mode::Hsm, &mut Script::default());
    (run.outcome, run.reason)
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
