//! What an event costs, for windows of 10² to 10⁶ instances of several shapes; what an instance costs in time and memory; what a
//! deviation costs; how long a large state machine takes to convert.
//!
//! `cargo bench -p ratn-executive`, or with the name of a shape or of a bench behind `--`. An event is one call of
//! `Executive::handle`: a goal has ended, resources were granted, or a projection was made. Divan warns of sizes that are larger than the
//! largest with which a shape is measured.

#![allow(
    missing_docs,
    unreachable_pub,
    clippy::unwrap_used,
    clippy::panic,
    clippy::print_stdout,
    reason = "a benchmark prints and may panic"
)]

mod counting;
mod harness;
mod shapes;

use harness::Harness;
use ratn_executive::executive::Executive;
use ratn_model::fact::{FactKey, Term};
use ratn_model::id::InstanceId;
use ratn_model::time::Timestamp;
use ratn_model::tolerance::Tolerance;
use ratn_model::value::Value;
use shapes::{
    Chain, Conditions, Counter, Decisions, FanOut, NestedLoops, RandomDag, Resources, Shape, Wildcard, World, WorldMiss,
};
use std::any::type_name;
use std::hint::black_box;
use std::sync::Arc;

const SIZES: [usize; 5] = [100, 1_000, 10_000, 100_000, 1_000_000];

fn main() {
    divan::main();
}

/// One event in a full window: an instance gets what it asked for, or ends and retires, and the window grows.
#[divan::bench(
    types = [
        Chain, FanOut, RandomDag, NestedLoops, World, WorldMiss, Counter, Wildcard, Conditions, Decisions, Resources,
    ],
    args = SIZES,
    sample_count = 20,
    sample_size = 1,
    max_time = 2,
)]
fn event<S: Shape>(bencher: divan::Bencher<'_, '_>, window: usize) {
    if window <= S::LARGEST {
        events::<S>(bencher, window, 2_000);
    }
}

/// The same in windows so small that every shape can be measured.
#[divan::bench(types = [Chain, World, Counter], args = [10, 20], sample_count = 20, sample_size = 1)]
fn event_of_a_small_window<S: Shape>(bencher: divan::Bencher<'_, '_>, window: usize) {
    events::<S>(bencher, window, 30);
}

fn events<S: Shape>(bencher: divan::Bencher<'_, '_>, window: usize, count: usize) {
    let mut harness = Harness::new(S::program(window), Vec::new());
    bencher.counter(divan::counter::ItemsCount::new(count)).bench_local(|| harness.run(count));
}

/// What of an event is the bench: its strings and maps are made and dropped.
#[divan::bench(sample_count = 20, sample_size = 1)]
fn making_events(bencher: divan::Bencher<'_, '_>) {
    const EVENTS: u64 = 2_000;
    bencher.counter(divan::counter::ItemsCount::new(EVENTS)).bench_local(|| {
        for id in 0..EVENTS {
            drop(black_box(harness::success(InstanceId(id), 1)));
        }
    });
}

/// A million instances are expanded, executed and retired.
#[divan::bench(sample_count = 3, sample_size = 1)]
fn a_million_instances(bencher: divan::Bencher<'_, '_>) {
    bencher.counter(divan::counter::ItemsCount::new(1_000_000_usize)).bench_local(|| {
        let mut harness = Harness::new(FanOut::program(100), Vec::new());
        harness.run(1_000_000);
    });
}

/// A loop of a million rounds, whose memory does not grow; bytes are printed, because they are no times.
#[divan::bench(sample_count = 1, sample_size = 1)]
fn a_million_iterations() {
    counting::begin();
    let before = counting::bytes_in_use();
    let mut harness = Harness::new(shapes::million(), Vec::new());
    let mut in_use_after = |iterations| {
        harness.run_until(iterations);
        counting::bytes_in_use() - before
    };
    // The last instances of the window are expanded, so that it is as full as before.
    let (early, late) = (in_use_after(10_000), in_use_after(999_000));
    counting::end();
    println!("{early} bytes in use after 10,000 iterations, {late} after 999,000");
    let grown = (late - early).unsigned_abs();
    assert!(grown * 10 <= early.unsigned_abs(), "what is in use must not grow with the iterations");
}

/// The state of a full window is written down: so long a run that makes a checkpoint stands still. How large it is is printed.
#[divan::bench(types = [Chain, RandomDag, NestedLoops, World], args = [100, 1_000, 10_000, 100_000], sample_count = 10, sample_size = 1)]
fn checkpoint<S: Shape>(bencher: divan::Bencher<'_, '_>, window: usize) {
    let Some(harness) = in_use::<S>(window) else { return };
    println!("{} of {window}: {} bytes", type_name::<S>(), harness.checkpoint().len());
    bencher.bench_local(|| black_box(harness.checkpoint()));
}

/// An executive is made of such a state.
#[divan::bench(types = [Chain, RandomDag, NestedLoops, World], args = [100, 1_000, 10_000, 100_000], sample_count = 10, sample_size = 1)]
fn restore<S: Shape>(bencher: divan::Bencher<'_, '_>, window: usize) {
    let Some(harness) = in_use::<S>(window) else { return };
    let (program, bytes) = (Arc::new(S::program(window)), harness.checkpoint());
    bencher.bench_local(|| Executive::restore(program.clone(), Tolerance::EXACT, &bytes).unwrap());
}

