//! What a commit contradicts, against recomputing what every projection would show; digests of what is read.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use proptest::prelude::*;
use ratn_model::fact::{Change, FactKey, FactPattern, Footprint, Term};
use ratn_model::tolerance::Tolerance;
use ratn_model::value::Value;
use ratn_world::digest::Digest;
use ratn_world::reads::{Contradiction, Effect, Live};
use ratn_world::world::World;
use std::collections::BTreeMap;
use std::sync::Arc;

type Facts = BTreeMap<FactKey, Value>;

fn term() -> impl Strategy<Value = Term> {
    prop_oneof![(0_i64..2).prop_map(Term::Int), "[ab]".prop_map(Term::Name)]
}

fn key() -> impl Strategy<Value = FactKey> {
    let arguments =
        prop_oneof![9 => prop::collection::vec(term(), 0..3), 1 => prop::collection::vec(Just(Term::Int(0)), 7)];
    ("[pq]", arguments).prop_map(|(predicate, arguments)| FactKey { predicate, arguments })
}

fn pattern() -> impl Strategy<Value = FactPattern> {
    let arguments = prop_oneof![
        9 => prop::collection::vec(prop::option::of(term()), 0..3),
        1 => prop::collection::vec(prop::option::of(Just(Term::Int(0))), 7)
    ];
    ("[pq]", arguments).prop_map(|(predicate, arguments)| FactPattern { predicate, arguments })
}

fn change() -> impl Strategy<Value = Change> {
    prop_oneof![
        4 => (key(), 0_i64..3).prop_map(|(fact, i)| Change::Set { fact, value: Value::Int(i) }),
        1 => pattern().prop_map(|pattern| Change::Delete { pattern }),
        1 => (key(), -1_i64..2).prop_map(|(fact, by)| Change::Increase { fact, by: by as f64 }),
    ]
}

fn footprint() -> impl Strategy<Value = Footprint> {
    prop_oneof![
        1 => Just(Footprint::Everything),
        6 => prop::collection::vec(pattern(), 0..4).prop_map(Footprint::Patterns),
    ]
}

#[derive(Debug, Clone)]
enum Step {
    Project(Vec<(Option<u8>, Change)>, Footprint),
    Commit(Option<u8>, Vec<Change>),
    /// What a projection predicted of a writer, exactly.
    ComesTrue(usize, u8),
    Release(usize),
}

fn step() -> impl Strategy<Value = Step> {
    let writer = || prop::option::of(0_u8..3);
    prop_oneof![
        3 => (prop::collection::vec((writer(), change()), 0..4), footprint()).prop_map(|(e, r)| Step::Project(e, r)),
        3 => (writer(), prop::collection::vec(change(), 0..4)).prop_map(|(w, c)| Step::Commit(w, c)),
        1 => (0_usize..6, 0_u8..3).prop_map(|(p, w)| Step::ComesTrue(p, w)),
        1 => (0_usize..6).prop_map(Step::Release),
    ]
}

fn apply(facts: &mut Facts, change: &Change) {
    match change {
        Change::Set { fact, value } => drop(facts.insert(fact.clone(), value.clone())),
        Change::Delete { pattern } => facts.retain(|key, _| !pattern.matches(key)),
        Change::Increase { fact, by } => {
            let old = facts.get(fact).and_then(Value::as_number).unwrap_or(0.0);
            facts.insert(fact.clone(), Value::Int((old + by) as i64));
        }
    }
}

/// The obvious model of a projection: what it read, its effects still to come, its reads.
struct Model {
    read: Facts,
    effects: Vec<Effect>,
    reads: Footprint,
}

fn read(root: &Facts, effects: &[Effect], reads: &Footprint) -> Facts {
    let mut facts = root.clone();
    effects.iter().for_each(|effect| apply(&mut facts, &effect.change));
    facts.retain(|key, _| reads.contains(key));
    facts
}

fn first_difference(id: usize, was: &Facts, is: &Facts) -> Option<Contradiction<usize>> {
    let mut keys: Vec<&FactKey> = was.keys().chain(is.keys()).collect();
    keys.sort_unstable();
    let fact = keys.into_iter().find(|key| was.get(*key) != is.get(*key))?.clone();
    let (was, is) = (was.get(&fact).cloned(), is.get(&fact).cloned());
    Some(Contradiction { projection: id, fact, was, is })
}

