//! Conditions → steps, in an order in which each step has its inputs.

use super::conditions::{Condition, Says, conditions};
use crate::expression::scope::NothingKnown;
use crate::expression::{BinaryOperator, Expr, FactExpr};
use crate::fact::FactPattern;
use std::collections::BTreeSet;

/// A planned query.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// The variables of an answer, in the order of the text; those with generated names come last.
    pub(super) variables: Vec<String>,
    /// Number of variables without generated names.
    pub(super) named: usize,
    pub(super) steps: Vec<Step>,
}

#[derive(Debug, Clone, PartialEq)]
pub(super) enum Step {
    /// For each fact that matches the bound arguments: binds the others.
    Find { predicate: String, arguments: Vec<Slot>, says: Found },
    /// Continues if the expression is true.
    Test(Expr),
    /// Binds a variable to a value.
    Bind(usize, Expr),
    /// Continues if the steps have an answer, or (false) if they have none.
    Answers(Vec<Step>, bool),
}

/// An argument or a value.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Slot {
    Any,
    /// A variable of the answer: bound before, or bound by the fact found.
    Variable(usize),
    /// Can be evaluated by then.
    Computed(Expr),
}

#[derive(Debug, Clone, PartialEq)]
pub(super) enum Found {
    Anything,
    Yes,
    Value(Slot),
}

/// Error: a query cannot be answered.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PlanError {
    /// Too many conditions.
    #[error("the query has more than {} conditions; split it", super::MAX_CONDITIONS)]
    TooLarge,
    /// No condition at all.
    #[error("the query is empty; write a condition, `at(?box) = ?pose`")]
    Empty,
    /// Only tests use a variable.
    #[error("`?{name}` in `{condition}` gets no value: no fact of the query has it as an argument or says it")]
    Unbound {
        /// Its name.
        name: String,
        /// Where it is used.
        condition: String,
    },
}

/// Plans a query. `known` tells which variables have values from outside; these are not part of the answers.
///
/// # Errors
/// [`PlanError`].
pub fn plan(query: &[Expr], known: &dyn Fn(&str) -> bool) -> Result<Plan, PlanError> {
    let conditions = conditions(query)?;
    if conditions.is_empty() {
        return Err(PlanError::Empty);
    }
    let mut planner = Planner { known, variables: Vec::new() };
    let mut order = Vec::new();
    for expr in query {
        expr.visit(&mut |part| {
            if let Expr::Unknown(name) = part {
                note(&mut order, name);
            }
        });
    }
    conditions.iter().for_each(|condition| mentioned(condition, &mut |name| note(&mut order, name)));
    let (named, hidden): (Vec<_>, Vec<_>) = order.into_iter().filter(|n| !known(n)).partition(|n| !n.ends_with('?'));
    // Variables that occur only in negations are bound there and not part of the answers.
    let outside: BTreeSet<&str> = binders(&conditions);
    let (answered, inner): (Vec<_>, Vec<_>) = named.into_iter().partition(|name| outside.contains(name));
    let count = answered.len();
    planner.variables = answered.into_iter().chain(inner).chain(hidden).map(str::to_owned).collect();
    let steps = planner.steps(&conditions, &mut BTreeSet::new())?;
    Ok(Plan { variables: planner.variables, named: count, steps })
}

impl Plan {
    /// The named variables of an answer, without `?`, in the order of the text.
    pub fn variables(&self) -> &[String] {
        &self.variables[..self.named]
    }

    /// The facts that answers are made of, as far as they are known before the query runs; facts in tests are not included.
    pub fn patterns(&self) -> Vec<FactPattern> {
        fn of(steps: &[Step], into: &mut Vec<FactPattern>) {
            for step in steps {
                match step {
                    Step::Find { predicate, arguments, .. } => {
                        let term = |slot: &Slot| match slot {
                            Slot::Computed(expr) => crate::expression::bind::term(expr, &NothingKnown).ok(),
                            Slot::Any | Slot::Variable(_) => None,
                        };
                        let arguments = arguments.iter().map(term).collect();
                        into.push(FactPattern { predicate: predicate.clone(), arguments });
                    }
                    Step::Answers(inner, _) => of(inner, into),
                    Step::Test(_) | Step::Bind(..) => {}
                }
            }
        }
        let mut patterns = Vec::new();
        of(&self.steps, &mut patterns);
        patterns
    }
}

struct Planner<'a> {
    known: &'a dyn Fn(&str) -> bool,
    variables: Vec<String>,
}

