//! Queries: finds values for `?name` that make all conditions true, by trying every fact for every condition.
//!
//! The next condition is the first one that can be tried with the values found so far: tests as early as possible, then facts,
//! and last `?v = expression`, which binds only if nothing else does.

use super::Fail;
use super::evaluate::{Place, Read, same, term, wrong};
use super::facts::fitting;
use ratn_model::expression::{BinaryOperator, Expr, FactExpr, Function, UnaryOperator};
use ratn_model::fact::{FactPattern, Term};
use ratn_model::value::Value;

/// One condition; facts that a test needs are separate conditions.
enum Condition {
    Fact(FactExpr, Says),
    Test(Expr),
    /// There is an answer to these (true), or there is none (false).
    Answers(Vec<Condition>, bool),
}

/// The required value of a fact.
enum Says {
    Anything,
    /// Neither false nor null.
    Yes,
    Value(Expr),
}

pub(super) fn has_answer(query: &[Expr], place: &Place<'_>) -> Result<bool, Fail> {
    let mut hidden = place.row.len();
    let conditions = conditions(query, &mut hidden);
    let all: Vec<&Condition> = conditions.iter().collect();
    answers(&all, &mut place.clone(), &mut |_| true)
}

/// The values of some variables in the answers, without duplicates, in the total order of values of the model.
pub(super) fn found_values(wanted: &[String], query: &[Expr], place: &Place<'_>) -> Result<Vec<Value>, Fail> {
    let mut hidden = place.row.len();
    let conditions = conditions(query, &mut hidden);
    let all: Vec<&Condition> = conditions.iter().collect();
    let mut values: Vec<Value> = Vec::new();
    answers(&all, &mut place.clone(), &mut |place| {
        let of =
            |name: &String| place.row.iter().rev().find(|(known, _)| known == name).map(|(_, value)| value.clone());
        let each: Vec<(String, Value)> =
            wanted.iter().map(|name| (name.clone(), of(name).unwrap_or(Value::Null))).collect();
        let value = if let [(_, one)] = each.as_slice() { one.clone() } else { Value::Map(each.into_iter().collect()) };
        if !values.contains(&value) {
            values.push(value);
        }
        false
    })?;
    values.sort_by(|a, b| a.total_order(b));
    Ok(values)
}

/// Returns whether to stop after an answer.
type Enough<'a> = dyn FnMut(&Place<'_>) -> bool + 'a;

fn conditions(query: &[Expr], hidden: &mut usize) -> Vec<Condition> {
    let mut all = Vec::new();
    for expr in query {
        add(expr, hidden, &mut all);
    }
    all
}

fn add(expr: &Expr, hidden: &mut usize, all: &mut Vec<Condition>) {
    match expr {
        Expr::Binary(BinaryOperator::And, a, b) => {
            add(a, hidden, all);
            add(b, hidden, all);
        }
        Expr::Unary(UnaryOperator::Not, of) => {
            let inner = conditions(std::slice::from_ref(of), hidden);
            all.push(Condition::Answers(inner, false));
        }
        Expr::Query(inner) => {
            let inner = conditions(inner, hidden);
            all.push(Condition::Answers(inner, true));
        }
        Expr::Fact(fact) => add_fact(fact, Says::Yes, hidden, all),
        Expr::Exists(fact) => add_fact(fact, Says::Anything, hidden, all),
        other => {
            let test = without_facts(other, hidden, all);
            all.push(Condition::Test(test));
        }
    }
}

fn add_fact(fact: &FactExpr, says: Says, hidden: &mut usize, all: &mut Vec<Condition>) {
    let arguments = fact.arguments.iter().map(|a| a.as_ref().map(|a| without_facts(a, hidden, all))).collect();
    all.push(Condition::Fact(FactExpr { predicate: fact.predicate.clone(), arguments }, says));
}

/// Replaces each fact that must hold for the expression to be true by a variable.
fn without_facts(expr: &Expr, hidden: &mut usize, all: &mut Vec<Condition>) -> Expr {
    let mut within = |of: &Expr| Box::new(without_facts(of, hidden, all));
    match expr {
        Expr::Fact(fact) => {
            *hidden += 1;
            let variable = Expr::Unknown(format!("hidden {hidden}"));
            add_fact(fact, Says::Value(variable.clone()), hidden, all);
            variable
        }
        Expr::Binary(BinaryOperator::Or | BinaryOperator::And, ..) | Expr::Unary(UnaryOperator::Not, _) => expr.clone(),
        Expr::Binary(operator, a, b) => Expr::Binary(*operator, within(a), within(b)),
        Expr::Unary(operator, of) => Expr::Unary(*operator, within(of)),
        Expr::Field(of, name) => Expr::Field(within(of), name.clone()),
        Expr::Index(of, index) => Expr::Index(within(of), within(index)),
        Expr::List(items) => Expr::List(items.iter().map(|item| *within(item)).collect()),
        Expr::Map(fields) => Expr::Map(fields.iter().map(|(name, item)| (name.clone(), *within(item))).collect()),
        Expr::Call(Function::If, items) => {
            let mut items = items.clone();
            items.iter_mut().take(1).for_each(|first| *first = *within(first));
            Expr::Call(Function::If, items)
        }
        Expr::Call(Function::Either, _) => expr.clone(),
        Expr::Call(called, items) => Expr::Call(*called, items.iter().map(|item| *within(item)).collect()),
        _ => expr.clone(),
    }
}

