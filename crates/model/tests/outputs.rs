//! Outputs of conditions, loops and concurrencies: what a task file says of them is this program, and what no way gives is refused.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may panic")]

use ratn_model::catalogue::Catalogue;
use ratn_model::list::List;
use ratn_model::load::load;
use ratn_model::program::{Program, State, StateKind};
use ratn_model::value::{Type, Value};

/// A task of these states, and what is wrong with it.
fn read(states: &str) -> Result<Program, Vec<String>> {
    let task = format!("task: t\nworld: [hand_empty(gripper)]\nstates:\n{states}");
    match load(&task, "t.yaml", &Catalogue::standard()) {
        Ok(loaded) => Ok(loaded.program),
        Err(findings) => Err(findings.iter().map(|found| format!("{}: {}", found.rule, found.message)).collect()),
    }
}

fn program(states: &str) -> Program {
    read(states).unwrap_or_else(|refused| panic!("{refused:#?}\n{states}"))
}

fn refused(states: &str) -> Vec<String> {
    match read(states) {
        Err(refused) => refused,
        Ok(_) => panic!("it loads:\n{states}"),
    }
}

fn state<'p>(program: &'p Program, path: &str) -> &'p State {
    program.states.iter().find(|state| state.path == path).unwrap_or_else(|| panic!("there is no {path}"))
}

/// The outputs of a state, with the names of states.
fn outputs(program: &Program, path: &str) -> Vec<String> {
    let named = |output: &ratn_model::program::TaskOutput| {
        let mut text = format!("{}: {}", output.name, output.value);
        for id in output.value.flows() {
            text = text.replace(&format!("{id}."), &format!("{}.", program.state(id).path));
        }
        text
    };
    state(program, path).outputs().iter().map(named).collect()
}

/// An action with a float `pan` as output.
fn look(name: &str) -> String {
    format!(
        "{name}: {{ action: pan_tilt/look_at, in: {{ target: \"pose(1, 0, 1)\" }}, resources: [{{ block: PanTilt }}] }}"
    )
}

fn condition(then: &str, otherwise: &str, outputs: &str) -> String {
    format!(
        "  - choose:\n      condition: exists at(cup)\n      then: [{then}]\n      else: [{otherwise}]\n      outputs: {outputs}\n  - {}\n",
        "next: { action: pan_tilt/look_at, in: { target: \"pose(1, choose.pan, 1)\" }, resources: [{ block: PanTilt }] }"
    )
}

fn in_braces(item: &str) -> String {
    format!("{{ {item} }}")
}

#[test]
fn a_way_of_an_either_may_contain_another_one() {
    let (a, b) = (in_braces(&look("a")), in_braces(&look("b")));
    for value in ["either(a.pan + 1, 0)", "either(either(a.pan, b.pan) + 1, 0)", "either(-either(a.pan, b.pan), b.pan)"]
    {
        let text = condition(&a, &b, &format!("{{ pan: \"{value}\" }}"));
        assert!(read(&text).is_ok(), "{value}: {:?}", read(&text).err());
    }
    // Neither branch has one: on each way the other part is missing.
    let wrong = refused(&condition(&a, &b, "{ pan: \"either(a.pan + b.pan, b.pan + a.pan)\" }"));
    assert!(wrong[0].starts_with("branch-may-not-have-written"), "{wrong:?}");
}

#[test]
fn what_a_state_contains_is_no_way_of_what_it_needs_to_begin() {
    let text = format!(
        "  - h: {{ requires: [\"either(a.pan, 10) > 5\"], states: [{{ {} }}] }}\n  - again: {{ condition: exists at(cup), then: [], else: [], transitions: {{ success: h }} }}\n",
        look("a")
    );
    let wrong = refused(&text);
    assert!(wrong[0].starts_with("branch-may-not-have-written"), "{wrong:?}");
}

