//! Queries: what they mean, against an obvious model; what is refused; that hostile ones end soon.

#![allow(clippy::unwrap_used, reason = "a test may panic")]
#![allow(clippy::disallowed_methods, reason = "that answering is bounded in time is what is tested")]

use proptest::prelude::*;
use ratn_model::fact::{Change, FactKey, Term};
use ratn_model::id::Revision;
use ratn_model::ontology::turtle;
use ratn_model::pose::Pose;
use ratn_model::value::Value;
use ratn_world::query::{Query, QueryError, Rows};
use ratn_world::world::World;
use std::collections::BTreeMap;
use std::time::{Duration, Instant};

/// Longer than any query within the bounds takes, by far, in a debug build on a busy machine.
const SOON: Duration = Duration::from_secs(60);

fn key(predicate: &str, arguments: &[&str]) -> FactKey {
    let term = |text: &&str| text.parse().map_or_else(|_| Term::Name((*text).to_owned()), Term::Int);
    FactKey { predicate: predicate.to_owned(), arguments: arguments.iter().map(term).collect() }
}

fn depot() -> World {
    let pose = |x| Value::Pose(Pose::at(x, 0.0, 0.5));
    let facts = [
        (key("at", &["box_1"]), pose(1.0)),
        (key("at", &["box_2"]), pose(2.0)),
        (key("at", &["box_3"]), pose(3.0)),
        (key("at", &["table"]), pose(0.0)),
        (key("class", &["box_1", "SLC"]), Value::Bool(true)),
        (key("class", &["box_2", "SLC"]), Value::Bool(true)),
        (key("class", &["box_3", "SLC"]), Value::Bool(true)),
        (key("class", &["box_4", "SLC"]), Value::Bool(true)),
        (key("class", &["table", "SLC"]), Value::Bool(false)),
        (key("in_gripper", &["box_2"]), pose(0.0)),
        (key("weight", &["box_1"]), Value::Float(1.5)),
        (key("weight", &["box_2"]), Value::Int(1)),
        (key("weight", &["box_3"]), Value::Float(2.5)),
        (key("next", &["1"]), Value::Int(2)),
        (key("next", &["2"]), Value::Int(3)),
        (key("owner", &["box_1"]), Value::String("ann".to_owned())),
        (key("likes", &["ann", "ann"]), Value::Bool(true)),
        (key("likes", &["ann", "ben"]), Value::Bool(true)),
    ];
    World::from_facts(facts, Revision(1))
}

fn ask(text: &str) -> Result<Rows, QueryError> {
    Query::parse(text)?.prepare(None)?.run(&depot(), &BTreeMap::new(), 100)
}

/// `?a ?b: 1 2 | 3 4`
fn printed(rows: &Rows) -> String {
    let row = |row: &Vec<Value>| row.iter().map(ToString::to_string).collect::<Vec<_>>().join(" ");
    let rows_: Vec<String> = rows.rows.iter().map(row).collect();
    format!("{}: {}{}", rows.variables.join(" "), rows_.join(" | "), if rows.more { " …" } else { "" })
}

fn check(text: &str, expect: &str) {
    match ask(text) {
        Ok(rows) => assert_eq!(printed(&rows), expect, "{text}"),
        Err(error) => assert_eq!(error.to_string(), expect, "{text}"),
    }
}

#[test]
fn a_query_finds_what_makes_all_its_conditions_true() {
    check("class(?box, SLC), not in_gripper(?box), weight(?box) < 2, exists at(?box)", "box: box_1");
    let rows = ask("at(?box) = ?pose, class(?box, SLC), not in_gripper(?box), weight(?box) < 2").unwrap();
    assert_eq!(rows.variables, ["box", "pose"]);
    assert_eq!(rows.rows, [[Value::String("box_1".to_owned()), Value::Pose(Pose::at(1.0, 0.0, 0.5))]]);
}

