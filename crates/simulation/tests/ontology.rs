//! A task with an ontology: what comes out otherwise than it allows ends the state `aborted`, in both modes, and changes nothing.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_executive::protocol::{Goal, Mode};
use ratn_model::catalogue::Catalogue;
use ratn_model::fact::{FactKey, Term};
use ratn_model::load::{Files, load_with};
use ratn_model::tolerance::Tolerance;
use ratn_model::value::Value;
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
actions.take = { outputs = { what = "any" } }
"#;

const TASK: &str = "
task: grab
ontology: hand.ttl
world: [\"held(arm) = nothing\"]
states:
  - grab:
      action: arm/take
      out: { what: any }
      pia: true
      reads: []
      effects: [\"held(arm) = what\"]
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

struct Takes(Value);

impl Oracle for Takes {
    fn perform(&mut self, _: &str, _: u32, _: &Goal, _: &World) -> Performance {
        let outputs = BTreeMap::from([("what".to_owned(), self.0.clone())]);
        let answer = Answer::Finished { outcome: "success".to_owned(), outputs, measured: Vec::new() };
        Performance { duration_s: 1.0, answer }
    }
}

fn take(what: Value, mode: Mode) -> Run {
    perform(TASK, &Hand, what, mode)
}

fn perform(task: &str, files: &dyn Files, what: Value, mode: Mode) -> Run {
    let catalogue = Catalogue::from_toml(CATALOGUE).unwrap();
    let program = load_with(task, "task.yaml", &catalogue, files).unwrap().program;
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
    run(setup, &mut Takes(what)).unwrap()
}

#[test]
fn an_effect_outside_the_range_is_not_made_real_and_its_state_is_aborted() {
    let held = FactKey { predicate: "held".to_owned(), arguments: vec![Term::Name("arm".to_owned())] };
    let text = |text: &str| Value::String(text.to_owned());
    for mode in [Mode::Hsm, Mode::Cdtn] {
        let good = take(text("cup"), mode);
        assert_eq!((good.outcome.as_str(), good.world.get(&held)), ("success", Some(&text("cup"))), "{mode:?}");
        for wrong in [Value::Int(3), text("elephant")] {
            let bad = take(wrong, mode);
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
      action: arm/take
      out: { what: any }
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
    let on = |what: &str| {
        let name = |name: &str| Term::Name(name.to_owned());
        FactKey { predicate: "on".to_owned(), arguments: vec![name("cup"), name(what)] }
    };
    for mode in [Mode::Hsm, Mode::Cdtn] {
        for (effects, outcome) in [
            ("\"on(cup, what)\"", "aborted"),
            ("\"delete on(cup, ?)\", \"on(cup, what)\"", "success"),
            ("\"on(cup, table) = false\", \"on(cup, what)\"", "success"),
        ] {
            let run = perform(&MOVES.replace("EFFECTS", effects), &Shelf, Value::String("shelf".to_owned()), mode);
            assert_eq!(run.outcome, outcome, "{mode:?} {effects}");
            assert_eq!(run.world.get(&on("shelf")).is_some(), outcome == "success", "{mode:?} {effects}");
            assert_eq!(
                format!("{:?}", run.log).contains("[not-functional]"),
                outcome == "aborted",
                "{mode:?} {effects}"
            );
        }
    }
}
