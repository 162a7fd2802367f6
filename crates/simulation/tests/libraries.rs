//! Tasks that use other task files come to the same end in both modes: variables of a library are its own, whatever those around
//! are called, in loops and inside of routines.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may panic")]

mod support;

use ratn_executive::protocol::Goal;
use ratn_model::load::Files;
use ratn_model::value::Value;
use ratn_simulation::run::{Run, run};
use ratn_world::world::World;
use support::{MODES, Providers, facts, load, setup};

/// Puts out what it is given; an arm that is given 40 or more finds nothing.
fn echo(_: &str, _: u32, goal: &Goal, _: &World) -> (&'static str, Value) {
    let given = goal.inputs.get("a").cloned().unwrap_or(Value::Null);
    let nothing = &*goal.provider == "arm" && given.as_number().is_some_and(|number| number >= 40.0);
    (if nothing { "empty" } else { "success" }, given)
}

struct Shelf;

impl Files for Shelf {
    fn read(&self, _: &str, path: &str) -> Result<(String, String), String> {
        let text = match path {
            "add.yaml" => ADD,
            "twice.yaml" => TWICE,
            other => return Err(format!("there is no {other}")),
        };
        Ok((path.to_owned(), text.to_owned()))
    }
}

/// Adds 1 + 2 + … up to `n` to what it begins with, and moves by that.
const ADD: &str = r#"
task: add
parameters: { n: 2, begin: 0 }
variables: { sum: $begin }
outcomes: [nothing]
outputs: { sum: { type: any, value: "[$sum, $begin, go.x]", default: [] } }
states:
  - for: i in range(1, $n + 1)
    do:
      - think:
          action: brain/think
          in: { a: $sum + $i }
          computes: true
          reads: []
          assign: { sum: think.x }
          resources: [{ block: Brain }, world_model]
  - go:
      action: arm/grasp
      in: { a: $sum }
      reads: []
      effects: { success: ["moved($n) = x"], empty: ["moved($n) = 0"] }
      resources: [{ block: Arm }]
      transitions: { empty: nothing }
"#;

const TWICE: &str = r#"
task: twice
parameters: { n: 1 }
states:
  - i: { library: add.yaml, with: { n: $n, begin: 0 } }
  - again: { library: add.yaml, with: { n: $n + 1 }, transitions: { nothing: success } }
"#;

fn both(task: &str) -> [Run; 2] {
    let program = load(task, "task.yaml", &Shelf);
    MODES.map(|mode| run(setup(program.clone(), mode), &mut Providers(echo)).unwrap())
}

#[test]
fn loops_around_and_inside_have_variables_of_the_same_name() {
    for routine in ["", ", routine: true"] {
        let [sequential, parallel] = both(&format!(
            r#"
task: whole
parameters: {{ n: 3 }}
variables: {{ sum: 100 }}
outputs: {{ sum: $sum }}
states:
  - for: i in range($n)
    do:
      - add: {{ library: add.yaml, with: {{ n: $i + 1, begin: 10 * $i }}, assign: {{ sum: "$sum + add.sum[0] + $i" }}{routine} }}
"#
        ));
        for run in [&sequential, &parallel] {
            assert_eq!((run.outcome.as_str(), run.reason.as_str()), ("success", ""), "{routine}");
            // 100 + (0 + 1 + 0) + (10 + 3 + 1) + (20 + 6 + 2)
            assert_eq!(run.outputs["sum"], Value::Int(143), "{routine}");
            assert_eq!(facts(run), ["moved(1) = 1", "moved(2) = 13", "moved(3) = 26"], "{routine}");
        }
        assert!(parallel.end_s <= sequential.end_s);
    }
}

#[test]
fn libraries_of_libraries_and_their_outcomes() {
    let [sequential, parallel] = both(
        r#"
task: whole
variables: { i: 0, n: 8 }
outputs: { found: $i }
states:
  - while: $i < 2
    do:
      - twice: { library: twice.yaml, with: { n: $n }, assign: { i: $i + 1, n: 2 }, transitions: { nothing: aborted } }
"#,
    );
    for run in [&sequential, &parallel] {
        assert_eq!((run.outcome.as_str(), run.reason.as_str()), ("success", ""));
        assert_eq!(run.outputs["found"], Value::Int(2));
        // 36 fits, 45 does not.
        assert_eq!(facts(run), ["moved(2) = 3", "moved(3) = 6", "moved(8) = 36", "moved(9) = 0"]);
    }
    assert!(parallel.end_s <= sequential.end_s, "{} s against {} s", parallel.end_s, sequential.end_s);
}
