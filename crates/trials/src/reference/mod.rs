//! The reference: a second, slow and simple evaluation of a task program, one state after the other, as docs/task-files.md describes it.
//!
//! Both modes are compared with it, so that a mistake common to both is found, too. It shares no behaviour with them: expressions, facts, patterns, queries,
//! effects, bindings, transitions, loops, retries and resource sums are implemented here independently, without an index and as simply as possible. It does
//! share:
//!
//! - the plain data of `ratn-model` (`Program`, `State`, `Expr`, `Value`, `FactKey`, `Change`), the arithmetic of poses, and the ontology's check of a single
//!   change;
//! - the [`Oracle`], which is the environment. Its interface needs a `World`, so one is built from the facts for that purpose.
//!
//! There is no clock. A goal that takes longer than its timeout counts as aborted. Regions run one after another, which is equivalent because they share
//! nothing. Other dependence on time (deadlines, races for the same facts or resources) and endless waits (for resources that never exist) give
//! [`Fail::NotMine`]: there is no verdict. Only races of regions that share nothing are evaluated. Refusals are given to it by the paths of the states.
//!
//! | | |
//! |---|---|
//! | facts and effects | `facts`, `effects` |
//! | expressions | `evaluate`, `function`, `query` |
//! | checks that need only a run's log | `preconditions` |
//! | execution | `walk` (composite states), `race` (preemptive concurrencies, timeouts, watches), `goal` (one action), `waits`, `shown` (what a provider sees), `resources` |

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

/// Limit of visits and iterations in one evaluation.
const MAX_STEPS: usize = 50_000;

/// Why something has no value, or was not executed.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Fail {
    /// It needs an output that was never written.
    Unwritten(String),
    /// It can have no value here.
    Wrong(String),
    /// The reference does not evaluate this: there is no verdict on the program.
    NotMine(&'static str),
    /// The present action is cut short: the run was told to end here, or a race was decided.
    Cut,
}

/// The expected result of a program.
#[derive(Debug, Default, Clone, PartialEq)]
pub(super) struct ReferenceResult {
    pub(super) outcome: String,
    pub(super) outputs: Outputs,
    pub(super) facts: Facts,
    /// Remaining task resources in thousandths, by kind.
    pub(super) units: BTreeMap<String, u64>,
    /// The goals of PIAs in one order that the program allows: path, and seed with inputs.
    pub(super) acts: Vec<(String, String)>,
    /// Results of actions outside of routines, by path.
    pub(super) results: BTreeMap<String, Vec<Real>>,
    /// The changes, by predicate, or by fact if there are regions.
    pub(super) changes: BTreeMap<String, Vec<Change>>,
}

/// The input of an evaluation.
pub(super) struct Given<'a> {
    pub(super) program: &'a Program,
    pub(super) seed: u64,
    pub(super) parameters: BTreeMap<String, Value>,
    pub(super) facts: Facts,
    /// Task resources at the start in thousandths, by kind.
    pub(super) units: BTreeMap<String, u64>,
    /// States whose acquires are always refused, by their paths without visits.
    pub(super) refused: BTreeSet<String>,
    /// Changes from outside when a goal starts.
    pub(super) outside: Vec<(Trigger, Event)>,
    /// Signals sent before the run begins, the oldest first.
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
    /// Signals that no wait has taken, the oldest first.
    signals: Vec<(String, Value)>,
    /// The outputs of the latest visit of each state.
    outputs: BTreeMap<StateId, Outputs>,
    /// Outcomes of regions.
    regions: BTreeMap<StateId, String>,
    steps: usize,
    /// Decides at each place where an action waits or runs, region by region, whether the run is told to end there.
    choices: Option<Choices>,
    /// Changes by the environment that a cut wait was waiting for: they may come at any moment of the way out, or never.
    coming: Vec<(FactKey, Option<Value>)>,
    /// Whether this thread of control is on its way out.
    is_leaving: bool,
    /// Whether the state that was cut short had not been entered yet.
    is_outside: bool,
    /// The races around this thread of control.
    races: Races,
    result: ReferenceResult,
}

/// Where a run is told to end: one decision for each place where it could be. A region that is not told at one place is told at a later one, or has ended.
#[derive(Debug, Clone, Default)]
pub(super) struct Choices {
    made: Vec<bool>,
    next: usize,
}

impl Choices {
    /// The next sequence of decisions; `None` after the last.
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

/// Evaluates a program up to the place where the run is told to end, and its way out; returns the decisions that were needed, too. The result is `None` if it
/// is not told to end.
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
    /// The reference at the start of a program, with the variables in scope.
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

    /// A moment at which a change may come that was waited for before.
    fn may_come(&mut self) {
        if !self.coming.is_empty() && self.choices.as_mut().is_some_and(Choices::choose) {
            for (key, value) in std::mem::take(&mut self.coming) {
                self.becomes(key, value);
            }
        }
    }

    /// The environment sets or removes a fact.
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

    /// The present scope.
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

    /// Applies changes, all of them or none.
    fn change(&mut self, changes: Vec<Change>) -> Result<(), Fail> {
        self.result.facts = effects::applied(&self.result.facts, &changes, self.program.ontology.as_ref())?;
        for change in changes {
            let name = compared_as(self.program, &change);
            self.result.changes.entry(name).or_default().push(change);
        }
        Ok(())
    }
}

/// Separates failures of the program, which are results, from reasons to end the evaluation.
fn fails<T>(result: Result<T, Fail>) -> Result<Result<T, Fail>, Fail> {
    match result {
        Err(Fail::NotMine(what)) => Err(Fail::NotMine(what)),
        Err(Fail::Cut) => Err(Fail::Cut),
        other => Ok(other),
    }
}
