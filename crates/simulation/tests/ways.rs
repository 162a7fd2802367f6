//! Which of several ways gives a value: what was left out, passed over, or only has a default, in both modes.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may panic")]

mod support;

use ratn_executive::protocol::{Goal, Mode};
use ratn_model::load::Files;
use ratn_model::value::Value;
use ratn_simulation::run::{Run, run};
use ratn_world::world::World;
use support::{MODES, NoFiles, Providers, acts, load, setup};

/// Every goal succeeds with what it is given as `a` as its output, but for those that `fail` names.
fn run_with(states: &str, mode: Mode, files: &dyn Files, fail: &[&str]) -> (Run, Vec<String>) {
    let task = states
        .replace("DO", "action: arm/move, pia: true, reads: [], effects: [], resources: [{ block: Arm }]")
        .replace("NOTE", "action: pen/note, pia: true, reads: [], effects: [], resources: [{ block: Pen }]")
        .replace("THINK", "action: brain/think, computes: true, reads: [], resources: [{ block: Brain }]");
    let mut providers = Providers(|path: &str, _: u32, goal: &Goal, _: &World| {
        let outcome = if fail.contains(&path) { "aborted" } else { "success" };
        (outcome, goal.inputs.get("a").cloned().unwrap_or(Value::Null))
    });
    let program = load(&format!("task: t\n{task}"), "task.yaml", files);
    let run = run(setup(program.clone(), mode), &mut providers).unwrap();
    let acts = acts(&program, &run).into_values().flatten().collect();
    (run, acts)
}

/// What a task notes, in both modes.
fn noted(states: &str, fail: &[&str]) -> Vec<String> {
    noted_with(states, &NoFiles, fail)
}

fn noted_with(states: &str, files: &dyn Files, fail: &[&str]) -> Vec<String> {
    let of = |mode| {
        let (run, acts) = run_with(states, mode, files, fail);
        assert_eq!((run.outcome.as_str(), run.reason.as_str()), ("success", ""), "{mode:?}: {acts:?}");
        acts.into_iter().filter(|act| act.contains("note")).collect::<Vec<String>>()
    };
    let [hsm, cdtn] = MODES.map(of);
    assert_eq!(hsm, cdtn);
    hsm
}

#[test]
fn an_output_that_was_left_out_is_no_way() {
    let part = |around: &str, states: &str| {
        format!(
            "
states:
  - part:
      outcomes: [early]
      outputs: {{ x: a.x }}{around}
      states:
        - first: {{ {states} }}
        - any: {{ condition: first.x > 1, outcomes: [early], then: [{{ out: {{ states: [], transitions: {{ success: early }} }} }}], transitions: {{ early: early }} }}
        - a: {{ DO, in: {{ a: 7 }} }}
      transitions: {{ early: note }}
  - note: {{ NOTE, in: {{ value: 'either(part.x, 0)' }} }}
"
        )
    };
    for around in ["", "\n      timeout: 1000", "\n      routine: true", "\n      retry: { times: 1, on: [aborted] }"] {
        for states in ["THINK, in: { a: 2 }", "DO, in: { a: 2 }"] {
            assert_eq!(noted(&part(around, states), &[]), ["note {value: 0}"], "{around} {states}");
        }
        assert_eq!(noted(&part(around, "THINK, in: { a: 1 }"), &[]), ["note {value: 7}"], "{around}");
    }
}

/// Each visit gives what it gives, and nothing of the visit before.
#[test]
fn an_output_that_is_left_out_at_the_second_visit_is_not_that_of_the_first() {
    let text = "
variables: { n: 1 }
states:
  - part:
      outcomes: [early]
      outputs: { x: a.x }
      assign: { n: $n + 1 }
      states:
        - any: { condition: $n > 1, outcomes: [early], then: [{ out: { states: [], transitions: { success: early } } }], transitions: { early: early } }
        - a: { DO, in: { a: 7 } }
      transitions: { early: note }
  - note: { NOTE, in: { value: 'either(part.x, 0)' } }
  - again: { condition: $n < 3, outcomes: [more], then: [{ out: { states: [], transitions: { success: more } } }], transitions: { more: part } }
";
    assert_eq!(noted(text, &[]), ["note {value: 7}", "note#2 {value: 0}"]);
}

