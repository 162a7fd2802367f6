//! Evaluates expressions at a place of the program.

use super::comprehension;
use super::facts::{Facts, fitting};
use super::function;
use super::query;
use super::{Fail, Outputs};
use ratn_model::expression::{BinaryOperator, Expr, FactExpr, Function, UnaryOperator};
use ratn_model::fact::{FactPattern, Term};
use ratn_model::id::StateId;
use ratn_model::program::{Program, StateKind};
use ratn_model::value::Value;
use std::cmp::Ordering;
use std::collections::BTreeMap;

/// Limit of the length of a list.
pub(super) const LONGEST_LIST: usize = 100_000;

/// Whether the outputs in an expression exist.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Had {
    /// It uses no outputs.
    Always,
    Written,
    Default,
    Nothing,
}

/// The scope of expressions.
#[derive(Clone)]
pub(super) struct Place<'a> {
    pub(super) program: &'a Program,
    pub(super) facts: &'a Facts,
    pub(super) outputs: &'a BTreeMap<StateId, Outputs>,
    pub(super) regions: &'a BTreeMap<StateId, String>,
    /// `$name`; the last one with a name counts.
    pub(super) variables: Vec<(String, Value)>,
    /// The outputs of the state itself.
    pub(super) own: Option<&'a Outputs>,
    /// `$name`: the elements of the surrounding comprehensions.
    pub(super) elements: Vec<(String, Value)>,
    /// `?name`: the values found by the query around it.
    pub(super) row: Vec<(String, Value)>,
}

impl Place<'_> {
    /// A fact with its arguments evaluated.
    pub(super) fn pattern(&self, fact: &FactExpr) -> Result<FactPattern, Fail> {
        let mut arguments = Vec::new();
        for argument in &fact.arguments {
            arguments.push(match argument {
                None => None,
                Some(argument) => Some(term(&argument.read(self)?)?),
            });
        }
        Ok(FactPattern { predicate: fact.predicate.clone(), arguments })
    }

    /// Whether the outputs in an expression exist at this place.
    fn has(&self, expr: &Expr) -> Had {
        match expr {
            Expr::Call(Function::Either, ways) => self.way(ways).map_or(Had::Nothing, |way| self.has(way)),
            Expr::Port { state, port } => {
                let is_end = port == "outcome" && self.regions.contains_key(state);
                if is_end || self.outputs.get(state).is_some_and(|outputs| outputs.contains_key(port)) {
                    Had::Written
                } else if self.program.state(*state).defaults.contains_key(port) {
                    Had::Default
                } else {
                    Had::Nothing
                }
            }
            other => {
                let mut all = Vec::new();
                let mut within: Vec<&Expr> = Vec::new();
                let mut is_whole = true;
                other.visit(&mut |part| {
                    let is_either = matches!(part, Expr::Call(Function::Either, _));
                    if !std::mem::take(&mut is_whole) && (is_either || matches!(part, Expr::Port { .. })) {
                        within.push(part);
                    }
                });
                for part in &within {
                    // Outputs inside of another `either` belong to that one.
                    let is_inner = within.iter().any(|around| {
                        let mut is_part = false;
                        let is_either = matches!(around, Expr::Call(Function::Either, _));
                        around.visit(&mut |inner| is_part |= is_either && std::ptr::eq(inner, *part));
                        is_part && !std::ptr::eq(*around, *part)
                    });
                    if !is_inner {
                        all.push(self.has(part));
                    }
                }
                if all.contains(&Had::Nothing) {
                    Had::Nothing
                } else if all.contains(&Had::Default) {
                    Had::Default
                } else if all.contains(&Had::Written) {
                    Had::Written
                } else {
                    Had::Always
                }
            }
        }
    }

    /// The argument that `either` takes. Arguments behind one that needs no output are never considered.
    fn way<'e>(&self, ways: &'e [Expr]) -> Option<&'e Expr> {
        let asked = ways.iter().position(|way| self.has(way) == Had::Always).map_or(ways.len(), |end| end + 1);
        let first = |had: Had| ways[..asked].iter().find(|way| self.has(way) == had);
        first(Had::Written).or_else(|| first(Had::Default)).or_else(|| first(Had::Always))
    }

    fn port(&self, state: StateId, port: &str) -> Option<Value> {
        let of = self.program.state(state);
        let around = of.parent.map(|parent| &self.program.state(parent).kind);
        if port == "outcome" && matches!(around, Some(StateKind::Concurrency { .. })) {
            return self.regions.get(&state).map(|outcome| Value::String(outcome.clone()));
        }
        let written = self.outputs.get(&state).and_then(|outputs| outputs.get(port));
        written.or_else(|| of.defaults.get(port)).cloned()
    }
}

