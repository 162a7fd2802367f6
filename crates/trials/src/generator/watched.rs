//! Motions and hierarchies with `while` conditions.

use super::super::{Dice, PREDICATES, around};
use super::fact_at;
use ratn_model::expression::{BinaryOperator, EffectExpr, Expr, UnaryOperator};
use ratn_model::guard::{Guard, Limits};
use ratn_model::id::StateId;
use ratn_model::program::{ABORTED, Nature, Program, State, StateKind, Target, VIOLATED};
use ratn_model::value::Value;
use std::collections::BTreeMap;

/// Adds `while` conditions to some motions. Regions are left out, because other regions may write the facts there.
pub(super) fn watch(program: &mut Program, guards: &mut BTreeMap<StateId, Guard>, dice: &mut Dice) {
    let beside = |state: &State| around(program, state).any(|out| matches!(out.kind, StateKind::Concurrency { .. }));
    let moves = |state: &State| {
        matches!(state.kind, StateKind::Action { .. }) && state.annotations.nature == Nature::Irreversible
    };
    let holds_some =
        |state: &State| matches!(&state.kind, StateKind::Sequence { children, .. } if !children.is_empty());
    let may_be = |state: &&State| {
        state.parent.is_some() && !state.is_pause() && (moves(state) || holds_some(state)) && !beside(state)
    };
    let watched: Vec<(StateId, bool)> =
        program.states.iter().filter(may_be).map(|state| (state.id, moves(state))).collect();
    for (id, moves) in watched {
        if !dice.percent(if moves { 40 } else { 15 }) {
            continue;
        }
        let conditions = 1 + dice.below(2);
        let holds = (0..conditions).map(|_| condition(dice)).collect();
        let state = &mut program.states[id.0 as usize];
        match moves {
            true => state.annotations.holds = holds,
            false => guards.entry(id).or_default().limits = Some(Limits { holds, timeout_s: None }),
        }
        state.outcomes.push(VIOLATED.to_owned());
        if dice.percent(70) {
            let effect = EffectExpr::Set(fact_at(dice.below(PREDICATES), 0), number(dice.below(9) as i64));
            state.annotations.effects.insert(VIOLATED.to_owned(), vec![effect]);
        }
        let failed = state.transitions.get(ABORTED).cloned();
        if failed.is_none() || dice.percent(20) {
            state.annotations.exceptional.push(VIOLATED.to_owned());
        }
        let failed = failed.unwrap_or_else(|| Target::Outcome(ABORTED.to_owned()));
        state.transitions.insert(VIOLATED.to_owned(), failed);
    }
}

/// A condition that is true more often than not.
fn condition(dice: &mut Dice) -> Expr {
    let fact = fact_at(dice.below(PREDICATES), 0);
    let less = Expr::Binary(
        BinaryOperator::Less,
        Box::new(Expr::Fact(fact.clone())),
        Box::new(number(2 + dice.below(8) as i64)),
    );
    match dice.below(4) {
        0 => Expr::Exists(fact),
        1 => Expr::Unary(
            UnaryOperator::Not,
            Box::new(Expr::Binary(
                BinaryOperator::Equal,
                Box::new(Expr::Fact(fact)),
                Box::new(number(dice.below(5) as i64)),
            )),
        ),
        _ => less,
    }
}

fn number(value: i64) -> Expr {
    Expr::Literal(Value::Int(value))
}
