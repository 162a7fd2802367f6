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
    says(&condition("'len($mode) <> 3'"), &["`<>` is no operator here", "write `!=`"]);
    says(&condition("'len($mode) === 3'"), &["`===` is no operator here", "write `=`"]);
    says(&condition("'len($mode) % 2 = 0'"), &["`%` is no operator here", "write `n - m * floor(n / m)`"]);
    says(&condition("'len($mode) // 2 = 0'"), &["`//` is no operator here", "write `floor(a / b)`"]);
    says(&condition("'2 ** 3 = 8'"), &["`**` is no operator here", "write `x * x`"]);
    says(&condition("'len([x for x in [1, 2]]) = 2'"), &["expected `,`, found `for`", "map($x in list, value)"]);
    says(&condition("'if hand_empty(g) then true else false'"), &["write `if(condition, a, b)`"]);
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
fn a_variable_without_its_sign_is_told_as_such() {
    says(&condition("mode"), &["`condition` is bool; `mode` is string", "the variable `mode` is written `$mode`"]);
    let task = "task: t\nparameters: { home: { type: joints, default: 'joints(0,0,0,0,0,0,0)' }, n: 1 }\nstates:\n";
    let tuck = "  - m: { action: arm/move_to, in: { joints: home }, resources: [Arm] }\n";
    says(&first(&format!("{task}{tuck}")), &["`joints` is joints; `home` is string", "is written `$home`"]);
    let compares = |text: &str| first(&format!("{task}  - c: {{ condition: '{text}', then: [] }}\n"));
    says(&compares("n > 0"), &["expected float, found string", "is written `$n`"]);
    says(&compares("len(n) + n > 0"), &["expected float, found string", "is written `$n`"]);
    assert!(!compares("other > 0").contains('$'));
    // An element is a variable, too.
    says(&condition("'any($x in [1, 2], x > 1)'"), &["is written `$x`"]);
}

#[test]
fn a_condition_in_the_words_of_other_languages_is_shown_in_those_of_this_one() {
    let task = |rest: &str| first(&format!("task: t\nstates:\n{rest}"));
    says(
        &task("  - if: hand_empty(g)\n    then: []\n"),
        &["t:3:5:", "there is no form `if`", "`- condition: …`, with `then: […]` and `else: […]`"],
    );
    says(&task("  - c: { if: hand_empty(g), then: [] }\n"), &["no form `if`", "condition"]);
    says(
        &task("  - repeat: 3\n    do: []\n"),
        &["there is no form `repeat`", "`- for: i in range(n)`, with `do: […]`"],
    );
    says(&task("  - parallel: []\n    join: all\n"), &["there is no form `parallel`", "concurrency: barrier"]);
}

#[test]
fn what_is_no_list_of_facts_is_written_as_one() {
    let release = |rest: &str| {
        first(&format!("task: t\nstates:\n  - r: {{ action: gripper/release, resources: [Gripper], {rest} }}\n"))
    };
    for nothing in ["none", "nothing", "empty"] {
        says(&release(&format!("reads: {nothing}")), &["write `[]` for no fact"]);
    }
    says(&release("reads: [posture]"), &["a fact has its arguments in parentheses", "`posture(…)`"]);
    says(&release("effects: ['open = true']"), &["a fact has its arguments in parentheses", "`open(…)`"]);
    says(&release("effects: ['at(cup) == 1']"), &["write `=`"]);
    says(&release("duration: 5s"), &["`5s` is no number", "leave the unit out"]);
    says(&release("timeout: 3 s"), &["a number of seconds", "leave the unit out"]);
}

#[test]
fn a_fact_with_a_letter_wrong_is_the_one_that_is_there() {
    let release = |rest: &str| {
        first(&format!(
            "task: t\nworld: [hand_empty(g)]\nstates:\n  - r: {{ action: gripper/release, resources: [Gripper], {rest} }}\n"
        ))
    };
    says(
        &release("requires: [hand_emtpy(g)], effects: []"),
        &["error[unestablished-precondition]", "did you mean `hand_empty`?"],
    );
    says(&release("requires: [full(g)], effects: []"), &["help: add it to the `world`"]);
    // A deletion says of no fact that there is one.
    says(
        &release("effects: [delete hand_emtpy(g)]"),
        &["warning[unknown-fact]", "nothing writes `hand_emtpy(g)`, which is deleted", "did you mean `hand_empty`?"],
    );
    assert_eq!(release("effects: [delete hand_empty(g)]"), "fine");
    assert_eq!(release("effects: [delete held(cup)]"), "fine");
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
    let home = "task: t\nparameters: { home: { type: joints, default: [0.9, -1.2, 0] }, at: { type: pose, default: [1, 0, 1] } }\nstates: []\n";
    says(&first(home), &["the default of `home` is list, not joints", "help: write \"joints(0.9, -1.2, 0)\""]);
    let place = home.replace("joints, default: [0.9, -1.2, 0]", "int, default: 1");
    says(&first(&place), &["the default of `at` is list, not pose", "help: write \"pose(1, 0, 1)\""]);
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
