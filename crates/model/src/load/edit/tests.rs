#![allow(clippy::unwrap_used, reason = "a test may panic")]
use super::*;
use crate::catalogue::Catalogue;
use crate::load::{Files, load_with};
use crate::program::Program;
use std::path::{Path, PathBuf};

struct Here(PathBuf);

impl Files for Here {
    fn read(&self, _: &str, path: &str) -> Result<(String, String), String> {
        let text = std::fs::read_to_string(self.0.join(path)).map_err(|error| error.to_string())?;
        Ok((path.to_owned(), text))
    }
}

fn value(text: &str) -> Document {
    Document::read(text, "value").unwrap()
}

fn check(text: &str, path: &str, key: &str, new: Option<&str>, expect: &str) {
    let new = new.map(value);
    assert_eq!(edited(text, path, key, new.as_ref()).as_deref(), Ok(expect), "{path} {key}");
}

fn examples() -> Vec<(String, String)> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples");
    let mut found: Vec<(String, String)> = std::fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|ending| ending == "yaml"))
        .map(|path| (path.file_name().unwrap().to_string_lossy().into_owned(), std::fs::read_to_string(&path).unwrap()))
        .collect();
    found.sort();
    assert!(found.len() > 5);
    found
}

/// A program without its locations, which change with the lines of the file.
fn program(text: &str) -> Option<Program> {
    let files = Here(Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples"));
    let mut program = load_with(text, "t.yaml", &Catalogue::standard(), &files).ok()?.program;
    program.digest = String::new();
    program.states.iter_mut().for_each(|state| state.location = Location { line: 0, column: 0 });
    Some(program)
}

/// Number of equal lines at the beginning and at the end.
fn frame(old: &str, new: &str) -> (usize, usize) {
    let (old, new): (Vec<&str>, Vec<&str>) = (old.split('\n').collect(), new.split('\n').collect());
    let most = old.len().min(new.len());
    let head = old.iter().zip(&new).take_while(|(a, b)| a == b).count();
    let tail = old.iter().rev().zip(new.iter().rev()).take(most - head).take_while(|(a, b)| a == b).count();
    (head, tail)
}

/// Values that a key may have, short and long ones, different from those of the examples.
fn values(key: &str) -> Vec<Option<Document>> {
    let texts: &[&str] = match key {
        "computes" | "pia" | "deterministic" | "routine" => &["true", "false"],
        "attempts" => &["5", "1"],
        "exceptional" => &["[aborted]", "[violated, aborted]"],
        "exceptions" => &["imprecise", "precise"],
        "duration" => &["3.25", "\"max($i, 2)\""],
        "resources" => {
            &["[{ block: Other }]", "[world_model, { create: Made, class: task, with: { what: \"a: b\" } }]"]
        }
        "effects" => {
            &["{ success: [not here(it)], aborted: [] }", "[{ for: b in boxes, do: [\"at($b.id) = $b.pose, 1\"] }]"]
        }
        _ => &[
            "[]",
            "[\"at('# no, comment')\", here(it)]",
            "[\"a_predicate_of_a_long_name(with_many, arguments, that, fill, the, line)\", \"another_predicate_of_a_long_name(with_many, arguments)\"]",
        ],
    };
    texts.iter().map(|text| Some(value(text))).chain([None]).collect()
}

/// One of this many changes is also loaded.
const EVERY: usize = 17;

/// For every example, every state, every key that it has, some keys that it may have, and some values in turn (`RATN_EDIT_EXHAUSTIVE=1`: all of them): the new
/// tree is the old one with only this change, all other lines and all comments are unchanged, and if it loads, only this state differs.
#[test]
fn only_the_lines_of_the_key_change_in_every_state_of_every_example() {
    let is_exhaustive = std::env::var_os("RATN_EDIT_EXHAUSTIVE").is_some();
    let (mut turn, mut done, mut loaded) = (0, 0, 0);
    for (name, text) in examples() {
        let before = program(&text).unwrap_or_else(|| panic!("{name} does not load"));
        let states = written(&text).unwrap();
        for state in &states {
            assert_eq!(state.fixed, None, "{name} {}", state.path);
            for (key, old) in &state.keys {
                let more = match old {
                    Some(Document::List(items)) => vec![
                        Some(Document::List([items.clone(), vec![Document::Text("more(it)".to_owned())]].concat())),
                        Some(Document::List(items.iter().skip(1).cloned().collect())),
                    ],
                    _ => Vec::new(),
                };
                let all: Vec<Option<Document>> = values(key).into_iter().chain(more).collect();
                turn += 1;
                // Every second new key is enough.
                if old.is_none() && turn % 2 == 0 && !is_exhaustive {
                    continue;
                }
                let count = if is_exhaustive { all.len() } else { 1 };
                for new in all.into_iter().cycle().skip(turn / 2).take(count) {
                    let place = format!("{name}: {} {key}: {new:?}", state.path);
                    let after = edited(&text, &state.path, key, new.as_ref())
                        .unwrap_or_else(|error| panic!("{place}: {error}"));
                    done += 1;
                    let now = written(&after).unwrap();
                    for (one, other) in states.iter().zip(&now) {
                        assert_eq!((&one.path, &one.form), (&other.path, &other.form), "{place}");
                        for ((own, was), (_, is)) in one.keys.iter().zip(&other.keys) {
                            let is_changed = one.path == state.path && own == key;
                            assert_eq!(is, if is_changed { &new } else { was }, "{place}: {} {own}", one.path);
                        }
                    }
                    let (mut all, mut kept) = (comments(&text), comments(&after));
                    all.sort_unstable();
                    kept.sort_unstable();
                    assert_eq!(all, kept, "{place}");
                    // Lines that differ belong to this key.
                    let (head, tail) = frame(&text, &after);
                    let lines: Vec<&str> = text.split('\n').collect();
                    let between = &lines[head..lines.len() - tail];
                    let is_new = old.is_none();
                    assert!(!is_new || between.len() <= 1, "{place}: {between:?}");
                    if !is_new && !between.is_empty() {
                        let first = lines[..=head].iter().rposition(|line| line.contains(&format!("{key}:"))).unwrap();
                        assert!(first as u32 + 1 >= state.location.line, "{place}: {between:?}");
                    }
                    // And back: the loader sees the old file again, whatever the layout.
                    let back = edited(&after, &state.path, key, old.as_ref())
                        .unwrap_or_else(|error| panic!("{place}, back: {error}"));
                    if old.is_none() {
                        assert_eq!(back, text, "{place}: what was added is taken away without a trace");
                    }
                    // Loading is slow without optimization, so only some are loaded. The trees have been compared for all.
                    if done % EVERY != 0 {
                        continue;
                    }
                    assert!(back == text || program(&back).unwrap() == before, "{place}");
                    let Some(mut other) = program(&after) else { continue };
                    loaded += 1;
                    for (one, other) in before.states.iter().zip(&mut other.states) {
                        // `exceptions` of a state also hold for the states inside, and what it reads gives them a projection.
                        let is_inside = one.path.starts_with(&format!("{}/", state.path));
                        if one.path == state.path
                            || one.path == format!("{}/try", state.path)
                            || (matches!(*key, "exceptions" | "reads") && is_inside)
                        {
                            other.annotations = one.annotations.clone();
                        }
                    }
                    assert_eq!(other, before, "{place}");
                }
            }
        }
    }
    assert!(done > 500 && loaded > 10, "{done} changes, {loaded} loaded");
}

const TASK: &str = "\
task: t
states:
  # The first.
  - plan:   # it plans
      action: path_planner/plan
      reads:      # what it sees
        # the table
        - at(table)   # alone
        - scene

      # How long.
      duration: 2   # seconds
  - go: { action: arm/follow, in: { trajectory: plan.trajectory },
          requires: [\"a, b\", 'it''s'], pia: true }   # moves
  - for: x in [1]
    do: # nothing
      - inner:
          states: []
";

#[test]
fn what_is_replaced_keeps_its_comments() {
    let expect = TASK.replace(
        "      reads:      # what it sees\n        # the table\n        - at(table)   # alone\n        - scene\n",
        "      # the table\n      # alone\n      reads:      # what it sees\n        - at(chair)\n",
    );
    check(TASK, "plan", "reads", Some("[at(chair)]"), &expect);
    check(TASK, "plan", "duration", Some("\"$n\""), &TASK.replace("duration: 2 ", "duration: $n "));
    check(TASK, "plan", "duration", None, &TASK.replace("duration: 2   # seconds", "# seconds"));
}

#[test]
fn items_that_stay_are_not_written_anew() {
    let text = "\
task: t
states:
  - a:
      action: x/y
      effects: # all
        # The first.
        - >-
          at(a) =
          b
        - { for: b in boxes, do: [c] } # each
        # The last.
        - d
";
    let items = value(&text.replace("task: t\nstates:\n  - a:\n      action: x/y\n      effects: # all\n", ""));
    let Document::List(items) = items else { panic!("a list") };
    let set = |new: Vec<Document>| edited(text, "a", "effects", Some(&Document::List(new))).unwrap();
    let e = Document::Text("e".to_owned());
    assert_eq!(set([items.clone(), vec![e.clone()]].concat()), format!("{text}        - e\n"));
    assert_eq!(
        set(vec![items[0].clone(), e, items[2].clone()]),
        text.replace("        - { for: b in boxes, do: [c] } # each\n", "        - e\n        # each\n")
    );
    assert_eq!(set(items[..2].to_vec()), text.replace("        - d\n", ""));
}

#[test]
fn what_is_new_stands_before_the_states_within_else_last() {
    check(
        TASK,
        "plan",
        "computes",
        Some("true"),
        &TASK.replace("   # seconds\n", "   # seconds\n      computes: true\n"),
    );
    check(TASK, "for_x", "reads", Some("[a(b)]"), &TASK.replace("    do:", "    reads: [a(b)]\n    do:"));
    check(
        TASK,
        "for_x/inner",
        "duration",
        Some("1"),
        &TASK.replace("          states: []", "          duration: 1\n          states: []"),
    );
    check(TASK, "go", "duration", Some("1"), &TASK.replace("pia: true }", "pia: true, duration: 1 }"));
}

#[test]
fn in_brackets_an_entry_is_replaced_and_goes_with_its_comma() {
    check(TASK, "go", "requires", Some("[c]"), &TASK.replace("[\"a, b\", 'it''s']", "[c]"));
    check(TASK, "go", "requires", None, &TASK.replace("requires: [\"a, b\", 'it''s'], ", ""));
}

#[test]
fn a_list_that_is_closed_in_the_column_of_its_key_is_the_value_of_the_key() {
    let text = "\
task: t
states:
  - a:
      action: x/y
      reads: [
        b, # first
        c,
      ]
      duration: 1
  - d:
      action: x/y
      reads: [
        e
      ]
";
    let new = "      # first\n      reads: [f]\n";
    check(
        text,
        "a",
        "reads",
        Some("[f]"),
        &text.replace("      reads: [\n        b, # first\n        c,\n      ]\n", new),
    );
    check(
        text,
        "a",
        "reads",
        None,
        &text.replace("      reads: [\n        b, # first\n        c,\n      ]\n", "      # first\n"),
    );
    check(text, "d", "reads", Some("[f]"), &text.replace("reads: [\n        e\n      ]", "reads: [f]"));
    check(text, "a", "duration", Some("2"), &text.replace("duration: 1", "duration: 2"));
    check(text, "d", "duration", Some("2"), &format!("{text}      duration: 2\n"));
}

#[test]
fn line_ends_of_another_system_stay_and_a_last_line_without_one_does() {
    let text = "task: t\r\nstates:\r\n  - a:\r\n      action: x/y # §\r\n      duration: 1";
    let after = edited(text, "a", "reads", Some(&value("[b]"))).unwrap();
    assert_eq!(after, format!("{text}\r\n      reads: [b]"));
    assert_eq!(edited(&after, "a", "reads", None).as_deref(), Ok(text));
}

#[test]
fn what_cannot_be_done_safely_is_refused_with_what_where_why_and_what_next() {
    let alias = "task: t\nstates:\n  - a: &one { action: x/y }\n  - b: *one\n";
    let anchored = "task: t\nstates:\n  - a: { action: x/y, duration: &d 3 }\n  - b: { action: x/y, duration: *d }\n";
    let made = "task: t\nstates:\n  - both:\n      concurrency: barrier\n      regions: { for: 'arm in [left, right]', do: [{ go: { action: x/y } }] }\n";
    let commented = "task: t\nstates:\n  - a: { action: x/y, reads: [b, # why\n       c] }\n";
    let switch = "task: t\nstates:\n  - w:\n      switch: a.b\n      cases:\n        cup: []\n        box: [{ go: { action: x/y } }]\n";
    let refused = [
        (alias, "b", "duration"),
        (anchored, "a", "duration"),
        (anchored, "b", "duration"),
        (made, "both/left/go", "duration"),
        (made, "both/left", "duration"),
        (commented, "a", "reads"),
        (switch, "w/else", "duration"),
        (TASK, "library/inside", "duration"),
        (TASK, "for_x", "senses"),
        ("task: [", "a", "reads"),
    ];
    let said = |(text, path, key): &(&str, &str, &str)| match edited(text, path, key, Some(&value("7"))) {
        Ok(text) => format!("changed: {text}"),
        Err(error) => error.to_string(),
    };
    let said: Vec<String> = refused.iter().map(said).collect();
    insta::assert_snapshot!(said.join("\n"), @r"
    `b` (line 4) has no text of its own: it stands in several places, through an alias; change it in an editor
    `duration` of `a` (line 3) is not changed: an anchor or an alias (`&`, `*`) stands there; change it in an editor
    `duration` of `b` (line 4) is not changed: an anchor or an alias (`&`, `*`) stands there; change it in an editor
    `both/left/go` (line 5) has no text of its own: it is made by `regions: { for: … }`; change it in an editor
    `both/left` (line 5) has no text of its own: it is made by `regions: { for: … }`; change it in an editor
    `reads` of `a` (line 3) is not changed: a comment stands inside of its value; change it in an editor
    `w/else` (line 7) has no text of its own: it is written out from a shorter form; change it in an editor
    there is no state `library/inside` in this file: read the file again; a state of a library is changed in the library's file
    `for_x` cannot have `senses`: a state with `for: x in [1]` may say reads, resources, duration, routine, exceptional, exceptions, shared
    line 1: unclosed bracket '[': the file cannot be read as a task; correct it in an editor first
    ");
    // A state in a case has a text of its own.
    assert!(edited(switch, "w/else/go", "duration", Some(&value("7"))).is_ok());
}

#[test]
fn merged_keys_are_left_alone() {
    let text = "task: t\nstates:\n  - a: { action: x/y, <<: { duration: 3 } }\n";
    if let Ok(after) = edited(text, "a", "duration", Some(&value("4"))) {
        assert!(after.contains("<<"), "{after}");
    }
}

/// The task files in the reference use every form.
#[test]
fn in_every_task_of_the_reference_a_key_is_added_changed_and_taken_away_or_it_is_said_why_not() {
    let reference = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/task-files.md");
    let reference = std::fs::read_to_string(reference).unwrap();
    let blocks = reference.split("```yaml\n").skip(1).filter_map(|block| block.split("```").next());
    let (mut done, mut refused) = (0, Vec::new());
    for text in blocks {
        for state in written(text).unwrap() {
            for (key, old) in &state.keys {
                let new = if old.is_some() { None } else { Some(value("[here(it)]")) };
                match edited(text, &state.path, key, new.as_ref()) {
                    Ok(after) => {
                        done += 1;
                        let now = written(&after).unwrap();
                        let own = now.iter().find(|one| one.path == state.path).unwrap();
                        assert!(own.keys.contains(&(*key, new)), "{} {key}", state.path);
                        edited(&after, &state.path, key, old.as_ref()).unwrap();
                    }
                    Err(error) => refused.push(error),
                }
            }
        }
    }
    assert!(done > 200, "{done} done, {refused:?}");
    let is_shared = |error: &EditError| matches!(error, EditError::Shared { .. });
    assert!(refused.iter().all(is_shared), "{refused:?}");
}

#[test]
fn a_comment_that_a_quote_in_a_text_over_several_lines_may_hide_is_left_to_an_editor() {
    let text = "task: t
states:
  - look:
      action: detector/segment
      reads:
        - |-
          'at(x)
        # a comment that matters
        - scene
";
    let refused = edited(text, "look", "reads", Some(&value("[scene]"))).unwrap_err().to_string();
    assert!(refused.contains("behind a text over several lines"), "{refused}");
}
