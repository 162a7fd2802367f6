//! Several patterns at once, and how much they may look at.

use ratn_model::fact::{FactKey, FactPattern, Term};
use ratn_model::id::Revision;
use ratn_model::value::Value;
use ratn_world::search::Found;
use ratn_world::world::{Fact, World};

/// A thousand facts about twenty subjects.
fn thousand() -> World {
    let key = |a: i64, b: i64| FactKey { predicate: "p".to_owned(), arguments: [a, b, a * b].map(Term::Int).into() };
    World::from_facts((0..20).flat_map(|a| (0..50).map(move |b| (key(a, b), Value::Int(a)))), Revision(3))
}

fn pattern(arguments: [Option<i64>; 3]) -> FactPattern {
    FactPattern { predicate: "p".to_owned(), arguments: arguments.map(|argument| argument.map(Term::Int)).into() }
}

/// The facts of the thousand, as far as they were found with so many looks.
fn found(patterns: &[FactPattern], most: usize) -> (Found, Vec<FactKey>) {
    let mut keys = Vec::new();
    let mut visit = |key: &FactKey, _: &Fact| {
        keys.push(key.clone());
        true
    };
    let found = thousand().search(patterns, most, &mut visit);
    (found, keys)
}

#[test]
fn patterns_that_overlap_find_each_fact_once_and_in_order() {
    let patterns = [pattern([Some(3), None, None]), pattern([None, Some(7), None]), pattern([None, None, Some(21)])];
    let world = thousand();
    let keys = world.iter().map(|(key, _)| key.clone());
    let expected: Vec<FactKey> = keys.filter(|key| patterns.iter().any(|pattern| pattern.matches(key))).collect();
    assert!(expected.len() > 60);
    assert_eq!(found(&patterns, usize::MAX), (Found::All, expected));
    assert_eq!(found(&[], 0), (Found::All, Vec::new()));
}

#[test]
fn different_patterns_over_many_facts_take_no_more_looks_than_they_may() {
    // Each looks at all fifty facts about a subject, and none matches.
    let patterns: Vec<FactPattern> = (0..20).map(|a| pattern([Some(a), None, Some(-1)])).collect();
    assert_eq!(found(&patterns, 1_000), (Found::All, Vec::new()));
    assert_eq!(found(&patterns, 999), (Found::Unfinished, Vec::new()));
}

#[test]
fn who_has_enough_is_shown_no_more() {
    let mut seen = 0;
    let mut two = |_: &FactKey, _: &Fact| {
        seen += 1;
        seen < 2
    };
    assert_eq!(thousand().search(&[pattern([None, None, None])], 3, &mut two), Found::All);
    assert_eq!(seen, 2);
}