/// A full window in which some have retired.
fn in_use<S: Shape>(window: usize) -> Option<Harness> {
    (window <= S::LARGEST).then(|| {
        let mut harness = Harness::new(S::program(window), Vec::new());
        harness.run(1_000);
        harness
    })
}

/// A day: a loop of a million rounds is at its end. Its checkpoint, and that it goes on from there.
#[divan::bench(sample_count = 5, sample_size = 1)]
fn checkpoint_and_restore_after_a_million_iterations(bencher: divan::Bencher<'_, '_>) {
    let began = std::time::Instant::now();
    let mut harness = Harness::new(shapes::million(), Vec::new());
    harness.run_until(999_000);
    println!("the run: {:?}; its checkpoint: {} bytes", began.elapsed(), harness.checkpoint().len());
    bencher.bench_local(|| {
        let bytes = harness.checkpoint();
        harness.restore(shapes::million(), &bytes);
        bytes
    });
    harness.run_until(999_900);
}

/// A PIA measures otherwise than predicted while nodes run that have read ten thousand facts: that one event. The fact is the last
/// in the order of keys.
#[divan::bench(args = [1, 10, 100], sample_count = 20, sample_size = 1, max_time = 5)]
fn deviation(bencher: divan::Bencher<'_, '_>, readers: usize) {
    const FACTS: i64 = 10_000;
    let world: Vec<(FactKey, Value)> = (0..FACTS).map(|number| (at(number), Value::Int(number))).collect();
    let program = shapes::watched(FACTS - 1, readers);
    let running = || {
        let harness = Harness::new(program.clone(), world.clone());
        assert_eq!(harness.under_way(), readers + 1, "the motion and all who read");
        (harness, vec![(at(FACTS - 1), Value::Int(5))])
    };
    bencher.with_inputs(running).bench_local_refs(|(harness, measured)| {
        harness.measure(std::mem::take(measured));
        assert_eq!(harness.under_way(), 0, "what they have read came out otherwise");
    });
}

/// A PIA measures otherwise than predicted, and a whole window has been made of that, each of the one before it: that one event, on
/// a stack of 2 MiB. Ten thousand overflow it.
#[divan::bench(args = [100, 1_000], sample_count = 5, sample_size = 1)]
fn cascade(bencher: divan::Bencher<'_, '_>, window: usize) {
    let finished = || {
        let mut harness = Harness::new(shapes::cascade(window), Vec::new());
        harness.run_all_but_the_oldest();
        harness
    };
    bencher.with_inputs(finished).bench_local_values(|mut harness| {
        on_a_small_stack(move || {
            harness.measure(vec![(at(0), Value::Int(5))]);
            harness
        })
    });
}

/// A window of 100,000 is expanded, executed for a while and discarded on a stack of 2 MiB.
#[divan::bench(types = [Chain, RandomDag, World, Resources], sample_count = 1, sample_size = 1)]
fn horizon_100_000<S: Shape>() {
    on_a_small_stack(|| {
        let mut harness = Harness::new(S::program(100_000), Vec::new());
        harness.run(2_000);
    });
}

/// Runs it where a thread would that says nothing of its stack.
fn on_a_small_stack<T: Send + 'static>(run: impl FnOnce() -> T + Send + 'static) -> T {
    const STACK: usize = 2 * 1024 * 1024;
    std::thread::Builder::new().stack_size(STACK).spawn(run).unwrap().join().unwrap()
}

fn at(number: i64) -> FactKey {
    FactKey { predicate: "at".to_owned(), arguments: vec![Term::Int(number)] }
}

/// A state machine of 10,000 states becomes a window.
#[divan::bench(sample_count = 10, sample_size = 1)]
fn conversion(bencher: divan::Bencher<'_, '_>) {
    let program = Arc::new(shapes::flat(10_000));
    bencher.bench_local(|| {
        let mut executive = Executive::new(program.clone(), Tolerance::EXACT);
        executive.handle(Timestamp(0), harness::started(Vec::new()))
    });
}

/// Bytes per instance of a window of 10⁵ (or of the largest), and allocations per event; printed, because they are no times.
#[divan::bench(
    types = [
        Chain, FanOut, RandomDag, NestedLoops, World, WorldMiss, Counter, Wildcard, Conditions, Decisions, Resources,
    ],
    sample_count = 1,
    sample_size = 1,
)]
fn memory<S: Shape>() {
    let window = S::LARGEST.min(100_000);
    let program = S::program(window);
    counting::begin();
    let before = counting::bytes_in_use();
    let mut harness = Harness::new(program, Vec::new());
    let bytes = (counting::bytes_in_use() - before).unsigned_abs() - harness.pending_bytes();
    let before = counting::allocations();
    let events = window.min(1_000);
    harness.run(events);
    let allocations = (counting::allocations() - before) as f64 / events as f64;
    counting::end();
    let shape = type_name::<S>().rsplit("::").next().unwrap_or_default();
    println!("{shape}: {} bytes per instance, {allocations} allocations per event", bytes / window);
}
