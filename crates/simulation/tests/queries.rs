//! Queries in tasks: `exists (…)` in preconditions and conditions, in both modes, on facts that hold and on facts that are to come.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod support;

use ratn_executive::protocol::{Goal, Mode};
use ratn_model::load::load;
use ratn_model::value::Value;
use ratn_simulation::run::Run;
use ratn_world::world::World;
use support::{MODES, Providers, catalogue, facts, simulate};

/// The box is put down by the first state; what comes after asks for a box that is on a table and light.
const TASK: &str = "
task: lift
world: [\"class(box_1, SLC)\", \"weight(box_1) = 1.5\", \"class(box_2, SLC)\", \"weight(box_2) = 5\", \"on(box_2, table)\"]
states:
  - put:
      action: arm/move
      pia: true
      reads: []
      effects: [\"on(box_1, PLACE)\"]
      resources: [{ block: Arm }]
  - light: { condition: \"exists (on(?box, table), class(?box, SLC), weight(?box) < 2)\", then: [THEN], else: [ELSE] }
  - lift:
      action: arm/move
      pia: true
      reads: []
      requires: [\"exists (on(?box, ?where), weight(?box) = ?w, ?w < 2, not on(?box, floor))\"]
      effects: [\"lifted(arm)\"]
      resources: [{ block: Arm }]
";

fn lift(place: &str, mode: Mode) -> Run {
    let state = |name: &str| {
        format!(
            "{{ {name}: {{ action: arm/move, pia: true, reads: [], effects: [\"went({name})\"], resources: [{{ block: Arm }}] }} }}"
        )
    };
    let task = TASK.replace("PLACE", place).replace("THEN", &state("yes")).replace("ELSE", &state("no"));
    simulate(&task, mode, &mut Providers(|_: &str, _: u32, _: &Goal, _: &World| ("success", Value::Null)))
}

#[test]
fn a_query_over_facts_that_older_states_write_is_answered_as_their_order_has_it() {
    for mode in MODES {
        for (place, went, outcome) in
            [("table", "yes", "success"), ("shelf", "no", "success"), ("floor", "no", "aborted")]
        {
            let run = lift(place, mode);
            assert_eq!(run.outcome, outcome, "{mode:?} {place}");
            let facts = facts(&run);
            let of = |name: &str| facts.contains(&format!("went({name}) = true"));
            assert_eq!((of("yes"), of("no")), (went == "yes", went == "no"), "{mode:?} {place}: {facts:?}");
            assert_eq!(facts.contains(&"lifted(arm) = true".to_owned()), outcome == "success", "{mode:?} {place}");
        }
    }
}

/// What is found decides what a loop does; a state before it changes what there is to find.
#[test]
fn a_loop_over_what_a_query_finds_does_what_holds_at_its_place() {
    let task = "
task: clear
world: [\"on(cup, table)\", \"on(box, table)\", \"on(fork, shelf)\", \"weight(cup) = 1\", \"weight(box) = 3\", \"weight(mug) = 2\"]
outputs: { heavy: \"find(?x, ?w, weight(?x) = ?w, ?w > 1)\", left: \"len(find(?x, on(?x, table)))\" }
states:
  - put: { action: arm/move, pia: true, reads: [], effects: [\"on(mug, table)\"], resources: [{ block: Arm }] }
  - for: \"thing in sort_by($x in find(?x, on(?x, table)), 0 - weight($x))\"
    do:
      - plan: { action: brain/think, computes: true, in: { a: $thing }, reads: [], resources: [{ block: Brain }] }
      - get:
          action: arm/move
          pia: true
          in: { a: $thing }
          reads: []
          effects: [\"delete on($thing, table)\", \"took($thing, $index)\"]
          resources: [{ block: Arm }]
    index: index
";
    for mode in MODES {
        let run = simulate(task, mode, &mut Providers(|_: &str, _: u32, _: &Goal, _: &World| ("success", Value::Null)));
        assert_eq!(run.outcome, "success", "{mode:?}: {}", run.reason);
        let facts = facts(&run);
        for took in ["took(box, 0) = true", "took(mug, 1) = true", "took(cup, 2) = true", "on(fork, shelf) = true"] {
            assert!(facts.contains(&took.to_owned()), "{mode:?}: {facts:?}");
        }
        assert_eq!(run.outputs["heavy"].to_string(), "[{w: 2, x: mug}, {w: 3, x: box}]", "{mode:?}");
        assert_eq!(run.outputs["left"], Value::Int(0), "{mode:?}");
    }
}

/// The variables of a `find` in a function are its own, wherever the function is used; its records have the names that are written.
#[test]
fn what_a_function_finds_has_nothing_to_do_with_the_variables_around() {
    let task = "
task: apart
world: [\"on(cup, table)\", \"on(box, shelf)\", \"weight(cup) = 1\"]
functions:
  tabled(): find(?x, on(?x, table))
  heavy($least): find(?x, ?w, weight(?x) = ?w, ?w >= $least)
outputs:
  both: \"exists (on(?x, shelf), len(tabled()) > 0, ?x = box)\"
  others: \"map($x in tabled(), exists (on(?x, shelf), ?x != $x))\"
  heavy: heavy(1)
states: []
";
    for mode in MODES {
        let run = simulate(task, mode, &mut Providers(|_: &str, _: u32, _: &Goal, _: &World| ("success", Value::Null)));
        let shown: Vec<String> = run.outputs.values().map(ToString::to_string).collect();
        assert_eq!(shown, ["true", "[{w: 1, x: cup}]", "[true]"], "{mode:?}: {}", run.reason);
    }
}

#[test]
fn a_query_that_cannot_be_planned_is_refused_with_its_place() {
    let task =
        TASK.replace("weight(?box) < 2", "?weight < 2").replace("THEN", "").replace("ELSE", "").replace("PLACE", "x");
    let refused = load(&task, "task.yaml", &catalogue()).unwrap_err();
    assert_eq!(refused[0].rule, "invalid-expression");
    assert!(refused[0].message.starts_with("`?weight` in `?weight < 2` gets no value"), "{}", refused[0]);
    let task = TASK.replace("PLACE", "?where");
    let refused = load(&task, "task.yaml", &catalogue()).unwrap_err();
    assert!(refused.iter().any(|d| d.message.contains("stands only within `exists (…)`")), "{}", refused[0]);
}
