//! Expressions → conditions: each condition either finds facts or tests values already found.

use super::MAX_CONDITIONS;
use super::plan::PlanError;
use crate::expression::{BinaryOperator, Expr, FactExpr, Function, UnaryOperator};

/// A condition in which each fact is separate.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Condition {
    /// There is such a fact with such a value.
    Fact(FactExpr, Says),
    /// The expression is true; facts in it may be absent.
    Test(Expr),
    /// There is an answer to these (true), or none (false).
    Answers(Vec<Condition>, bool),
}

/// The required value of a fact.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Says {
    /// Any value.
    Anything,
    /// Neither false nor null.
    Yes,
    /// This value.
    Value(Expr),
}

/// The conditions of a query, in the order of the text.
pub(super) fn conditions(query: &[Expr]) -> Result<Vec<Condition>, PlanError> {
    let mut made = Made { hidden: 0, count: 0 };
    made.all(query)
}

struct Made {
    hidden: usize,
    count: usize,
}

impl Made {
    fn all(&mut self, query: &[Expr]) -> Result<Vec<Condition>, PlanError> {
        let mut into = Vec::new();
        for expr in query {
            self.add(expr, &mut into)?;
        }
        Ok(into)
    }

    fn add(&mut self, expr: &Expr, into: &mut Vec<Condition>) -> Result<(), PlanError> {
        self.count += 1;
        if self.count > MAX_CONDITIONS {
            return Err(PlanError::TooLarge);
        }
        match expr {
            Expr::Binary(BinaryOperator::And, a, b) => {
                self.add(a, into)?;
                self.add(b, into)?;
            }
            Expr::Unary(UnaryOperator::Not, inner) => {
                let inner = self.all(std::slice::from_ref(inner))?;
                into.push(Condition::Answers(inner, false));
            }
            Expr::Query(inner) => {
                let inner = self.all(inner)?;
                into.push(Condition::Answers(inner, true));
            }
            Expr::Fact(fact) => self.fact(fact, Says::Yes, into)?,
            Expr::Exists(fact) => self.fact(fact, Says::Anything, into)?,
            Expr::Binary(BinaryOperator::Equal, a, b) => match (a.as_ref(), b.as_ref()) {
                (Expr::Fact(fact), value) | (value, Expr::Fact(fact)) => {
                    let value = self.without_facts(value, into)?;
                    // The value may need variables that the fact itself binds, so it is compared afterwards.
                    if matches!(value, Expr::Unknown(_)) || !mentions_unknowns(&value) {
                        self.fact(fact, Says::Value(value), into)?;
                    } else {
                        let says = self.without_facts(&Expr::Fact(fact.clone()), into)?;
                        into.push(Condition::Test(Expr::Binary(
                            BinaryOperator::Equal,
                            Box::new(says),
                            Box::new(value),
                        )));
                    }
                }
                _ => self.test(expr, into)?,
            },
            other => self.test(other, into)?,
        }
        Ok(())
    }

    fn test(&mut self, expr: &Expr, into: &mut Vec<Condition>) -> Result<(), PlanError> {
        let expr = self.without_facts(expr, into)?;
        into.push(Condition::Test(expr));
        Ok(())
    }

    fn fact(&mut self, fact: &FactExpr, says: Says, into: &mut Vec<Condition>) -> Result<(), PlanError> {
        let arguments = fact.arguments.iter().map(|argument| match argument {
            Some(argument) => self.without_facts(argument, into).map(Some),
            None => Ok(None),
        });
        let arguments = arguments.collect::<Result<_, PlanError>>()?;
        into.push(Condition::Fact(FactExpr { predicate: fact.predicate.clone(), arguments }, says));
        Ok(())
    }

    /// Replaces each fact that must hold for the expression to be true by a variable; these facts become conditions.
    fn without_facts(&mut self, expr: &Expr, into: &mut Vec<Condition>) -> Result<Expr, PlanError> {
        let mut expr = expr.clone();
        let mut out = TakeOut { made: self, into, problem: None };
        out.strict(&mut expr);
        match out.problem {
            Some(problem) => Err(problem),
            None => Ok(expr),
        }
    }
}

fn mentions_unknowns(expr: &Expr) -> bool {
    let mut found = false;
    expr.visit(&mut |part| found |= matches!(part, Expr::Unknown(_)));
    found
}

struct TakeOut<'a> {
    made: &'a mut Made,
    into: &'a mut Vec<Condition>,
    problem: Option<PlanError>,
}

impl TakeOut<'_> {
    fn strict(&mut self, expr: &mut Expr) {
        match expr {
            Expr::Binary(BinaryOperator::Or | BinaryOperator::And, ..)
            | Expr::Unary(UnaryOperator::Not, _)
            | Expr::Exists(_)
            | Expr::Query(_)
            | Expr::Find(..)
            | Expr::Literal(_)
            | Expr::Variable(_)
            | Expr::Output(_)
            | Expr::Port { .. }
            | Expr::Element(_)
            | Expr::Unknown(_) => {}
            // Facts in the body are looked up for each element.
            Expr::Each { list, .. } => self.strict(list),
            Expr::Call(Function::Either, _) => {}
            Expr::Call(Function::If, arguments) => arguments.iter_mut().take(1).for_each(|first| self.strict(first)),
            Expr::Field(of, _) | Expr::Unary(_, of) => self.strict(of),
            Expr::Index(a, b) | Expr::Binary(_, a, b) => {
                self.strict(a);
                self.strict(b);
            }
            Expr::List(items) | Expr::Call(_, items) => items.iter_mut().for_each(|item| self.strict(item)),
            Expr::Map(fields) => fields.iter_mut().for_each(|(_, item)| self.strict(item)),
            Expr::Fact(_) => self.take(expr),
        }
    }

    fn take(&mut self, expr: &mut Expr) {
        let Expr::Fact(fact) = expr else { return };
        self.made.hidden += 1;
        self.made.count += 1;
        if self.made.count > MAX_CONDITIONS {
            self.problem = Some(PlanError::TooLarge);
            return;
        }
        // A name that cannot be written in a file; messages show it as the fact.
        let name = format!("{fact}#{}?", self.made.hidden);
        let taken = fact.clone();
        *expr = Expr::Unknown(name.clone());
        if let Err(problem) = self.made.fact(&taken, Says::Value(Expr::Unknown(name)), self.into) {
            self.problem = Some(problem);
        }
    }
}
