//! Rewrites a program with `find`: a query has an answer exactly if `find` finds something.

use super::Dice;
use ratn_model::expression::query::plan;
use ratn_model::expression::{BinaryOperator, Expr, Function};
use ratn_model::program::Program;
use ratn_model::value::Value;

/// Percentage of queries that are rewritten.
const SAID_SO: u64 = 60;

/// Rewrites some queries of a program with `find`.
pub(super) fn say_with_find(program: &mut Program, dice: &mut Dice) {
    for state in &mut program.states {
        state.each_expression_mut(&mut |_, expression| outermost(expression, dice));
    }
}

/// Only queries that are not inside of others, because a `find` has its own variables.
fn outermost(expression: &mut Expr, dice: &mut Dice) {
    match expression {
        Expr::Query(conditions) => {
            let found = plan(conditions, &|_| false).ok().map(|plan| plan.variables().to_vec());
            let Some(mut wanted) = found.filter(|found| !found.is_empty() && dice.percent(SAID_SO)) else { return };
            wanted.truncate(1 + dice.below(wanted.len() as u64) as usize);
            let found = Expr::Call(Function::Len, vec![Expr::Find(wanted, std::mem::take(conditions))]);
            let none = Expr::Literal(Value::Int(0));
            *expression = Expr::Binary(BinaryOperator::Greater, Box::new(found), Box::new(none));
        }
        Expr::Unary(_, of) => outermost(of, dice),
        Expr::Binary(_, a, b) => {
            outermost(a, dice);
            outermost(b, dice);
        }
        Expr::Call(_, items) | Expr::List(items) => items.iter_mut().for_each(|item| outermost(item, dice)),
        _ => {}
    }
}
