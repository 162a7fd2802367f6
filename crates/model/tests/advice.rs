//! What `check` says of the mistakes that people make who know other languages: the help that a person would give.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_model::catalogue::Catalogue;
use ratn_model::load::load;

/// The first finding of a task file.
fn first(source: &str) -> String {
    let findings = match load(source, "t", &Catalogue::standard()) {
        Ok(loaded) => loaded.warnings,
        Err(findings) => findings,
    };
    findings.first().map_or_else(|| "fine".to_owned(), ToString::to_string)
}

/// The first finding of a condition.
fn condition(text: &str) -> String {
    let declared = "reads: ['hand_empty(?)', 'on(?, ?)']";
    first(&format!(
        "task: t\nparameters: {{ mode: {{ type: string, default: fast }} }}\nstates:\n  - c: {{ condition: {text}, {declared}, then: [] }}\n"
    ))
}

#[track_caller]
fn says(found: &str, parts: &[&str]) {
    for part in parts {
        assert!(found.contains(part), "`{part}` is not in: {found}");
    }
}

#[test]
fn operators_of_other_languages_are_translated() {
    says(&condition("'hand_empty(g) && on(a, b)'"), &["t:4:36:", "`&&` is no operator here", "write `and`"]);
    says(&condition("'hand_empty(g) || on(a, b)'"), &["write `or`"]);
    says(&condition("'!hand_empty(g)'"), &["`!` is no operator here", "write `not`"]);
    says(&condition("'hand_empty(g) AND on(a, b)'"), &["write `and`, in small letters"]);
    says(&condition("'hand_empty(g) ? 1 : 2'"), &["if(condition, a, b)"]);
    assert_eq!(condition("'$mode != \"fast\" and not hand_empty(g)'"), "fine");
    assert_eq!(condition("$mode == \"fast\""), "fine");
}

#[test]
fn a_negation_that_yaml_takes_for_its_own_is_refused() {
    // It was a tag of nothing: the condition never held.
    for text in ["!hand_empty(g)", "! hand_empty(g)", "!hand_empty(g) and true"] {
        says(&condition(text), &["error[invalid-yaml]", "quote the value", "`not`"]);
    }
    says(&condition("*hand_empty(g)"), &["error[invalid-yaml]", "quote the value"]);
}

#[test]
fn a_text_of_which_a_part_is_quoted_is_quoted_whole() {
    says(
        &condition("\"$mode\" == \"fast\""),
        &["error[invalid-yaml]", "put the whole value into quotes of the other kind"],
    );
}

#[test]
fn true_in_other_words_is_written_as_here() {
    assert_eq!(condition("True"), "fine");
    says(&condition("yes"), &["type-mismatch", "write `true`"]);
    says(
        &first("task: t\nstates:\n  - r: { action: gripper/release, pia: no, resources: [Gripper] }\n"),
        &["write `false`"],
    );
}

#[test]
fn a_text_with_a_colon_is_to_be_quoted() {
    says(
        &first("task: t\ndescription: first: look, then go\nstates: []\n"),
        &["`description: \"first: look, then go\"`"],
    );
    says(
        &first("task: t\nstates:\n  - r: { action: gripper/release, description: open: wide }\n"),
        &["`description: \"open: wide\"`"],
    );
}

#[test]
fn a_colon_without_a_blank_is_found() {
    says(
        &first("task: t\nstates:\n  - r:\n      action:gripper/release\n      resources: [Gripper]\n"),
        &["`action: gripper/release`"],
    );
    says(
        &first("task: t\nstates:\n  - r: {action:gripper/release, resources: [Gripper]}\n"),
        &["`action: gripper/release`"],
    );
}

#[test]
fn wrong_indentation_is_told_as_such() {
    let task = |rest: &str| first(&format!("task: t\nstates:\n{rest}"));
    says(
        &task("  - r:\n    action: gripper/release\n    resources: [Gripper]\n"),
        &["t:3:5:", "`action` stands beside `r` instead of in it", "indent what belongs to `r`"],
    );
    says(&task("  - c:\n    condition: true\n    then: []\n"), &["`condition` stands beside `c` instead of in it"]);
    says(
        &task("  - r:\n      action: gripper/release\n    pia: true\n"),
        &["t:5:5:", "`pia` stands beside the state `r`"],
    );
    says(
        &task("  - r:\n      action: gripper/release\n       pia: true\n"),
        &["t:5", "`pia` stands in column 8 and the key above it, which has a value already, in column 7"],
    );
    says(
        &task("  - r:\n      action: gripper/release\n     pia: true\n"),
        &["`pia` stands in column 6", "begin it in column 7"],
    );
    let columns = ["begin every `-` of a list in the same column", "in column 4, the list above in column 3"];
    says(&task("  - r: { action: gripper/release }\n   - s: { action: gripper/release }\n"), &columns[..1]);
    says(&task("  - r:\n      action: gripper/release\n   - s:\n      action: gripper/release\n"), &columns);
    says(
        &task("  - m:\n      action: arm/move_to\n      in:\n      joints: 'joints(0,0,0,0,0,0,0)'\n"),
        &["if it belongs to `in`, indent it"],
    );
    says(&task("  r: { action: gripper/release }\n"), &["write each state as `- r: {…}`"]);
    says(&task("\t- r: { action: gripper/release }\n"), &["indent with blanks"]);
}

#[test]
fn a_list_where_joints_or_a_pose_is_wanted_is_written_as_one() {
    let tuck = "task: t\nstates:\n  - m: { action: arm/move_to, in: { joints: [0.9, -1.2, 0, 0.9, 0, -0.6, 0] }, resources: [Arm] }\n";
    says(&first(tuck), &["help: write \"joints(0.9, -1.2, 0, 0.9, 0, -0.6, 0)\""]);
    let look =
        "task: t\nstates:\n  - l: { action: pan_tilt/look_at, in: { target: [0.9, -1.2, 0] }, resources: [PanTilt] }\n";
    says(&first(look), &["help: write \"pose(0.9, -1.2, 0)\""]);
}

#[test]
fn a_function_that_is_not_there_is_refused_wherever_it_can_be_no_fact() {
    let look = "task: t\nstates:\n  - look: { action: detector/segment, in: { region: { pose: 'pose(1,0,1)', size: [1, 1] } }, resources: [Detector, Camera] }\n";
    let over = |list: &str| first(&format!("{look}  - for: box in {list}\n    do: []\n"));
    says(
        &over("sorted(look.boxes)"),
        &["error[unknown-function]", "there is no function `sorted`", "write `sort(list)`"],
    );
    says(&over("sotr(look.boxes)"), &["error[unknown-function]", "did you mean `sort(list)`?"]);
    says(
        &over("nearest_first(look.boxes)"),
        &["error[unknown-function]", "about individuals and ints, not about list<"],
    );
    says(&condition("'half(0.5) < 1'"), &["error[unknown-function]", "no function `half`"]);
    says(&condition("'lenght([1, 2]) = 2'"), &["error[unknown-function]"]);
    assert!(!over("filter($box in look.boxes, not on($box.id, 3))").contains("unknown-function"));
}
