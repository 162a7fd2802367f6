//! Steps → answers, by nested lookups.

use super::MAX_STEPS;
use super::plan::{Found, Plan, Slot, Step};
use crate::expression::evaluate::{EvaluateError, equal};
use crate::expression::{Scope, bind};
use crate::fact::{FactKey, FactPattern, Term};
use crate::value::Value;
use std::borrow::Cow;
use std::cell::Cell;

/// Whether the caller wants more answers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Flow {
    /// The next answer.
    More,
    /// Stop.
    Enough,
}

/// Error: the query could not be answered.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum RunError {
    /// A value is not known yet or cannot be computed.
    #[error(transparent)]
    Evaluate(#[from] EvaluateError),
    /// It would visit too many facts.
    #[error(
        "it looks at more than {MAX_STEPS} facts; bind more of its arguments, or begin with the condition that fewest facts fit"
    )]
    TooManySteps,
}

/// Calls `answer` with the values of [`Plan::variables`] for every answer, until it returns [`Flow::Enough`]. An answer is repeated
/// if it can be derived in several ways.
///
/// # Errors
/// [`RunError`].
pub fn run(plan: &Plan, scope: &dyn Scope, answer: &mut dyn FnMut(&[Value]) -> Flow) -> Result<(), RunError> {
    let own = Cell::new(MAX_STEPS);
    let mut running = Running { scope, names: &plan.variables, steps_left: scope.budget().unwrap_or(&own) };
    let mut row = vec![None; plan.variables.len()];
    let mut values = Vec::with_capacity(plan.named);
    running.steps(&plan.steps, &mut row, &mut |row| {
        values.clear();
        // Does not occur: in a well-formed plan every answer variable has a value.
        values.extend(row[..plan.named].iter().map(|value| value.clone().unwrap_or(Value::Null)));
        answer(&values)
    })?;
    Ok(())
}

type Row = Vec<Option<Value>>;

struct Running<'a> {
    scope: &'a dyn Scope,
    names: &'a [String],
    steps_left: &'a Cell<u64>,
}