#[test]
fn a_condition_gives_what_the_branch_gives_that_was_taken() {
    let (a, b) = (in_braces(&look("a")), in_braces(&look("b")));
    let made = program(&condition(&a, &b, "{ pan: \"either(a.pan, b.pan)\" }"));
    assert_eq!(outputs(&made, "choose"), ["pan: either(choose/a.pan, choose/b.pan)"]);
    // One of each branch of the same name.
    let made = program(&condition(&a, &a, "{ pan: a.pan }"));
    let StateKind::Condition { then, otherwise, .. } = &state(&made, "choose").kind else { panic!("a condition") };
    let value = &state(&made, "choose").outputs()[0].value;
    assert_eq!(value.flows().into_iter().collect::<Vec<_>>(), [then[0], otherwise[0]]);
    // A default where a branch gives nothing: the port has it, too.
    let made = program(&condition(&a, "", "{ pan: { value: a.pan, default: 0.5 } }"));
    assert_eq!(outputs(&made, "choose"), ["pan: either(choose/a.pan, 0.5)"]);
    assert_eq!(state(&made, "choose").defaults["pan"], Value::Float(0.5));
}

#[test]
fn an_output_that_a_branch_does_not_give_is_refused() {
    let (a, b) = (in_braces(&look("a")), in_braces(&look("b")));
    for (then, otherwise, outputs) in [
        (&*a, "", "{ pan: a.pan }"),
        (&*a, &*b, "{ pan: a.pan }"),
        (&*a, &*b, "{ pan: \"a.pan + b.pan\" }"),
        ("", "", "{ pan: \"either(a.pan, b.pan)\" }"),
    ] {
        let found = refused(&condition(then, otherwise, outputs));
        let rules = ["branch-may-not-have-written", "unknown-state"];
        assert!(rules.iter().any(|rule| found[0].starts_with(rule)), "{then} {otherwise} {outputs}: {found:?}");
    }
    let found = refused(&condition(&a, &b, "{ pan: \"either(a.pan, 'no')\" }"));
    assert!(found[0].contains("one way gives float, another string"), "{found:?}");
}

/// Where a state may be left early by an outcome of its own, that is another way.
#[test]
fn a_way_that_leaves_early_gives_nothing_and_is_a_way_all_the_same() {
    let states = |value: &str| {
        format!(
            "  - part:\n      outcomes: [early]\n      outputs: {{ pan: \"{value}\" }}\n      states:\n        - any: {{ condition: exists at(cup), outcomes: [early], then: [{{ out: {{ states: [], transitions: {{ success: early }} }} }}], transitions: {{ early: c }} }}\n        - {}\n        - b: {{ states: [], transitions: {{ success: success }} }}\n        - {}\n",
            look("a"),
            look("c")
        )
    };
    program(&states("either(a.pan, c.pan)"));
    program(&states("either(a.pan, 0)"));
    let found = refused(&states("either(a.pan, a.tilt)"));
    assert!(
        found[0].starts_with("branch-may-not-have-written: on some way that leads here none of `a.pan`, `a.tilt`"),
        "{found:?}"
    );
    assert!(refused(&states("a.pan"))[0].starts_with("branch-may-not-have-written"));
}

#[test]
fn a_switch_gives_what_the_case_gives_that_was_taken() {
    let a = in_braces(&look("a"));
    let states = |default: &str| {
        format!(
            "  - kind: {{ wait: {{ signal: kind }} }}\n  - choose:\n      switch: kind.value\n      cases: {{ cup: [{a}], box: [{a}] }}\n{default}      outputs: {{ pan: a.pan }}\n"
        )
    };
    let made = program(&states(&format!("      default: [{a}]\n")));
    let expected = ["pan: either(choose/a.pan, choose/else/a.pan, choose/else/a.pan)"];
    assert_eq!(outputs(&made, "choose"), expected);
    assert!(refused(&states(""))[0].starts_with("branch-may-not-have-written"));
}