fn name(writer: u8) -> Arc<str> {
    Arc::from(format!("w{writer}"))
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 600, ..ProptestConfig::default() })]

    #[test]
    fn a_commit_contradicts_those_that_would_show_something_else_and_no_others(steps in prop::collection::vec(step(), 1..25)) {
        let mut root = World::default();
        let mut root_model = Facts::new();
        let mut live: Live<usize> = Live::default();
        let mut models: BTreeMap<usize, Model> = BTreeMap::new();
        let mut next = 0;
        for step in steps {
            let (writer, changes) = match step {
                Step::Project(effects, reads) => {
                    let effects: Vec<Effect> =
                        effects.into_iter().map(|(w, change)| Effect { writer: w.map(name), change }).collect();
                    let changes: Vec<Change> = effects.iter().map(|effect| effect.change.clone()).collect();
                    live.insert(next, root.revision(), root.project(&changes).unwrap(), effects.clone(), reads.clone());
                    models.insert(next, Model { read: read(&root_model, &effects, &reads), effects, reads });
                    next += 1;
                    continue;
                }
                Step::Release(nth) => {
                    if let Some(id) = models.keys().nth(nth).copied() {
                        models.remove(&id);
                        live.remove(id);
                    }
                    continue;
                }
                Step::ComesTrue(nth, w) => {
                    let Some(model) = models.values().nth(nth) else { continue };
                    let of_writer = model.effects.iter().filter(|e| e.writer.as_deref() == Some(&*name(w)));
                    (Some(w), of_writer.map(|e| e.change.clone()).collect::<Vec<_>>())
                }
                Step::Commit(w, changes) => (w, changes),
            };
            let writer = writer.map(name);
            let before = root.clone();
            root.apply_as(writer.as_deref(), &changes).unwrap();
            changes.iter().for_each(|change| apply(&mut root_model, change));
            let found = live.contradicted(&before, &root, writer.as_deref(), &changes, &|_| Tolerance::EXACT);
            let mut expected = Vec::new();
            for (id, model) in &mut models {
                model.effects.retain(|effect| writer.is_none() || effect.writer != writer);
                expected.extend(first_difference(*id, &model.read, &read(&root_model, &model.effects, &model.reads)));
            }
            prop_assert_eq!(&found, &expected);
            for Contradiction { projection, .. } in found {
                live.remove(projection);
                models.remove(&projection);
            }
            prop_assert_eq!(live.len(), models.len());
        }
    }

    #[test]
    fn digests_are_equal_where_the_reads_and_what_they_show_are(
        a in prop::collection::vec(change(), 0..6),
        b in prop::collection::vec(change(), 0..6),
        reads in footprint(),
        others in footprint(),
    ) {
        let world = |changes: &[Change]| World::default().project(changes).unwrap();
        let shown = |world: &World| -> Facts {
            world.iter().filter(|(key, _)| reads.contains(key)).map(|(key, fact)| (key.clone(), fact.value.clone())).collect()
        };
        let (a, b) = (world(&a), world(&b));
        prop_assert_eq!(Digest::of_reads(&a, &reads) == Digest::of_reads(&b, &reads), shown(&a) == shown(&b));
        let set = |reads: &Footprint| match reads {
            Footprint::Everything => None,
            Footprint::Patterns(patterns) => Some(patterns.iter().cloned().collect::<std::collections::BTreeSet<_>>()),
        };
        prop_assert_eq!(Digest::of_reads(&a, &reads) == Digest::of_reads(&a, &others), set(&reads) == set(&others));
    }
}

