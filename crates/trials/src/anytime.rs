//! Anytime actions in random programs: results that get better, and what must not matter.
//!
//! Some computing actions get an additional output, the cost of their result, which motions take as an input. The effects of a motion do
//! not depend on it ("any result is acceptable"). The results of a computing action do, so there it must be the cost of the first result.
//! The provider is hostile: its later results are incomplete or change outputs that must not change; it dies, loses its lease, fails or
//! never ends.

use super::{Dice, Hash};
use ratn_executive::protocol::Goal;
use ratn_model::expression::Expr;
use ratn_model::id::StateId;
use ratn_model::program::{ABORTED, Annotations, Nature, Program, ResourceExpr, State, StateKind};
use ratn_model::resource::ResourceOperation;
use ratn_model::value::{Type, Value};
use ratn_simulation::run::{Answer, Better};
use std::collections::{BTreeMap, BTreeSet};

/// The cost of a result, less is better; an input of a motion is named by this and a number.
pub(super) const COST: &str = "cost";
const FIRST_COST: i64 = 100;

/// Makes some computing actions anytime, and passes the costs of their results on to others.
pub(super) fn improve(program: &mut Program, dice: &mut Dice) {
    let is_made = |state: &State| {
        matches!(state.kind, StateKind::Action { .. })
            && state.annotations.nature == Nature::Computes
            && state.annotations.timeout_s.is_none()
    };
    let candidates: Vec<StateId> = program.states.iter().filter(|state| is_made(state)).map(|state| state.id).collect();
    let chosen: BTreeSet<StateId> = candidates.into_iter().filter(|_| dice.percent(70)).collect();
    for state in &mut program.states {
        let StateKind::Action { inputs, outputs, .. } = &mut state.kind else { continue };
        if chosen.contains(&state.id) {
            state.annotations.anytime = true;
            outputs.insert(COST.to_owned(), Type::Int);
        }
        // Most computing users of a result ignore its cost.
        let chance = if is_motion(&state.annotations) { 90 } else { 10 };
        let used = inputs.iter().filter_map(|(_, value)| match value {
            Expr::Port { state, .. } if chosen.contains(state) => Some(*state),
            _ => None,
        });
        let used: BTreeSet<StateId> = used.filter(|_| dice.percent(chance)).collect();
        let more = used.into_iter().enumerate();
        inputs.extend(more.map(|(n, state)| (format!("{COST}{n}"), Expr::Port { state, port: COST.to_owned() })));
    }
}

/// Whether an action may change something real.
fn is_motion(said: &Annotations) -> bool {
    let changes = |line: &ResourceExpr| !matches!(line.operation, ResourceOperation::Block | ResourceOperation::Exists);
    said.nature == Nature::Irreversible || said.resources.iter().any(changes)
}

/// Whether a node's behaviour depends on an input.
pub(super) fn depends_on(state: &State, port: &str) -> bool {
    !is_motion(&state.annotations) || !port.starts_with(COST)
}

/// Ports without the costs, which may differ between the modes.
pub(super) fn without_cost(ports: &BTreeMap<String, Value>) -> BTreeMap<String, Value> {
    ports
        .iter()
        .filter(|(port, _)| !port.starts_with(COST))
        .map(|(port, value)| (port.clone(), value.clone()))
        .collect()
}

/// Adds the cost to the outputs, if the action has it.
pub(super) fn with_cost(state: &State, outputs: &mut BTreeMap<String, Value>) {
    if matches!(&state.kind, StateKind::Action { outputs, .. } if outputs.contains_key(COST)) {
        outputs.insert(COST.to_owned(), Value::Int(FIRST_COST));
    }
}

/// The results after the first one, and the end of the goal.
pub(super) fn later(
    seed: u64,
    path: &str,
    attempt: u32,
    goal: &Goal,
    first: &BTreeMap<String, Value>,
) -> Option<Better> {
    let kept = goal.improves.as_deref()?;
    let mut hash = Hash(seed);
    hash.add("better");
    hash.add(path);
    hash.add_number(u64::from(attempt));
    let mut dice = hash.dice();
    if dice.percent(10) {
        // The goal has nothing to improve.
        return None;
    }
    let mut after_s = 0.0;
    let mut better = |n: i64| {
        after_s += 0.1 + dice.below(30) as f64 / 10.0;
        let mut outputs = first.clone();
        outputs.insert(COST.to_owned(), Value::Int(FIRST_COST - n));
        if dice.percent(15) {
            outputs.remove("list");
        }
        if kept.iter().any(|port| port == "x") && dice.percent(30) {
            outputs.insert("x".to_owned(), Value::Int(77));
        }
        (after_s, outputs, (FIRST_COST - n) as f64)
    };
    let results: Vec<_> = (1..=1 + (hash.dice().below(4) as i64)).map(&mut better).collect();
    let last = results.last().map(|(_, outputs, _)| outputs.clone()).unwrap_or_default();
    let finished =
        |outcome: &str, outputs| Answer::Finished { outcome: outcome.to_owned(), outputs, measured: Vec::new() };
    let end = match dice.below(6) {
        0 | 1 => Some(finished("success", last)),
        2 => Some(finished(ABORTED, BTreeMap::new())),
        3 => Some(Answer::Crashed),
        4 => Some(Answer::LeaseLost),
        _ => None,
    };
    Some(Better { results, end: end.map(|end| (after_s + dice.below(30) as f64 / 10.0, end)) })
}
