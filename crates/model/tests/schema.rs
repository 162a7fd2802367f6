//! `docs/task-file.schema.json`, which editors complete and check with, says what the loader says: it takes every task that
//! loads, and has the loader's keys and no others.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_model::catalogue::Catalogue;
use ratn_model::load::load;
use serde_json::Value;
use std::collections::BTreeSet;
use std::path::Path;

const SCHEMA: &str = include_str!("../../../docs/task-file.schema.json");
const DOCUMENT: &str = include_str!("../../../docs/task-files.md");
/// Where the loader lists the keys that it knows, as `const …_KEYS`.
const LOADER: [&str; 2] = [include_str!("../src/load.rs"), include_str!("../src/load/state.rs")];
/// What a state may be beside a loop that tests.
const FORMS: [&str; 8] = ["action", "states", "for", "condition", "concurrency", "library", "wait", "ask"];
const ASK: &str = "task: t\nstates:\n- a:\n    ask: { question: Well?, choices: [fine] }\n";

fn schema() -> Value {
    serde_json::from_str(SCHEMA).unwrap()
}

/// What of a task file does not fit the schema, with its place.
fn misfits(text: &str) -> Vec<String> {
    let root = schema();
    fit(&root, &root, &serde_saphyr::from_str(text).unwrap(), "")
}

/// The part of JSON Schema that the file uses; any other word is refused.
fn fit(root: &Value, schema: &Value, value: &Value, at: &str) -> Vec<String> {
    let fits = |schema: &Value| fit(root, schema, value, at).is_empty();
    let all = |rule: &Value| rule.as_array().cloned().unwrap_or_else(|| vec![rule.clone()]);
    let entries = || value.as_object().into_iter().flatten();
    let mut found = Vec::new();
    for (word, rule) in schema.as_object().unwrap() {
        let good = match word.as_str() {
            "$schema" | "title" | "description" | "definitions" | "then" | "else" => true,
            "$ref" => {
                let name = rule.as_str().unwrap().strip_prefix("#/definitions/").unwrap();
                found.extend(fit(root, &root["definitions"][name], value, at));
                true
            }
            "allOf" => {
                all(rule).iter().for_each(|part| found.extend(fit(root, part, value, at)));
                true
            }
            "anyOf" => all(rule).iter().any(fits),
            "not" => !fits(rule),
            "if" => {
                let branch = &schema[if fits(rule) { "then" } else { "else" }];
                found.extend(fit(root, branch, value, at));
                true
            }
            "enum" => all(rule).contains(value),
            "type" => all(rule).iter().any(|ty| match ty.as_str().unwrap() {
                "object" => value.is_object(),
                "array" => value.is_array(),
                "string" => value.is_string(),
                "boolean" => value.is_boolean(),
                "null" => value.is_null(),
                "integer" => value.is_i64() || value.is_u64(),
                "number" => value.is_number(),
                other => panic!("no type `{other}`"),
            }),
            "minimum" => value.as_f64().is_none_or(|number| number >= rule.as_f64().unwrap()),
            "exclusiveMinimum" => value.as_f64().is_none_or(|number| number > rule.as_f64().unwrap()),
            "minProperties" => value.as_object().is_none_or(|map| map.len() as u64 >= rule.as_u64().unwrap()),
            "maxProperties" => value.as_object().is_none_or(|map| map.len() as u64 <= rule.as_u64().unwrap()),
            "required" => {
                all(rule).iter().all(|key| value.as_object().is_none_or(|map| map.contains_key(key.as_str().unwrap())))
            }
            "pattern" => value.as_str().is_none_or(|text| match rule.as_str().unwrap() {
                "^[A-Za-z_][A-Za-z0-9_]*$" => text.chars().all(|c| c.is_ascii_alphanumeric() || c == '_'),
                "^[^/]+/[^/]+$" => text.split('/').count() == 2,
                other => panic!("no pattern `{other}`"),
            }),
            "propertyNames" => {
                entries().for_each(|(key, _)| found.extend(fit(root, rule, &Value::from(key.as_str()), at)));
                true
            }
            "properties" => {
                let known = entries().filter_map(|(key, value)| Some((key, value, rule.get(key)?)));
                known.for_each(|(key, value, rule)| found.extend(fit(root, rule, value, &format!("{at}/{key}"))));
                true
            }
            "additionalProperties" => {
                let known = &schema["properties"];
                let others = entries().filter(|(key, _)| known.get(key.as_str()).is_none());
                for (key, value) in others {
                    match rule {
                        Value::Bool(allowed) if !allowed => found.push(format!("{at}: there is no `{key}`")),
                        rule => found.extend(fit(root, rule, value, &format!("{at}/{key}"))),
                    }
                }
                true
            }
            "items" => {
                let items = value.as_array().into_iter().flatten().enumerate();
                items.for_each(|(i, item)| found.extend(fit(root, rule, item, &format!("{at}/{i}"))));
                true
            }
            other => panic!("the test does not know `{other}`"),
        };
        if !good {
            found.push(format!("{at}: {value} is not as `{word}` says: {rule}"));
        }
    }
    found
}

