//! What projections, lookups, commits, contradictions, queries and scenes cost, at 10⁴, 10⁵ and 10⁶ facts; what projections take
//! in memory.
//!
//! `cargo bench -p ratn-world`. A quarter of the facts each: `at(o) = pose`, `on(o, shelf)`, `near(o, p)`, `weight(o)`.

#![allow(missing_docs, clippy::unwrap_used, reason = "a benchmark may panic")]

use divan::{AllocProfiler, Bencher, black_box};
use ratn_model::fact::{Change, FactKey, FactPattern, Footprint, Term};
use ratn_model::id::Revision;
use ratn_model::pose::Pose;
use ratn_model::tolerance::Tolerance;
use ratn_model::value::Value;
use ratn_world::query::Query;
use ratn_world::reads::{Effect, Live};
use ratn_world::scene::Shape;
use ratn_world::scene::delta::SceneDelta;
use ratn_world::scene::live::LiveScene;
use ratn_world::world::World;
use std::cell::Cell;
use std::collections::BTreeMap;
use std::sync::Arc;

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

#[divan::bench(args = FACTS, sample_size = 1000)]
fn point_lookup(bencher: Bencher<'_, '_>, facts: usize) {
    let (world, keys) = (world(facts), keys(facts));
    let next = Cell::new(0);
    bencher.bench_local(|| {
        next.set((next.get() + 1) % keys.len());
        world.get(black_box(&keys[next.get()])).is_some()
    });
}

/// Facts that a planner asks for again and again.
#[divan::bench(args = FACTS, sample_size = 1000)]
fn point_lookup_of_thirty_two_keys(bencher: Bencher<'_, '_>, facts: usize) {
    let (world, keys) = (world(facts), keys(facts));
    let next = Cell::new(0);
    bencher.bench_local(|| {
        next.set((next.get() + 1) % 32);
        world.get(black_box(&keys[next.get()])).is_some()
    });
}

/// Facts that no lookup touched before for long: each from memory, with the key that asks for it.
#[divan::bench(args = FACTS, sample_size = 1000)]
fn point_lookup_from_memory(bencher: Bencher<'_, '_>, facts: usize) {
    let world = world(facts);
    let objects = facts / 4;
    let keys: Vec<FactKey> = (0..objects).map(|i| key("at", vec![name("object", i * 7919 % objects)])).collect();
    let next = Cell::new(0);
    bencher.bench_local(|| {
        next.set((next.get() + 1) % keys.len());
        world.get(black_box(&keys[next.get()])).is_some()
    });
}

#[divan::bench(args = FACTS, sample_size = 1000)]
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

#[divan::bench(args = FACTS, sample_size = 1000)]
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

/// One commit after the other while somebody holds the first world and, as the pool does, the one before: the slowest is what
/// a commit can take when it copies a shard of the table.
#[divan::bench(args = FACTS, sample_count = 10_000, sample_size = 1)]
fn commits_in_a_row_beside_who_holds_the_first(bencher: Bencher<'_, '_>, facts: usize) {
    let first = world(facts);
    let mut root = first.clone();
    let mut seed = 0;
    bencher
        .with_inputs(|| {
            seed += 1;
            effects(facts, seed)
        })
        .bench_local_values(|effects| {
            let before = root.clone();
            root.apply(&effects).unwrap();
            before
        });
    assert_eq!(first.len(), facts);
}

/// A node's commit of its 20 effects, checked against 100 live projections that predicted them: all read where anything is (`at(?)`),
/// and each the weights of 20 objects.
#[divan::bench(args = FACTS)]
fn commit_against_a_hundred_projections_that_read_what_it_writes(bencher: Bencher<'_, '_>, facts: usize) {
    contradictions(bencher, facts, true);
}

/// The same, where each projection reads only the weights of its 20 objects.
#[divan::bench(args = FACTS)]
fn commit_against_a_hundred_projections_that_read_other_facts(bencher: Bencher<'_, '_>, facts: usize) {
    contradictions(bencher, facts, false);
}

fn contradictions(bencher: Bencher<'_, '_>, facts: usize, everywhere: bool) {
    let root = world(facts);
    let commit = effects(facts, 1);
    let weight = |i: usize| FactPattern::of(&key("weight", vec![name("object", i % (facts / 4))]));
    let mut live: Live<usize> = Live::default();
    for id in 0..100 {
        let mut reads: Vec<FactPattern> = (0..20).map(|i| weight(id * 37 + i * 101)).collect();
        if everywhere {
            reads.push(FactPattern { predicate: "at".to_owned(), arguments: vec![None] });
        }
        let effect = |change: &Change| Effect { writer: Some(Arc::from("place")), change: change.clone() };
        let shown = root.project(&commit).unwrap();
        live.insert(id, root.revision(), shown, commit.iter().map(effect).collect(), Footprint::Patterns(reads));
    }
    let after = root.project(&commit).unwrap();
    let exact = |_: &str| Tolerance::EXACT;
    bencher.with_inputs(|| live.clone()).bench_local_refs(|live| {
        let found = live.contradicted(&root, &after, Some("place"), black_box(&commit), &exact);
        assert!(found.is_empty());
    });
}

/// Ten things on a shelf, what each is near, and the weight of that.
#[divan::bench(args = FACTS)]
fn join_of_three_with_ten_answers(bencher: Bencher<'_, '_>, facts: usize) {
    let world = world(facts);
    let query = Query::parse("on(?thing, $shelf), near(?thing, ?other), weight(?other) < 1").unwrap();
    let prepared = query.prepare(None).unwrap();
    let shelf = BTreeMap::from([("shelf".to_owned(), Value::String(format!("shelf{}", facts / 80)))]);
    assert_eq!(prepared.run(&world, &shelf, 100).unwrap().rows.len(), 10);
    bencher.bench_local(|| prepared.run(black_box(&world), &shelf, 100).unwrap());
}

/// Twenty of a thousand objects move: the scene follows, and the delta is made.
#[divan::bench]
fn scene_of_a_thousand_objects_follows_twenty_effects(bencher: Bencher<'_, '_>) {
    let shape = Shape::Box { size: [0.1; 3] }.to_value();
    let place = |x: usize| Value::Pose(Pose::at(x as f64, 0.0, 0.0));
    let of = |i: usize| {
        [(key("shape", vec![name("object", i)]), shape.clone()), (key("at", vec![name("object", i)]), place(i))]
    };
    let before = World::from_facts((0..1000).flat_map(of), Revision(1));
    let changes: Vec<Change> = (0..EFFECTS)
        .map(|i| Change::Set { fact: key("at", vec![name("object", i * 49)]), value: place(2000 + i) })
        .collect();
    let after = before.project(&changes).unwrap();
    let scene = LiveScene::of(&before).unwrap();
    bencher.bench_local(|| {
        let mut next = scene.clone();
        next.update(&before, &after, black_box(&changes)).unwrap();
        SceneDelta::between(&scene, &next)
    });
}

#[divan::bench(args = [100_000], sample_count = 10)]
fn a_thousand_projections(bencher: Bencher<'_, '_>, facts: usize) {
    let world = world(facts);
    let effects: Vec<Vec<Change>> = (0..1000).map(|i| effects(facts, i)).collect();
    bencher.bench_local(|| effects.iter().map(|e| world.project(e).unwrap()).collect::<Vec<World>>());
}
