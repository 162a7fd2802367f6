//! Expression → value.
//!
//! An absent fact is null; null counts as false where a boolean is expected (closed world). `=` is exact, ints and floats compare as
//! numbers. `/` always gives a float. Nothing here panics: what cannot be computed is an error with a reason. The depth of an expression is
//! bounded by the parser.

use super::query::{self, Flow, RunError};
use super::scope::{Given, Lookup, Scope};
use super::{BinaryOperator, Expr, Function, UnaryOperator, comprehension, function};
use crate::value::Value;
use std::borrow::Cow;
use std::collections::BTreeMap;

/// The longest list that an expression may build.
pub const MAX_LIST: usize = 100_000;

/// Error: an expression has no value.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum EvaluateError {
    /// It needs something that has not been written yet; it may have a value later.
    #[error("{what} is not known yet")]
    NotYetKnown {
        /// What it needs.
        what: String,
    },
    /// It can never have a value here.
    #[error("`{expression}`: {problem}")]
    Wrong {
        /// The part of the expression that is wrong.
        expression: String,
        /// Why.
        problem: String,
    },
}

impl EvaluateError {
    /// Whether the expression may have a value later.
    pub fn is_not_yet_known(&self) -> bool {
        matches!(self, EvaluateError::NotYetKnown { .. })
    }
}

impl Expr {
    /// The value in a scope.
    ///
    /// # Errors
    /// [`EvaluateError::NotYetKnown`] if the scope does not know a name yet; [`EvaluateError::Wrong`] if values do not fit.
    pub fn evaluate(&self, scope: &dyn Scope) -> Result<Value, EvaluateError> {
        self.value(scope).map(Cow::into_owned)
    }

    /// Whether it is true in a scope; null (an absent fact) is false.
    ///
    /// # Errors
    /// As [`Expr::evaluate`]; also for a value that is neither boolean nor null.
    pub fn holds(&self, scope: &dyn Scope) -> Result<bool, EvaluateError> {
        match self.value(scope)?.as_ref() {
            Value::Bool(b) => Ok(*b),
            Value::Null => Ok(false),
            other => Err(self.wrong(format!("expected true or false, found {}", described(other)))),
        }
    }

    pub(crate) fn wrong(&self, problem: impl Into<String>) -> EvaluateError {
        EvaluateError::Wrong { expression: self.to_string(), problem: problem.into() }
    }