#[test]
fn every_task_that_loads_fits_the_schema() {
    let mut tasks: Vec<String> = Vec::new();
    for block in DOCUMENT.split("\n```") {
        if let Some(task) = block.strip_prefix("yaml\n") {
            tasks.push(task.to_owned());
        } else if let Some(fragment) =
            block.strip_prefix("yaml fragment").and_then(|rest| Some(rest.split_once('\n')?.1))
        {
            tasks.push(format!("task: fragment\nstates:\n{fragment}"));
        }
    }
    let examples = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples");
    for entry in std::fs::read_dir(examples).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_some_and(|extension| extension == "yaml") {
            tasks.push(std::fs::read_to_string(path).unwrap());
        }
    }
    assert!(tasks.len() >= 8, "{}", tasks.len());
    for task in tasks {
        let misfits = misfits(&task);
        assert!(misfits.is_empty(), "{misfits:#?}\n{task}");
    }
}

#[test]
fn what_is_misspelt_or_of_another_kind_does_not_fit() {
    for (task, place) in [
        ("task: t\ncolour: blue\nstates: []\n", ": there is no `colour`"),
        ("task: t\nstates:\n  - a: { action: arm/stop, retry: {} }\n", "/states/0/a/retry"),
        ("task: t\nstates:\n  - a: { state: [] }\n", "/states/0/a"),
        (
            "task: t\nstates:\n  - while: true\n    do: [{ a: { states: [], attempts: 3 } }]\n",
            "/states/0/do/0/a: there is no `attempts`",
        ),
        ("task: t\nhorizon: 0\nstates: []\n", "/horizon"),
        ("task: t\nstates:\n  - wait: { fore: open(door) }\n", "/states/0/wait: there is no `fore`"),
        ("task: t\nstates:\n  - go: { ask: { question: Go? } }\n", "/states/0/go/ask"),
    ] {
        let misfits = misfits(task);
        assert!(misfits.iter().any(|misfit| misfit.starts_with(place)), "{misfits:#?}\n{task}");
    }
}

/// Every key that the loader lists in `const …_KEYS`.
fn listed() -> BTreeSet<&'static str> {
    let mut keys = BTreeSet::new();
    for source in LOADER {
        let constants = source.split("const ").filter(|text| text.split(':').next().unwrap().ends_with("_KEYS"));
        for constant in constants.filter(|text| !text.starts_with("LATER")) {
            let list = constant.split(';').nth(1).unwrap();
            keys.extend(list.split('"').skip(1).step_by(2));
        }
    }
    keys
}

#[test]
fn the_schema_has_the_keys_of_the_loader_and_no_others() {
    let schema = schema();
    let of = |form: &str| -> BTreeSet<String> {
        let properties =
            if form.is_empty() { &schema["properties"] } else { &schema["definitions"][form]["properties"] };
        properties.as_object().unwrap().keys().cloned().collect()
    };
    let forms = [
        ("", "task: t\nstates: []\n"),
        ("action", "task: t\nstates:\n- a:\n    action: gripper/release\n"),
        ("fallback", "task: t\nstates:\n- a:\n    fallback: [{ b: { states: [] } }]\n"),
        ("switch", "task: t\nstates:\n- a:\n    switch: $x\n    cases: { b: [] }\n"),
        ("hierarchy", "task: t\nstates:\n- a:\n    states: []\n"),
        ("for", "task: t\nstates:\n- a:\n    for: b in [1]\n    do: []\n"),
        ("while", "task: t\nstates:\n- a:\n    while: false\n    do: []\n"),
        ("condition", "task: t\nstates:\n- a:\n    condition: true\n    then: []\n"),
        ("concurrency", "task: t\nstates:\n- a:\n    concurrency: barrier\n    regions: []\n"),
        ("library", "task: t\nstates:\n- a:\n    library: part.yaml\n"),
        ("wait", "task: t\nstates:\n- a:\n    wait: { seconds: 1 }\n"),
        ("ask", ASK),
    ];
    let mut candidates: BTreeSet<String> = listed().into_iter().map(str::to_owned).collect();
    forms.iter().for_each(|(form, _)| candidates.extend(of(form)));
    assert!(candidates.len() > 45, "{candidates:?}");
    for (form, task) in forms {
        let known = of(form);
        let indent = if form.is_empty() { "" } else { "    " };
        for key in &candidates {
            if task.contains(&format!("\n{indent}{key}:")) {
                assert!(known.contains(key), "the schema lacks `{key}` of {form}");
                continue;
            }
            // Beside another form, `while` is what must hold meanwhile.
            if form == "while" && FORMS.contains(&key.as_str()) {
                assert!(!known.contains(key), "`{key}` of {form}");
                continue;
            }
            let findings = load(&format!("{task}{indent}{key}: 1\n"), "t.yaml", &Catalogue::standard());
            let findings = findings.map_or_else(|errors| errors, |loaded| loaded.warnings);
            // Another form's key makes it no state, or one of two forms.
            let refused = findings.iter().any(|finding| {
                let second_form = finding.rule == "invalid-state" && finding.message.starts_with("a state is `");
                let same_loop = ["while", "do_while", "until"].contains(&key.as_str()) && form == "while";
                finding.rule == "unknown-key" || (second_form && !same_loop)
            });
            assert_eq!(known.contains(key), !refused, "`{key}` of {form}: {findings:?}");
        }
    }
}
