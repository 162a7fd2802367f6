//! What a run costs: linear in what it does, in constant memory where the window stays as large, without recursion.
//!
//! No test measures against a wall clock: each compares two sizes of one task in the same run, ten times apart, and allows 25 times
//! the time, or the allocations. They are counted per thread.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may panic")]

mod support;

use ratn_executive::executive::Executive;
use ratn_executive::protocol::{Command, Event, Goal, Learned, Mode};
use ratn_model::fact::FactKey;
use ratn_model::id::{FencingToken, InstanceId, LeaseId, ProjectionId, Revision};
use ratn_model::list::List;
use ratn_model::program::Program;
use ratn_model::resource::Lease;
use ratn_model::time::Timestamp;
use ratn_model::tolerance::Tolerance;
use ratn_model::value::Value;
use ratn_simulation::sequential::{Assumptions, sequential};
use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};
use support::{NoFiles, catalogue, fact, load};

/// Ten times the work may take so many times as long.
const MOST: f64 = 25.0;

/// How often what takes too long is measured again.
const RUNS: usize = 6;

thread_local! {
    static LIVE: Cell<isize> = const { Cell::new(0) };
    static MADE: Cell<usize> = const { Cell::new(0) };
}

/// Counts what each thread has allocated and not freed, and all that it has allocated.
struct Counting;

fn count(change: isize) {
    // A thread that ends frees what it has after its counter is gone.
    let _ = LIVE.try_with(|live| live.set(live.get() + change));
    if change > 0 {
        let _ = MADE.try_with(|made| made.set(made.get() + 1));
    }
}

/// How many allocations something takes.
fn allocations<T>(work: impl FnOnce() -> T) -> usize {
    let before = MADE.get();
    work();
    MADE.get() - before
}