    pub(crate) fn value<'a>(&'a self, scope: &'a dyn Scope) -> Result<Cow<'a, Value>, EvaluateError> {
        let known = |value: Option<Cow<'a, Value>>| {
            value.ok_or_else(|| EvaluateError::NotYetKnown { what: format!("`{self}`") })
        };
        Ok(match self {
            Expr::Literal(value) => Cow::Borrowed(value),
            Expr::Variable(name) => known(scope.variable(name))?,
            Expr::Output(name) => known(scope.output(name))?,
            Expr::Port { state, port } => known(scope.port(*state, port))?,
            Expr::Field(of, name) => self.field(of.value(scope)?, name)?,
            Expr::Index(of, index) => self.element(of.value(scope)?, index.value(scope)?.as_ref())?,
            Expr::List(items) => {
                let values = items.iter().map(|item| item.evaluate(scope)).collect::<Result<_, _>>()?;
                Cow::Owned(Value::List(values))
            }
            Expr::Map(fields) => {
                let values = fields
                    .iter()
                    .map(|(name, item)| Ok((name.clone(), item.evaluate(scope)?)))
                    .collect::<Result<BTreeMap<_, _>, EvaluateError>>()?;
                Cow::Owned(Value::Map(values))
            }
            Expr::Call(Function::If, arguments) => match arguments.as_slice() {
                [condition, yes, no] => (if condition.holds(scope)? { yes } else { no }).value(scope)?,
                _ => return Err(self.wrong("expected `if(condition, a, b)`")),
            },
            Expr::Call(Function::Either, ways) => match (first_given(ways, scope), ways.last()) {
                ((Given::NotYetKnown, _), _) => known(None)?,
                ((_, Some(way)), _) | (_, Some(way)) => way.value(scope)?,
                (_, None) => return Err(self.wrong("expected `either(a, b, …)`")),
            },
            Expr::Call(called, arguments) => {
                let values = arguments.iter().map(|a| a.evaluate(scope)).collect::<Result<Vec<_>, _>>()?;
                Cow::Owned(function::call(*called, &values).map_err(|problem| self.wrong(problem))?)
            }
            Expr::Each { what, element, list, body } => {
                Cow::Owned(comprehension::evaluate(self, (*what, element), (list, body), scope)?)
            }
            Expr::Element(name) => known(scope.element(name))?,
            Expr::Fact(fact) => match scope.fact(&fact.bind(scope)?) {
                Lookup::Holds(value) => value,
                Lookup::Absent => Cow::Owned(Value::Null),
                Lookup::Unknown => known(None)?,
            },
            Expr::Exists(fact) => match scope.fact(&fact.bind(scope)?) {
                Lookup::Holds(_) => Cow::Owned(Value::Bool(true)),
                Lookup::Absent => Cow::Owned(Value::Bool(false)),
                Lookup::Unknown => known(None)?,
            },
            Expr::Query(conditions) => Cow::Owned(Value::Bool(self.has_answer(conditions, scope)?)),
            Expr::Find(wanted, conditions) => Cow::Owned(Value::List(self.answers(wanted, conditions, scope)?.into())),
            Expr::Unknown(name) => known(scope.unknown(name))?,
            Expr::Unary(UnaryOperator::Not, operand) => Cow::Owned(Value::Bool(!operand.holds(scope)?)),
            Expr::Unary(UnaryOperator::Negate, operand) => Cow::Owned(match operand.value(scope)?.as_ref() {
                Value::Int(i) => Value::Int(i.checked_neg().ok_or_else(|| self.wrong("too large"))?),
                Value::Float(x) => Value::Float(-x),
                other => return Err(self.wrong(format!("expected a number, found {}", described(other)))),
            }),
            Expr::Binary(BinaryOperator::Or, a, b) => Cow::Owned(Value::Bool(a.holds(scope)? || b.holds(scope)?)),
            Expr::Binary(BinaryOperator::And, a, b) => Cow::Owned(Value::Bool(a.holds(scope)? && b.holds(scope)?)),
            Expr::Binary(operator, a, b) => {
                let (a, b) = (a.value(scope)?, b.value(scope)?);
                Cow::Owned(binary(*operator, a.as_ref(), b.as_ref()).map_err(|problem| self.wrong(problem))?)
            }
        })
    }

    /// Whether the outputs that it uses exist in this scope.
    fn given(&self, scope: &dyn Scope) -> Given {
        match self {
            Expr::Port { state, port } => scope.given(*state, port),
            Expr::Call(Function::Either, ways) => first_given(ways, scope).0,
            _ => {
                let mut given = Given::Always;
                self.parts(&mut |part| given = given.max(part.given(scope)));
                given
            }
        }
    }

    /// Whether the query `self` has an answer.
    fn has_answer(&self, conditions: &[Expr], scope: &dyn Scope) -> Result<bool, EvaluateError> {
        let plan = query::plan(conditions, &|name| scope.unknown(name).is_some());
        let plan = plan.map_err(|error| self.wrong(error.to_string()))?;
        let mut found = false;
        let ran = query::run(&plan, scope, &mut |_| {
            found = true;
            Flow::Enough
        });
        match ran {
            Ok(()) => Ok(found),
            Err(RunError::Evaluate(error)) => Err(error),
            Err(error @ RunError::TooManySteps) => Err(self.wrong(error.to_string())),
        }
    }

    /// The answers to the query `self`, as values of the wanted variables.
    fn answers(&self, wanted: &[String], conditions: &[Expr], scope: &dyn Scope) -> Result<Vec<Value>, EvaluateError> {
        let plan = query::plan(conditions, &|name| scope.unknown(name).is_some());
        let plan = plan.map_err(|error| self.wrong(error.to_string()))?;
        let place = |name: &String| {
            let place = plan.variables().iter().position(|variable| variable == name);
            place.ok_or_else(|| self.wrong(format!("`?{name}` gets no value")))
        };
        let places = wanted.iter().map(place).collect::<Result<Vec<usize>, _>>()?;
        let mut found: Vec<Value> = Vec::new();
        let ran = query::run(&plan, scope, &mut |row| {
            let value = match places.as_slice() {
                [one] => row[*one].clone(),
                several => {
                    // In the body of a function variables were renamed to `name of …`.
                    let fields = wanted.iter().map(|name| name.split(' ').next().unwrap_or_default().to_owned());
                    Value::Map(fields.zip(several.iter().map(|place| row[*place].clone())).collect())
                }
            };
            if let Err(at) = found.binary_search_by(|other| other.total_order(&value)) {
                found.insert(at, value);
            }
            if found.len() > query::MAX_FOUND { Flow::Enough } else { Flow::More }
        });
        match ran {
            Ok(()) if found.len() > query::MAX_FOUND => {
                let most = query::MAX_FOUND;
                Err(self.wrong(format!("it finds more than {most} answers; narrow it by another condition")))
            }
            Ok(()) => Ok(found),
            Err(RunError::Evaluate(error)) => Err(error),
            Err(error @ RunError::TooManySteps) => Err(self.wrong(error.to_string())),
        }
    }

    fn field<'a>(&self, of: Cow<'a, Value>, name: &str) -> Result<Cow<'a, Value>, EvaluateError> {
        let number = |x: f64| Ok(Cow::Owned(Value::Float(x)));
        match (of.as_ref(), name) {
            (Value::Map(fields), _) if !fields.contains_key(name) => {
                let names: Vec<&str> = fields.keys().map(String::as_str).collect();
                return Err(self.wrong(format!("there is no field `{name}`, only {}", names.join(", "))));
            }
            (Value::Pose(pose), "x") => return number(pose.position[0]),
            (Value::Pose(pose), "y") => return number(pose.position[1]),
            (Value::Pose(pose), "z") => return number(pose.position[2]),
            (Value::Trajectory(trajectory), "duration_s") => return number(trajectory.duration_s()),
            (Value::Map(_), _) => {}
            (other, _) => return Err(self.wrong(format!("{} has no field `{name}`", described(other)))),
        }
        let missing = || self.wrong(format!("there is no field `{name}`"));
        match of {
            Cow::Borrowed(Value::Map(fields)) => fields.get(name).map(Cow::Borrowed).ok_or_else(missing),
            Cow::Owned(Value::Map(mut fields)) => fields.remove(name).map(Cow::Owned).ok_or_else(missing),
            _ => Err(missing()),
        }
    }

    fn element<'a>(&self, of: Cow<'a, Value>, index: &Value) -> Result<Cow<'a, Value>, EvaluateError> {
        if let (Value::Map(_), Value::String(name)) = (of.as_ref(), index) {
            return self.field(of, name);
        }
        let length = match of.as_ref() {
            Value::List(items) => items.len(),
            Value::Joints(joints) => joints.len(),
            other => return Err(self.wrong(format!("{} has no elements", described(other)))),
        };
        let Value::Int(wanted) = index else {
            return Err(self.wrong(format!("expected an int as index, found {}", described(index))));
        };
        let at = usize::try_from(*wanted)
            .ok()
            .filter(|i| *i < length)
            .ok_or_else(|| self.wrong(format!("index {wanted} is outside a list of {length}")))?;
        Ok(match of {
            Cow::Borrowed(Value::List(items)) => Cow::Borrowed(&items[at]),
            Cow::Owned(Value::List(items)) => Cow::Owned(items[at].clone()),
            Cow::Borrowed(Value::Joints(joints)) => Cow::Owned(Value::Float(joints[at])),
            Cow::Owned(Value::Joints(joints)) => Cow::Owned(Value::Float(joints[at])),
            _ => return Err(self.wrong("it has no elements")),
        })
    }
}

