//! Outputs of conditions, loops and concurrencies, with values that depend on the way taken, and their users.
//!
//! They are added to a finished program: inputs are replaced, or further inputs are added. So the programs of older features do not
//! change.

use super::super::{Dice, around, is_preemptive};
use ratn_model::expression::{BinaryOperator, EffectExpr, Expr, Function};
use ratn_model::guard::{Collected, Guard};
use ratn_model::id::StateId;
use ratn_model::list::List;
use ratn_model::program::{Program, State, StateKind, TaskOutput};
use ratn_model::value::{Type, Value};
use std::collections::BTreeMap;

/// The output in which a loop collects values.
const ALL: &str = "all";
/// The output that every state with outputs has.
const X: &str = "x";
/// Limit of the users of an output.
const MOST_USERS: u64 = 3;

/// Adds outputs to some states, and users of them to some others.
pub(super) fn add(program: &mut Program, guards: &mut BTreeMap<StateId, Guard>, dice: &mut Dice) {
    // Inner states have larger ids, so they get their outputs first.
    for id in (1..program.states.len() as u64).rev().map(StateId) {
        let inside = givers(program, id);
        if inside.is_empty() || !dice.percent(75) {
            continue;
        }
        let value = chosen(&inside, dice);
        let state = &mut program.states[id.0 as usize];
        let is_loop = state.is_loop();
        let Some(outputs) = state.kind.outputs_mut() else { continue };
        match outputs.iter_mut().find(|output| output.name == X) {
            Some(output) => output.value = value,
            None => outputs.push(TaskOutput { name: X.to_owned(), ty: Type::Any, value }),
        }
        if dice.percent(40) {
            state.defaults.insert(X.to_owned(), Value::Int(dice.below(3) as i64));
        }
        if is_loop && dice.percent(50) {
            collect(state, guards, &inside, dice);
        }
    }
    for id in (1..program.states.len() as u64).map(StateId) {
        for port in [X, ALL] {
            if program.state(id).outputs().iter().any(|output| output.name == port) {
                use_it(program, (id, port), dice);
            }
        }
    }
}

/// States inside of a composite state in a loop use its output of the iteration before.
pub(super) fn of_the_iteration_before(program: &mut Program, dice: &mut Dice) {
    let is_again = |state: &State| around(program, state).skip(1).any(State::is_loop);
    let gives = |state: &&State| state.outputs().iter().any(|output| output.name == X);
    let all: Vec<StateId> =
        program.states.iter().filter(gives).filter(|state| is_again(state)).map(|state| state.id).collect();
    for id in all {
        let has_default = program.state(id).defaults.contains_key(X);
        for inside in (1..program.states.len() as u64).map(StateId) {
            let is_inside = around(program, program.state(inside)).skip(1).any(|out| out.id == id);
            if !is_inside || program.state(inside).is_pause() || !dice.percent(30) {
                continue;
            }
            let own = Expr::Port { state: id, port: X.to_owned() };
            let value = match has_default && dice.percent(50) {
                true => own,
                false => Expr::Call(Function::Either, vec![own, Expr::Literal(Value::Int(5))]),
            };
            if let StateKind::Action { inputs, .. } = &mut program.states[inside.0 as usize].kind {
                inputs.push((format!("of_the_last_{}", id.0), value));
            }
        }
    }
}

/// The direct children of a state that have an output `x`.
fn givers(program: &Program, id: StateId) -> Vec<StateId> {
    let gives = |state: &&State| match &state.kind {
        StateKind::Action { outputs, .. } => outputs.contains_key(X),
        _ => state.outputs().iter().any(|output| output.name == X),
    };
    program.state(id).children().map(|child| program.state(child)).filter(gives).map(|state| state.id).collect()
}

