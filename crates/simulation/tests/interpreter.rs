//! What the golden scenarios cannot say of the elements of a task program: programs that no file makes, seeds, tables of like cases,
//! and the executive with the test as its shell, so that grants, crashes and requests of the user come at any moment.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may panic")]

mod support;

use ratn_executive::executive::Executive;
use ratn_executive::protocol::{Command, Event, Goal, Learned, Mode};
use ratn_model::expression::Expr;
use ratn_model::fact::{FactKey, Term};
use ratn_model::id::{FencingToken, InstanceId, LeaseId, Revision};
use ratn_model::measurement::{Certainty, Measurement};
use ratn_model::program::{Program, StateKind, Target};
use ratn_model::resource::{Lease, LeasedResource};
use ratn_model::time::Timestamp;
use ratn_model::tolerance::Tolerance;
use ratn_model::value::Value;
use ratn_simulation::run::{Run, run};
use ratn_world::world::World;
use std::collections::BTreeMap;
use std::sync::Arc;
use support::{MODES, NoFiles, Providers, acts, facts, load, setup, starts};

const THINK: &str = "action: brain/judge, resources: [{ block: Brain }]";
const MOVE: &str = "action: arm/grasp, resources: [{ block: Arm }]";
const TURN: &str = "action: head/turn, resources: [{ block: Head }]";
const NOTE: &str = "action: pen/note, resources: [{ block: Pen }]";

/// A task's text with its actions written short.
fn task(text: &str) -> String {
    let long = text.replace("THINK", THINK).replace("MOVE", MOVE).replace("TURN", TURN).replace("NOTE", NOTE);
    format!("task: t\n{long}")
}