#[test]
fn a_loop_collects_what_each_iteration_gives() {
    let states = |more: &str| {
        format!(
            "  - looks:\n      for: n in [1, 2]\n      outputs: {{ pans: {{ each: \"[$n, a.pan]\"{more} }}, last: {{ value: a.pan, default: 0 }} }}\n      do:\n        - {}\n  - {}\n",
            look("a"),
            "for: pan in looks.pans\n    do: [{ t: { action: pan_tilt/look_at, in: { target: \"pose($pan[0], $pan[1], looks.last)\" }, resources: [{ block: PanTilt }] } }]"
        )
    };
    let made = program(&states(", type: 'list<list<float>>'"));
    let looks = state(&made, "looks");
    assert_eq!(outputs(&made, "looks"), ["pans: $pans of looks", "last: either(looks/pass/a.pan, 0)"]);
    assert_eq!(looks.defaults["pans"], Value::List(List::new()));
    assert_eq!(looks.variables.len(), 1);
    assert_eq!(looks.outputs()[0].ty, Type::List(Box::new(Type::List(Box::new(Type::Float)))));
    let pass = state(&made, "looks/pass");
    assert!(made.is_pass(pass.id) && !made.is_pass(looks.id));
    let (variable, longer) = &pass.assign[0];
    assert_eq!((variable.as_str(), pass.assign.len()), ("pans of looks", 1));
    let a = state(&made, "looks/pass/a").id;
    assert_eq!(longer.to_string(), format!("$pans of looks + [[$n, {a}.pan]]"));
    let found = refused(&states(", type: 'list<string>'"));
    assert!(found[0].starts_with("type-mismatch: `pans` is list<string>; "), "{found:?}");
    // What another state reads of it is typed, too.
    let found = refused(&states("").replace("$pan[0]", "$pan.x"));
    assert!(found[0].starts_with("type-mismatch: "), "{found:?}");
}

/// What is inside of the loop stands in one state more, and is where it was for everything else.
#[test]
fn a_loop_that_collects_sees_what_any_loop_sees() {
    let states = |outputs: &str| {
        format!(
            "  - looks:\n      do_while: a.pan > 0.1\n      index: i\n{outputs}      do:\n        - {}\n        - next: {{ action: pan_tilt/look_at, in: {{ target: \"pose(1, b.pan, $i)\" }}, resources: [{{ block: PanTilt }}] }}\n        - {}\n  - behind: {{ action: pan_tilt/look_at, in: {{ target: \"pose(1, a.pan, 1)\" }}, resources: [{{ block: PanTilt }}] }}\n",
            look("a"),
            look("b").replace("resources:", "out: { pan: { default: 0 } }, resources:")
        )
    };
    program(&states(""));
    program(&states("      outputs: { all: { each: '[$i, a.pan]' }, pan: a.pan }\n"));
    let found = refused(&states("      outputs: { all: $i }\n"));
    assert!(found[0].starts_with("unknown-variable"), "{found:?}");
    let found = refused(&states("      outputs: { all: { each: 1, value: 2 } }\n"));
    assert!(found[0].starts_with("unknown-key"), "{found:?}");
}

/// What only an iteration gives that leaves the loop is given all the same.
#[test]
fn a_loop_that_is_left_by_an_outcome_of_its_own_gives_what_that_iteration_gave() {
    let states = |value: &str| {
        format!(
            "  - search:\n      for: n in [1, 2]\n      outcomes: [found]\n      outputs: {{ at: {value} }}\n      do:\n        - {}\n        - is_it:\n            condition: a.pan > 0\n            outcomes: [found]\n            then: [{{ hit: {{ states: [], outputs: {{ at: $n }}, transitions: {{ success: found }} }} }}]\n            transitions: {{ found: found }}\n      transitions: {{ found: success }}\n",
            look("a")
        )
    };
    let made = program(&states("{ value: hit.at, default: 0 }"));
    assert_eq!(outputs(&made, "search"), ["at: either(search/is_it/hit.at, 0)"]);
    assert!(refused(&states("hit.at"))[0].starts_with("branch-may-not-have-written"));
}

#[test]
fn only_a_loop_has_a_value_of_each_iteration() {
    let found = refused(&condition(&in_braces(&look("a")), "", "{ pan: { each: a.pan } }"));
    assert!(found.iter().any(|found| found.starts_with("unknown-key: there is no key `each` here")), "{found:?}");
}

