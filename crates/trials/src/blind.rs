//! Imprecise programs whose decisions do not depend on facts: their outcomes are the same in both modes, after failures, too.
//!
//! Where motions are imprecise, a failure leaves a world that HSM mode never has, so worlds are not compared. But what is decided
//! by ports, literals and outcomes alone, with an oracle that sees only path and try, does not depend on the world. So the
//! task's outcome and outputs, and the result of every state that HSM mode retired, are what they are in HSM mode. CDTN mode may have
//! retired more: motions that ran beside the one that failed.

use super::reference;
use super::story::{Story, story};
use super::trial::{Conditions, MAX_CDTN_EVENTS, MAX_HSM_EVENTS, Verdict, oracle, run_with, should_be_with};
use ratn_executive::protocol::{Goal, Mode};
use ratn_model::expression::Expr;
use ratn_model::program::Program;
use ratn_model::value::Value;
use ratn_simulation::run::{Oracle, Performance, Run, RunError};
use ratn_world::world::World;
use std::collections::BTreeMap;
use std::sync::Arc;

/// Of a hundred visits, so many fail: it is failures that are looked at.
const FAILURES_PERCENT: u64 = 20;

/// Shows another oracle neither the world nor the inputs: only path and try are left.
struct Blindfold<'a>(&'a mut dyn Oracle);

impl Oracle for Blindfold<'_> {
    fn perform(&mut self, path: &str, attempt: u32, goal: &Goal, _: &World) -> Performance {
        let goal = Goal { inputs: BTreeMap::new(), ..goal.clone() };
        self.0.perform(path, attempt, &goal, &World::default())
    }
}

/// Runs the program, without what depends on facts, in both modes, and compares the outcomes.
pub fn trial_blind(program: &Program, conditions: &Conditions) -> Verdict {
    let program = Arc::new(without_facts(program));
    let conditions = &Conditions { failures_percent: FAILURES_PERCENT, ..conditions.clone() };
    let run = |mode, events| {
        run_with(&program, conditions, mode, events, Vec::new(), &mut Blindfold(&mut oracle(&program, conditions)))
    };
    let hsm = match run(Mode::Hsm, MAX_HSM_EVENTS) {
        Ok(run) => run,
        Err(RunError::Endless(_)) => return Verdict::LeftOut,
        Err(problem) => return Verdict::Differs(format!("blind, HSM mode: {problem}")),
    };
    let cdtn = match run(Mode::Cdtn, MAX_CDTN_EVENTS * hsm.log.len() + 10_000) {
        Ok(run) => run,
        Err(problem) => return Verdict::Differs(format!("blind, CDTN mode: {problem}")),
    };
    let (before, after) = (story(&program, &hsm), story(&program, &cdtn));
    let mut eyes = oracle(&program, conditions);
    let told = should_be_with(&program, conditions, &[], &mut Blindfold(&mut eyes));
    let told = told.ok().and_then(|told| reference::outcomes(&told, &hsm, &before));
    let told = told.map(|problem| format!("HSM mode and the reference: {problem}"));
    match told.or_else(|| lost_outcome((&hsm, &before), (&cdtn, &after))) {
        Some(problem) => Verdict::Differs(format!("blind, {problem}")),
        None => Verdict::Same { hsm_s: hsm.end_s, cdtn_s: cdtn.end_s, acts: after.acts.len() },
    }
}

/// The first outcome of HSM mode that CDTN mode does not have.
fn lost_outcome((hsm, before): (&Run, &Story), (cdtn, after): (&Run, &Story)) -> Option<String> {
    if (&hsm.outcome, &hsm.outputs) != (&cdtn.outcome, &cdtn.outputs) {
        let end = |run: &Run| format!("{} ({}) {:?}", run.outcome, run.reason, run.outputs);
        return Some(format!("the task ends otherwise:\n hsm  {}\n cdtn {}", end(hsm), end(cdtn)));
    }
    before.retired.iter().find_map(|(path, results)| {
        let others = after.retired.get(path).map_or(&[][..], Vec::as_slice);
        let lost = results.iter().find(|result| !others.iter().any(|other| result.may_be(other)))?;
        Some(format!("{path} ends otherwise:\n hsm  {lost:?}\n cdtn {others:?}"))
    })
}