#[test]
fn each_form_of_a_condition_means_what_the_table_says() {
    check("class(?x, SLC)", "x: box_1 | box_2 | box_3 | box_4");
    check("exists class(?x, SLC)", "x: box_1 | box_2 | box_3 | box_4 | table");
    check("class(?x, SLC) = false", "x: table");
    check("class(?x, SLC), not at(?x)", "x: box_4");
    check("class(?x, SLC), not exists at(?x)", "x: box_4");
    check("class(?x, SLC), not weight(?x) < 2", "x: box_3 | box_4");
    check("class(?x, SLC), exists (weight(?x) = ?w, ?w < 2)", "x: box_1 | box_2");
    check("class(?x, SLC), not (weight(?x) = ?w, ?w < 2)", "at character 37: expected `)`, found `,`");
    check("class(?x, SLC), not exists (weight(?x) = ?w, ?w < 2)", "x: box_3 | box_4");
    check("class(?x, SLC) and weight(?x) >= 1.5", "x: box_1 | box_3");
    check("weight(?x) = ?w, ?w < 1.5 or ?w > 2, class(?x, SLC)", "x w: box_2 1 | box_3 2.5");
    check("weight(?x) = weight(?y), ?x != ?y", "x y: ");
    check("weight(?x) < weight(?y)", "x y: box_1 box_3 | box_2 box_1 | box_2 box_3");
    check("weight(?x) = ?w, ?double = ?w * 2", "x w double: box_1 1.5 3 | box_2 1 2 | box_3 2.5 5");
    check(
        "at(?x) = ?p, ?p.x > 1.5",
        "x p: box_2 pose(2.000, 0.000, 0.500; 0.000, 0.000, 0.000, 1.000) | box_3 pose(3.000, 0.000, 0.500; 0.000, 0.000, 0.000, 1.000)",
    );
    check("at(?x).x > 1.5, class(?x, ?)", "x: box_2 | box_3");
    check("owner(?box) = ?who, likes(?who, ?who)", "box who: box_1 ann");
    check("owner(?box) = ?who, likes(?who, ?other), ?other != ?who", "box who other: box_1 ann ben");
    check("next(?a) = ?b, next(?b) = ?c", "a b c: 1 2 3");
    check("next(?a) = ?a + 1", "a: 1 | 2");
    check("at(table)", ": ");
    assert_eq!(ask("at(table)").unwrap().rows, [Vec::new()]);
    assert!(ask("at(nowhere)").unwrap().rows.is_empty());
    check("likes(?x, ?x)", "x: ann");
    check("weight(?x) in [1, 2.5]", "x: box_2 | box_3");
}

#[test]
fn answers_are_cut_to_what_was_asked_for_and_say_so() {
    let prepared = Query::parse("class(?x, $kind)").unwrap().prepare(None).unwrap();
    let kind = |kind: &str| BTreeMap::from([("kind".to_owned(), Value::String(kind.to_owned()))]);
    assert_eq!(printed(&prepared.run(&depot(), &kind("SLC"), 2).unwrap()), "x: box_1 | box_2 …");
    assert_eq!(printed(&prepared.run(&depot(), &kind("SLC"), 4).unwrap()), "x: box_1 | box_2 | box_3 | box_4");
    assert_eq!(printed(&prepared.run(&depot(), &kind("KLT"), 4).unwrap()), "x: ");
    let refused = |arguments: &BTreeMap<String, Value>| prepared.run(&depot(), arguments, 2).unwrap_err().to_string();
    assert_eq!(refused(&BTreeMap::new()), "the query needs a value for `$kind`");
    let mut more = kind("SLC");
    more.insert("knid".to_owned(), Value::Null);
    assert_eq!(refused(&more), "the query has no `$knid`");
}

#[test]
fn what_is_no_query_is_refused_with_the_reason() {
    check("", "at character 1: expected a value, found the end");
    check("at(?x", "at character 6: expected `,`, found the end");
    check("at(?x),", "at character 8: expected a value, found the end");
    check(
        "?x < 2",
        "at character 1: `?x` in `?x < 2` gets no value: no fact of the query has it as an argument or says it",
    );
    check("at(?x), not in(?y, ?z), ?y = 1", "at character 13: expected a value, found the keyword `in`");
    check(
        "box.pose = 1",
        "at character 1: `box.pose` is the output of a state, and a query has none; write `?box.pose` for a field of a variable, or quote a text that contains a point",
    );
    check("at(?x) = ?p, ?p.w = 1", "`?p.w`: a pose has no field `w`");
    check("weight(?x) < heavy", "`weight(?x) < heavy`: expected a number, found string `heavy`");
}

#[test]
fn an_ontology_refuses_questions_about_facts_that_cannot_be() {
    let ontology = turtle::read(include_str!("../../../examples/aimm.ttl")).unwrap();
    let refused = |text: &str| Query::parse(text).unwrap().prepare(Some(&ontology)).unwrap_err().to_string();
    assert!(Query::parse("at(?box) = ?p, weight(?box) < 2").unwrap().prepare(Some(&ontology)).is_ok());
    assert_eq!(refused("att(?box)"), "[unknown-predicate] the ontology has no predicate `att`; did you mean `at`?");
    assert_eq!(refused("at(?box, ?y)"), "[outside-domain] `at` has 1 argument, and `at(?, ?)` has 2");
    assert_eq!(
        refused("at(?x), not weight(table) > 1"),
        "[outside-domain] in `weight(table)`, `table` is a Furniture and a View, not a Portable"
    );
}

