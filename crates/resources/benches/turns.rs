//! How long the longest turn of the pool is where a client asks for as much as it may.
//!
//! `cargo bench -p ratn-resources --bench turns`.

#![allow(missing_docs, clippy::unwrap_used, clippy::print_stdout, reason = "a benchmark prints and may panic")]
#![allow(clippy::disallowed_methods, reason = "a benchmark measures")]

use ratn_model::resource::{Requirement, ResourceClass, ResourceOperation};
use ratn_model::time::Timestamp;
use ratn_model::value::Value;
use ratn_resources::{AcquireRequest, Limits, Notice, Pool, ResourceSpec, SessionId};
use std::time::{Duration, Instant};

const TTL: Duration = Duration::from_secs(1_000_000);

fn main() {
    println!("{:<72} {:>12} {:>12} {:>8}", "what", "longest turn", "in all", "turns");
    row("close a session with 4,000 leases of one resource", leases_of_one_resource(), close);
    row("close a session with 50,000 leases of a resource each", leases_of_many_resources(), close);
    row("close a session that consumed 50,000 resources", consumed(false), close);
    row("the same, of resources that it provides, beside 50,000 leases", consumed(true), close);
    row("5,000 selectors wait for a kind: 4,000 units of it are given back", selectors(5_000), give_back);
    row("the same: one unit of another kind is taken and given back", behind(selectors(5_000)), take_another);
    row("end a task that consumed 50,000 resources, part by part", consumed(false), end_task);
    row("acquire 47,300 of a kind and 8,000 of those with an attribute", much(), more_than_all);
}

/// Does something, until it is done, then lets the pool take turns until nothing is left to do.
fn row(what: &str, mut pool: Pool, act: fn(&mut Pool) -> bool) {
    drained(&mut pool);
    let (mut longest, mut turns) = (Duration::ZERO, 0);
    let began = Instant::now();
    let mut turn = |pool: &mut Pool, act: &dyn Fn(&mut Pool) -> bool| {
        let began = Instant::now();
        let done = act(pool);
        drained(pool);
        longest = longest.max(began.elapsed());
        turns += 1;
        done
    };
    while !turn(&mut pool, &act) {}
    while pool.next_deadline() == Some(Timestamp(0)) && began.elapsed() < Duration::from_secs(60) {
        turn(&mut pool, &on_time);
    }
    println!("{what:<72} {longest:>12.1?} {:>12.1?} {turns:>8}", began.elapsed());
}

fn end_task(pool: &mut Pool) -> bool {
    pool.end_task(Timestamp(0), &SessionId::from("s")).unwrap()
}

fn on_time(pool: &mut Pool) -> bool {
    pool.advance(Timestamp(0));
    true
}

fn drained(pool: &mut Pool) {
    drop(pool.take_notices());
    drop(pool.take_records());
}

fn pool() -> Pool {
    let mut pool = Pool::new(Limits { units_per_request: 100_000, ..Limits::default() });
    for name in ["s", "other"] {
        pool.keep_alive(Timestamp(0), &SessionId::from(name), "bench", TTL).unwrap();
    }
    pool
}

fn create(pool: &mut Pool, session: Option<&str>, spec: ResourceSpec) {
    let session = session.map(SessionId::from);
    pool.create(Timestamp(0), session.as_ref(), spec).unwrap();
    drained(pool);
}

fn tool(kind: &str) -> ResourceSpec {
    ResourceSpec::new(ResourceClass::Module, kind)
}

fn ask(session: &str, operation: ResourceOperation, kind: &str, count: u32) -> AcquireRequest {
    let requirement = Requirement { count: count.into(), ..Requirement::new(operation, kind) };
    AcquireRequest::new(SessionId::from(session), vec![requirement])
}

fn acquire(pool: &mut Pool, request: AcquireRequest) {
    pool.acquire(Timestamp(0), request).unwrap();
    pool.take_records();
    let granted = pool.take_notices();
    debug_assert!(granted.len() < 10_000 || matches!(granted[0], Notice::Granted { .. }));
}

fn close(pool: &mut Pool) -> bool {
    pool.close_session(Timestamp(0), &SessionId::from("s")).unwrap();
    true
}

fn leases_of_one_resource() -> Pool {
    let mut pool = pool();
    create(&mut pool, None, tool("Tool").capacity(4_000));
    (0..4_000).for_each(|_| acquire(&mut pool, ask("s", ResourceOperation::Block, "Tool", 1)));
    pool
}

fn leases_of_many_resources() -> Pool {
    let mut pool = pool();
    (0..50_000).for_each(|_| create(&mut pool, None, tool("Tool")));
    (0..50_000).for_each(|_| acquire(&mut pool, ask("s", ResourceOperation::Block, "Tool", 1)));
    pool
}

fn consumed(provided: bool) -> Pool {
    let mut pool = pool();
    (0..50_000).for_each(|_| create(&mut pool, provided.then_some("s"), tool("Tool")));
    if provided {
        create(&mut pool, None, tool("Hot").capacity(50_000));
        pool.set_limits(Limits { holders: 100, ..Limits::default() });
        (0..500).for_each(|_| create(&mut pool, None, tool("Hot").capacity(100)));
        (0..50_000).for_each(|_| acquire(&mut pool, ask("other", ResourceOperation::Block, "Hot", 1)));
    }
    (0..50).for_each(|_| acquire(&mut pool, ask("s", ResourceOperation::Consume, "Tool", 1_000)));
    pool
}

/// So many wait for a unit of `Tool`, each for another one, and all but one unit are held.
fn selectors(count: i64) -> Pool {
    let mut pool = pool();
    create(&mut pool, None, tool("Other"));
    for number in 0..4_000 {
        create(&mut pool, None, tool("Tool").attribute("number", Value::Int(number)));
    }
    acquire(&mut pool, ask("s", ResourceOperation::Block, "Tool", 4_000));
    for number in 0..count {
        let session = if number % 2 == 0 { "s" } else { "other" };
        let mut request = ask(session, ResourceOperation::Block, "Tool", 1);
        request.requirements[0].attributes.insert("number".to_owned(), Value::Int(number));
        acquire(&mut pool, request);
    }
    while pool.next_deadline() == Some(Timestamp(0)) {
        pool.advance(Timestamp(0));
    }
    pool
}

fn give_back(pool: &mut Pool) -> bool {
    let lease = pool.leases()[0].id;
    pool.release(Timestamp(0), None, lease).unwrap();
    true
}

fn behind(mut pool: Pool) -> Pool {
    give_back(&mut pool);
    pool
}

fn take_another(pool: &mut Pool) -> bool {
    acquire(pool, ask("other", ResourceOperation::Block, "Other", 1));
    let lease = pool.youngest_lease();
    let _ = pool.release(Timestamp(0), None, lease);
    true
}

fn much() -> Pool {
    let mut pool = pool();
    for number in 0..50_000 {
        create(&mut pool, None, tool("Tool").attribute("a", Value::Bool(number % 6 == 0)));
    }
    pool
}

fn more_than_all(pool: &mut Pool) -> bool {
    let mut request = ask("s", ResourceOperation::Block, "Tool", 47_300);
    let mut special = ask("s", ResourceOperation::Block, "Tool", 8_000).requirements.remove(0);
    special.attributes.insert("a".to_owned(), Value::Bool(true));
    request.requirements.push(special);
    acquire(pool, request);
    true
}
