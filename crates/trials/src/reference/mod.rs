//! The reference: a second, slow and plain evaluation of a task program, one state after the other, as docs/task-files.md says it.
//!
//! Both modes are compared with it, so a mistake that they share is found, too. It shares no behaviour with them: expressions, facts,
//! patterns, queries, effects, bindings, transitions, loops, retries and resource sums are read and counted here once more,
//! without an index and without cleverness. What it does share:
//!
//! - the plain data of `ratn-model` (`Program`, `State`, `Expr`, `Value`, `FactKey`, `Change`), the arithmetic of poses
//!   and what an ontology says of one change;
//! - the [`Oracle`], which is the environment. It wants a `World`, so one is built from the facts only to be handed to it.
//!
//! There is no clock. A goal that takes longer than its timeout is one that has aborted; regions run one after another,
//! which is the same because they touch nothing of each other. What depends on time otherwise than a race of regions that touch nothing of
//! each other does (deadlines, races for the same), or on a wait without an end (resources that are never there) is [`Fail::NotMine`]: there is no verdict. What is refused, it is told
//! by the paths of the states.
//!
//! | | |
//! |---|---|
//! | facts and effects | `facts`, `effects` |
//! | expressions | `evaluate`, `function`, `query` |
//! | what is known of a run's log alone | `preconditions` |
//! | what runs | `walk` (states that contain others), `race` (what ends before all that is in it has), `goal` (one action), `waits` (a state that waits), `shown` (what its provider sees), `resources` |

mod compare;
mod comprehension;
mod effects;
mod evaluate;
mod facts;
mod function;
mod goal;
mod preconditions;
mod query;
mod race;
mod resources;
mod shown;
mod waits;
mod walk;

#[cfg(test)]
mod tests;

pub(super) use compare::{disagreement, end, is_cut, outcomes};
pub(super) use preconditions::unmet;

use super::compared_as;
use super::story::Real;
use evaluate::{Place, Read};
use facts::Facts;
use race::Races;
use ratn_executive::protocol::Event;
use ratn_model::fact::{Change, FactKey};
use ratn_model::id::StateId;
use ratn_model::program::{ABORTED, Program, SUCCESS};
use ratn_model::value::Value;
use ratn_simulation::run::{Oracle, Trigger};
use std::collections::{BTreeMap, BTreeSet};

/// Output ports of one state.
type Outputs = BTreeMap<String, Value>;

/// No run of the reference has more visits and iterations.
const MAX_STEPS: usize = 50_000;

/// Why something has no value, or did not happen.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Fail {
    /// It needs what was never written.
    Unwritten(String),
    /// It can have no value here.
    Wrong(String),
    /// The reference does not evaluate this: there is no verdict on the program.
    NotMine(&'static str),
    /// What is under way is cut short: the run was told to end here, or a race was decided.
    Cut,
}

/// What should become of a program.
#[derive(Debug, Default, Clone, PartialEq)]
pub(super) struct ReferenceResult {
    pub(super) outcome: String,
    pub(super) outputs: Outputs,
    pub(super) facts: Facts,
    /// Thousandths of task resources that are left, by kind.
    pub(super) units: BTreeMap<String, u64>,
    /// The goals of PIAs in one order that the program allows: path, and seed with inputs.
    pub(super) acts: Vec<(String, String)>,
    /// How actions that are in no routine ended, by path.
    pub(super) results: BTreeMap<String, Vec<Real>>,
    /// What was changed, by predicate, or by fact where there are regions.
    pub(super) changes: BTreeMap<String, Vec<Change>>,
}

/// What a program is evaluated with.
pub(super) struct Given<'a> {
    pub(super) program: &'a Program,
    pub(super) seed: u64,
    pub(super) parameters: BTreeMap<String, Value>,
    pub(super) facts: Facts,
    /// Thousandths of the task resources that there are, by kind.
    pub(super) units: BTreeMap<String, u64>,
    /// States that are refused whatever they ask for, by their paths without visits.
    pub(super) refused: BTreeSet<String>,
    /// What changes from outside when a goal starts.
    pub(super) outside: Vec<(Trigger, Event)>,
    /// What is sent before the run begins, the oldest first.
    pub(super) signals: Vec<(String, Value)>,
    pub(super) oracle: &'a mut dyn Oracle,
}

/// A program under evaluation.
struct Reference<'a> {
    program: &'a Program,
    seed: u64,
    oracle: &'a mut dyn Oracle,
    refused: BTreeSet<String>,
    outside: Vec<(Trigger, Event)>,
    /// Signals that nobody has waited for yet, the oldest first.
    signals: Vec<(String, Value)>,
    /// Of all states, what their latest visits wrote.
    outputs: BTreeMap<StateId, Outputs>,
    /// How regions ended.
    regions: BTreeMap<StateId, String>,
    steps: usize,
    /// Whether the run is told to end at the places where an action waits or is under way, as they come in each region.
    choices: Option<Choices>,
    /// What the environment was about to change when a wait for it was cut short: it may come at any moment of the way out, or never.
    coming: Vec<(FactKey, Option<Value>)>,
    /// This thread of control is on its way out.
    is_leaving: bool,
    /// What was cut short had not been entered.
    is_outside: bool,
    /// What this thread of control is in.
    races: Races,
    result: ReferenceResult,
}

/// Where a run is told to end: of the places where it could be, one after another, whether it is. A region that is not told at the first is
/// at a later one, or has ended.
#[derive(Debug, Clone, Default)]
pub(super) struct Choices {
    made: Vec<bool>,
    next: usize,
}

