//! What an event costs, for windows of 10² to 10⁶ instances of several shapes; what an instance costs in time and memory; how
//! long a large state machine takes to convert.
//!
//! `cargo bench -p ratn-executive`. Every shape is a program with a loop whose window is as large as the horizon says; goals
//! are answered by the bench as they are started, so that the window stays full.

#![allow(missing_docs, clippy::unwrap_used, clippy::print_stdout, reason = "a benchmark prints and may panic")]

use ratn_executive::executive::Executive;
use ratn_executive::protocol::{Command, Event, Learned, Mode};
use ratn_model::expression::{Expr, Function};
use ratn_model::id::{InstanceId, Revision, StateId};
use ratn_model::program::{Annotations, Exceptions, Location, Nature, Program, SUCCESS, State, StateKind};
use ratn_model::time::Timestamp;
use ratn_model::tolerance::Tolerance;
use ratn_model::value::{Type, Value};
use std::alloc::{GlobalAlloc, Layout, System};
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicIsize, AtomicUsize, Ordering};

/// Counts the bytes that are in use, while it is told to: counting costs a tenth of an event.
struct Counting;

static COUNTS: AtomicBool = AtomicBool::new(false);
static IN_USE: AtomicIsize = AtomicIsize::new(0);
static ALLOCATIONS: AtomicUsize = AtomicUsize::new(0);

