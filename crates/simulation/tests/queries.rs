//! Queries in tasks: `exists (…)` in preconditions and conditions, in both modes, on facts that hold and on facts that are to come.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_executive::protocol::{Goal, Mode};
use ratn_model::catalogue::Catalogue;
use ratn_model::load::load;
use ratn_model::tolerance::Tolerance;
use ratn_simulation::run::{Answer, Oracle, Performance, Run, Setup, run};
use ratn_world::world::World;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

const CATALOGUE: &str = r#"
[resources]
Arm = { class = "module", count = 1, actuates = true }

[providers.arm]
resource = "Arm"
actions.do = {}
"#;

/// The box is put down by the first state; what comes after asks for a box that is on a table and light.
const TASK: &str = "
task: lift
world: [\"class(box_1, SLC)\", \"weight(box_1) = 1.5\", \"class(box_2, SLC)\", \"weight(box_2) = 5\", \"on(box_2, table)\"]
states:
  - put:
      action: arm/do
      pia: true
      reads: []
      effects: [\"on(box_1, PLACE)\"]
      resources: [{ block: Arm }]
  - light: { condition: \"exists (on(?box, table), class(?box, SLC), weight(?box) < 2)\", then: [THEN], else: [ELSE] }
  - lift:
      action: arm/do
      pia: true
      reads: []
      requires: [\"exists (on(?box, ?where), weight(?box) = ?w, ?w < 2, not on(?box, floor))\"]
      effects: [\"lifted(arm)\"]
      resources: [{ block: Arm }]
";

struct Does;

impl Oracle for Does {
    fn perform(&mut self, _: &str, _: u32, _: &Goal, _: &World) -> Performance {
        let answer = Answer::Finished { outcome: "success".to_owned(), outputs: BTreeMap::new(), measured: Vec::new() };
        Performance { duration_s: 1.0, answer }
    }
}

fn lift(place: &str, mode: Mode) -> Run {
    let state = |name: &str| {
        format!(
            "{{ {name}: {{ action: arm/do, pia: true, reads: [], effects: [\"went({name})\"], resources: [{{ block: Arm }}] }} }}"
        )
    };
    let task = TASK.replace("PLACE", place).replace("THEN", &state("yes")).replace("ELSE", &state("no"));
    let catalogue = Catalogue::from_toml(CATALOGUE).unwrap();
    let program = load(&task, "task.yaml", &catalogue).unwrap().program;
    let setup = Setup {
        program: Arc::new(program),
        mode,
        parameters: BTreeMap::new(),
        seed: 1,
        resources: catalogue.resources.clone().into_iter().collect(),
        world: Vec::new(),
        tolerance: Tolerance::EXACT,
        latency: Duration::ZERO,
    };
    run(setup, &mut Does).unwrap()
}

#[test]
fn a_query_over_facts_that_older_states_write_is_answered_as_their_order_has_it() {
    for mode in [Mode::Hsm, Mode::Cdtn] {
        for (place, went, outcome) in
            [("table", "yes", "success"), ("shelf", "no", "success"), ("floor", "no", "aborted")]
        {
            let run = lift(place, mode);
            assert_eq!(run.outcome, outcome, "{mode:?} {place}");
            let facts: Vec<String> = run.world.iter().map(|(key, _)| key.to_string()).collect();
            let of = |name: &str| facts.contains(&format!("went({name})"));
            assert_eq!((of("yes"), of("no")), (went == "yes", went == "no"), "{mode:?} {place}: {facts:?}");
            assert_eq!(facts.contains(&"lifted(arm)".to_owned()), outcome == "success", "{mode:?} {place}");
        }
    }
}

#[test]
fn a_query_that_cannot_be_planned_is_refused_with_its_place() {
    let task =
        TASK.replace("weight(?box) < 2", "?weight < 2").replace("THEN", "").replace("ELSE", "").replace("PLACE", "x");
    let refused = load(&task, "task.yaml", &Catalogue::from_toml(CATALOGUE).unwrap()).unwrap_err();
    assert_eq!(refused[0].rule, "invalid-expression");
    assert!(refused[0].message.starts_with("`?weight` in `?weight < 2` gets no value"), "{}", refused[0]);
    let task = TASK.replace("PLACE", "?where");
    let refused = load(&task, "task.yaml", &Catalogue::from_toml(CATALOGUE).unwrap()).unwrap_err();
    assert!(refused.iter().any(|d| d.message.contains("stands only within `exists (…)`")), "{}", refused[0]);
}
