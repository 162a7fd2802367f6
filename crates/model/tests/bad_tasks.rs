//! Every file of `tests/bad-tasks` is refused for the rule that its first line names, with the line where it is broken.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_model::catalogue::Catalogue;
use ratn_model::diagnostic::Severity;
use ratn_model::load::{Files, load_with};
use std::collections::BTreeSet;
use std::path::Path;

/// Rules that the folder must have a task for.
const RULES: [&str; 42] = [
    "annotation-not-in-force",
    "branch-may-not-have-written",
    "computes-actuates",
    "conflicting-annotations",
    "duplicate-name",
    "horizon-too-small",
    "indivisible-resource",
    "invalid-amount",
    "invalid-constant",
    "invalid-expression",
    "invalid-name",
    "invalid-ontology",
    "invalid-state",
    "invalid-yaml",
    "may-deadlock",
    "missing-input",
    "no-way-out",
    "not-functional",
    "not-supported-yet",
    "outside-domain",
    "outside-range",
    "provider-not-blocked",
    "recursive-function",
    "region-conflict",
    "too-many-resources",
    "type-mismatch",
    "unestablished-precondition",
    "unknown-action",
    "unknown-fact",
    "unknown-function",
    "unknown-key",
    "unknown-library",
    "unknown-outcome",
    "unknown-port",
    "unknown-predicate",
    "unknown-provider",
    "unknown-resource",
    "unknown-state",
    "unknown-target",
    "unknown-variable",
    "unreachable-state",
    "unservable-flow",
];

/// Files are beside the bad tasks.
struct Folder;

impl Files for Folder {
    fn read(&self, _: &str, path: &str) -> Result<(String, String), String> {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/bad-tasks").join(path);
        Ok((path.to_owned(), std::fs::read_to_string(file).map_err(|error| error.to_string())?))
    }
}

#[test]
fn every_bad_task_is_refused_or_warned_of_for_its_rule_with_a_line() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/bad-tasks");
    let catalogue = Catalogue::standard();
    let mut seen = BTreeSet::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        let source = std::fs::read_to_string(&path).unwrap();
        let first = source.lines().next().unwrap();
        if let Some(rule) = first.strip_prefix("# warning: ") {
            let loaded = load_with(&source, &name, &catalogue, &Folder);
            let warnings = loaded.unwrap_or_else(|refused| panic!("{name}: {refused:#?}")).warnings;
            assert!(!warnings.is_empty() && warnings.iter().all(|found| found.rule == rule), "{name}: {warnings:#?}");
            seen.insert(rule.to_owned());
            continue;
        }
        let rule = first.strip_prefix("# rule: ").expect("the first line names the rule").trim();
        assert!(name.starts_with(rule), "{name} is named after its rule, {rule}");
        let findings = load_with(&source, &name, &catalogue, &Folder)
            .map(|loaded| loaded.warnings)
            .err()
            .unwrap_or_else(|| panic!("{} loads", path.display()));
        let printed: Vec<String> = findings.iter().map(ToString::to_string).collect();
        let errors: Vec<_> = findings.iter().filter(|finding| finding.severity == Severity::Error).collect();
        assert!(!errors.is_empty() && errors.iter().all(|error| error.rule == rule), "{name}: {printed:#?}");
        assert!(
            errors.iter().all(|error| error.location.line > 1 && error.location.column > 0),
            "{name}: {printed:#?}"
        );
        seen.insert(rule.to_owned());
    }
    assert_eq!(seen.iter().map(String::as_str).collect::<Vec<_>>(), RULES);
}
