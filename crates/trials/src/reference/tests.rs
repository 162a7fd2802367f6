//! The reference evaluates expressions as `ratn-model` does: explicit cases from the documents, and random ones.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use super::evaluate::{Place, Read, same};
use super::facts::{Facts, fits};
use super::{Fail, Outputs};
use crate::{Dice, Features, program};
use ratn_model::expression::parse::{NameError, Names, parse_expression};
use ratn_model::expression::{BinaryOperator, Expr, FactExpr, Function, Lookup, Scope, UnaryOperator};
use ratn_model::fact::{FactKey, FactPattern, Term};
use ratn_model::id::StateId;
use ratn_model::program::Program;
use ratn_model::value::Value;
use std::borrow::Cow;
use std::collections::BTreeMap;

struct NoNames;

impl Names for NoNames {
    fn variable(&mut self, name: &str) -> Result<Expr, NameError> {
        Ok(Expr::Variable(name.to_owned()))
    }

    fn word(&mut self, _: &str) -> Option<Expr> {
        None
    }

    fn port(&mut self, _: &str, port: &str) -> Result<Expr, NameError> {
        Ok(Expr::Port { state: StateId(0), port: port.to_owned() })
    }
}

/// A scope for `ratn-model` with facts and one variable.
struct Plain<'a>(&'a Facts, &'a Value);

impl Scope for Plain<'_> {
    fn variable(&self, name: &str) -> Option<Cow<'_, Value>> {
        (name == "v").then_some(Cow::Borrowed(self.1))
    }

    fn output(&self, _: &str) -> Option<Cow<'_, Value>> {
        None
    }

    fn port(&self, _: StateId, _: &str) -> Option<Cow<'_, Value>> {
        None
    }

    fn fact(&self, pattern: &FactPattern) -> Lookup<'_> {
        let first = self.0.iter().find(|(key, _)| pattern.matches(key));
        first.map_or(Lookup::Absent, |(_, value)| Lookup::Holds(Cow::Borrowed(value)))
    }

    fn each_fact(&self, pattern: &FactPattern, visit: &mut dyn FnMut(&FactKey, &Value) -> bool) -> bool {
        let _ = self.0.iter().filter(|(key, _)| fits(pattern, key)).all(|(key, value)| visit(key, value));
        true
    }
}

fn read(program: &Program, expr: &Expr, facts: &Facts, v: &Value) -> Result<Value, Fail> {
    let (outputs, regions): (BTreeMap<StateId, Outputs>, _) = Default::default();
    let variables = vec![("v".to_owned(), v.clone())];
    expr.read(&Place {
        program,
        facts,
        outputs: &outputs,
        regions: &regions,
        variables,
        own: None,
        elements: Vec::new(),
        row: Vec::new(),
    })
}

fn key(predicate: &str, arguments: &[Term]) -> FactKey {
    FactKey { predicate: predicate.to_owned(), arguments: arguments.to_vec() }
}

#[test]
fn queries_have_the_answers_that_the_documents_say() {
    let program = program(0, &Features::BASIC);
    let name = |name: &str| Term::Name(name.to_owned());
    let facts = Facts::from([
        (key("on", &[name("cup"), name("table")]), Value::Bool(true)),
        (key("on", &[name("box"), name("floor")]), Value::Bool(false)),
        (key("weight", &[name("cup")]), Value::Int(1)),
        (key("weight", &[name("box")]), Value::Int(5)),
        (key("limit", &[]), Value::Int(2)),
    ]);
    for (text, expected) in [
        ("exists (on(?x, table))", true),
        ("exists (on(?x, floor))", false),
        ("exists (exists on(?x, floor))", true),
        ("exists (weight(?x) < limit())", true),
        ("exists (weight(?x) < 1)", false),
        ("exists (on(?x, ?where), weight(?x) > 2)", false),
        ("exists (weight(?x) = ?w, ?w > 2, not on(?x, ?where))", true),
        ("exists (weight(?x) = ?w, not weight(?y) > ?w)", true),
        ("exists (?w = 4 + 1, weight(?x) = ?w)", true),
        ("exists (weight(?) > 4)", true),
        ("exists (weight(?x) = ?w and exists (on(?x, ?t)) and ?t2 = ?w + 1 and ?t2 = 2)", true),
        ("exists (gone(?x))", false),
        ("not exists (weight(spoon))", true),
    ] {
        let expr = parse_expression(text, &mut NoNames).unwrap();
        assert_eq!(read(&program, &expr, &facts, &Value::Null), Ok(Value::Bool(expected)), "{text}");
        assert_eq!(expr.evaluate(&Plain(&facts, &Value::Null)), Ok(Value::Bool(expected)), "{text}");
    }
}