/// In both modes, with providers that end so by the path.
fn both(program: Program, end: impl Fn(&str) -> (&'static str, Value)) -> [Run; 2] {
    MODES.map(|mode| {
        let mut providers = Providers(|path: &str, _: u32, _: &Goal, _: &World| end(path));
        run(setup(program.clone(), mode), &mut providers).unwrap()
    })
}

/// The seeds of the tries of `look`, which are aborted until the last.
fn seeds(text: &str, tries: usize, mode: Mode) -> Vec<u64> {
    let mut seeds = Vec::new();
    let mut providers = Providers(|path: &str, _: u32, goal: &Goal, _: &World| {
        if path != "look" {
            return ("success", Value::Null);
        }
        seeds.push(goal.seed);
        (if seeds.len() < tries { "aborted" } else { "success" }, Value::Int(1))
    });
    let run = run(setup(load(&task(text), "task.yaml", &NoFiles), mode), &mut providers).unwrap();
    assert_eq!((run.outcome.as_str(), seeds.len()), ("success", tries), "{}", run.reason);
    seeds
}

#[test]
fn null_counts_as_false_for_a_while() {
    let text = task(
        "states:
  - look: { THINK }
  - loop: { while: look.x, do: [ never: { MOVE } ] }",
    );
    for run in both(load(&text, "task.yaml", &NoFiles), |_| ("success", Value::Null)) {
        assert_eq!((run.outcome.as_str(), starts(&run).len()), ("success", 1), "{}", run.reason);
    }
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
    let mut program = load(&text.replace("success: success", "success: later"), "task.yaml", &NoFiles);
    let later = program.states.iter().find(|state| state.name == "later").unwrap().id;
    let StateKind::Sequence { outputs, .. } = &mut program.states[1].kind else { panic!("`part` is a hierarchy") };
    outputs[0].value = Expr::Port { state: later, port: "x".to_owned() };
    let look = &mut program.states.iter_mut().find(|state| state.name == "look").unwrap().transitions;
    look.insert("success".to_owned(), Target::Outcome("success".to_owned()));
    let end = |path: &str| (if path == "part/look" { "empty" } else { "success" }, Value::Int(1));
    for run in both(program.clone(), end) {
        assert_eq!(run.outcome, "none", "{}", run.reason);
        assert_eq!(acts(&program, &run)[""].last().unwrap(), "say {value: 1}");
    }
    for run in both(program, |_| ("success", Value::Int(1))) {
        assert_eq!(run.outcome, "aborted");
        assert!(run.reason.contains("output `x`"), "{}", run.reason);
    }
}
#[test]
fn every_try_has_a_seed_of_its_own_and_it_is_the_same_in_both_modes() {
    let text = "states: [ look: { THINK, retry: { count: 3, backoff: 0.5 } }, then: { MOVE } ]";
    let [hsm, cdtn] = MODES.map(|mode| seeds(text, 3, mode));
    assert!(hsm[0] != hsm[1] && hsm[1] != hsm[2] && hsm[0] != hsm[2], "{hsm:?}");
    assert_eq!(hsm, cdtn);
}

#[test]
fn a_deterministic_state_is_tried_again_with_the_same_seed() {
    let text = "states: [ look: { THINK, computes: true, reads: [], deterministic: true, retry: 1 } ]";
    let seeds = seeds(text, 2, Mode::Hsm);
    assert_eq!(seeds[0], seeds[1]);
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
        for run in both(load(&text, "task.yaml", &NoFiles), |path| ("success", Value::Int(i64::from(path != "look")))) {
            assert_eq!(run.outcome, "success", "{what}: {}", run.reason);
            assert_eq!(starts(&run), ["0 look", "1 mend"], "{what}");
        }
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
        let end = |path: &str| (if path == "part/look" { outcome } else { "success" }, Value::Int(1));
        for run in both(load(&text, "task.yaml", &NoFiles), end) {
            assert_eq!(facts(&run), [format!("state(part) = {fact}")]);
        }
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
        let program = Arc::new(load(&task(text), "task.yaml", &NoFiles));
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
            breakpoints: Box::default(),
            origin: Box::default(),
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
            Command::Operate { instance, operations } => {
                let operations: Vec<String> = operations.iter().map(ToString::to_string).collect();
                Some(format!("{} {}", operations.join(", "), instance.0))
            }
            Command::End { outcome, .. } => Some(format!("end {outcome}")),
            _ => None,
        };
        std::mem::take(&mut self.commands).into_iter().filter_map(word).collect()
    }

    /// Who has asked last since the last time.
    fn asks(&mut self) -> u64 {
        let heard = self.heard();
        let last = heard.iter().rfind(|word| word.starts_with("acquire")).cloned();
        last.and_then(|word| word.split(' ').nth(1)?.parse().ok()).unwrap_or_else(|| panic!("{heard:?}"))
    }

    fn grant(&mut self, instance: u64, lease: u64) {
        let lease =
            Lease { id: LeaseId(lease), token: FencingToken(lease), resources: Vec::new(), consumed: Vec::new() };
        self.tell(Event::Granted { instance: InstanceId(instance), lease });
    }

    /// As [`Bench::grant`], with the one brain under the lease.
    fn grant_brain(&mut self, instance: u64, lease: u64) {
        let (endpoint, superclasses) = Default::default();
        let brain = LeasedResource { id: "Brain-1".to_owned(), kind: "Brain".to_owned(), endpoint, superclasses };
        let lease =
            Lease { id: LeaseId(lease), token: FencingToken(lease), resources: vec![brain], consumed: Vec::new() };
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
            at_rest: true,
        });
    }

    fn crash(&mut self, instance: u64, attempt: u32) {
        self.crash_of(instance, attempt, false);
    }

    /// Its worker died, or nobody knows what became of it.
    fn crash_of(&mut self, instance: u64, attempt: u32, unknown: bool) {
        let (instance, reason) = (InstanceId(instance), "its worker died".to_owned());
        self.tell(Event::Crashed { instance, attempt, reason, unknown, refused: false });
    }

    /// Its provider refuses the goal, because its lease is over.
    fn refuse(&mut self, instance: u64, attempt: u32) {
        let (instance, reason) = (InstanceId(instance), "its lease is over".to_owned());
        self.tell(Event::Crashed { instance, attempt, reason, unknown: false, refused: true });
    }
}