#[test]
fn hostile_queries_end_soon() {
    let began = Instant::now();
    let many = World::from_facts((0..3000).map(|i| (key("p", &[&i.to_string(), "x"]), Value::Int(i))), Revision(1));
    let run = |text: &str| Query::parse(text)?.prepare(None)?.run(&many, &BTreeMap::new(), 10);
    for text in [
        "p(?a, ?), p(?b, ?), p(?c, ?), p(?d, ?)",
        "p(?a, ?) = ?u, p(?b, ?) = ?v, ?u + ?v = -1",
        "p(?a, ?), not exists (p(?b, ?), p(?c, ?), ?b + ?c < 0)",
        "p(?a, ?) = ?u, p(?b, ?) = ?v, ?u < 0 or ?v < 0 or exists (p(?x, ?) = ?w, p(?y, ?) = ?z, ?w + ?z < 0)",
    ] {
        let error = run(text).unwrap_err();
        let bounds = ["looks at more than 2000000 facts", "more than 100000 answers"];
        assert!(bounds.iter().any(|bound| error.to_string().contains(bound)), "{text}: {error}");
    }
    let long = "p(?a, ?), ".repeat(65) + "p(?a, ?)";
    let deep = "not ".repeat(60) + "p(?a, ?)";
    let nested = "exists (".repeat(60) + "p(?a, ?)" + &")".repeat(60);
    let wide = format!("p(?a, {})", "f(".repeat(100));
    for text in [long, deep, nested, wide, "p(".repeat(4_000), "?".repeat(9_000), "p(?a), ".repeat(2_000)] {
        assert!(Query::parse(&text).is_err(), "{}", &text[..40]);
    }
    assert!(began.elapsed() < SOON, "{:?}", began.elapsed());
}

// The obvious model: every assignment of every value to every variable.

fn value() -> impl Strategy<Value = Value> {
    prop_oneof![(0_i64..3).prop_map(Value::Int), "[ab]".prop_map(Value::String), any::<bool>().prop_map(Value::Bool)]
}

fn term() -> impl Strategy<Value = Term> {
    prop_oneof![(0_i64..3).prop_map(Term::Int), "[ab]".prop_map(Term::Name)]
}

/// A condition as text, and as what it means.
#[derive(Debug, Clone)]
enum Simple {
    Fact(String, Vec<Place>, Option<Place>),
    Not(String, Vec<Place>),
    Differ(usize, usize),
}

#[derive(Debug, Clone)]
enum Place {
    Any,
    Variable(usize),
    Constant(Term),
}

fn place() -> impl Strategy<Value = Place> {
    prop_oneof![1 => Just(Place::Any), 5 => (0_usize..3).prop_map(Place::Variable), 2 => term().prop_map(Place::Constant)]
}

fn simple() -> impl Strategy<Value = Simple> {
    let fact = ("[pq]", prop::collection::vec(place(), 1..3));
    let says = prop::option::of(place().prop_filter("a value", |place| !matches!(place, Place::Any)));
    prop_oneof![
        4 => (fact, says).prop_map(|((p, a), v)| Simple::Fact(p, a, v)),
        1 => ("[pq]", prop::collection::vec(place(), 1..3)).prop_map(|(p, a)| Simple::Not(p, a)),
        1 => (0_usize..3, 0_usize..3).prop_map(|(a, b)| Simple::Differ(a, b)),
    ]
}

const NAMES: [&str; 3] = ["x", "y", "z"];

fn text(simple: &Simple) -> String {
    let place = |place: &Place| match place {
        Place::Any => "?".to_owned(),
        Place::Variable(i) => format!("?{}", NAMES[*i]),
        Place::Constant(term) => term.to_string(),
    };
    let fact = |p: &str, a: &[Place]| format!("{p}({})", a.iter().map(place).collect::<Vec<_>>().join(", "));
    match simple {
        Simple::Fact(p, a, None) => fact(p, a),
        Simple::Fact(p, a, Some(v)) => format!("{} = {}", fact(p, a), place(v)),
        Simple::Not(p, a) => format!("not {}", fact(p, a)),
        Simple::Differ(a, b) => format!("?{} != ?{}", NAMES[*a], NAMES[*b]),
    }
}

fn of_term(term: &Term) -> Value {
    match term {
        Term::Int(i) => Value::Int(*i),
        Term::Name(name) => Value::String(name.clone()),
    }
}

fn fits(place: &Place, value: &Value, row: &[Value], free: &[bool]) -> bool {
    match place {
        Place::Any => true,
        Place::Variable(i) => free[*i] || row[*i] == *value,
        Place::Constant(term) => of_term(term) == *value,
    }
}