#[expect(unsafe_code, reason = "a global allocator is unsafe by its nature; this one adds a counter to the system's")]
// SAFETY: every call is passed on unchanged to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count(1);
        // SAFETY: the caller keeps the contract of `alloc`.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        count(-1);
        // SAFETY: the caller keeps the contract of `dealloc`.
        unsafe { System.dealloc(at, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// The executive with a shell that grants everything and answers at once, one event after the other; what moves the arm answers
/// only when nothing else is under way.
struct Shell {
    executive: Executive,
    events: VecDeque<Event>,
    motions: VecDeque<Event>,
    number: u64,
    /// What every motion measures.
    measured: Vec<(FactKey, Value)>,
    /// How often a goal of this provider was started.
    started: BTreeMap<Arc<str>, usize>,
    /// How long the executive took, all events together.
    took: Duration,
    end: Option<(String, String)>,
}

impl Shell {
    fn new(task: &str) -> Shell {
        let program = Arc::new(load(task, "task.yaml", &NoFiles));
        let mut shell = Shell {
            executive: Executive::new(program.clone(), Tolerance::ROBOT),
            events: VecDeque::new(),
            motions: VecDeque::new(),
            number: 0,
            measured: Vec::new(),
            started: BTreeMap::new(),
            took: Duration::ZERO,
            end: None,
        };
        shell.events.push_back(started(&program));
        shell
    }

    /// Handles one event; false when the task has ended.
    fn step(&mut self) -> bool {
        let event = self.events.pop_front().or_else(|| self.motions.pop_front());
        let event = event.unwrap_or_else(|| panic!("stuck: {:#?}", self.executive.explain()));
        self.number += 1;
        #[expect(clippy::disallowed_methods, reason = "a test of what it takes")]
        let before = Instant::now();
        let commands = self.executive.handle(Timestamp(self.number * 1_000_000), event);
        self.took += before.elapsed();
        for command in commands {
            self.perform(command);
        }
        self.end.is_none()
    }

    fn perform(&mut self, command: Command) {
        match command {
            Command::Acquire { instance, .. } => {
                self.number += 1;
                let lease = Lease {
                    id: LeaseId(self.number),
                    token: FencingToken(1),
                    resources: Vec::new(),
                    consumed: Vec::new(),
                };
                self.events.push_back(Event::Granted { instance, lease });
            }
            Command::Withdraw { instance } => {
                self.events.retain(|event| !matches!(event, Event::Granted { instance: to, .. } if *to == instance))
            }
            Command::Project { instance, attempt, .. } => {
                self.number += 1;
                let projection = ProjectionId(self.number);
                self.events.push_back(Event::Projected { instance, attempt, projection });
            }
            Command::Start { instance, attempt, goal } => {
                *self.started.entry(goal.provider.clone()).or_default() += 1;
                let moves = &*goal.provider == "arm";
                let answer = self.answer(instance, attempt, &goal);
                if moves { self.motions.push_back(answer) } else { self.events.push_back(answer) }
            }
            Command::End { outcome, reason, .. } => self.end = Some((outcome, reason)),
            _ => {}
        }
    }

    /// Success, with `x` one more than its input `a`.
    fn answer(&self, instance: InstanceId, attempt: u32, goal: &Goal) -> Event {
        let x = match goal.inputs.get("a") {
            Some(Value::Int(a)) => a + 1,
            _ => 1,
        };
        Event::Finished {
            instance,
            attempt,
            outcome: "success".to_owned(),
            outputs: BTreeMap::from([("x".to_owned(), Value::Int(x)), ("list".to_owned(), Value::List(List::new()))]),
            measured: if &*goal.provider == "arm" { self.measured.clone() } else { Vec::new() },
            evidence: Vec::new(),
            reason: String::new(),
            at_rest: true,
        }
    }

    /// To the end, which must be success.
    fn finish(&mut self) {
        while self.step() {}
        let (outcome, reason) = self.end.clone().unwrap();
        assert_eq!((outcome.as_str(), reason.as_str()), ("success", ""));
    }

    /// Until only motions are under way.
    fn compute_ahead(&mut self) {
        while !self.events.is_empty() {
            assert!(self.step(), "it has ended: {:?}", self.end);
        }
    }
}

fn started(program: &Program) -> Event {
    Event::Started {
        task: program.name.clone(),
        digest: program.digest.clone(),
        mode: Mode::Cdtn,
        parameters: program.bind_parameters(&[]).unwrap(),
        seed: 7,
        world: Vec::new(),
        revision: Revision(0),
        capacity: BTreeMap::new(),
        learned: Learned::default(),
        breakpoints: Box::default(),
        origin: Box::default(),
    }
}

/// Ten times as much takes at most 25 times as long.
fn is_linear(what: &str, sizes: [usize; 2], took: impl Fn(usize) -> Duration) {
    // The first run pays for what is loaded once.
    took(sizes[0] / 10);
    let mut least = sizes.map(&took);
    // Somebody else may have had the processor meanwhile: the least of several runs counts.
    for _ in 0..RUNS {
        if least[1].as_secs_f64() <= MOST * least[0].as_secs_f64() {
            return;
        }
        let again = sizes.map(&took);
        least = [least[0].min(again[0]), least[1].min(again[1])];
    }
    let [small, large] = least;
    panic!("{what}: {small:?} for {}, {large:?} for {}: more than {MOST} times", sizes[0], sizes[1]);
}

/// Every iteration changes what the one before has left, and one state reads what has come of all.
fn counting(iterations: usize) -> String {
    format!(
        "task: counting
horizon: {horizon}
world: ['n() = 0']
states:
  - for: i in range({iterations})
    do:
      - step: {{ action: arm/move, pia: true, reads: [], effects: ['n() = n() + 1'], resources: [{{ block: Arm }}] }}
  - read: {{ action: brain/think, in: {{ a: n() }}, computes: true, reads: [], resources: [{{ block: Brain }}] }}
  - go: {{ action: arm/move, in: {{ a: read.x }}, pia: true, reads: [], effects: ['read() = read.x'], resources: [{{ block: Arm }}] }}
",
        horizon = iterations + 10
    )
}

/// The same with a reader in every iteration.
fn counting_and_reading(iterations: usize) -> String {
    let reader = "      - see: { action: brain/think, in: { a: n() }, computes: true, reads: [], resources: [{ block: Brain }] }\n";
    let horizon = format!("horizon: {}", 2 * iterations + 10);
    let task = counting(iterations).replace("  - read:", &format!("{reader}  - read:"));
    task.replace(&format!("horizon: {}", iterations + 10), &horizon)
}

/// What the executive takes for it. Nothing is computed twice.
fn count_to(iterations: usize, task: &str, readers: usize) -> Duration {
    let mut shell = Shell::new(task);
    shell.finish();
    let sum = shell.executive.root().get(&fact("read()"));
    assert_eq!(sum, Some(&Value::Int(i64::try_from(iterations).unwrap() + 1)));
    assert_eq!(shell.started["brain"], readers);
    shell.took
}

/// Every iteration computes while the arm still moves.
fn computing_ahead(iterations: usize) -> String {
    format!(
        "task: ahead
horizon: {horizon}
states:
  - go: {{ action: arm/move, pia: true, reads: [], effects: ['gone() = true'], duration: 1000000, resources: [{{ block: Arm }}] }}
  - each:
      for: i in range({iterations})
      do:
        - think: {{ action: brain/think, in: {{ a: $i }}, computes: true, reads: [], duration: 2, resources: [{{ block: Brain }}] }}
  - end: {{ action: arm/move, in: {{ a: 7 }}, pia: true, reads: [], effects: ['n() = x'], resources: [{{ block: Arm }}] }}
",
        horizon = 4 * iterations + 10
    )
}

/// The same, with a list of ten texts of each iteration.
fn collecting_ahead(iterations: usize) -> String {
    let each = "      outputs: { texts: { each: \"repeat(concat('iteration ', $i), 10)\", type: list<list<string>> } }\n      do:";
    computing_ahead(iterations).replace("      do:", each)
}

/// What the executive takes for it.
fn compute_ahead(iterations: usize) -> Duration {
    compute_all_ahead(&computing_ahead(iterations), iterations)
}

fn compute_all_ahead(task: &str, iterations: usize) -> Duration {
    let mut shell = Shell::new(task);
    shell.compute_ahead();
    assert_eq!(shell.started["brain"], iterations, "all are computed ahead");
    shell.finish();
    assert_eq!(shell.executive.root().get(&fact("n()")), Some(&Value::Int(8)));
    shell.took
}

/// What `ratn check` takes to say what keeps a task sequential.
fn check(task: &str) -> Duration {
    let program = load(task, "task.yaml", &NoFiles);
    let parameters = program.bind_parameters(&[]).unwrap();
    let assumptions = Assumptions {
        parameters,
        elements: 2,
        durations_s: BTreeMap::new(),
        units: BTreeMap::new(),
        attributes: BTreeMap::new(),
    };
    #[expect(clippy::disallowed_methods, reason = "a test of what it takes")]
    let before = Instant::now();
    sequential(&program, &catalogue(), &assumptions).unwrap();
    before.elapsed()
}

#[test]
fn a_chain_of_effects_comes_to_its_sum() {
    count_to(6, &counting(6), 1);
    count_to(6, &counting_and_reading(6), 7);
    check(&counting(6));
    compute_ahead(6);
    check(&computing_ahead(6));
}

#[test]
fn a_chain_of_effects_that_one_state_reads_costs_as_much_as_it_is_long() {
    is_linear("a loop of n() = n() + 1", [1_000, 10_000], |n| count_to(n, &counting(n), 1));
}

#[test]
fn a_chain_of_effects_that_every_iteration_reads_costs_as_much_as_it_is_long() {
    is_linear("a loop of n() = n() + 1 and a reader", [1_000, 10_000], |n| {
        count_to(n, &counting_and_reading(n), n + 1)
    });
}

#[test]
fn what_check_says_of_a_chain_of_effects_costs_as_much_as_it_is_long() {
    is_linear("check", [100, 1_000], |n| check(&counting(n)));
}

#[test]
fn a_loop_that_computes_ahead_costs_as_much_as_it_is_long() {
    is_linear("a loop that computes ahead", [1_000, 10_000], compute_ahead);
}

#[test]
fn what_check_says_of_a_loop_that_computes_ahead_costs_as_much_as_it_is_long() {
    is_linear("check", [100, 1_000], |n| check(&computing_ahead(n)));
}

/// Ten times as much takes at most 25 times as many allocations: each text of a list that is copied is one.
fn allocates_linearly(what: &str, work: impl Fn(usize) -> Duration) {
    let [small, large] = [100, 1_000].map(|iterations| allocations(|| work(iterations)));
    assert!(large as f64 <= MOST * small as f64, "{what}: {small} allocations for 100 iterations, {large} for 1000");
}

#[test]
fn a_loop_that_collects_what_it_computes_ahead_copies_no_lists() {
    allocates_linearly("the executive", |n| compute_all_ahead(&collecting_ahead(n), n));
    allocates_linearly("check", |n| check(&collecting_ahead(n)));
}

/// Runs in a thread with as little stack as threads have by default.
fn with_a_small_stack(test: impl FnOnce() + Send + 'static) {
    const STACK_BYTES: usize = 2 << 20;
    std::thread::Builder::new().stack_size(STACK_BYTES).spawn(test).unwrap().join().unwrap();
}

/// A motion that measures otherwise than predicted, and a chain behind it, each state made of the one before: all are in the
/// window, all are computed twice.
fn a_deviation_before(length: usize, chain: &str) {
    let task = format!(
        "task: chain
horizon: {horizon}
world: ['n() = 0']
states:
  - grasp: {{ action: arm/move, pia: true, reads: [], effects: ['n() = 1'], resources: [{{ block: Arm }}] }}
{chain}",
        horizon = length + 1_000
    );
    with_a_small_stack(move || {
        let mut shell = Shell::new(&task);
        shell.measured = vec![(fact("n()"), Value::Int(5))];
        shell.compute_ahead();
        assert_eq!(shell.started["brain"], length, "all are computed ahead");
        shell.finish();
        assert_eq!((shell.started["arm"], shell.started["brain"]), (1, 2 * length));
    });
}

fn effects_made_of_each_other(length: usize) {
    let chain = format!(
        "  - for: i in range({length})
    do:
      - step: {{ action: brain/think, in: {{ a: n() }}, computes: true, reads: [], effects: ['n() = x'], resources: [{{ block: Brain }}] }}
"
    );
    a_deviation_before(length, &chain);
}

fn outputs_made_of_each_other(length: usize) {
    let think = "action: brain/think, computes: true, reads: [], resources: [{ block: Brain }]";
    let chain = format!(
        "  - first: {{ {think}, in: {{ a: n() }} }}
  - for: i in range({rounds})
    do:
      - even: {{ {think}, in: {{ a: 'max(first.x, odd.x)' }} }}
      - odd: {{ {think}, in: {{ a: even.x }}, out: {{ x: {{ default: 0 }} }} }}
",
        rounds = length / 2
    );
    a_deviation_before(length / 2 * 2 + 1, &chain);
}

#[test]
fn a_deviation_goes_along_a_chain_to_its_end() {
    effects_made_of_each_other(40);
    outputs_made_of_each_other(40);
}

#[test]
fn a_hundred_thousand_effects_made_of_each_other_need_no_stack() {
    effects_made_of_each_other(100_000);
}

#[test]
fn a_hundred_thousand_outputs_made_of_each_other_need_no_stack() {
    outputs_made_of_each_other(100_000);
}

#[test]
fn a_deviation_costs_as_much_as_there_are_facts_in_view() {
    is_linear("a deviation", [1_000, 10_000], |facts| {
        let task = format!(
            "task: view
world: [{{ for: i in range({facts}), set: 'at($i) = 0' }}]
states:
  - grasp: {{ action: arm/move, pia: true, reads: [], effects: ['at({last}) = 1'], resources: [{{ block: Arm }}] }}
  - plan: {{ action: brain/think, computes: true, reads: ['at(?)'], resources: [{{ block: Brain }}, world_model] }}
  - other: {{ action: brain/think, computes: true, reads: ['at(?)'], resources: [{{ block: Brain }}, world_model] }}
",
            last = facts - 1
        );
        let mut shell = Shell::new(&task);
        shell.measured = vec![(fact(&format!("at({})", facts - 1)), Value::Int(5))];
        shell.compute_ahead();
        // What the deviation costs, not what it took to look for the first time.
        shell.took = Duration::ZERO;
        shell.finish();
        assert_eq!(shell.started["brain"], 4);
        shell.took
    });
}

/// A build without optimizations would take minutes for as many.
const ITERATIONS: usize = if cfg!(debug_assertions) { 20_000 } else { 100_000 };

/// Live allocations after a fifth and after all of the iterations of a loop whose body is this.
fn live_in_a_loop(body: &str, provider: &str) -> [isize; 2] {
    let task =
        format!("task: loops\nworld: ['n() = 0']\nvariables: {{ i: 0 }}\nstates:\n  - while: $i >= 0\n    do:\n{body}");
    let mut shell = Shell::new(&task);
    [ITERATIONS / 5, ITERATIONS].map(|iterations| {
        while shell.started.get(provider).copied().unwrap_or(0) < iterations {
            assert!(shell.step(), "it has ended: {:?}", shell.end);
        }
        LIVE.with(Cell::get)
    })
}

fn stays(live: [isize; 2]) {
    let [early, late] = live;
    assert!(
        late <= early + early / 10 + 1_000,
        "{early} live allocations after a fifth of {ITERATIONS} iterations, {late} after all"
    );
}

#[test]
fn a_loop_of_a_hundred_thousand_iterations_needs_constant_memory() {
    stays(live_in_a_loop(
        "      - think: { action: brain/think, in: { a: $i }, computes: true, reads: [], resources: [{ block: Brain }] }
      - go: { action: arm/move, in: { a: think.x }, pia: true, reads: [], effects: ['n() = n() + 1'], resources: [{ block: Arm }], assign: { i: '$i + 1' } }
",
        "arm",
    ));
}

#[test]
fn a_loop_of_a_hundred_thousand_undecided_conditions_needs_constant_memory() {
    stays(live_in_a_loop(
        "      - look: { action: eye/look, senses: ['n()'], effects: [], resources: [{ block: Eye }] }
      - found:
          condition: look.x = 1
          then:
            - think: { action: brain/think, in: { a: $i }, computes: true, reads: ['n()'], resources: [{ block: Brain }, world_model] }
          else:
            - other: { action: brain/think, in: { a: $i }, computes: true, reads: ['n()'], resources: [{ block: Brain }, world_model] }
      - go: { action: arm/move, pia: true, reads: [], effects: ['n() = n() + 1'], resources: [{ block: Arm }], assign: { i: '$i + 1' } }
",
        "arm",
    ));
}
