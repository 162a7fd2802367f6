//! `docs/task-files.md` says what is so: its tasks load, its fragments read, its tables are complete.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_model::catalogue::Catalogue;
use ratn_model::diagnostic::Diagnostic;
use ratn_model::expression::{Comprehension, Function};
use ratn_model::load::load;
use std::collections::BTreeSet;
use std::path::Path;

const DOCUMENT: &str = include_str!("../../../docs/task-files.md");

/// The blocks of code whose first line is ```` ```info ````.
fn blocks(info: &str) -> Vec<String> {
    let mut blocks = Vec::new();
    let mut lines = DOCUMENT.lines();
    while let Some(line) = lines.next() {
        let Some(found) = line.strip_prefix("```") else { continue };
        let block: Vec<&str> = lines.by_ref().take_while(|line| *line != "```").collect();
        if found == info {
            blocks.push(block.join("\n") + "\n");
        }
    }
    blocks
}

/// The rows of the tables below a heading, as cells.
fn rows(heading: &str) -> Vec<Vec<&'static str>> {
    let (_, section) = DOCUMENT.split_once(&format!("\n## {heading}\n")).unwrap();
    let section = section.split_once("\n## ").map_or(section, |(section, _)| section);
    let row = |line: &'static str| Some(line.strip_prefix('|')?.strip_suffix('|')?.split('|').map(str::trim).collect());
    section.lines().filter_map(row).filter(|cells: &Vec<&str>| !cells[0].starts_with("---")).skip(1).collect()
}

fn quoted(cell: &str) -> Vec<&str> {
    cell.split('`').skip(1).step_by(2).collect()
}

fn findings(source: &str) -> Vec<Diagnostic> {
    match load(source, "task.yaml", &Catalogue::standard()) {
        Ok(loaded) => loaded.warnings,
        Err(findings) => findings,
    }
}

#[test]
fn every_whole_task_of_the_document_loads_without_a_finding() {
    let tasks = blocks("yaml");
    assert!(tasks.len() >= 2);
    for task in tasks {
        let found = findings(&task);
        assert!(found.is_empty(), "{}\n{task}", found[0]);
    }
}

#[test]
fn every_fragment_of_the_document_reads_but_for_what_it_takes_from_elsewhere() {
    let fragments = blocks("yaml fragment");
    assert!(!fragments.is_empty());
    for fragment in fragments {
        let around = ["unknown-state", "unknown-variable", "unestablished-precondition"];
        let found = findings(&format!("task: fragment\nstates:\n{fragment}"));
        let own = found.iter().find(|finding| !around.contains(&finding.rule.as_str()));
        assert!(own.is_none(), "{}\n{fragment}", own.unwrap());
    }
}

#[test]
fn no_state_of_the_document_is_called_what_other_readers_of_yaml_take_for_a_boolean() {
    for block in blocks("yaml").into_iter().chain(blocks("yaml fragment")) {
        for key in block.lines().filter_map(|line| line.trim_start().trim_start_matches("- ").split_once(':')) {
            let name = key.0.to_ascii_lowercase();
            assert!(!["y", "n", "yes", "no", "on", "off", "true", "false"].contains(&name.as_str()), "{name}\n{block}");
        }
    }
}

#[test]
fn the_document_lists_the_rules_that_there_is_a_bad_task_for_and_no_others() {
    let documented: BTreeSet<String> =
        rows("The rules of `check`").iter().map(|cells| quoted(cells[0])[0].to_owned()).collect();
    // That these are all rules is what the test of bad tasks makes sure of.
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/bad-tasks");
    let rule = |entry: std::io::Result<std::fs::DirEntry>| {
        let text = std::fs::read_to_string(entry.unwrap().path()).unwrap();
        text.lines().next().unwrap().split_once(": ").unwrap().1.trim().to_owned()
    };
    let tested: BTreeSet<String> = std::fs::read_dir(folder).unwrap().map(rule).collect();
    assert_eq!(documented, tested);
}

#[test]
fn the_document_lists_every_function_as_it_is_called() {
    let documented: BTreeSet<&str> = rows("Expressions").iter().flat_map(|cells| quoted(cells[0])).collect();
    let usages = Function::ALL.map(|function| function.usage().split(", an object").next().unwrap().to_owned());
    let comprehensions = Comprehension::ALL.map(Comprehension::usage);
    let called: BTreeSet<&str> = usages.iter().flat_map(|usage| usage.split(" or ")).chain(comprehensions).collect();
    assert_eq!(documented, called);
}
