//! The example tasks load without a warning, and their durations are those of the paper's tables.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_model::catalogue::Catalogue;
use ratn_model::load::load;
use ratn_model::program::{Program, StateKind};
use ratn_model::value::Value;
use std::collections::BTreeMap;

fn example(name: &str) -> Program {
    let path = format!("{}/../../examples/{name}.yaml", env!("CARGO_MANIFEST_DIR"));
    let source = std::fs::read_to_string(&path).unwrap();
    match load(&source, &path, &Catalogue::standard()) {
        Ok(loaded) => {
            assert!(loaded.warnings.is_empty(), "{}", loaded.warnings[0]);
            loaded.program
        }
        Err(findings) => panic!("{}", findings.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n")),
    }
}

/// The sum of the durations of every visit of an action; `elements` are those of the one loop.
fn sequential_s(program: &Program, variable: &str, elements: &[Value]) -> f64 {
    let parameters = program.bind_parameters(&[]).unwrap();
    let mut total = 0.0;
    for state in &program.states {
        let (StateKind::Action { .. }, Some(duration)) = (&state.kind, &state.annotations.duration_s) else { continue };
        let in_loop = state.parent.is_some_and(|p| matches!(program.state(p).kind, StateKind::ForEach { .. }));
        let visits = if in_loop { elements } else { &[Value::Null][..] };
        for element in visits {
            let mut scope: BTreeMap<String, Value> = parameters.clone();
            scope.insert(variable.to_owned(), element.clone());
            total += duration.evaluate(&scope).unwrap().as_number().unwrap();
        }
    }
    total
}

#[test]
fn fetching_boxes_takes_as_long_as_in_the_first_table_when_executed_in_sequence() {
    let program = example("fetch_boxes");
    for (boxes, seconds) in [(1, 81.3), (2, 124.4), (3, 167.5)] {
        let found = sequential_s(&program, "box", &vec![Value::Null; boxes]);
        assert!((found - seconds).abs() < 1e-9, "{boxes} boxes: {found}");
    }
}

#[test]
fn setting_the_table_takes_as_long_as_in_the_second_table_when_executed_in_sequence() {
    let program = example("set_table");
    for (each, seconds) in [(2, 170.4), (3, 255.6)] {
        let objects: Vec<Value> =
            ["bowl", "fork"].iter().flat_map(|name| vec![Value::String((*name).to_owned()); each]).collect();
        let found = sequential_s(&program, "object", &objects);
        assert!((found - seconds).abs() < 1e-9, "{each} of each: {found}");
    }
}

#[test]
fn the_objects_to_set_are_the_bowls_then_the_forks_then_the_cups() {
    let program = example("set_table");
    let set = [("bowls", "1"), ("forks", "2"), ("cups", "1")].map(|(name, n)| (name.to_owned(), n.to_owned()));
    let scope = program.bind_parameters(&set).unwrap();
    let StateKind::ForEach { collection, .. } = &program.states[1].kind else { panic!("a loop") };
    assert_eq!(collection.evaluate(&scope).unwrap().to_string(), "[bowl, fork, fork, cup]");
    let world = ratn_model::expression::EffectExpr::bind(&program.initial, &scope).unwrap();
    let text: Vec<String> = world.iter().map(|change| change.pattern().to_string()).collect();
    assert!(text.contains(&"at(bowl_1)".to_owned()) && text.contains(&"at(fork_2)".to_owned()), "{text:?}");
    assert!(text.contains(&"at(cup_1)".to_owned()) && text.contains(&"at(place_cup_3)".to_owned()), "{text:?}");
}