/// The program with constants where it looks facts up, and without preconditions.
fn without_facts(program: &Program) -> Program {
    let constant = |part: &mut Expr| match part {
        Expr::Fact(_) => *part = Expr::Literal(Value::Int(1)),
        Expr::Exists(_) | Expr::Query(_) => *part = Expr::Literal(Value::Bool(true)),
        _ => {}
    };
    let mut program = program.clone();
    for state in &mut program.states {
        state.annotations.requires.clear();
        // What holds a fact is a constant then, whatever its arguments were.
        state.each_expression_mut(&mut |_, expression| expression.rewrite(&mut |part| constant(part)));
    }
    // The task's outputs may be of facts; those of its states are compared one by one.
    program.outputs.retain(|output| output.value.fact_expressions().is_empty());
    program
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]

    use super::*;
    use ratn_model::catalogue::{Catalogue, ResourceOffer};
    use ratn_model::resource::ResourceClass;
    use ratn_model::tolerance::Tolerance;
    use ratn_simulation::run::{Answer, Setup, run};
    use std::time::Duration;

    const CATALOGUE: &str = r#"
[resources]
Arm = { class = "module", count = 1, actuates = true }
Head = { class = "module", count = 1, actuates = true }
Base = { class = "module", count = 1, actuates = true }
[providers.head]
resource = "Head"
actions.turn = {}
[providers.arm]
resource = "Arm"
actions.move = {}
[providers.base]
resource = "Base"
actions.drive = {}
"#;

    const LOST_FAILURE: &str = r"
task: a_failure_beside_another_motion
states:
  - both:
      concurrency: barrier
      regions:
        - turn: { action: head/turn, pia: true, reads: [], effects: { success: [], aborted: [] }, exceptions: imprecise,
                  resources: [{ block: Head }], duration: 5 }
        - go: { action: arm/move, pia: true, reads: [], effects: { success: [], aborted: [] }, resources: [{ block: Arm }], duration: 3 }
      transitions: { aborted: repair, success: success }
  - repair: { action: base/drive, pia: true, reads: [], effects: { success: [], aborted: [] }, resources: [{ block: Base }] }
";

    /// The motions take what is estimated; one may abort.
    struct Motions(&'static str);

    impl Oracle for Motions {
        fn perform(&mut self, path: &str, _: u32, goal: &Goal, _: &World) -> Performance {
            let outcome = if path == self.0 { "aborted" } else { "success" }.to_owned();
            let answer = Answer::Finished { outcome, outputs: BTreeMap::new(), measured: Vec::new() };
            Performance { duration_s: goal.expected_s.unwrap_or(1.0), answer }
        }
    }

    fn run_of(mode: Mode, aborts: &'static str) -> (Run, Story) {
        let catalogue = Catalogue::from_toml(CATALOGUE).unwrap();
        let program = ratn_model::load::load(LOST_FAILURE, "task.yaml", &catalogue).unwrap().program;
        let offer = |kind: &str| (kind.to_owned(), ResourceOffer::new(ResourceClass::Module, 1));
        let setup = Setup {
            program: Arc::new(program.clone()),
            mode,
            parameters: BTreeMap::new(),
            seed: 1,
            resources: ["Arm", "Head", "Base"].map(offer).into(),
            world: Vec::new(),
            tolerance: Tolerance::EXACT,
            latency: Duration::ZERO,
        };
        let run = run(setup, &mut Motions(aborts)).unwrap();
        let told = story(&program, &run);
        (run, told)
    }

    fn difference(hsm: &(Run, Story), other: &(Run, Story)) -> Option<String> {
        lost_outcome((&hsm.0, &hsm.1), (&other.0, &other.1))
    }

    #[test]
    fn a_failure_that_is_lost_is_noticed() {
        let hsm = run_of(Mode::Hsm, "both/turn");
        assert!(hsm.1.retired.contains_key("repair"), "{:?}", hsm.1.retired);
        assert_eq!(difference(&hsm, &run_of(Mode::Hsm, "both/turn")), None);
        // As if nobody had heard of the failure.
        assert!(difference(&hsm, &run_of(Mode::Hsm, "nothing")).is_some());
    }

    #[test]
    fn the_failure_of_an_imprecise_motion_in_a_region_is_not_lost() {
        let (hsm, cdtn) = (run_of(Mode::Hsm, "both/turn"), run_of(Mode::Cdtn, "both/turn"));
        assert_eq!(difference(&hsm, &cdtn), None);
    }
}