/// The output of one of several states: the first one that was written; in a few cases without a default for the case that none was.
fn chosen(from: &[StateId], dice: &mut Dice) -> Expr {
    let port = |state: StateId| Expr::Port { state, port: X.to_owned() };
    let mut rest = from.to_vec();
    let mut ways = Vec::new();
    while !rest.is_empty() && ways.len() < 3 {
        let way = port(rest.remove(dice.below(rest.len() as u64) as usize));
        let one = Box::new(Expr::Literal(Value::Int(1)));
        ways.push(if dice.percent(20) { Expr::Binary(BinaryOperator::Add, Box::new(way), one) } else { way });
    }
    if dice.percent(80) {
        ways.push(Expr::Literal(Value::Int(dice.below(3) as i64)));
    }
    match ways.len() {
        1 => ways.remove(0),
        3.. if dice.percent(30) => {
            let inner = Expr::Call(Function::Either, ways.split_off(1));
            Expr::Call(Function::Either, vec![ways.remove(0), inner])
        }
        _ => Expr::Call(Function::Either, ways),
    }
}

/// A loop collects a value of each iteration.
fn collect(state: &mut State, guards: &mut BTreeMap<StateId, Guard>, inside: &[StateId], dice: &mut Dice) {
    let value = match &state.kind {
        StateKind::ForEach { variable, .. } if dice.percent(30) => Expr::Variable(variable.clone()),
        StateKind::While { index: Some(index), .. } if dice.percent(30) => Expr::Variable(index.clone()),
        _ => chosen(inside, dice),
    };
    let nothing = || Value::List(List::new());
    state.defaults.insert(ALL.to_owned(), nothing());
    if let Some(outputs) = state.kind.outputs_mut() {
        outputs.push(TaskOutput { name: ALL.to_owned(), ty: Type::Any, value: Expr::Literal(nothing()) });
    }
    guards.entry(state.id).or_default().collected.push(Collected { name: ALL.to_owned(), value });
}

/// States behind a state in its list use its output, and so may the task.
fn use_it(program: &mut Program, (from, port): (StateId, &str), dice: &mut Dice) {
    let Some(parent) = program.state(from).parent else { return };
    let siblings = program.state(parent).list_of(from).to_vec();
    let behind = siblings.iter().skip_while(|id| **id != from).skip(1);
    let behind: Vec<StateId> = behind.copied().collect();
    let is_region = matches!(program.state(parent).kind, StateKind::Concurrency { .. });
    let is_behind = |state: &State| !is_region && around(program, state).any(|out| behind.contains(&out.id));
    let users: Vec<StateId> = program.states.iter().filter(|state| is_behind(state)).map(|state| state.id).collect();
    let plain = Expr::Port { state: from, port: port.to_owned() };
    let otherwise = match port {
        ALL => Expr::List(vec![Expr::Literal(Value::Int(7))]),
        _ => Expr::Literal(Value::Int(2)),
    };
    let value = || Expr::Call(Function::Either, vec![plain.clone(), otherwise.clone()]);
    let mut used = 0;
    for id in users {
        if used >= MOST_USERS || !dice.percent(50) {
            continue;
        }
        let value = if dice.percent(85) { value() } else { plain.clone() };
        let is_racing = around(program, program.state(id)).any(is_preemptive);
        let state = &mut program.states[id.0 as usize];
        if state.is_pause() {
            continue;
        }
        let number = || if port == ALL { Expr::Call(Function::Len, vec![value.clone()]) } else { value.clone() };
        match &mut state.kind {
            StateKind::Action { inputs, .. } => {
                let set = state.annotations.effects.values_mut().flatten().find_map(|effect| match effect {
                    EffectExpr::Set(_, of @ Expr::Literal(Value::Int(_))) => Some(of),
                    _ => None,
                });
                match set.filter(|_| !is_racing && dice.percent(40)) {
                    Some(of) => *of = number(),
                    None => inputs.push((format!("of_{port}_{}", from.0), value)),
                }
            }
            StateKind::ForEach { collection, .. } if port == ALL => *collection = value,
            StateKind::Condition { predicate, .. } if dice.percent(50) => {
                let two = Box::new(Expr::Literal(Value::Int(1)));
                *predicate = Expr::Binary(BinaryOperator::Greater, Box::new(number()), two);
            }
            _ => continue,
        }
        used += 1;
    }
    if parent == Program::ROOT && dice.percent(50) {
        let name = format!("of_{port}_{}", from.0);
        program.outputs.push(TaskOutput { name, ty: Type::Any, value: value() });
    }
}