#[test]
fn a_race_gives_what_the_winner_gives() {
    let race = |kind: &str, outputs: &str| {
        let open = "open: { action: gripper/feel, pia: true, reads: [], effects: [], resources: [{ block: Gripper }] }";
        let turn = look("turn").replace("resources:", "pia: true, reads: [], effects: [], resources:");
        format!(
            "  - both:\n      concurrency: {kind}\n      outputs: {outputs}\n      regions:\n        - {open}\n        - {turn}\n"
        )
    };
    program(&race("preemptive", "{ got: \"either(turn.pan, open.width_m)\" }"));
    program(&race("preemptive", "{ got: { value: turn.pan, default: 0 } }"));
    program(&race("barrier", "{ got: turn.pan }"));
    program(&race("2", "{ got: turn.pan }"));
    program(&race("1", "{ got: \"either(turn.pan, open.width_m)\" }"));
    for kind in ["preemptive", "1"] {
        let found = refused(&race(kind, "{ got: turn.pan }"));
        assert!(found[0].starts_with("branch-may-not-have-written: `turn.pan` may not have been written"), "{found:?}");
    }
    // A limit and a watch make a race of it that is won by what is inside.
    let limited = "  - turn:\n      timeout: 20\n      outputs: { pan: a.pan }\n      states:\n        - LOOK\n";
    program(&limited.replace("LOOK", &look("a")));
}