#[test]
fn what_an_iteration_has_passed_over_is_no_way_of_it() {
    let text = |kind: &str, each: &str| {
        format!(
            "
states:
  - loops:
      {kind}
      outputs: {{ all: {{ each: '{each}' }}, last: 'either(x.x, y.x, 0)' }}
      do:
        - which: {{ THINK, in: {{ a: VALUE }} }}
        - any: {{ condition: which.x > 1, outcomes: [other], then: [{{ out: {{ states: [], transitions: {{ success: other }} }} }}], transitions: {{ other: y }} }}
        - x: {{ DO, in: {{ a: which.x }}, transitions: {{ success: success }} }}
        - y: {{ DO, in: {{ a: which.x }} }}
  - note: {{ NOTE, in: {{ value: loops.all }} }}
  - note_2: {{ NOTE, in: {{ value: loops.last }} }}
"
        )
    };
    for each in ["either(x.x, y.x, 0)", "either(y.x, x.x, 0)", "either(x.x + 0, y.x, 0)"] {
        let listed = text("for: n in [1, 2, 1, 3]", each).replace("VALUE", "$n");
        assert_eq!(noted(&listed, &[]), ["note {value: [1, 2, 1, 3]}", "note_2 {value: 3}"], "{each}");
        // A state that fails gives nothing either, and what stands behind it does instead.
        let fails = listed.replace(
            "x: { DO, in: { a: which.x }, transitions: { success: success }",
            "x: { DO, in: { a: which.x }, transitions: { success: success, aborted: success }",
        );
        let noted = noted(&fails, &["loops[2]/pass/x"]);
        assert_eq!(noted, ["note {value: [1, 2, 0, 3]}", "note_2 {value: 3}"], "{each}");
    }
    let counted = text("while: $i < 3\n      index: i", "either(x.x, y.x, 0)").replace("VALUE", "$i + 1");
    assert_eq!(noted(&counted, &[]), ["note {value: [1, 2, 3]}", "note_2 {value: 3}"]);
    // A loop that collects nothing forgets as well.
    let plain = "
states:
  - loops:
      for: n in [1, 2]
      do:
        - any: { condition: $n > 1, outcomes: [other], then: [{ out: { states: [], transitions: { success: other } } }], transitions: { other: y } }
        - x: { DO, in: { a: $n } }
        - y: { DO, in: { a: 10 } }
        - note: { NOTE, in: { value: 'either(x.x, y.x)' } }
";
    assert_eq!(noted(plain, &[]), ["loops[0]/note {value: 1}", "loops[1]/note {value: 10}"]);
    assert_eq!(noted(&plain.replace("do:", "routine: true\n      do:"), &[]), noted(plain, &[]));
}

/// What comes only later in the body is that of the iteration before.
#[test]
fn an_iteration_sees_what_the_one_before_gave_of_what_comes_later() {
    let text = "
states:
  - loops:
      for: n in [1, 2, 3]
      do:
        - note: { NOTE, in: { value: x.x } }
        - x: { DO, in: { a: $n }, out: { x: { default: 0 } } }
        - itself: { DO, in: { a: '[itself.x, $n]' }, out: { x: { default: 0 } } }
        - note_2: { NOTE, in: { value: itself.x } }
";
    let expected = [
        "loops[0]/note {value: 0}",
        "loops[0]/note_2 {value: [0, 1]}",
        "loops[1]/note {value: 1}",
        "loops[1]/note_2 {value: [[0, 1], 2]}",
        "loops[2]/note {value: 2}",
        "loops[2]/note_2 {value: [[[0, 1], 2], 3]}",
    ];
    assert_eq!(noted(text, &[]), expected);
    // One that collects forgets nothing else.
    let collecting = noted(&text.replace("do:", "outputs: { all: { each: x.x } }\n      do:"), &[]);
    assert_eq!(collecting, expected.map(|note| note.replace("]/", "]/pass/")));
    let while_it_gives = "
states:
  - loops:
      do_while: x.x < 3
      index: i
      do:
        - x: { DO, in: { a: $i + 1 } }
        - note: { NOTE, in: { value: x.x } }
";
    let expected = ["loops[0]/note {value: 1}", "loops[1]/note {value: 2}", "loops[2]/note {value: 3}"];
    assert_eq!(noted(while_it_gives, &[]), expected);
}