fn holds(simple: &Simple, row: &[Value], free: &[bool], facts: &BTreeMap<FactKey, Value>) -> bool {
    let some = |p: &str, a: &[Place], says: &dyn Fn(&Value) -> bool| {
        facts.iter().any(|(key, value)| {
            key.predicate == p
                && key.arguments.len() == a.len()
                && key.arguments.iter().zip(a).all(|(term, place)| fits(place, &of_term(term), row, free))
                // One variable twice, free in a negation, is still one.
                && (0..3).filter(|i| free[*i]).all(|i| {
                    let mut at = key.arguments.iter().zip(a).filter(|(_, place)| matches!(place, Place::Variable(j) if *j == i));
                    let first = at.next().map(|(term, _)| term);
                    at.all(|(term, _)| Some(term) == first)
                })
                && says(value)
        })
    };
    match simple {
        Simple::Fact(p, a, None) => some(p, a, &|value| *value != Value::Bool(false)),
        Simple::Fact(p, a, Some(v)) => some(p, a, &|value| fits(v, value, row, free)),
        Simple::Not(p, a) => !some(p, a, &|value| *value != Value::Bool(false)),
        Simple::Differ(a, b) => row[*a] != row[*b],
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, ..ProptestConfig::default() })]

    #[test]
    fn the_answers_are_those_of_trying_everything(
        facts in prop::collection::btree_map(("[pq]", prop::collection::vec(term(), 1..3)), value(), 0..14),
        query in prop::collection::vec(simple(), 1..5),
        projected in any::<bool>(),
    ) {
        let facts: BTreeMap<FactKey, Value> =
            facts.into_iter().map(|((predicate, arguments), value)| (FactKey { predicate, arguments }, value)).collect();
        let world = if projected {
            let change = |(fact, value): (&FactKey, &Value)| Change::Set { fact: fact.clone(), value: value.clone() };
            World::default().project(&facts.iter().map(change).collect::<Vec<_>>()).unwrap()
        } else {
            World::from_facts(facts.clone(), Revision(1))
        };
        let query_text = query.iter().map(text).collect::<Vec<_>>().join(", ");
        let Ok(parsed) = Query::parse(&query_text) else { return Ok(()) };
        prop_assert_eq!(Query::parse(&parsed.to_string()).unwrap(), parsed.clone());
        let rows = parsed.prepare(None).unwrap().run(&world, &BTreeMap::new(), 100_000).unwrap();

        // Those that a fact gives a value to; the others stand in negations only.
        let places = |simple: &Simple| match simple {
            Simple::Fact(_, a, v) => a.iter().chain(v).cloned().collect::<Vec<_>>(),
            _ => Vec::new(),
        };
        let bound: Vec<usize> = (0..3)
            .filter(|i| query.iter().flat_map(places).any(|place| matches!(place, Place::Variable(j) if j == *i)))
            .collect();
        let free: Vec<bool> = (0..3).map(|i| !bound.contains(&i)).collect();
        let universe: Vec<Value> = (0..3).map(Value::Int).chain(["a", "b"].map(|s| Value::String(s.to_owned())))
            .chain([true, false].map(Value::Bool)).collect();
        let mut expected: Vec<Vec<(usize, Value)>> = Vec::new();
        let n = universe.len();
        for choice in 0..n.pow(3) {
            let row: Vec<Value> = (0..3).map(|i| universe[choice / n.pow(i) % n].clone()).collect();
            if query.iter().all(|simple| holds(simple, &row, &free, &facts)) {
                let row: Vec<(usize, Value)> = bound.iter().map(|i| (*i, row[*i].clone())).collect();
                if !expected.contains(&row) {
                    expected.push(row);
                }
            }
        }
        let mut found: Vec<Vec<(usize, Value)>> = rows.rows.iter().map(|row| {
            let mut named: Vec<(usize, Value)> = rows.variables.iter().zip(row)
                .map(|(name, value)| (NAMES.iter().position(|n| n == name).unwrap(), value.clone())).collect();
            named.sort_by_key(|(i, _)| *i);
            named
        }).collect();
        let sorted = |rows: &mut Vec<Vec<(usize, Value)>>| rows.sort_by_key(|row| format!("{row:?}"));
        sorted(&mut expected);
        sorted(&mut found);
        prop_assert_eq!(found, expected, "{}", query_text);
    }

    #[test]
    fn no_text_panics(text in "\\PC{0,60}") {
        let _ = ask(&text);
    }

    #[test]
    fn no_text_of_the_language_panics(
        text in "(at\\(|weight\\(|class\\(|\\?x|\\?y|\\?|, |\\)| = | < |not |exists |\\(|SLC|1| or | and |\\.x){1,14}"
    ) {
        let _ = ask(&text);
    }
}