/// Tries all values that make these conditions true, until `enough` returns true.
fn answers(conditions: &[&Condition], place: &mut Place<'_>, enough: &mut Enough<'_>) -> Result<bool, Fail> {
    if conditions.is_empty() {
        return Ok(enough(place));
    }
    let others = |at: usize| conditions.iter().enumerate().filter(move |(n, _)| *n != at).map(|(_, other)| *other);
    let rest = |at: usize| others(at).collect::<Vec<&Condition>>();
    for (at, condition) in conditions.iter().enumerate() {
        // A variable that occurs nowhere else may have any value.
        let is_bound = |name: &String| is_known(name, place) || !others(at).any(|other| names_in(other).contains(name));
        let holds = match condition {
            Condition::Answers(inner, wanted) if names_in(condition).iter().all(is_bound) => {
                let all: Vec<&Condition> = inner.iter().collect();
                answers(&all, &mut place.clone(), &mut |_| true)? == *wanted
            }
            Condition::Test(test) if is_readable(test, place) => test.is_true(place)?,
            _ => continue,
        };
        return if holds { answers(&rest(at), place, enough) } else { Ok(false) };
    }
    for (at, condition) in conditions.iter().enumerate() {
        if let Condition::Fact(fact, says) = condition
            && let Some(pattern) = pattern(fact, place)?
        {
            return found(fact, &pattern, says, &rest(at), place, enough);
        }
    }
    for (at, condition) in conditions.iter().enumerate() {
        let Condition::Test(Expr::Binary(BinaryOperator::Equal, a, b)) = condition else { continue };
        for (variable, value) in [(a, b), (b, a)] {
            if let Expr::Unknown(name) = &**variable
                && is_readable(value, place)
            {
                let value = value.read(place)?;
                place.row.push((name.clone(), value));
                let answer = answers(&rest(at), place, enough);
                place.row.pop();
                return answer;
            }
        }
    }
    wrong("a variable of the query gets no value")
}

/// Tries every fact that matches.
fn found(
    fact: &FactExpr,
    pattern: &Option<FactPattern>,
    says: &Says,
    rest: &[&Condition],
    place: &mut Place<'_>,
    enough: &mut Enough<'_>,
) -> Result<bool, Fail> {
    let Some(pattern) = pattern else { return Ok(false) };
    let before = place.row.len();
    let facts = place.facts;
    for (key, value) in fitting(facts, pattern) {
        let mut fits = true;
        for (wanted, there) in fact.arguments.iter().zip(&key.arguments) {
            if let Some(Expr::Unknown(name)) = wanted {
                let there = match there {
                    Term::Int(i) => Value::Int(*i),
                    Term::Name(name) => Value::String(name.clone()),
                };
                fits &= unify(name, there, place);
            }
        }
        fits &= match says {
            Says::Anything => true,
            Says::Yes => !matches!(value, Value::Null | Value::Bool(false)),
            Says::Value(Expr::Unknown(name)) => unify(name, value.clone(), place),
            Says::Value(wanted) => same(&wanted.read(place)?, value),
        };
        let answer = if fits { answers(rest, place, enough) } else { Ok(false) };
        place.row.truncate(before);
        if answer? {
            return Ok(true);
        }
    }
    Ok(false)
}

/// Binds the variable, or compares it if bound.
fn unify(name: &str, value: Value, place: &mut Place<'_>) -> bool {
    match place.row.iter().rev().find(|(known, _)| known == name) {
        Some((_, known)) => same(known, &value),
        None => {
            place.row.push((name.to_owned(), value));
            true
        }
    }
}

/// The pattern of the facts to try; `Some(None)`: no fact can match, because a variable's value is no argument.
fn pattern(fact: &FactExpr, place: &Place<'_>) -> Result<Option<Option<FactPattern>>, Fail> {
    let mut arguments = Vec::new();
    for argument in &fact.arguments {
        arguments.push(match argument {
            None => None,
            Some(Expr::Unknown(name)) if !is_known(name, place) => None,
            Some(variable @ Expr::Unknown(_)) => match term(&variable.read(place)?) {
                Ok(term) => Some(term),
                Err(_) => return Ok(Some(None)),
            },
            Some(computed) if is_readable(computed, place) => Some(term(&computed.read(place)?)?),
            Some(_) => return Ok(None),
        });
    }
    Ok(Some(Some(FactPattern { predicate: fact.predicate.clone(), arguments })))
}

fn is_known(name: &String, place: &Place<'_>) -> bool {
    place.row.iter().any(|(known, _)| known == name)
}

/// Whether every `?name` in it is bound, except those of inner queries.
fn is_readable(expr: &Expr, place: &Place<'_>) -> bool {
    let mut all = Vec::new();
    expr.visit(&mut |part| {
        if let Expr::Query(inner) = part {
            let within: Vec<String> = inner.iter().flat_map(names).collect();
            all.retain(|name| !within.contains(name));
        }
        if let Expr::Unknown(name) = part {
            all.push(name.clone());
        }
    });
    all.iter().all(|name| is_known(name, place))
}

fn names(expr: &Expr) -> Vec<String> {
    let mut all = Vec::new();
    expr.visit(&mut |part| {
        if let Expr::Unknown(name) = part {
            all.push(name.clone());
        }
    });
    all
}

fn names_in(condition: &Condition) -> Vec<String> {
    match condition {
        Condition::Test(test) => names(test),
        Condition::Answers(inner, _) => inner.iter().flat_map(names_in).collect(),
        Condition::Fact(fact, says) => {
            let mut all: Vec<String> = fact.arguments.iter().flatten().flat_map(names).collect();
            if let Says::Value(value) = says {
                all.extend(names(value));
            }
            all
        }
    }
}