#[test]
fn the_default_of_a_way_that_failed_does_not_hide_the_way_that_succeeded() {
    let text = |value: &str| {
        format!(
            "
states:
  - a: {{ DO, in: {{ a: 1 }}, out: {{ x: {{ default: 5 }} }}, transitions: {{ success: note, aborted: b }} }}
  - b: {{ DO, in: {{ a: 2 }}, transitions: {{ aborted: note }} }}
  - note: {{ NOTE, in: {{ value: '{value}' }} }}
"
        )
    };
    for (value, expected) in [
        ("either(a.x, b.x)", [1, 2, 5]),
        ("either(b.x, a.x)", [1, 2, 5]),
        ("either(a.x, b.x, 0)", [1, 2, 5]),
        ("either(a.x + 0, either(b.x, 9))", [1, 2, 5]),
        ("either(either(a.x, b.x), 9)", [1, 2, 5]),
        // What needs no output is always there, and nothing behind it counts.
        ("either(0, b.x)", [0, 0, 0]),
        ("either(b.x, 0, a.x)", [0, 2, 0]),
    ] {
        let failing: [&[&str]; 3] = [&[], &["a"], &["a", "b"]];
        for (fail, expected) in failing.into_iter().zip(expected) {
            assert_eq!(noted(&text(value), fail), [format!("note {{value: {expected}}}")], "{value} {fail:?}");
        }
    }
}

/// A race that a region with a default has lost.
#[test]
fn the_default_of_a_region_that_lost_does_not_hide_the_winner() {
    let text = "
states:
  - both:
      concurrency: preemptive
      outputs: { x: 'either(slow.x, quick.x)' }
      regions:
        - slow: { DO, in: { a: 1 }, duration: 2, out: { x: { default: 5 } } }
        - quick: { THINK, in: { a: 2 }, duration: 1 }
  - note: { NOTE, in: { value: both.x } }
";
    assert_eq!(noted(text, &[]), ["note {value: 2}"]);
}

struct Library;

impl Files for Library {
    fn read(&self, _: &str, path: &str) -> Result<(String, String), String> {
        let text = "
task: l
parameters: { list: { type: any, default: null } }
states:
  - loops:
      for: n in $list
      outputs: { all: { each: $n } }
      do: [{ nothing: { states: [] } }]
";
        Ok((path.to_owned(), text.to_owned()))
    }
}

/// The variable that it collects in is gone with it, whatever it is called.
#[test]
fn a_loop_whose_list_has_no_value_leaves_nothing_behind() {
    let text = "
states:
  - loops:
      for: n in [1, 2]
      outputs: { all: { each: $n } }
      do:
        - inner: { library: l.yaml, with: { list: 'if($n = 1, [4], $n)' }, transitions: { aborted: on } }
        - on: { NOTE, in: { value: $n } }
  - note: { NOTE, in: { value: loops.all } }
";
    assert_eq!(noted_with(text, &Library, &[]).last().map(String::as_str), Some("note {value: [1, 2]}"));
    let own = text.replace(
        "library: l.yaml, with: { list: 'if($n = 1, [4], $n)' }",
        "for: 'm in if($n = 1, [4], $n)', outputs: { all: { each: $m } }, do: [{ nothing: { states: [] } }]",
    );
    assert_eq!(noted(&own, &[]).last().map(String::as_str), Some("note {value: [1, 2]}"));
}

#[test]
fn many_iterations_are_collected() {
    let text = "
states:
  - loops:
      for: n in range(300)
      outputs: { all: { each: '[$n]' } }
      do: [{ x: { THINK } }]
  - note: { NOTE, in: { value: 'loops.all[0] + loops.all[299] + [len(loops.all)]' } }
";
    for mode in MODES {
        let (run, acts) = run_with(text, mode, &NoFiles, &[]);
        assert_eq!(run.outcome, "success");
        assert_eq!(acts, ["note {value: [0, 299, 300]}"], "{mode:?}");
    }
}