#[test]
fn what_came_nearly_as_predicted_is_no_contradiction_and_what_did_not_come_is_one() {
    let fact = FactKey { predicate: "at".to_owned(), arguments: vec![Term::Name("box".to_owned())] };
    let set = |x: f64| Change::Set { fact: fact.clone(), value: Value::Float(x) };
    let mut live = Live::default();
    let mut root = World::default();
    let effects = vec![Effect { writer: Some(Arc::from("place")), change: set(1.0) }];
    let reads = Footprint::Patterns(vec![FactPattern::of(&fact)]);
    live.insert(7, root.revision(), root.project(&[set(1.0)]).unwrap(), effects, reads);
    let mut commit = |live: &mut Live<u32>, writer: &str, changes: &[Change]| {
        let before = root.clone();
        root.apply(changes).unwrap();
        live.contradicted(&before, &root, Some(writer), changes, &|_| Tolerance { number: 0.1, ..Tolerance::EXACT })
    };
    assert_eq!(commit(&mut live, "other", &[set(5.0)]), [], "it will be overwritten by what is still to come");
    let mut empty = live.clone();
    assert_eq!(commit(&mut live, "place", &[set(1.05)]), []);
    let gone = Change::Delete { pattern: FactPattern::of(&fact) };
    let found = commit(&mut empty, "place", &[gone]);
    assert_eq!(found, [Contradiction { projection: 7, fact: fact.clone(), was: Some(Value::Float(1.0)), is: None }]);
}

/// Each at a base of its own, half of them of everything, half of all that moves.
#[test]
fn a_commit_costs_its_facts_and_who_reads_them_and_not_the_product_of_the_two() {
    const READERS: usize = 200;
    const FACTS: i64 = 300;
    let fact = |i: i64| FactKey { predicate: "at".to_owned(), arguments: vec![Term::Int(i)] };
    let all = |x: f64| (0..FACTS).map(|i| Change::Set { fact: fact(i), value: Value::Float(x) }).collect::<Vec<_>>();
    let mut root = World::default();
    root.apply(&all(0.0)).unwrap();
    let mut live: Live<usize> = Live::default();
    for id in 0..READERS {
        let reads = match id % 2 {
            0 => Footprint::Everything,
            _ => Footprint::Patterns(vec![FactPattern { predicate: "at".to_owned(), arguments: vec![None] }]),
        };
        let own = Change::Set { fact: fact(id as i64), value: Value::Float(7.0) };
        let effect = Effect { writer: Some(Arc::from("place")), change: own.clone() };
        live.insert(id, root.revision(), root.project(&[own]).unwrap(), vec![effect], reads);
        let other = FactKey { predicate: "other".to_owned(), arguments: Vec::new() };
        root.apply(&[Change::Set { fact: other, value: Value::Int(id as i64) }]).unwrap();
    }
    let mut commit = |live: &mut Live<usize>, x: f64| {
        let (before, looks) = (root.clone(), std::cell::Cell::new(0));
        root.apply(&all(x)).unwrap();
        let tolerance = |_: &str| {
            looks.set(looks.get() + 1);
            Tolerance { number: 0.1, ..Tolerance::EXACT }
        };
        (live.contradicted(&before, &root, None, &all(x), &tolerance), looks.get())
    };
    // Nearly the same, twice: the second time it was written behind all bases. Both patterns look at each fact.
    for x in [0.04, 0.08] {
        let (found, looks) = commit(&mut live, x);
        assert!(found.is_empty() && looks <= 2 * FACTS, "{looks} looks");
    }
    // What is still to come of one hides the first fact from it.
    let (found, looks) = commit(&mut live, 1.0);
    let first: Vec<_> = found.iter().map(|found| found.fact.clone()).collect();
    let expected = (0..READERS).map(|id| fact(i64::from(id == 0)));
    assert_eq!(first, expected.collect::<Vec<_>>());
    assert!(looks <= 2 * FACTS, "{looks} looks");
}

#[test]
fn a_digest_is_the_same_on_every_machine() {
    let values =
        BTreeMap::from([("goal".to_owned(), Value::List(vec![Value::Int(1), Value::Null, Value::Float(0.5)].into()))]);
    assert_eq!(
        Digest::of_values(&values).to_string(),
        "e2c0b3c65406f047137d90a5aeefb4db135767155e79372c11e24708e8c53875"
    );
    assert_eq!(Digest::of_values(&BTreeMap::new()), Digest::of_values(&BTreeMap::new()));
}