impl Running<'_> {
    fn steps(&mut self, steps: &[Step], row: &mut Row, answer: &mut dyn FnMut(&Row) -> Flow) -> Result<Flow, RunError> {
        let Some((step, rest)) = steps.split_first() else { return Ok(answer(row)) };
        self.one_more()?;
        match step {
            Step::Find { predicate, arguments, says } => self.find(predicate, arguments, says, rest, row, answer),
            Step::Test(expr) => {
                let holds = expr.holds(&self.with(row))?;
                if holds { self.steps(rest, row, answer) } else { Ok(Flow::More) }
            }
            Step::Bind(at, expr) => {
                let value = expr.evaluate(&self.with(row))?;
                row[*at] = Some(value);
                let flow = self.steps(rest, row, answer);
                row[*at] = None;
                flow
            }
            Step::Answers(inner, wanted) => {
                let mut found = false;
                self.steps(inner, row, &mut |_| {
                    found = true;
                    Flow::Enough
                })?;
                if found == *wanted { self.steps(rest, row, answer) } else { Ok(Flow::More) }
            }
        }
    }

    fn with<'r>(&'r self, row: &'r Row) -> WithRow<'r> {
        WithRow { outer: self.scope, names: self.names, row, steps_left: self.steps_left }
    }

    fn one_more(&mut self) -> Result<(), RunError> {
        let left = self.steps_left.get().checked_sub(1).ok_or(RunError::TooManySteps)?;
        self.steps_left.set(left);
        Ok(())
    }

    fn find(
        &mut self,
        predicate: &str,
        arguments: &[Slot],
        says: &Found,
        rest: &[Step],
        row: &mut Row,
        answer: &mut dyn FnMut(&Row) -> Flow,
    ) -> Result<Flow, RunError> {
        let mut pattern =
            FactPattern { predicate: predicate.to_owned(), arguments: Vec::with_capacity(arguments.len()) };
        let mut free: Vec<(usize, usize)> = Vec::new();
        for (position, slot) in arguments.iter().enumerate() {
            let term = match slot {
                Slot::Any => None,
                Slot::Variable(at) => match &row[*at] {
                    // No fact has an argument that is neither an individual nor an int.
                    Some(value) => match term(value) {
                        Some(term) => Some(term),
                        None => return Ok(Flow::More),
                    },
                    None => {
                        free.push((position, *at));
                        None
                    }
                },
                Slot::Computed(expr) => Some(bind::term(expr, &self.with(row))?),
            };
            pattern.arguments.push(term);
        }
        let wanted = match says {
            Found::Value(Slot::Computed(expr)) => Some(expr.evaluate(&self.with(row))?),
            _ => None,
        };
        let scope = self.scope;
        let (mut flow, mut problem) = (Flow::More, None);
        let is_known = scope.each_fact(&pattern, &mut |key, value| {
            let found = self.found(&pattern, key, value, &free, says, wanted.as_ref(), rest, row, answer);
            match found {
                Ok(went) => flow = went,
                Err(error) => {
                    problem = Some(error);
                    flow = Flow::Enough;
                }
            }
            flow == Flow::More
        });
        match problem {
            Some(error) => Err(error),
            None if !is_known => {
                Err(EvaluateError::NotYetKnown { what: format!("which facts fit `{pattern}`") }.into())
            }
            None => Ok(flow),
        }
    }

    #[allow(clippy::too_many_arguments, reason = "the parts of one lookup, used here only")]
    fn found(
        &mut self,
        pattern: &FactPattern,
        key: &FactKey,
        value: &Value,
        free: &[(usize, usize)],
        says: &Found,
        wanted: Option<&Value>,
        rest: &[Step],
        row: &mut Row,
        answer: &mut dyn FnMut(&Row) -> Flow,
    ) -> Result<Flow, RunError> {
        self.one_more()?;
        if !pattern.matches(key) {
            return Ok(Flow::More);
        }
        let mut bound: Vec<usize> = Vec::with_capacity(free.len() + 1);
        let mut fits = match (says, wanted) {
            (Found::Yes, _) => !matches!(value, Value::Bool(false) | Value::Null),
            (_, Some(wanted)) => equal(value, wanted),
            _ => true,
        };
        let free_value = match says {
            Found::Value(Slot::Variable(at)) => Some((*at, value.clone())),
            _ => None,
        };
        let arguments = free.iter().map(|(position, at)| (*at, of_term(&key.arguments[*position])));
        for (at, value) in arguments.chain(free_value) {
            match &row[at] {
                // The same variable occurs twice in one fact.
                Some(before) => fits &= equal(before, &value),
                None => {
                    row[at] = Some(value);
                    bound.push(at);
                }
            }
        }
        let flow = if fits { self.steps(rest, row, answer) } else { Ok(Flow::More) };
        bound.into_iter().for_each(|at| row[at] = None);
        flow
    }
}

fn term(value: &Value) -> Option<Term> {
    match value {
        Value::String(name) => Some(Term::Name(name.clone())),
        Value::Int(i) => Some(Term::Int(*i)),
        _ => None,
    }
}

fn of_term(term: &Term) -> Value {
    match term {
        Term::Int(i) => Value::Int(*i),
        Term::Name(name) => Value::String(name.clone()),
    }
}

/// The scope around a query, with the variables bound so far.
struct WithRow<'a> {
    outer: &'a dyn Scope,
    names: &'a [String],
    row: &'a Row,
    steps_left: &'a Cell<u64>,
}

impl Scope for WithRow<'_> {
    fn outer(&self) -> Option<&dyn Scope> {
        Some(self.outer)
    }

    fn unknown(&self, name: &str) -> Option<Cow<'_, Value>> {
        match self.names.iter().position(|known| known == name) {
            Some(at) => self.row[at].as_ref().map(Cow::Borrowed),
            None => self.outer.unknown(name),
        }
    }

    fn budget(&self) -> Option<&Cell<u64>> {
        Some(self.steps_left)
    }
}
