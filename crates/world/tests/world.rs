//! The world against the obvious model: a plain map, scanned.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use proptest::prelude::*;
use ratn_model::fact::{Change, FactKey, FactPattern, Term};
use ratn_model::id::Revision;
use ratn_model::value::Value;
use ratn_world::world::{ChangeError, OVERLAY_LIMIT, World};
use std::collections::BTreeMap;
use std::sync::Arc;

fn term() -> impl Strategy<Value = Term> {
    prop_oneof![(0_i64..3).prop_map(Term::Int), "[ab]{1,2}".prop_map(Term::Name)]
}

fn key() -> impl Strategy<Value = FactKey> {
    ("[pq]{1,2}", prop::collection::vec(term(), 0..4))
        .prop_map(|(predicate, arguments)| FactKey { predicate, arguments })
}

fn pattern() -> impl Strategy<Value = FactPattern> {
    ("[pq]{1,2}", prop::collection::vec(prop::option::of(term()), 0..4))
        .prop_map(|(predicate, arguments)| FactPattern { predicate, arguments })
}

fn change() -> impl Strategy<Value = Change> {
    prop_oneof![
        4 => (key(), -5_i64..5).prop_map(|(fact, i)| Change::Set { fact, value: Value::Int(i) }),
        1 => pattern().prop_map(|pattern| Change::Delete { pattern }),
        1 => (key(), -3_i64..3).prop_map(|(fact, by)| Change::Increase { fact, by: by as f64 }),
    ]
}

fn apply(model: &mut BTreeMap<FactKey, Value>, change: &Change) {
    match change {
        Change::Set { fact, value } => {
            model.insert(fact.clone(), value.clone());
        }
        Change::Delete { pattern } => model.retain(|key, _| !pattern.matches(key)),
        Change::Increase { fact, by } => {
            let old = model.get(fact).and_then(Value::as_number).unwrap_or(0.0);
            model.insert(fact.clone(), Value::Int((old + by) as i64));
        }
    }
}

fn facts(world: &World) -> BTreeMap<FactKey, Value> {
    world.iter().map(|(key, fact)| (key.clone(), fact.value.clone())).collect()
}

proptest! {
    #[test]
    fn changes_and_patterns_do_what_the_obvious_model_does(
        changes in prop::collection::vec(change(), 0..40),
        patterns in prop::collection::vec(pattern(), 0..8),
    ) {
        let (mut world, mut model) = (World::default(), BTreeMap::new());
        for change in &changes {
            world.apply(std::slice::from_ref(change)).unwrap();
            apply(&mut model, change);
        }
        prop_assert_eq!(&facts(&world), &model);
        for pattern in &patterns {
            let found: Vec<FactKey> = world.matching(pattern).map(|(key, _)| key.clone()).collect();
            let expected: Vec<FactKey> = model.keys().filter(|key| pattern.matches(key)).cloned().collect();
            prop_assert_eq!(found, expected);
        }
    }

    #[test]
    fn a_projection_is_the_root_with_the_changes_and_leaves_the_root_alone(
        before in prop::collection::vec(change(), 0..20),
        after in prop::collection::vec(change(), 0..20),
    ) {
        let mut root = World::default();
        root.apply(&before).unwrap();
        let unchanged = root.clone();
        let projection = root.project(&after).unwrap();
        prop_assert_eq!(&root, &unchanged);
        root.apply(&after).unwrap();
        prop_assert_eq!(&projection, &root);
        prop_assert_eq!(projection.len(), root.len());
        prop_assert_eq!(facts(&projection).len(), root.len());
    }

    #[test]
    fn a_projection_of_a_projection_finds_what_the_obvious_model_finds(
        lists in prop::collection::vec(prop::collection::vec(change(), 0..12), 0..6),
        patterns in prop::collection::vec(pattern(), 0..8),
        commits in any::<[bool; 6]>(),
    ) {
        let (mut world, mut model) = (World::default(), BTreeMap::new());
        for (changes, commit) in lists.iter().zip(commits) {
            if commit {
                world.apply_as(Some("place"), changes).unwrap();
            } else {
                let writers = vec![Arc::from("place"); changes.len()];
                world = world.project_as(&writers, changes).unwrap();
            }
            changes.iter().for_each(|change| apply(&mut model, change));
        }
        prop_assert_eq!(&facts(&world), &model);
        prop_assert_eq!(world.len(), model.len());
        prop_assert!(world.iter().all(|(_, fact)| fact.writer.as_deref() == Some("place") && fact.revision <= world.revision()));
        for (key, value) in &model {
            prop_assert_eq!(world.get(key), Some(value));
        }
        for pattern in &patterns {
            let found: Vec<FactKey> = world.matching(pattern).map(|(key, _)| key.clone()).collect();
            let expected: Vec<FactKey> = model.keys().filter(|key| pattern.matches(key)).cloned().collect();
            prop_assert_eq!(found, expected);
        }
    }
}