impl Planner<'_> {
    /// The steps of conditions, given the bound variables, to which it adds those that it binds.
    fn steps<'c>(&self, conditions: &'c [Condition], bound: &mut BTreeSet<&'c str>) -> Result<Vec<Step>, PlanError> {
        let mut left: Vec<&Condition> = conditions.iter().collect();
        let mut steps = Vec::new();
        while !left.is_empty() {
            // Tests go first; then the fact with most bound arguments; among equals the first in the text.
            let ready = |condition: &&Condition| self.is_ready(condition, &left, bound);
            let at = left.iter().position(ready).or_else(|| {
                let facts =
                    left.iter().enumerate().filter_map(|(at, condition)| Some((self.score(condition, bound)?, at)));
                facts.max_by_key(|(score, at)| (*score, std::cmp::Reverse(*at))).map(|(_, at)| at)
            });
            let Some(at) = at else { return Err(self.unbound(&left, bound)) };
            let condition = left.remove(at);
            steps.push(self.step(condition, &left, bound)?);
        }
        Ok(steps)
    }

    fn step<'c>(
        &self,
        condition: &'c Condition,
        left: &[&'c Condition],
        bound: &mut BTreeSet<&'c str>,
    ) -> Result<Step, PlanError> {
        Ok(match condition {
            Condition::Fact(fact, says) => {
                let arguments = fact.arguments.iter().map(|argument| match argument {
                    None => Slot::Any,
                    Some(expr) => self.slot(expr),
                });
                let arguments = arguments.collect();
                let says = match says {
                    Says::Anything => Found::Anything,
                    Says::Yes => Found::Yes,
                    Says::Value(expr) => Found::Value(self.slot(expr)),
                };
                bound.extend(binds(fact, condition));
                Step::Find { predicate: fact.predicate.clone(), arguments, says }
            }
            Condition::Test(expr) => match self.binding(expr, left, bound) {
                Some((name, at, value)) => {
                    bound.insert(name);
                    Step::Bind(at, value.clone())
                }
                None => Step::Test(expr.clone()),
            },
            Condition::Answers(inner, wanted) => Step::Answers(self.steps(inner, &mut bound.clone())?, *wanted),
        })
    }

    fn slot(&self, expr: &Expr) -> Slot {
        match expr {
            Expr::Unknown(name) => self.index(name).map_or_else(|| Slot::Computed(expr.clone()), Slot::Variable),
            other => Slot::Computed(other.clone()),
        }
    }

    fn index(&self, name: &str) -> Option<usize> {
        self.variables.iter().position(|variable| variable == name)
    }

    fn has(&self, name: &str, bound: &BTreeSet<&str>) -> bool {
        (self.known)(name) || bound.contains(name)
    }

    /// Whether a test can be evaluated now.
    fn is_ready<'c>(&self, condition: &'c Condition, left: &[&'c Condition], bound: &BTreeSet<&'c str>) -> bool {
        let has_all = |expr: &'c Expr| unknowns(expr).into_iter().all(|name| self.has(name, bound));
        match condition {
            Condition::Fact(..) => return false,
            Condition::Test(expr) if self.binding(expr, left, bound).is_some() => return true,
            Condition::Test(expr) if !has_all(expr) => return false,
            Condition::Test(_) | Condition::Answers(..) => {}
        }
        // A variable of an inner query that also occurs outside has its value from outside.
        let others = left.iter().filter(|other| !std::ptr::eq(**other, condition));
        let outside: BTreeSet<&str> = others.flat_map(|other| binders(std::slice::from_ref(*other))).collect();
        let mut has_all = true;
        mentioned(condition, &mut |name| has_all &= self.has(name, bound) || !outside.contains(name));
        has_all
    }

    /// `?x = value`, if nothing else binds `?x`.
    fn binding<'c>(
        &self,
        expr: &'c Expr,
        left: &[&'c Condition],
        bound: &BTreeSet<&'c str>,
    ) -> Option<(&'c str, usize, &'c Expr)> {
        let Expr::Binary(BinaryOperator::Equal, a, b) = expr else { return None };
        [(a, b), (b, a)].into_iter().find_map(|(variable, value)| {
            let Expr::Unknown(name) = variable.as_ref() else { return None };
            let is_free = !self.has(name, bound)
                && !left.iter().any(|other| {
                    matches!(other, Condition::Fact(..))
                        && binders(std::slice::from_ref(*other)).contains(name.as_str())
                });
            let is_known = unknowns(value).into_iter().all(|name| self.has(name, bound));
            Some((name.as_str(), self.index(name).filter(|_| is_free && is_known)?, value.as_ref()))
        })
    }

    /// How well the bound arguments select a fact; `None` if its arguments cannot be computed yet.
    fn score<'c>(&self, condition: &'c Condition, bound: &BTreeSet<&'c str>) -> Option<(bool, usize, usize)> {
        let Condition::Fact(fact, says) = condition else { return None };
        let is_bound = |expr: &Expr| unknowns(expr).into_iter().all(|name| self.has(name, bound));
        let value = match says {
            Says::Value(value) => Some(value),
            Says::Anything | Says::Yes => None,
        };
        let computed = fact.arguments.iter().flatten().chain(value).filter(|e| !matches!(e, Expr::Unknown(_)));
        if !computed.into_iter().all(is_bound) {
            return None;
        }
        let known = |argument: &Option<Expr>| argument.as_ref().is_some_and(is_bound);
        let leading = fact.arguments.iter().take_while(|argument| known(argument)).count();
        let all = fact.arguments.iter().filter(|argument| known(argument)).count();
        Some((leading == fact.arguments.len(), all, leading))
    }

    fn unbound(&self, left: &[&Condition], bound: &BTreeSet<&str>) -> PlanError {
        let mut found = None;
        for condition in left {
            mentioned(condition, &mut |name| {
                if found.is_none() && !self.has(name, bound) {
                    found = Some((name.to_owned(), described(condition)));
                }
            });
        }
        let (name, condition) = found.unwrap_or_default();
        PlanError::Unbound { name, condition }
    }
}