/// The argument that `either` takes: the first one that was written. An argument that needs no output always exists, so arguments behind it
/// do not count. If none was written, the first with a default.
fn first_given<'e>(ways: &'e [Expr], scope: &dyn Scope) -> (Given, Option<&'e Expr>) {
    let mut by_default = None;
    for way in ways {
        match way.given(scope) {
            Given::Written => return (Given::Written, Some(way)),
            Given::Always if by_default.is_none() => return (Given::Always, Some(way)),
            Given::Always => break,
            Given::Default => by_default = by_default.or(Some(way)),
            Given::NotYetKnown => return (Given::NotYetKnown, None),
            Given::Missing => {}
        }
    }
    (if by_default.is_some() { Given::Default } else { Given::Missing }, by_default)
}

/// A value for a message: its type, and its text if that is short.
pub(crate) fn described(value: &Value) -> String {
    match value {
        Value::Null => "nothing (null)".to_owned(),
        Value::Bool(_) | Value::Int(_) | Value::Float(_) => format!("{} {value}", value.type_name()),
        Value::String(text) if text.len() <= 60 => format!("string `{text}`"),
        _ => format!("a {}", value.type_name()),
    }
}

/// Exact equality, with ints and floats compared as numbers, also inside lists and maps.
pub fn equal(a: &Value, b: &Value) -> bool {
    match (a, b) {
        (Value::Int(i), Value::Float(x)) | (Value::Float(x), Value::Int(i)) => *i as f64 == *x,
        (Value::List(a), Value::List(b)) => a.len() == b.len() && a.iter().zip(b).all(|(a, b)| equal(a, b)),
        (Value::Map(a), Value::Map(b)) => {
            a.len() == b.len() && a.iter().zip(b).all(|((n, a), (m, b))| n == m && equal(a, b))
        }
        _ => a == b,
    }
}

