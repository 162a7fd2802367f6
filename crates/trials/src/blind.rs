//! Programs that read no fact, with imprecise motions that fail ([`super::Features::IMPRECISE`]): their outcomes are the same in
//! both modes.
//!
//! With imprecise motions, a failure leaves a world that HSM mode never has, so worlds are not compared. But decisions that depend
//! only on ports, literals and outcomes, with an oracle that sees only path, try and inputs, do not depend on the world. So the
//! task's outcome and outputs, and the result of every state that retired in HSM mode, must be the same, and CDTN mode must perform
//! every motion of HSM mode. It may perform more: motions that ran beside the one that failed.

use super::story::Story;
use ratn_simulation::run::Run;
use std::collections::BTreeSet;

/// The first outcome or motion of HSM mode that is missing in CDTN mode.
pub(super) fn problem((hsm, before): (&Run, &Story), (cdtn, after): (&Run, &Story)) -> Option<String> {
    lost_outcome((hsm, before), (cdtn, after)).or_else(|| {
        let started: BTreeSet<(&str, &str)> = after.acts.iter().map(|act| (&*act.path, &*act.goal)).collect();
        let missing = before.acts.iter().find(|act| !started.contains(&(&*act.path, &*act.goal)))?;
        Some(format!("{} never starts in CDTN mode", missing.path))
    })
}

/// The first outcome of HSM mode that is missing in CDTN mode.
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

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]

    use super::*;
    use crate::story::story;
    use ratn_executive::protocol::{Goal, Mode};
    use ratn_model::catalogue::{Catalogue, ResourceOffer};
    use ratn_model::resource::ResourceClass;
    use ratn_model::tolerance::Tolerance;
    use ratn_simulation::run::{Answer, Oracle, Performance, Setup, run};
    use ratn_world::world::World;
    use std::collections::BTreeMap;
    use std::sync::Arc;
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

    /// Motions with their estimated durations; one may abort.
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
        // As if the failure had been lost.
        assert!(difference(&hsm, &run_of(Mode::Hsm, "nothing")).is_some());
    }

    #[test]
    fn the_failure_of_an_imprecise_motion_in_a_region_is_not_lost() {
        let (hsm, cdtn) = (run_of(Mode::Hsm, "both/turn"), run_of(Mode::Cdtn, "both/turn"));
        assert_eq!(difference(&hsm, &cdtn), None);
    }
}