fn described(condition: &Condition) -> String {
    match condition {
        Condition::Fact(fact, Says::Value(value)) => format!("{fact} = {value}"),
        Condition::Fact(fact, _) => fact.to_string(),
        Condition::Test(expr) => expr.to_string(),
        Condition::Answers(inner, wanted) => {
            let inner: Vec<String> = inner.iter().map(described).collect();
            format!("{} ({})", if *wanted { "exists" } else { "not" }, inner.join(", "))
        }
    }
}

fn note<'c>(order: &mut Vec<&'c str>, name: &'c str) {
    if !order.contains(&name) {
        order.push(name);
    }
}

/// The variables without which an expression has no value. A variable that occurs only in an inner query may be that
/// query's own.
fn unknowns(expr: &Expr) -> Vec<&str> {
    fn of<'e>(expr: &'e Expr, names: &mut Vec<&'e str>) {
        match expr {
            Expr::Unknown(name) => names.push(name),
            Expr::Query(_) | Expr::Find(..) => {}
            other => other.parts(&mut |part| of(part, names)),
        }
    }
    let mut names = Vec::new();
    of(expr, &mut names);
    names
}

/// The variables in the queries inside of an expression.
fn within(expr: &Expr) -> Vec<&str> {
    let mut names = Vec::new();
    expr.visit(&mut |query| {
        if let Expr::Query(_) | Expr::Find(..) = query {
            query.visit(&mut |part| {
                if let Expr::Unknown(name) = part {
                    names.push(name.as_str());
                }
            });
        }
    });
    names
}

/// The variables in a condition.
fn mentioned<'c>(condition: &'c Condition, visit: &mut dyn FnMut(&'c str)) {
    match condition {
        Condition::Fact(fact, says) => {
            fact.arguments.iter().flatten().flat_map(unknowns).for_each(&mut *visit);
            if let Says::Value(value) = says {
                unknowns(value).into_iter().for_each(visit);
            }
        }
        Condition::Test(expr) => unknowns(expr).into_iter().chain(within(expr)).for_each(visit),
        Condition::Answers(inner, _) => inner.iter().for_each(|condition| mentioned(condition, visit)),
    }
}

fn binds<'c>(fact: &'c FactExpr, condition: &'c Condition) -> impl Iterator<Item = &'c str> {
    let value = match condition {
        Condition::Fact(_, Says::Value(value)) => Some(value),
        _ => None,
    };
    fact.arguments.iter().flatten().chain(value).filter_map(|expr| match expr {
        Expr::Unknown(name) => Some(name.as_str()),
        _ => None,
    })
}

/// The variables that these conditions bind, except in negations and in `exists`.
fn binders(conditions: &[Condition]) -> BTreeSet<&str> {
    let mut names = BTreeSet::new();
    for condition in conditions {
        match condition {
            Condition::Fact(fact, _) => names.extend(binds(fact, condition)),
            Condition::Test(Expr::Binary(BinaryOperator::Equal, a, b)) => {
                for side in [a, b] {
                    if let Expr::Unknown(name) = side.as_ref() {
                        names.insert(name);
                    }
                }
            }
            Condition::Test(_) | Condition::Answers(..) => {}
        }
    }
    names
}
