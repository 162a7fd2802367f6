//! A task with an ontology: what comes out otherwise than it allows ends the state `aborted`, in both modes, and changes nothing.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod support;

use ratn_executive::protocol::{Goal, Mode};
use ratn_model::load::Files;
use ratn_model::value::Value;
use ratn_simulation::run::{Run, run};
use ratn_world::world::World;
use support::{MODES, Providers, fact, load, setup, text};

const TASK: &str = "
task: grab
ontology: hand.ttl
world: [\"held(arm) = nothing\"]
states:
  - grab:
      action: arm/move
      out: { x: any }
      pia: true
      reads: []
      effects: [\"held(arm) = x\"]
      resources: [{ block: Arm }]
";

struct Hand;

impl Files for Hand {
    fn read(&self, _: &str, path: &str) -> Result<(String, String), String> {
        let text = "@prefix ratn: <urn:ratn:ontology#> . @prefix owl: <http://www.w3.org/2002/07/owl#> . @prefix : <urn:hand#> .
            :Arm a owl:Class . :arm a :Arm . :Holdable a owl:Class . :nothing a :Holdable . :cup a :Holdable .
            :held a ratn:Predicate ; ratn:arguments ( :Arm ) ; ratn:value :Holdable .";
        Ok((path.to_owned(), text.to_owned()))
    }
}

/// A run in which the arm takes this.
fn take(task: &str, files: &dyn Files, what: &Value, mode: Mode) -> Run {
    let mut providers = Providers(|_: &str, _: u32, _: &Goal, _: &World| ("success", what.clone()));
    run(setup(load(task, "task.yaml", files), mode), &mut providers).unwrap()
}

#[test]
fn an_effect_outside_the_range_is_not_made_real_and_its_state_is_aborted() {
    let held = fact("held(arm)");
    for mode in MODES {
        let good = take(TASK, &Hand, &text("cup"), mode);
        assert_eq!((good.outcome.as_str(), good.world.get(&held)), ("success", Some(&text("cup"))), "{mode:?}");
        for wrong in [Value::Int(3), text("elephant")] {
            let bad = take(TASK, &Hand, &wrong, mode);
            assert_eq!((bad.outcome.as_str(), bad.world.get(&held)), ("aborted", Some(&text("nothing"))), "{mode:?}");
            let log = format!("{:?}", bad.log);
            assert!(log.contains("[outside-range]"), "{mode:?}: {log}");
        }
    }
}

const MOVES: &str = "
task: move
ontology: shelf.ttl
world: [\"on(cup, table)\"]
states:
  - look:
      action: arm/move
      out: { x: any }
      pia: true
      reads: []
      effects: [EFFECTS]
      resources: [{ block: Arm }]
";

struct Shelf;

impl Files for Shelf {
    fn read(&self, _: &str, path: &str) -> Result<(String, String), String> {
        let text = "@prefix ratn: <urn:ratn:ontology#> . @prefix owl: <http://www.w3.org/2002/07/owl#> . @prefix : <urn:shelf#> .
            :Thing a owl:Class . :cup a :Thing . :table a :Thing . :shelf a :Thing .
            :on a ratn:Predicate , owl:FunctionalProperty ; ratn:arguments ( :Thing :Thing ) ; ratn:value \"bool\" .";
        Ok((path.to_owned(), text.to_owned()))
    }
}

#[test]
fn a_second_fact_of_a_functional_predicate_is_not_made_real_unless_the_first_goes() {
    for mode in MODES {
        for (effects, outcome) in [
            ("\"on(cup, x)\"", "aborted"),
            ("\"delete on(cup, ?)\", \"on(cup, x)\"", "success"),
            ("\"on(cup, table) = false\", \"on(cup, x)\"", "success"),
        ] {
            let run = take(&MOVES.replace("EFFECTS", effects), &Shelf, &text("shelf"), mode);
            assert_eq!(run.outcome, outcome, "{mode:?} {effects}");
            assert_eq!(run.world.get(&fact("on(cup, shelf)")).is_some(), outcome == "success", "{mode:?} {effects}");
            assert_eq!(
                format!("{:?}", run.log).contains("[not-functional]"),
                outcome == "aborted",
                "{mode:?} {effects}"
            );
        }
    }
}
