//! What a call costs in an empty pool and in one of 100,000 resources and 10,000 waiters, what a resource costs in memory, and how
//! long a restart takes.
//!
//! `cargo bench -p ratn-resources`.

#![allow(missing_docs, clippy::unwrap_used, clippy::print_stdout, reason = "a benchmark prints and may panic")]

use ratn_model::id::LeaseId;
use ratn_model::resource::{Requirement, ResourceClass, ResourceOperation};
use ratn_model::time::Timestamp;
use ratn_model::value::Value;
use ratn_resources::{
    AcquireRequest, Limits, Pool, Request, ResourceSpec, SessionId, Snapshot, WaiterId, decode, encode,
};
use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

/// Counts the bytes that are in use.
struct Counting;

static IN_USE: AtomicUsize = AtomicUsize::new(0);

#[expect(unsafe_code, reason = "a global allocator is unsafe by its nature; this one adds a counter to the system's")]
// SAFETY: every call is passed on unchanged to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        IN_USE.fetch_add(layout.size(), Ordering::Relaxed);
        // SAFETY: the caller keeps the contract of `alloc`.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        IN_USE.fetch_sub(layout.size(), Ordering::Relaxed);
        // SAFETY: the caller keeps the contract of `dealloc`.
        unsafe { System.dealloc(at, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

const NOW: Timestamp = Timestamp(0);
const RESOURCES: usize = 100_000;
const WAITERS: usize = 10_000;
const KINDS: usize = 100;
/// Calls per sample.
const CALLS: usize = 1_000;

fn main() {
    memory();
    divan::main();
}

fn memory() {
    let before = IN_USE.load(Ordering::Relaxed);
    let pool = filled(RESOURCES, 0);
    let resources = IN_USE.load(Ordering::Relaxed) - before;
    println!("memory of a resource with 3 attributes: {} bytes", resources / RESOURCES);
    drop(pool);
    let pool = filled(RESOURCES, 1);
    let leased = IN_USE.load(Ordering::Relaxed) - before;
    println!("memory of its lease, with its part of the resource: {} bytes", (leased - resources) / RESOURCES);
    drop(pool);
    let pool = filled(RESOURCES, WAITERS);
    let waiters = IN_USE.load(Ordering::Relaxed) - before - leased;
    println!("memory of a waiter: {} bytes", waiters / WAITERS);
    drop(pool);
}

/// A free unit of a kind is blocked and released; nobody waits for that kind.
#[divan::bench(args = [(0, 0), (RESOURCES, 0), (RESOURCES, WAITERS)], sample_count = 100, sample_size = 1)]
fn block_and_release(bencher: divan::Bencher<'_, '_>, (resources, waiters): (usize, usize)) {
    let mut pool = filled(resources, waiters);
    pool.create(NOW, None, ResourceSpec::new(ResourceClass::Module, "Hot").capacity(1)).unwrap();
    drained(&mut pool);
    bencher.counter(divan::counter::ItemsCount::new(CALLS)).bench_local(|| {
        for _ in 0..CALLS {
            pool.acquire(NOW, ask("Hot", 1)).unwrap();
            let lease = pool.youngest_lease();
            pool.release(NOW, None, lease).unwrap();
            drained(&mut pool);
        }
    });
}

/// One of the resources that 10,000 wait for is released and goes to the next; who had it asks again.
#[divan::bench(args = [10, WAITERS], sample_count = 100, sample_size = 1)]
fn release_to_the_next_of(bencher: divan::Bencher<'_, '_>, waiters: usize) {
    let mut pool = filled(RESOURCES, waiters);
    let mut held: std::collections::VecDeque<LeaseId> = pool.leases().iter().map(|lease| lease.id).collect();
    drained(&mut pool);
    bencher.counter(divan::counter::ItemsCount::new(CALLS)).bench_local(|| {
        for _ in 0..CALLS {
            let lease = held.pop_front().unwrap();
            let kind = pool.lease(lease).unwrap().resources[0].kind.clone();
            pool.release(NOW, None, lease).unwrap();
            held.push_back(pool.youngest_lease());
            pool.acquire(NOW, ask(&kind, 1)).unwrap();
            drained(&mut pool);
        }
    });
}

/// Whether 47,300 of a kind and 8,000 of those with an attribute can be had, of which there are 50,000: they cannot.
#[divan::bench(sample_count = 10, sample_size = 1)]
fn ask_for_more_than_all(bencher: divan::Bencher<'_, '_>) {
    let mut pool = Pool::new(Limits { units_per_request: 100_000, ..Limits::default() });
    pool.keep_alive(NOW, &session(), "bench", Duration::from_secs(1_000_000)).unwrap();
    for i in 0..50_000 {
        let spec = ResourceSpec::new(ResourceClass::Module, "Tool").attribute("a", Value::Bool(i % 6 == 0));
        pool.create(NOW, None, spec).unwrap();
    }
    drained(&mut pool);
    bencher.bench_local(|| {
        let mut request = ask("Tool", 47_300);
        let mut special = ask("Tool", 8_000).requirements.remove(0);
        special.attributes.insert("a".to_owned(), Value::Bool(true));
        request.requirements.push(special);
        let waiter = pool.acquire(NOW, request).unwrap();
        pool.cancel(NOW, waiter).unwrap();
        drained(&mut pool);
    });
}

/// Why the last of the waiters waits.
#[divan::bench(args = [10, WAITERS], sample_count = 100, sample_size = 1)]
fn explain(bencher: divan::Bencher<'_, '_>, waiters: usize) {
    let pool = filled(RESOURCES, waiters);
    let last: WaiterId = pool.waiters().last().unwrap().0;
    bencher.bench_local(|| pool.explain(last).unwrap());
}

/// A pool of 100,000 resources from the bytes of its snapshot.
#[divan::bench(sample_count = 10, sample_size = 1)]
fn restart_from_a_snapshot(bencher: divan::Bencher<'_, '_>) {
    let bytes = filled(RESOURCES, 0).snapshot().encode();
    bencher.bench_local(|| {
        Pool::restore(Limits::default(), NOW, Some(Snapshot::decode(&bytes).unwrap()), Vec::new()).unwrap()
    });
}

/// The same from the records that made it.
#[divan::bench(sample_count = 10, sample_size = 1)]
fn restart_from_records(bencher: divan::Bencher<'_, '_>) {
    let records = created(RESOURCES).take_records();
    let bytes = encode(&records);
    bencher.bench_local(|| Pool::restore(Limits::default(), NOW, None, decode(&bytes).unwrap()).unwrap());
}

/// 100 kinds; where anybody waits, everything of a kind is held and everybody waits for all of it that one can have.
fn filled(resources: usize, waiters: usize) -> Pool {
    let mut pool = created(resources);
    if waiters > 0 {
        for i in 0..resources {
            pool.acquire(NOW, ask(&kind(i % KINDS), 1)).unwrap();
        }
    }
    for i in 0..waiters {
        pool.acquire(NOW, ask(&kind(i % KINDS), 1)).unwrap();
    }
    drained(&mut pool);
    pool
}

fn created(resources: usize) -> Pool {
    let limits = Limits {
        resources: 200_000,
        leases: 300_000,
        waiters: 20_000,
        waiters_per_session: 20_000,
        ..Limits::default()
    };
    let mut pool = Pool::new(limits);
    pool.keep_alive(NOW, &session(), "bench", Duration::from_secs(1_000_000)).unwrap();
    for i in 0..resources {
        let spec = ResourceSpec::new(ResourceClass::Process, kind(i % KINDS))
            .id(format!("path-planner-{i}@compute"))
            .attribute("endpoint", Value::String(format!("http://127.0.0.1:{i}")))
            .attribute("payload", Value::Float(2.5))
            .attribute("version", Value::Int(3));
        pool.handle(NOW, "", Request::Create { session: Some(session()), spec }).unwrap();
    }
    pool
}

fn drained(pool: &mut Pool) {
    divan::black_box(pool.take_notices());
    divan::black_box(pool.take_records());
}

fn ask(kind: &str, count: u32) -> AcquireRequest {
    let operation = ResourceOperation::Block;
    let requirement = Requirement { count: count.into(), ..Requirement::new(operation, kind) };
    AcquireRequest::new(session(), vec![requirement])
}

fn kind(number: usize) -> String {
    format!("Kind{number}")
}

fn session() -> SessionId {
    SessionId::from("bench")
}