impl Choices {
    /// The next of all; none after the last.
    pub(super) fn next(mut self) -> Option<Choices> {
        while self.made.pop()? {}
        self.made.push(true);
        Some(Choices { made: self.made, next: 0 })
    }

    fn choose(&mut self) -> bool {
        if self.next == self.made.len() {
            self.made.push(false);
        }
        self.next += 1;
        self.made[self.next - 1]
    }
}

/// Evaluates a program up to where the run is told to end, and what is done on the way out; with the choices as far as they were needed. `None`
/// where it is not told to.
///
/// # Errors
/// [`Fail::NotMine`].
pub(super) fn evaluate_cut(
    given: Given<'_>,
    choices: Choices,
    outcome: &str,
) -> Result<(Option<ReferenceResult>, Choices), Fail> {
    let (mut reference, mut variables) = Reference::of(given);
    reference.choices = Some(choices);
    let end = reference.task(&mut variables);
    reference.may_come();
    let choices = reference.choices.unwrap_or_default();
    match end {
        Err(Fail::Cut) => {
            reference.result.outcome = outcome.to_owned();
            Ok((Some(reference.result), choices))
        }
        Err(problem) => Err(problem),
        Ok(_) => Ok((None, choices)),
    }
}

/// Evaluates a program from its start to its end.
///
/// # Errors
/// [`Fail::NotMine`].
pub(super) fn evaluate(given: Given<'_>) -> Result<ReferenceResult, Fail> {
    let (mut reference, mut variables) = Reference::of(given);
    reference.result.outcome = reference.task(&mut variables)?;
    Ok(reference.result)
}

impl<'a> Reference<'a> {
    /// At the start of a program, with the variables in sight.
    fn of(given: Given<'a>) -> (Reference<'a>, Vec<(String, Value)>) {
        let Given { program, seed, parameters, facts, units, refused, outside, signals, oracle } = given;
        let reference = Reference {
            program,
            seed,
            oracle,
            refused,
            outside,
            signals,
            outputs: BTreeMap::new(),
            regions: BTreeMap::new(),
            steps: 0,
            choices: None,
            coming: Vec::new(),
            is_leaving: false,
            is_outside: false,
            races: Races::default(),
            result: ReferenceResult { facts, units, ..ReferenceResult::default() },
        };
        (reference, parameters.into_iter().collect())
    }
}

impl Reference<'_> {
    /// A place where the run may be told to end.
    fn may_be_cut(&mut self) -> Result<(), Fail> {
        let is_cut = !self.is_leaving && self.choices.as_mut().is_some_and(Choices::choose);
        if is_cut { Err(self.cut_by_the_run()) } else { Ok(()) }
    }

    /// A moment at which what was waited for may come, though nobody waits for it any more.
    fn may_come(&mut self) {
        if !self.coming.is_empty() && self.choices.as_mut().is_some_and(Choices::choose) {
            for (key, value) in std::mem::take(&mut self.coming) {
                self.becomes(key, value);
            }
        }
    }

    /// The environment makes a fact so.
    fn becomes(&mut self, key: FactKey, value: Option<Value>) {
        match value {
            Some(value) => drop(self.result.facts.insert(key, value)),
            None => drop(self.result.facts.remove(&key)),
        }
    }

    fn task(&mut self, variables: &mut Vec<(String, Value)>) -> Result<String, Fail> {
        let program = self.program;
        if program.deadline_s.is_some() {
            return Err(Fail::NotMine("a deadline"));
        }
        let initial = effects::bound(&program.initial, &self.place(variables, None));
        let begun = match fails(initial)? {
            Ok(changes) => self.change(changes),
            Err(problem) => Err(problem),
        };
        if fails(begun)?.is_err() {
            return Ok(ABORTED.to_owned());
        }
        let outcome = self.visit(Program::ROOT, "", variables, false)?;
        if outcome == SUCCESS {
            for output in &program.outputs {
                let value = output.value.read(&self.place(variables, None));
                match fails(value)? {
                    Ok(value) => drop(self.result.outputs.insert(output.name.clone(), value)),
                    Err(_) => {
                        self.result.outputs.clear();
                        return Ok(ABORTED.to_owned());
                    }
                }
            }
        }
        Ok(outcome)
    }

    /// Where names get their values now.
    fn place<'p>(&'p self, variables: &[(String, Value)], own: Option<&'p Outputs>) -> Place<'p> {
        Place {
            program: self.program,
            facts: &self.result.facts,
            outputs: &self.outputs,
            regions: &self.regions,
            variables: variables.to_vec(),
            own,
            elements: Vec::new(),
            row: Vec::new(),
        }
    }

    /// Changes happen, all of them or none.
    fn change(&mut self, changes: Vec<Change>) -> Result<(), Fail> {
        self.result.facts = effects::applied(&self.result.facts, &changes, self.program.ontology.as_ref())?;
        for change in changes {
            let name = compared_as(self.program, &change);
            self.result.changes.entry(name).or_default().push(change);
        }
        Ok(())
    }
}

/// A failure of the program is a result; what the reference does not evaluate ends the evaluation.
fn fails<T>(result: Result<T, Fail>) -> Result<Result<T, Fail>, Fail> {
    match result {
        Err(Fail::NotMine(what)) => Err(Fail::NotMine(what)),
        Err(Fail::Cut) => Err(Fail::Cut),
        other => Ok(other),
    }
}
