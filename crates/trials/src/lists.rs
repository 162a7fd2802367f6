//! Rewrites a program with comprehensions: parts of its expressions become elements of a list, with different names for nested
//! elements. The meaning does not change.

use super::Dice;
use ratn_model::expression::{Comprehension, Expr};
use ratn_model::program::Program;
use ratn_model::value::Value;

/// One of this many parts is rewritten.
const EVERY: u64 = 4;
/// Limit of an expression's parts; a larger one is not rewritten.
const MOST_PARTS: usize = 24;

/// Rewrites parts of a program's expressions with comprehensions.
pub(super) fn say_with_comprehensions(program: &mut Program, dice: &mut Dice) {
    let mut names = 0;
    for state in &mut program.states {
        state.each_expression_mut(&mut |_, expression| {
            let mut parts = 0;
            expression.visit(&mut |_| parts += 1);
            let in_query = |expr: &Expr| {
                let mut found = false;
                expr.visit(&mut |part| found |= matches!(part, Expr::Query(_)));
                found
            };
            // Planning depends on the form of a query's conditions.
            if parts <= MOST_PARTS && !in_query(expression) {
                expression.rewrite(&mut |part| {
                    if dice.below(EVERY) == 0 {
                        names += 1;
                        say(part, &format!("e{names}"), dice);
                    }
                });
            }
        });
    }
}

fn say(part: &mut Expr, name: &str, dice: &mut Dice) {
    let element = || Expr::Element(name.to_owned());
    let each = |what, list: Vec<Expr>, body: Expr| Expr::Each {
        what,
        element: name.to_owned(),
        list: Box::new(Expr::List(list)),
        body: Box::new(body),
    };
    let number = |i| Expr::Literal(Value::Int(i));
    let whole = std::mem::replace(part, Expr::Literal(Value::Null));
    *part = match whole {
        // The fact is looked up with the element as its argument.
        Expr::Fact(mut fact) if fact.arguments.first().is_some_and(Option::is_some) => {
            let first = fact.arguments[0].replace(element());
            first_of(each(Comprehension::Map, first.into_iter().collect(), Expr::Fact(fact)))
        }
        Expr::Exists(mut fact) if fact.arguments.first().is_some_and(Option::is_some) => {
            let what = if dice.below(2) == 0 { Comprehension::Any } else { Comprehension::All };
            let first = fact.arguments[0].replace(element());
            each(what, first.into_iter().collect(), Expr::Exists(fact))
        }
        // These parts must be evaluated exactly when they were evaluated before.
        of @ (Expr::Port { .. } | Expr::Variable(_) | Expr::Output(_)) => match dice.below(3) {
            0 => first_of(each(Comprehension::Map, vec![number(0)], of)),
            1 => first_of(each(Comprehension::Filter, vec![of], Expr::Literal(Value::Bool(true)))),
            _ => first_of(each(Comprehension::SortBy, vec![of], number(1))),
        },
        Expr::Literal(Value::Int(i)) => match dice.below(2) {
            0 => each(Comprehension::MinBy, vec![number(i.saturating_add(1)), number(i)], element()),
            _ => each(Comprehension::MaxBy, vec![number(i), number(i.saturating_sub(1))], element()),
        },
        other => other,
    };
}

fn first_of(list: Expr) -> Expr {
    Expr::Index(Box::new(list), Box::new(Expr::Literal(Value::Int(0))))
}