#[test]
fn who_stands_at_a_breakpoint_waits_for_the_operator_in_either_mode() {
    for mode in MODES {
        let mut bench = Bench::new("states: [ go: { MOVE }, on: { MOVE } ]", mode);
        bench.tell(Event::BreakpointsSet { states: vec!["on".to_owned()] });
        bench.grant(1, 1);
        bench.finish(1, 1);
        let stands = |bench: &Bench| bench.executive.explain().contains(&"on waits for the operator".to_owned());
        assert!(stands(&bench), "{mode:?}: {:?}", bench.executive.explain());
        bench.tell(Event::ResumeRequested);
        assert!(!stands(&bench), "{mode:?}");
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
fn a_motion_of_which_nobody_knows_what_became_is_not_tried_again() {
    let text = "states: [ go: { MOVE, retry: 2 } ]";
    for (mode, unknown) in [(Mode::Hsm, true), (Mode::Cdtn, true), (Mode::Hsm, false), (Mode::Cdtn, false)] {
        let mut bench = Bench::new(text, mode);
        bench.grant(1, 1);
        bench.crash_of(1, 1, unknown);
        let heard = bench.heard();
        let is_tried_again = heard.iter().filter(|word| word.starts_with("acquire")).count() == 2;
        assert_eq!(is_tried_again, !unknown, "{mode:?} {heard:?}");
        assert_eq!(heard.contains(&"end aborted".to_owned()), unknown, "{mode:?} {heard:?}");
    }
}

#[test]
fn a_motion_whose_lease_was_over_when_it_was_to_begin_has_not_been_tried() {
    for mode in MODES {
        let mut bench = Bench::new("states: [ go: { MOVE } ]", mode);
        bench.grant(1, 1);
        bench.refuse(1, 1);
        assert_eq!(bench.asks(), 1, "{mode:?}");
        bench.grant(1, 2);
        bench.finish(1, 2);
        assert_eq!(bench.heard().last().map(String::as_str), Some("end success"), "{mode:?}");
        // Not for ever.
        let mut bench = Bench::new("states: [ go: { MOVE } ]", mode);
        for attempt in 1..=3 {
            bench.grant(1, attempt.into());
            bench.refuse(1, attempt);
        }
        assert_eq!(bench.heard().last().map(String::as_str), Some("end aborted"), "{mode:?}");
    }
}

#[test]
fn a_part_of_a_routine_whose_lease_was_over_when_it_was_to_begin_waits_for_the_new_one() {
    let mut bench = routine_of("{ states: [ one: { MOVE }, two: { MOVE } ] }", "{ TURN, retry: 1 }");
    bench.grant(1, 1);
    assert_eq!(bench.heard(), ["acquire 1", "start 3.1 under 1", "start 4.1 under 1"]);
    // The lease ends as a whole with this worker.
    bench.crash(4, 1);
    bench.finish(3, 1);
    assert_eq!(bench.heard(), ["start 5.1 under 1"]);
    bench.refuse(5, 1);
    assert_eq!(bench.heard(), ["acquire 5", "release 1"]);
    bench.grant(5, 2);
    assert_eq!(bench.heard(), ["start 5.2 under 2", "start 4.2 under 2"]);
    bench.finish(5, 2);
    bench.finish(4, 2);
    assert_eq!(bench.heard(), ["release 2", "end success"]);
}

#[test]
fn a_pia_that_gets_its_resources_during_a_pause_begins_when_the_pause_ends() {
    let mut bench = Bench::new("states: [ go: { MOVE } ]", Mode::Hsm);
    bench.tell(Event::PauseRequested);
    bench.grant(1, 1);
    assert_eq!(bench.heard(), ["acquire 1", "release 1"], "others may want it meanwhile");
    bench.tell(Event::ResumeRequested);
    bench.grant(1, 2);
    bench.finish(1, 1);
    assert_eq!(bench.heard(), ["acquire 1", "start 1.1 under 2", "release 2", "end success"]);
}

#[test]
fn what_goes_back_is_back_before_something_is_used_up_and_that_is_gone_for_what_comes_behind_it() {
    let text = "states:
  - group:
      resources: [{ consume: Charge }]
      states: [ inside: { MOVE } ]
  - next: { TURN }";
    for mode in MODES {
        let mut bench = Bench::new(text, mode);
        let inside = bench.asks();
        bench.grant(inside, 1);
        bench.heard();
        bench.finish(inside, 1);
        let heard = bench.heard();
        let at = |word: &str| heard.iter().position(|one| one.starts_with(word));
        assert!(at("release") < at("consume") && at("consume").is_some(), "{heard:?}");
        assert!(at("acquire").is_none_or(|acquire| Some(acquire) > at("consume")), "{heard:?}");
    }
}

#[test]
fn a_way_out_has_its_minute_whatever_time_nobody_was_there() {
    let text = "states:
  - outer:
      states: [ inside: { MOVE } ]
      finally: [ back: { TURN, effects: [] } ]";
    for mode in MODES {
        let mut bench = Bench::new(text, mode);
        let abort = || Event::AbortRequested { reason: "enough".to_owned(), at_once: false };
        bench.asks();
        bench.tell(abort());
        let back = bench.asks();
        // Longer than a way out may take.
        bench.now += 100;
        bench.tell(Event::Resumed { share: None });
        bench.grant(back, 2);
        bench.finish(back, 1);
        assert_eq!(
            bench.heard(),
            [format!("start {back}.1 under 2"), "release 2".to_owned(), "end preempted".to_owned()]
        );
        // What is done in it does count.
        let mut bench = Bench::new(text, mode);
        bench.asks();
        bench.tell(abort());
        let back = bench.asks();
        bench.now += 100;
        bench.grant(back, 2);
        assert_eq!(bench.heard().last().map(String::as_str), Some("end preempted"));
    }
}

#[test]
fn a_step_lets_one_of_several_regions_begin() {
    let text = "states: [ both: { concurrency: barrier, regions: [ left: { MOVE }, right: { TURN } ] } ]";
    let mut bench = Bench::new(text, Mode::Hsm);
    bench.tell(Event::PauseRequested);
    bench.tell(Event::StepRequested);
    bench.grant(2, 1);
    bench.grant(1, 2);
    assert_eq!(bench.heard(), ["acquire 1", "acquire 2", "start 2.1 under 1", "release 2"]);
    bench.tell(Event::StepRequested);
    bench.grant(1, 3);
    assert_eq!(bench.heard(), ["acquire 1", "start 1.1 under 3"]);
}

const THINKS: &str = "{ THINK, computes: true, reads: [] }";

/// A routine of two regions beside each other, in CDTN mode.
fn routine_of(left: &str, right: &str) -> Bench {
    let text = format!(
        "states:
  - both:
      routine: true
      states:
        - fork:
            concurrency: barrier
            regions:
              - left: {left}
              - right: {right}"
    );
    Bench::new(&text, Mode::Cdtn)
}

#[test]
fn a_routine_whose_worker_died_asks_anew_when_none_of_its_regions_uses_its_lease() {
    let mut bench = routine_of(THINKS, THINKS);
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
fn who_waits_for_a_unit_whose_worker_died_begins_under_the_new_lease() {
    let mut bench = routine_of(THINKS, THINKS);
    bench.grant_brain(1, 1);
    assert_eq!(bench.heard(), ["acquire 1", "start 3.1 under 1"], "there is one brain");
    bench.crash(3, 1);
    assert_eq!(bench.heard(), ["acquire 3", "release 1"]);
    bench.grant_brain(3, 2);
    assert_eq!(bench.heard(), ["start 4.1 under 2"], "it has waited for longer");
    bench.finish(4, 1);
    assert_eq!(bench.heard(), ["start 3.2 under 2"]);
    bench.finish(3, 2);
    assert_eq!(bench.heard(), ["release 2", "end success"]);
}

#[test]
fn while_a_region_whose_worker_died_pauses_its_unit_is_nobody_elses() {
    let mut bench =
        routine_of("{ THINK, computes: true, reads: [], attempts: 1, retry: { count: 1, backoff: 5 } }", THINKS);
    bench.grant_brain(1, 1);
    assert_eq!(bench.heard(), ["acquire 1", "start 3.1 under 1"], "there is one brain");
    bench.crash(3, 1);
    assert_eq!(bench.heard(), ["acquire 4", "release 1"], "who has waited needs another one");
    bench.grant_brain(4, 2);
    assert_eq!(bench.heard(), ["start 4.1 under 2"]);
    bench.finish(4, 1);
    assert_eq!(bench.heard(), [""; 0]);
    for _ in 0..5 {
        bench.tell(Event::Woken);
    }
    assert_eq!(bench.heard(), ["start 3.2 under 2"], "the new one has not died");
    bench.finish(3, 2);
    assert_eq!(bench.heard(), ["release 2", "end success"]);
}

#[test]
fn a_worker_is_replaced_when_nothing_of_its_routine_moves_and_nothing_is_used_up_again() {
    let mut bench = routine_of(
        "{ action: brain/judge, pia: true, resources: [{ block: Brain }, { consume: Charge, count: 0.4 }], retry: 1 }",
        "{ states: [ one: { MOVE }, two: { MOVE }, three: { MOVE } ] }",
    );
    bench.grant(1, 1);
    assert_eq!(bench.heard(), ["acquire 1", "start 3.1 under 1", "start 4.1 under 1"]);
    bench.crash(3, 1);
    assert_eq!(bench.heard(), [""; 0], "a motion is under way");
    bench.finish(4, 1);
    assert_eq!(bench.heard(), ["start 5.1 under 1"], "what goes on may be what the others wait for");
    bench.finish(5, 1);
    assert_eq!(bench.heard(), ["start 6.1 under 1"]);
    bench.finish(6, 1);
    let again = bench.commands.iter().find_map(|command| match command {
        Command::Acquire { requirements, .. } => Some(requirements.clone()),
        _ => None,
    });
    let again: Vec<String> = again.unwrap().into_iter().map(|one| one.kind).collect();
    assert_eq!(again, ["Brain", "Arm"], "the charge is used up once");
    assert_eq!(bench.heard(), ["acquire 3", "release 1"]);
    bench.grant(3, 2);
    assert_eq!(bench.heard(), ["start 3.2 under 2"]);
    bench.finish(3, 2);
    assert_eq!(bench.heard(), ["release 2", "end success"]);
}

#[test]
fn a_routine_that_waits_keeps_no_room_that_only_the_reads_of_its_states_ask_for() {
    let text = "states:
  - both:
      concurrency: barrier
      regions:
        - one:
            shared: [ready(a)]
            resources: [{ block: Pen, hold: true }]
            states:
              - plan: { action: brain/think, computes: true, reads: ['k(a)'], resources: [{ block: Brain }] }
              - wait: { wait: { for: ready(a) } }
              - note: { NOTE, reads: [] }
        - two:
            shared: [ready(a)]
            states:
              - think: { action: brain/think, computes: true, reads: ['n(a)'], resources: [{ block: Brain }] }
              - make: { MOVE, reads: [], effects: [ready(a)] }";
    for mode in MODES {
        let mut setup = setup(load(&task(text), "task.yaml", &NoFiles), mode);
        setup.resources.iter_mut().find(|(kind, _)| kind == "WorldModel").unwrap().1.count = 1.into();
        let mut providers = Providers(|_: &str, _: u32, _: &Goal, _: &World| ("success", Value::Int(1)));
        let run = run(setup, &mut providers).unwrap_or_else(|error| panic!("{mode:?}: {error}"));
        assert_eq!(run.outcome, "success", "{mode:?}: {}", run.reason);
    }
}

#[test]
fn a_state_that_fails_without_a_reason_is_named_in_both_modes() {
    for mode in MODES {
        let mut bench = Bench::new("states: [ look: { THINK } ]", mode);
        let instance = bench.asks();
        bench.grant(instance, 1);
        bench.tell(Event::Finished {
            instance: InstanceId(instance),
            attempt: 1,
            outcome: "aborted".to_owned(),
            outputs: BTreeMap::new(),
            measured: Vec::new(),
            evidence: Vec::new(),
            reason: String::new(),
            at_rest: true,
        });
        let reason = bench.commands.into_iter().find_map(|command| match command {
            Command::End { reason, .. } => Some(reason),
            _ => None,
        });
        assert_eq!(reason.as_deref(), Some("look"), "{mode:?}");
    }
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
            at_rest: true,
        });
        let committed = std::mem::take(&mut bench.commands).into_iter().filter_map(|command| match command {
            Command::Commit { writer, changes, evidence, .. } => Some((writer, changes.len(), evidence)),
            _ => None,
        });
        let expected = [("part/look".to_owned(), 2, evidence.clone()), ("part".to_owned(), 1, Vec::new())];
        assert_eq!(committed.collect::<Vec<_>>(), expected, "{mode:?}");
    }
}