/// A way that was visited before the state around it was entered again is none any more.
#[test]
fn what_is_forgotten_when_a_state_is_entered_again_is_no_way() {
    let states = "  - part:
      outputs: { pan: \"either(a.pan, 0)\" }
      states: [{ LOOK_A }]
  - any:
      condition: exists at(cup)
      then: [{ LOOK_B }]
      outputs: { pan: \"either(b.pan, part.pan)\" }
";
    let states = states.replace("LOOK_A", &look("a")).replace("LOOK_B", &look("b"));
    let made = program(&states);
    assert_eq!(outputs(&made, "any"), ["pan: either(any/b.pan, part.pan)"]);
}

/// A hierarchy that may be left before its output was written, and a state behind it.
fn left_early(outputs: &str, around: &str, behind: &str) -> String {
    format!(
        "  - part:
      outcomes: [early]
      outputs: {outputs}{around}
      states:
        - any: {{ condition: exists at(cup), outcomes: [early], then: [{{ out: {{ states: [], transitions: {{ success: early }} }} }}], transitions: {{ early: early }} }}
        - {}
      transitions: {{ early: next }}
  - next: {{ action: pan_tilt/look_at, in: {{ target: \"pose(1, {behind}, 1)\" }}, resources: [{{ block: PanTilt }}] }}
",
        look("a")
    )
}

#[test]
fn an_output_that_may_be_left_out_is_no_way_that_is_sure() {
    for around in ["", "\n      timeout: 10", "\n      retry: { times: 1, on: [aborted] }", "\n      routine: true"] {
        let found = refused(&left_early("{ pan: a.pan }", around, "part.pan"));
        assert!(found[0].starts_with("branch-may-not-have-written: `part.pan` may not"), "{around}: {found:?}");
        let found = refused(&left_early("{ pan: a.pan, two: a.pan }", around, "either(part.pan, part.two)"));
        assert!(found[0].starts_with("branch-may-not-have-written: on some way"), "{around}: {found:?}");
        program(&left_early("{ pan: a.pan }", around, "either(part.pan, 0)"));
        program(&left_early("{ pan: { value: a.pan, default: 0 } }", around, "part.pan"));
        program(&left_early("{ pan: 5 }", around, "part.pan"));
        program(&left_early("{ pan: a.pan }", around, "0").replace("early: next", "early: success"));
        // What another state makes of it may be missing, too.
        let twice = left_early("{ pan: a.pan }", around, "outer.pan");
        let (inner, next) = twice.split_once("  - next").unwrap();
        let inner = inner.replace("early: next", "early: early").replace('\n', "\n      ");
        let outer = |value: &str| {
            format!(
                "  - outer:\n      outcomes: [early]\n      outputs: {{ pan: {value} }}\n      states:\n      {}\n      transitions: {{ early: next }}\n  - next{next}",
                inner.trim_end()
            )
        };
        let found = refused(&outer("part.pan"));
        assert!(found[0].starts_with("branch-may-not-have-written: `outer.pan` may not"), "{around}: {found:?}");
        program(&outer("\"either(part.pan, 0)\""));
    }
}

#[test]
fn what_a_state_says_of_its_own_end_needs_what_it_has_written_by_then() {
    let states = |more: &str| {
        let text = format!(
            "  - all:\n      variables: {{ seen: 0 }}\n      states:\n{}",
            left_early("{ pan: a.pan }", more, "0")
        );
        let (head, rest) = text.split_at(text.find("      states:\n").unwrap() + 14);
        head.to_owned() + &rest.replace("\n  ", "\n        ").replace("  - part", "        - part")
    };
    for more in ["\n      assign: { seen: pan }", "\n      effects: { success: [], early: ['seen() = pan'] }"] {
        let found = refused(&states(more));
        assert!(
            found[0].contains("the output `pan` may not have been written where this state ends by `early`"),
            "{found:?}"
        );
    }
    program(&states("\n      effects: { success: ['seen() = pan'], early: [] }"));
}

/// What the iteration before has written is no way of this one.
#[test]
fn a_way_that_only_another_iteration_has_come_through_is_none() {
    let states = |each: &str| {
        format!(
            "  - looks:
      for: n in [1, 2]
      outputs: {{ all: {{ each: \"{each}\" }} }}
      do:
        - any: {{ condition: exists at(cup), outcomes: [other], then: [{{ out: {{ states: [], transitions: {{ success: other }} }} }}], transitions: {{ other: b }} }}
        - {}
        - b: {{ states: [] }}
",
            look("a")
        )
    };
    program(&states("either(a.pan, 0)"));
    let found = refused(&states("either(a.pan, a.pan)"));
    assert!(found[0].starts_with("branch-may-not-have-written: on some way"), "{found:?}");
}

#[test]
fn what_a_while_counts_is_gone_at_its_end() {
    let states = |value: &str| {
        format!(
            "  - all:\n      variables: {{ seen: 0 }}\n      states:\n        - looks:\n            while: $i < 3\n            index: i\n            assign: {{ seen: {value} }}\n            do: [{{ {} }}]\n",
            look("a")
        )
    };
    program(&states("$seen + 1"));
    assert!(refused(&states("$i"))[0].starts_with("unknown-variable: there is no variable `$i` here"));
}

#[test]
fn what_a_decider_says_is_what_its_regions_have_given() {
    let both = |decide: &str, outputs: &str| {
        let turn = look("turn").replace("resources:", "pia: true, reads: [], effects: [], resources:");
        format!(
            "  - both:\n      concurrency: barrier\n      decide: {decide}\n      outputs: {outputs}\n      regions:\n        - open: {{ action: gripper/feel, pia: true, reads: [], effects: [], resources: [{{ block: Gripper }}] }}\n        - {turn}\n      transitions: {{ odd: next }}\n  - next: {{ action: pan_tilt/look_at, in: {{ target: \"pose(1, both.x, 1)\" }}, resources: [{{ block: PanTilt }}] }}\n"
        )
    };
    program(&both("{ odd: open.outcome = aborted and turn.outcome = success }", "{ x: turn.pan }"));
    program(&both("{ odd: open.outcome = aborted }", "{ x: { value: turn.pan, default: 0 } }"));
    program(&both(
        "{ success: turn.outcome = success, odd: turn.outcome = aborted }",
        "{ x: \"either(turn.pan, 0)\" }",
    ));
    let found = refused(&both("{ odd: open.outcome = aborted }", "{ x: turn.pan }"));
    assert!(found[0].starts_with("branch-may-not-have-written: `both.x` may not"), "{found:?}");
    let found = refused(
        &both("{ success: open.outcome = success }", "{ x: turn.pan }").replace("odd: next", "aborted: aborted"),
    );
    assert!(found[0].starts_with("branch-may-not-have-written: `turn.pan` may not"), "{found:?}");
}