/// A value as an argument of a fact.
pub(super) fn term(value: &Value) -> Result<Term, Fail> {
    match value {
        Value::Int(i) => Ok(Term::Int(*i)),
        Value::String(name) => Ok(Term::Name(name.clone())),
        other => wrong(format!("{other} is no argument of a fact")),
    }
}

/// The reference's evaluation of an expression.
pub(super) trait Read {
    fn read(&self, place: &Place<'_>) -> Result<Value, Fail>;
    /// Whether it is true; null is false.
    fn is_true(&self, place: &Place<'_>) -> Result<bool, Fail>;
}

impl Read for Expr {
    fn is_true(&self, place: &Place<'_>) -> Result<bool, Fail> {
        match self.read(place)? {
            Value::Bool(b) => Ok(b),
            Value::Null => Ok(false),
            other => wrong(format!("{other} is neither true nor false")),
        }
    }

    fn read(&self, place: &Place<'_>) -> Result<Value, Fail> {
        let written = |value: Option<Value>| value.ok_or_else(|| Fail::Unwritten(self.to_string()));
        let last = |all: &[(String, Value)], name: &str| {
            all.iter().rev().find(|(known, _)| known == name).map(|(_, value)| value.clone())
        };
        match self {
            Expr::Literal(value) => Ok(value.clone()),
            Expr::Variable(name) => written(last(&place.variables, name)),
            Expr::Unknown(name) => written(last(&place.row, name)),
            Expr::Output(name) => written(place.own.and_then(|own| own.get(name).cloned())),
            Expr::Port { state, port } => written(place.port(*state, port)),
            Expr::Field(of, name) => field(&of.read(place)?, name),
            Expr::Index(of, index) => element(&of.read(place)?, &index.read(place)?),
            Expr::List(items) => {
                Ok(Value::List(items.iter().map(|item| item.read(place)).collect::<Result<_, Fail>>()?))
            }
            Expr::Map(fields) => {
                let mut values = BTreeMap::new();
                for (name, item) in fields {
                    values.insert(name.clone(), item.read(place)?);
                }
                Ok(Value::Map(values))
            }
            Expr::Call(Function::If, arguments) => match &arguments[..] {
                [condition, yes, _] if condition.is_true(place)? => yes.read(place),
                [_, _, no] => no.read(place),
                _ => wrong("`if` has three arguments"),
            },
            Expr::Call(Function::Either, ways) => {
                let chosen = place.way(ways).or(ways.last());
                chosen.map_or_else(|| wrong("`either` of nothing"), |way| way.read(place))
            }
            Expr::Call(called, arguments) => {
                let values = arguments.iter().map(|a| a.read(place)).collect::<Result<Vec<Value>, Fail>>()?;
                function::call(*called, &values)
            }
            Expr::Fact(fact) => {
                let pattern = place.pattern(fact)?;
                let first = fitting(place.facts, &pattern).next();
                Ok(first.map_or(Value::Null, |(_, value)| value.clone()))
            }
            Expr::Exists(fact) => {
                let pattern = place.pattern(fact)?;
                Ok(Value::Bool(fitting(place.facts, &pattern).next().is_some()))
            }
            Expr::Element(name) => written(last(&place.elements, name)),
            Expr::Each { what, element, list, body } => comprehension::read((*what, element), (list, body), place),
            Expr::Find(wanted, conditions) => Ok(Value::List(query::found_values(wanted, conditions, place)?.into())),
            Expr::Query(conditions) => Ok(Value::Bool(query::has_answer(conditions, place)?)),
            Expr::Unary(UnaryOperator::Not, of) => Ok(Value::Bool(!of.is_true(place)?)),
            Expr::Unary(UnaryOperator::Negate, of) => match of.read(place)? {
                Value::Int(i) => i.checked_neg().map_or_else(|| wrong("too large"), |i| Ok(Value::Int(i))),
                Value::Float(x) => Ok(Value::Float(-x)),
                other => wrong(format!("-{other}")),
            },
            Expr::Binary(BinaryOperator::And, a, b) => Ok(Value::Bool(a.is_true(place)? && b.is_true(place)?)),
            Expr::Binary(BinaryOperator::Or, a, b) => Ok(Value::Bool(a.is_true(place)? || b.is_true(place)?)),
            Expr::Binary(operator, a, b) => both(*operator, &a.read(place)?, &b.read(place)?),
        }
    }
}

pub(super) fn wrong<T>(problem: impl Into<String>) -> Result<T, Fail> {
    Err(Fail::Wrong(problem.into()))
}

fn field(of: &Value, name: &str) -> Result<Value, Fail> {
    let found = match (of, name) {
        (Value::Map(fields), _) => fields.get(name).cloned(),
        (Value::Pose(pose), "x") => Some(Value::Float(pose.position[0])),
        (Value::Pose(pose), "y") => Some(Value::Float(pose.position[1])),
        (Value::Pose(pose), "z") => Some(Value::Float(pose.position[2])),
        (Value::Trajectory(path), "duration_s") => Some(Value::Float(path.points.last().map_or(0.0, |p| p.time_s))),
        _ => None,
    };
    found.map_or_else(|| wrong(format!("no field {name}")), Ok)
}

fn element(of: &Value, index: &Value) -> Result<Value, Fail> {
    let at = |length: usize| match index {
        Value::Int(i) if *i >= 0 && (*i as u64) < length as u64 => Ok(*i as usize),
        other => wrong(format!("no element {other}")),
    };
    match (of, index) {
        (Value::Map(_), Value::String(name)) => field(of, name),
        (Value::List(items), _) => Ok(items[at(items.len())?].clone()),
        (Value::Joints(joints), _) => Ok(Value::Float(joints[at(joints.len())?])),
        (other, _) => wrong(format!("{other} has no elements")),
    }
}

/// Whether two values are equal; ints and floats compare as numbers.
pub(super) fn same(a: &Value, b: &Value) -> bool {
    match (a, b) {
        (Value::Int(i), Value::Float(x)) | (Value::Float(x), Value::Int(i)) => *i as f64 == *x,
        (Value::List(a), Value::List(b)) => a.len() == b.len() && a.iter().zip(b).all(|(a, b)| same(a, b)),
        (Value::Map(a), Value::Map(b)) => {
            a.len() == b.len() && a.iter().all(|(name, value)| b.get(name).is_some_and(|other| same(value, other)))
        }
        _ => a == b,
    }
}

/// The order of two numbers or two texts.
pub(super) fn order(a: &Value, b: &Value) -> Result<Ordering, Fail> {
    match (a, b) {
        (Value::Int(i), Value::Int(j)) => Ok(i.cmp(j)),
        (Value::String(s), Value::String(t)) => Ok(s.cmp(t)),
        _ => number(a)?.partial_cmp(&number(b)?).map_or_else(|| wrong("no number"), Ok),
    }
}

pub(super) fn number(value: &Value) -> Result<f64, Fail> {
    match value {
        Value::Int(i) => Ok(*i as f64),
        Value::Float(x) => Ok(*x),
        other => wrong(format!("{other} is no number")),
    }
}

pub(super) fn both(operator: BinaryOperator, a: &Value, b: &Value) -> Result<Value, Fail> {
    use BinaryOperator as Op;
    let finite = |x: f64| if x.is_finite() { Ok(Value::Float(x)) } else { wrong("not a finite number") };
    let whole = |i: Option<i64>| i.map_or_else(|| wrong("too large"), |i| Ok(Value::Int(i)));
    match operator {
        Op::Equal => Ok(Value::Bool(same(a, b))),
        Op::NotEqual => Ok(Value::Bool(!same(a, b))),
        Op::Less => Ok(Value::Bool(order(a, b)? == Ordering::Less)),
        Op::LessOrEqual => Ok(Value::Bool(order(a, b)? != Ordering::Greater)),
        Op::Greater => Ok(Value::Bool(order(a, b)? == Ordering::Greater)),
        Op::GreaterOrEqual => Ok(Value::Bool(order(a, b)? != Ordering::Less)),
        Op::In => match (a, b) {
            (_, Value::List(items)) => Ok(Value::Bool(items.iter().any(|item| same(a, item)))),
            (Value::String(name), Value::Map(fields)) => Ok(Value::Bool(fields.contains_key(name))),
            _ => wrong("`in` what is no list"),
        },
        Op::Add => match (a, b) {
            (Value::List(a), Value::List(b)) if a.len() + b.len() > LONGEST_LIST => wrong("too long"),
            (Value::List(a), Value::List(b)) => Ok(Value::List(a.iter().chain(b).cloned().collect())),
            (Value::Int(i), Value::Int(j)) => whole(i.checked_add(*j)),
            _ => finite(number(a)? + number(b)?),
        },
        Op::Subtract => match (a, b) {
            (Value::Int(i), Value::Int(j)) => whole(i.checked_sub(*j)),
            _ => finite(number(a)? - number(b)?),
        },
        Op::Multiply => match (a, b) {
            (Value::Int(i), Value::Int(j)) => whole(i.checked_mul(*j)),
            _ => finite(number(a)? * number(b)?),
        },
        Op::Divide if number(b)? == 0.0 => number(a).and_then(|_| wrong("division by zero")),
        Op::Divide => finite(number(a)? / number(b)?),
        Op::And | Op::Or => wrong("read with its operands"),
    }
}