pub(super) fn binary(operator: BinaryOperator, a: &Value, b: &Value) -> Result<Value, String> {
    use BinaryOperator as Op;
    Ok(match operator {
        Op::Equal => Value::Bool(equal(a, b)),
        Op::NotEqual => Value::Bool(!equal(a, b)),
        Op::Less => Value::Bool(order(a, b)?.is_lt()),
        Op::LessOrEqual => Value::Bool(order(a, b)?.is_le()),
        Op::Greater => Value::Bool(order(a, b)?.is_gt()),
        Op::GreaterOrEqual => Value::Bool(order(a, b)?.is_ge()),
        Op::In => match (a, b) {
            (_, Value::List(items)) => Value::Bool(items.iter().any(|item| equal(a, item))),
            (Value::String(name), Value::Map(fields)) => Value::Bool(fields.contains_key(name)),
            (_, other) => return Err(format!("expected a list after `in`, found {}", described(other))),
        },
        Op::Add => match (a, b) {
            (Value::List(a), Value::List(b)) if a.len() + b.len() <= MAX_LIST => {
                let mut both = a.clone();
                both.extend(b.iter().cloned());
                Value::List(both)
            }
            (Value::List(_), Value::List(_)) => return Err(format!("the list is longer than {MAX_LIST}")),
            _ => arithmetic(a, b, i64::checked_add, |x, y| x + y)?,
        },
        Op::Subtract => arithmetic(a, b, i64::checked_sub, |x, y| x - y)?,
        Op::Multiply => arithmetic(a, b, i64::checked_mul, |x, y| x * y)?,
        Op::Divide => {
            let (x, y) = numbers(a, b)?;
            if y == 0.0 {
                return Err("division by zero".to_owned());
            }
            finite(x / y)?
        }
        Op::Or | Op::And => return Err("`and` and `or` are evaluated with their operands".to_owned()),
    })
}