#[expect(
    unsafe_code,
    reason = "a global allocator is unsafe by its nature; this one adds two counters to the system's"
)]
// SAFETY: every call is passed on unchanged to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        if COUNTS.load(Ordering::Relaxed) {
            IN_USE.fetch_add(layout.size().cast_signed(), Ordering::Relaxed);
            ALLOCATIONS.fetch_add(1, Ordering::Relaxed);
        }
        // SAFETY: the caller keeps the contract of `alloc`.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        if COUNTS.load(Ordering::Relaxed) {
            IN_USE.fetch_sub(layout.size().cast_signed(), Ordering::Relaxed);
        }
        // SAFETY: the caller keeps the contract of `dealloc`.
        unsafe { System.dealloc(at, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

const SIZES: [usize; 5] = [100, 1_000, 10_000, 100_000, 1_000_000];
const SHAPES: [&str; 4] = ["chain", "fan_out", "random_dag", "nested_loops"];

fn main() {
    divan::main();
}

/// One event (a goal has ended) in a full window: the instance finishes and retires, others begin, the window grows.
#[divan::bench(args = SIZES, consts = [0, 1, 2, 3], sample_count = 20, sample_size = 1)]
fn event<const SHAPE: usize>(bencher: divan::Bencher<'_, '_>, window: usize) {
    const EVENTS: usize = 2_000;
    let mut harness = Harness::new(SHAPES[SHAPE], window);
    bencher.counter(divan::counter::ItemsCount::new(EVENTS)).bench_local(|| harness.run(EVENTS));
}

/// A million instances are expanded, executed and retired.
#[divan::bench(sample_count = 3, sample_size = 1)]
fn a_million_instances(bencher: divan::Bencher<'_, '_>) {
    bencher.counter(divan::counter::ItemsCount::new(1_000_000_usize)).bench_local(|| {
        let mut harness = Harness::new("fan_out", 100);
        harness.run(1_000_000);
    });
}

/// A state machine of 10,000 states becomes a window.
#[divan::bench(sample_count = 10, sample_size = 1)]
fn conversion(bencher: divan::Bencher<'_, '_>) {
    let program = Arc::new(flat(10_000));
    bencher.bench_local(|| {
        let mut executive = Executive::new(program.clone(), Tolerance::EXACT);
        executive.handle(Timestamp(0), started())
    });
}

/// Bytes per instance of a window of 10⁵, and allocations per event; printed, because they are no times.
#[divan::bench(consts = [0, 1, 2, 3], sample_count = 1, sample_size = 1)]
fn memory<const SHAPE: usize>() {
    COUNTS.store(true, Ordering::Relaxed);
    let before = IN_USE.load(Ordering::Relaxed);
    let mut harness = Harness::new(SHAPES[SHAPE], 100_000);
    let bytes = (IN_USE.load(Ordering::Relaxed) - before).unsigned_abs() - harness.pending_bytes();
    let before = ALLOCATIONS.load(Ordering::Relaxed);
    harness.run(1_000);
    let allocations = (ALLOCATIONS.load(Ordering::Relaxed) - before) as f64 / 1_000.0;
    COUNTS.store(false, Ordering::Relaxed);
    println!("{}: {} bytes per instance, {allocations} allocations per event", SHAPES[SHAPE], bytes / 100_000);
}

struct Harness {
    executive: Executive,
    running: VecDeque<InstanceId>,
    now: u64,
}

impl Harness {
    fn new(shape: &str, window: usize) -> Harness {
        let program = match shape {
            "chain" => looped(window, &[vec![0]]),
            "fan_out" => looped(window, &[vec![]]),
            "random_dag" => looped(
                window,
                &(0..8_usize).map(|i| (0..4).map(|k| (i * 5 + k * 3 + 1) % 8).collect()).collect::<Vec<Vec<usize>>>(),
            ),
            _ => looped(window, &[vec![], vec![0]]),
        };
        let mut harness = Harness {
            executive: Executive::new(Arc::new(program), Tolerance::EXACT),
            running: VecDeque::new(),
            now: 0,
        };
        let commands = harness.executive.handle(Timestamp(0), started());
        harness.take(commands);
        harness
    }

    fn take(&mut self, commands: Vec<Command>) {
        for command in commands {
            match command {
                Command::Start { instance, .. } => self.running.push_back(instance),
                Command::End { reason, .. } => panic!("the task has ended: {reason}"),
                _ => {}
            }
        }
    }

    fn run(&mut self, events: usize) {
        for _ in 0..events {
            let instance = self.running.pop_front().unwrap();
            self.now += 1_000_000;
            let event = Event::Finished {
                instance,
                attempt: 1,
                outcome: SUCCESS.to_owned(),
                outputs: BTreeMap::from([("x".to_owned(), Value::Int(1))]),
                measured: Vec::new(),
                evidence: Vec::new(),
                reason: String::new(),
            };
            let commands = self.executive.handle(Timestamp(self.now), event);
            self.take(commands);
        }
    }

    fn pending_bytes(&self) -> usize {
        self.running.capacity() * size_of::<InstanceId>()
    }
}

fn started() -> Event {
    Event::Started {
        task: "bench".to_owned(),
        digest: String::new(),
        mode: Mode::Cdtn,
        parameters: BTreeMap::new(),
        seed: 1,
        world: Vec::new(),
        revision: Revision(0),
        capacity: BTreeMap::new(),
        learned: Learned::default(),
        origin: Default::default(),
    }
}

fn state(id: usize, name: &str, path: &str, parent: Option<u64>, kind: StateKind) -> State {
    State {
        id: StateId(id as u64),
        name: name.to_owned(),
        path: path.to_owned(),
        parent: parent.map(StateId),
        kind,
        outcomes: Vec::new(),
        transitions: BTreeMap::new(),
        variables: Vec::new(),
        assign: Vec::new(),
        defaults: BTreeMap::from([("x".to_owned(), Value::Int(0))]),
        annotations: Annotations::default(),
        location: Location::default(),
    }
}

fn action(id: usize, parent: u64, prefix: &str, reads: &[usize]) -> State {
    let inputs = reads.iter().enumerate().map(|(number, from)| {
        (format!("in{number}"), Expr::Port { state: StateId(*from as u64), port: "x".to_owned() })
    });
    let kind = StateKind::Action {
        provider: "brain".to_owned(),
        action: "think".to_owned(),
        inputs: inputs.collect(),
        outputs: BTreeMap::from([("x".to_owned(), Type::Int)]),
    };
    let name = format!("s{id}");
    let mut state = state(id, &name, &format!("{prefix}{name}"), Some(parent), kind);
    state.annotations = Annotations {
        nature: Nature::Computes,
        reads: Some(Vec::new()),
        effects: BTreeMap::from([(SUCCESS.to_owned(), Vec::new())]),
        ..Annotations::default()
    };
    state
}

fn program(states: Vec<State>, horizon: usize) -> Program {
    Program {
        name: "bench".to_owned(),
        horizon,
        speculation_width: Program::DEFAULT_SPECULATION_WIDTH,
        deadline_s: None,
        exceptions: Exceptions::Precise,
        parameters: Vec::new(),
        outputs: Vec::new(),
        initial: Vec::new(),
        tolerances: Default::default(),
        ontology: None,
        states,
        digest: String::new(),
    }
}

/// Two nested loops around nodes, each of which reads the latest outputs of the given others.
fn looped(horizon: usize, reads: &[Vec<usize>]) -> Program {
    let range = |n: i64| Expr::Call(Function::Range, vec![Expr::Literal(Value::Int(n))]);
    let for_each = |variable: &str, n: i64, body: Vec<StateId>| StateKind::ForEach {
        variable: variable.to_owned(),
        index: None,
        collection: range(n),
        body,
    };
    let first = 3;
    let body: Vec<StateId> = (first..first + reads.len()).map(|id| StateId(id as u64)).collect();
    let children = vec![StateId(1)];
    let mut states = vec![
        state(0, "bench", "", None, StateKind::Sequence { children, outputs: Vec::new() }),
        state(1, "outer", "outer", Some(0), for_each("i", 10_000, vec![StateId(2)])),
        state(2, "inner", "outer/inner", Some(1), for_each("j", 10_000, body)),
    ];
    for (number, from) in reads.iter().enumerate() {
        let from: Vec<usize> = from.iter().map(|other| first + other).collect();
        states.push(action(first + number, 2, "outer/inner/", &from));
    }
    program(states, horizon)
}

/// One long list of nodes, each of which reads what the one before it has put out.
fn flat(count: usize) -> Program {
    let children = (1..=count).map(|id| StateId(id as u64)).collect();
    let mut states = vec![state(0, "bench", "", None, StateKind::Sequence { children, outputs: Vec::new() })];
    for id in 1..=count {
        let reads: Vec<usize> = if id > 1 { vec![id - 1] } else { Vec::new() };
        states.push(action(id, 0, "", &reads));
    }
    program(states, count)
}
