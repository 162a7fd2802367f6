//! What projections, lookups and commits cost, at 10⁴, 10⁵ and 10⁶ facts; what projections take in memory.
//!
//! `cargo bench -p ratn-world`. A quarter of the facts each: `at(o) = pose`, `on(o, shelf)`, `near(o, p)`, `weight(o)`.

#![allow(missing_docs, clippy::unwrap_used, reason = "a benchmark may panic")]

use divan::{AllocProfiler, Bencher, black_box};
use ratn_model::fact::{Change, FactKey, FactPattern, Term};
use ratn_model::id::Revision;
use ratn_model::pose::Pose;
use ratn_model::value::Value;
use ratn_world::world::World;
use std::cell::Cell;

#[global_allocator]
static ALLOCATOR: AllocProfiler = AllocProfiler::system();

const FACTS: [usize; 3] = [10_000, 100_000, 1_000_000];
const EFFECTS: usize = 20;

fn main() {
    divan::main();
}

fn name(kind: &str, i: usize) -> Term {
    Term::Name(format!("{kind}{i}"))
}

fn key(predicate: &str, arguments: Vec<Term>) -> FactKey {
    FactKey { predicate: predicate.to_owned(), arguments }
}

fn world(facts: usize) -> World {
    let objects = facts / 4;
    let of = |i: usize| {
        let object = || name("object", i);
        [
            (key("at", vec![object()]), Value::Pose(Pose::IDENTITY)),
            (key("on", vec![object(), name("shelf", i / 10)]), Value::Bool(true)),
            (key("near", vec![object(), name("object", (i * 7 + 1) % objects)]), Value::Bool(true)),
            (key("weight", vec![object()]), Value::Float(0.5)),
        ]
    };
    World::from_facts((0..objects).flat_map(of), Revision(1))
}

/// Twenty effects on objects far apart.
fn effects(facts: usize, seed: usize) -> Vec<Change> {
    let objects = facts / 4;
    (0..EFFECTS)
        .map(|i| Change::Set {
            fact: key("at", vec![name("object", (seed * 31 + i * (objects / EFFECTS)) % objects)]),
            value: Value::Pose(Pose::IDENTITY),
        })
        .collect()
}

#[divan::bench(args = FACTS)]
fn fork_and_twenty_effects(bencher: Bencher<'_, '_>, facts: usize) {
    let (world, effects) = (world(facts), effects(facts, 1));
    bencher.bench_local(|| world.project(black_box(&effects)).unwrap());
}

#[divan::bench(args = FACTS)]
fn point_lookup(bencher: Bencher<'_, '_>, facts: usize) {
    let (world, keys) = (world(facts), keys(facts));
    let next = Cell::new(0);
    bencher.bench_local(|| {
        next.set((next.get() + 1) % keys.len());
        world.get(black_box(&keys[next.get()])).is_some()
    });
}

#[divan::bench(args = FACTS)]
fn point_lookup_in_a_projection(bencher: Bencher<'_, '_>, facts: usize) {
    let (world, keys) = (world(facts).project(&effects(facts, 1)).unwrap(), keys(facts));
    let next = Cell::new(0);
    bencher.bench_local(|| {
        next.set((next.get() + 1) % keys.len());
        world.get(black_box(&keys[next.get()])).is_some()
    });
}

/// As many as a planner asks for, in no order.
fn keys(facts: usize) -> Vec<FactKey> {
    (0..1000).map(|i| key("at", vec![name("object", i * 7919 % (facts / 4))])).collect()
}

#[divan::bench(args = FACTS)]
fn ten_by_object(bencher: Bencher<'_, '_>, facts: usize) {
    let world = world(facts);
    let pattern = FactPattern { predicate: "on".to_owned(), arguments: vec![None, Some(name("shelf", facts / 80))] };
    assert_eq!(world.matching(&pattern).count(), 10);
    bencher.bench_local(|| world.matching(black_box(&pattern)).count());
}

#[divan::bench(args = FACTS)]
fn commit_of_twenty_effects_beside_a_projection(bencher: Bencher<'_, '_>, facts: usize) {
    let (world, effects) = (world(facts), effects(facts, 1));
    bencher.bench_local(|| {
        let mut root = world.clone();
        root.apply(black_box(&effects)).unwrap();
        root
    });
}

#[divan::bench(args = [100_000], sample_count = 10)]
fn a_thousand_projections(bencher: Bencher<'_, '_>, facts: usize) {
    let world = world(facts);
    let effects: Vec<Vec<Change>> = (0..1000).map(|i| effects(facts, i)).collect();
    bencher.bench_local(|| effects.iter().map(|e| world.project(e).unwrap()).collect::<Vec<World>>());
}