#[test]
fn a_list_of_changes_applies_as_a_whole_or_not_at_all() {
    let key = |name: &str| FactKey { predicate: name.to_owned(), arguments: Vec::new() };
    let mut world = World::default();
    world.apply(&[Change::Set { fact: key("colour"), value: Value::String("red".to_owned()) }]).unwrap();
    let before = world.clone();
    let result = world.apply(&[
        Change::Set { fact: key("count"), value: Value::Int(1) },
        Change::Increase { fact: key("colour"), by: 1.0 },
    ]);
    assert!(matches!(result, Err(ChangeError::NotANumber { .. })));
    assert_eq!(world, before);
}

#[test]
fn an_increase_beyond_the_range_of_numbers_is_refused_and_changes_nothing() {
    let key = FactKey { predicate: "count".to_owned(), arguments: Vec::new() };
    let largest = 9_007_199_254_740_992.0;
    let check = |before: Option<Value>, by: f64, expect: Option<Value>| {
        let mut world = World::from_facts(before.clone().map(|value| (key.clone(), value)), Revision(1));
        let unchanged = world.clone();
        let result = world.apply(&[Change::Increase { fact: key.clone(), by }]);
        match expect {
            Some(value) => {
                assert_eq!((result, world.get(&key)), (Ok(Revision(2)), Some(&value)), "{before:?} and {by}")
            }
            None => {
                let refused = result.unwrap_err();
                assert!(matches!(refused, ChangeError::OutOfRange { .. }), "{before:?} and {by}: {refused}");
                assert!(refused.to_string().contains("beyond the range of its numbers"), "{refused}");
                assert_eq!(world, unchanged);
            }
        }
    };
    let int = |value| Some(Value::Int(value));
    check(int(i64::MAX - 1), 1.0, int(i64::MAX));
    check(int(i64::MAX), 1.0, None);
    check(int(i64::MIN), -1.0, None);
    check(int(i64::MIN + 1), -1.0, int(i64::MIN));
    check(int(0), 9.3e18, None);
    check(int(-1), 9_223_372_036_854_775_808.0, None);
    check(None, 1e300, None);
    check(None, -9_223_372_036_854_775_808.0, int(i64::MIN));
    check(None, largest, int(9_007_199_254_740_992));
    check(Some(Value::Float(f64::MAX)), f64::MAX, None);
    check(Some(Value::Float(1.5)), 1e300, Some(Value::Float(1e300)));
}

#[test]
fn a_projection_that_differs_in_more_than_an_overlay_holds_is_as_right_as_a_small_one() {
    let set = |i: i64, value: i64| Change::Set {
        fact: FactKey { predicate: "count".to_owned(), arguments: vec![Term::Int(i)] },
        value: Value::Int(value),
    };
    let many = i64::try_from(OVERLAY_LIMIT).unwrap() * 2;
    let mut root = World::default();
    root.apply(&(0..many).map(|i| set(i, 0)).collect::<Vec<_>>()).unwrap();
    let changes: Vec<Change> = (0..many).map(|i| set(i, 1)).collect();
    let projection = root.project(&changes).unwrap();
    assert!(projection.iter().all(|(_, fact)| fact.value == Value::Int(1)));
    assert!(root.iter().all(|(_, fact)| fact.value == Value::Int(0)), "the root is as it was");
    root.apply(&changes).unwrap();
    assert_eq!(projection, root);
}