/// Whether a comparison of two values holds.
pub(crate) fn compare(operator: BinaryOperator, a: &Value, b: &Value) -> Result<bool, String> {
    Ok(binary(operator, a, b)? == Value::Bool(true))
}

pub(crate) fn number(value: &Value) -> Result<f64, String> {
    value.as_number().ok_or_else(|| format!("expected a number, found {}", described(value)))
}

fn numbers(a: &Value, b: &Value) -> Result<(f64, f64), String> {
    Ok((number(a)?, number(b)?))
}

fn arithmetic(
    a: &Value,
    b: &Value,
    whole: fn(i64, i64) -> Option<i64>,
    real: fn(f64, f64) -> f64,
) -> Result<Value, String> {
    if let (Value::Int(i), Value::Int(j)) = (a, b) {
        return whole(*i, *j).map(Value::Int).ok_or_else(|| "the result is too large for an int".to_owned());
    }
    let (x, y) = numbers(a, b)?;
    finite(real(x, y))
}

fn finite(x: f64) -> Result<Value, String> {
    if x.is_finite() { Ok(Value::Float(x)) } else { Err("the result is not a finite number".to_owned()) }
}

pub(crate) fn order(a: &Value, b: &Value) -> Result<std::cmp::Ordering, String> {
    match (a, b) {
        (Value::Int(i), Value::Int(j)) => Ok(i.cmp(j)),
        (Value::String(s), Value::String(t)) => Ok(s.cmp(t)),
        _ => {
            let (x, y) = numbers(a, b)?;
            x.partial_cmp(&y).ok_or_else(|| "NaN has no order".to_owned())
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]

    use super::super::scope::NothingKnown;
    use super::*;

    fn of(operator: BinaryOperator, a: Value, b: Value) -> Result<Value, EvaluateError> {
        Expr::Binary(operator, Box::new(Expr::Literal(a)), Box::new(Expr::Literal(b))).evaluate(&NothingKnown)
    }

    #[test]
    fn ints_and_floats_compare_as_numbers() {
        assert_eq!(of(BinaryOperator::Equal, Value::Int(2), Value::Float(2.0)), Ok(Value::Bool(true)));
        assert_eq!(of(BinaryOperator::Less, Value::Int(2), Value::Float(2.5)), Ok(Value::Bool(true)));
        assert!(of(BinaryOperator::Less, Value::Int(2), Value::Null).is_err());
    }

    #[test]
    fn what_cannot_be_computed_is_an_error_that_says_why() {
        let error = of(BinaryOperator::Divide, Value::Int(1), Value::Int(0)).unwrap_err();
        assert_eq!(error.to_string(), "`1 / 0`: division by zero");
        assert!(of(BinaryOperator::Add, Value::Int(i64::MAX), Value::Int(1)).is_err());
        assert!(of(BinaryOperator::Multiply, Value::Float(1e300), Value::Float(1e300)).is_err());
        let index = Expr::Index(Box::new(Expr::List(Vec::new())), Box::new(Expr::Literal(Value::Int(0))));
        assert_eq!(index.evaluate(&NothingKnown).unwrap_err().to_string(), "`[][0]`: index 0 is outside a list of 0");
    }

    #[test]
    fn what_is_not_written_yet_is_not_an_error_of_the_program() {
        let port = Expr::Port { state: crate::id::StateId(3), port: "end".into() };
        assert!(port.evaluate(&NothingKnown).unwrap_err().is_not_yet_known());
        // `if` evaluates only the chosen branch.
        let choice =
            Expr::Call(Function::If, vec![Expr::Literal(Value::Bool(false)), port, Expr::Literal(Value::Int(1))]);
        assert_eq!(choice.evaluate(&NothingKnown), Ok(Value::Int(1)));
    }

    #[test]
    fn an_absent_fact_is_false() {
        assert_eq!(Expr::Literal(Value::Null).holds(&NothingKnown), Ok(false));
        assert!(Expr::Literal(Value::Int(1)).holds(&NothingKnown).is_err());
    }
}