#[test]
fn random_expressions_have_one_value() {
    let (program, mut values) = (program(0, &Features::BASIC), 0);
    for seed in 0..20_000 {
        let mut dice = Dice(seed);
        let facts: Facts = (0..dice.below(5))
            .map(|_| (key(["p", "q"][dice.below(2) as usize], &[Term::Int(dice.below(3) as i64)]), literal(&mut dice)))
            .collect();
        let (expr, v) = (expression(&mut dice, 4), literal(&mut dice));
        let model = expr.evaluate(&Plain(&facts, &v));
        match (read(&program, &expr, &facts, &v), &model) {
            (Err(Fail::NotMine(_)), _) => {}
            (Ok(value), Ok(other)) => {
                assert!(
                    value == *other && same(&value, other),
                    "seed {seed}: {expr}: {value} and {other} of {facts:?}"
                );
                values += 1;
            }
            (Err(_), Err(_)) => {}
            (reference, model) => panic!("seed {seed}: {expr}: {reference:?} and {model:?} of {facts:?}, $v = {v}"),
        }
    }
    assert!(values > 4_000, "only {values} have a value");
}

fn literal(dice: &mut Dice) -> Value {
    match dice.below(9) {
        0 => Value::Null,
        1 => Value::Bool(true),
        2 => Value::Float(dice.below(6) as f64 / 2.0),
        3 => Value::String(["a", "b"][dice.below(2) as usize].to_owned()),
        4 => Value::List((0..dice.below(3)).map(|n| Value::Int(n as i64)).collect()),
        5 => Value::map([("a", Value::Int(1)), ("b", Value::Int(dice.below(3) as i64))]),
        _ => Value::Int(dice.below(4) as i64),
    }
}

fn expression(dice: &mut Dice, depth: u64) -> Expr {
    use BinaryOperator as Op;
    const OPERATORS: [Op; 13] = [
        Op::Or,
        Op::And,
        Op::Equal,
        Op::NotEqual,
        Op::Less,
        Op::LessOrEqual,
        Op::Greater,
        Op::GreaterOrEqual,
        Op::In,
        Op::Add,
        Op::Subtract,
        Op::Multiply,
        Op::Divide,
    ];
    let fact = |dice: &mut Dice| {
        let argument = match dice.below(4) {
            0 => None,
            1 => Some(Expr::Variable("v".to_owned())),
            _ => Some(Expr::Literal(Value::Int(dice.below(3) as i64))),
        };
        FactExpr { predicate: ["p", "q"][dice.below(2) as usize].to_owned(), arguments: vec![argument] }
    };
    if depth == 0 || dice.percent(20) {
        return match dice.below(6) {
            0 => Expr::Variable("v".to_owned()),
            1 => Expr::Fact(fact(dice)),
            2 => Expr::Exists(fact(dice)),
            _ => Expr::Literal(literal(dice)),
        };
    }
    let mut inner = || Box::new(expression(dice, depth - 1));
    let (a, b, c) = (inner(), inner(), inner());
    match dice.below(14) {
        0 => Expr::Unary(UnaryOperator::Not, a),
        1 => Expr::Unary(UnaryOperator::Negate, a),
        2 => Expr::Field(a, ["a", "c"][dice.below(2) as usize].to_owned()),
        3 => Expr::Index(a, b),
        4 => Expr::List(vec![*a, *b]),
        5 => Expr::Map(vec![("a".to_owned(), *a), ("b".to_owned(), *b)]),
        6 => {
            let called = Function::ALL[dice.below(Function::ALL.len() as u64) as usize];
            let mut arguments = vec![*a, *b, *c];
            arguments.truncate(1 + dice.below(3) as usize);
            Expr::Call(called, arguments)
        }
        _ => Expr::Binary(OPERATORS[dice.below(13) as usize], a, b),
    }
}
