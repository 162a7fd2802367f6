//! Programs with something taken out: every reference to it goes, the numbers of states are made dense again. Names and paths of
//! what stays are as they were, so that the oracle says the same of it.

use ratn_model::expression::{EffectExpr, Expr, FactExpr};
use ratn_model::id::StateId;
use ratn_model::program::{Nature, Program, State, StateKind, Target};
use ratn_model::value::Value;
use std::collections::{BTreeMap, BTreeSet};

/// The program without a state and what it contains.
pub(super) fn without(program: &Program, id: StateId) -> Program {
    let mut gone = BTreeSet::from([id]);
    // What a state contains comes after it.
    for state in &program.states {
        if state.parent.is_some_and(|parent| gone.contains(&parent)) {
            gone.insert(state.id);
        }
    }
    let kept = program.states.iter().filter(|state| !gone.contains(&state.id));
    let numbers: BTreeMap<StateId, StateId> =
        kept.clone().enumerate().map(|(number, state)| (state.id, StateId(number as u64))).collect();
    let mut next = Program { states: kept.cloned().collect(), ..program.clone() };
    let renumber = |part: &mut Expr| {
        if let Expr::Port { state, .. } = part {
            match numbers.get(state) {
                Some(number) => *state = *number,
                None => *part = Expr::Literal(Value::Int(0)),
            }
        }
    };
    for state in &mut next.states {
        state.id = numbers.get(&state.id).copied().unwrap_or(state.id);
        state.parent = state.parent.and_then(|parent| numbers.get(&parent).copied());
        for list in lists(&mut state.kind) {
            *list = list.iter().filter_map(|child| numbers.get(child).copied()).collect();
        }
        state.transitions.retain(|_, target| match target {
            Target::State(to) => match numbers.get(to) {
                Some(number) => {
                    *to = *number;
                    true
                }
                None => false,
            },
            Target::Outcome(_) => true,
        });
        expressions(state, &renumber);
    }
    next.outputs.iter_mut().for_each(|output| part_of(&mut output.value, &renumber));
    next
}

fn lists(kind: &mut StateKind) -> Vec<&mut Vec<StateId>> {
    match kind {
        StateKind::Action { .. } => Vec::new(),
        StateKind::Sequence { children, .. } => vec![children],
        StateKind::ForEach { body, .. } | StateKind::While { body, .. } => vec![body],
        StateKind::Condition { then, otherwise, .. } => vec![then, otherwise],
        StateKind::Concurrency { regions, .. } => vec![regions],
    }
}

/// Every expression of a state, part by part.
pub(super) fn expressions(state: &mut State, change: &dyn Fn(&mut Expr)) {
    match &mut state.kind {
        StateKind::Action { inputs, .. } => inputs.iter_mut().for_each(|(_, e)| part_of(e, change)),
        StateKind::Sequence { outputs, .. } => outputs.iter_mut().for_each(|o| part_of(&mut o.value, change)),
        StateKind::ForEach { collection, .. } => part_of(collection, change),
        StateKind::While { predicate, .. } | StateKind::Condition { predicate, .. } => part_of(predicate, change),
        StateKind::Concurrency { decide, outputs, .. } => {
            decide.iter_mut().for_each(|(_, e)| part_of(e, change));
            outputs.iter_mut().for_each(|o| part_of(&mut o.value, change));
        }
    }
    state.variables.iter_mut().chain(&mut state.assign).for_each(|(_, e)| part_of(e, change));
    let a = &mut state.annotations;
    a.requires.iter_mut().for_each(|e| part_of(e, change));
    a.reads.iter_mut().flatten().for_each(|f| fact(f, change));
    if let Nature::Senses(facts) = &mut a.nature {
        facts.iter_mut().for_each(|f| fact(f, change));
    }
    a.effects.values_mut().flatten().for_each(|e| effect(e, change));
    a.duration_s.iter_mut().for_each(|e| part_of(e, change));
    for resource in &mut a.resources {
        resource.attributes.iter_mut().for_each(|(_, e)| part_of(e, change));
        resource.conditions.iter_mut().for_each(|condition| part_of(&mut condition.value, change));
    }
}

fn part_of(expression: &mut Expr, change: &dyn Fn(&mut Expr)) {
    change(expression);
    match expression {
        Expr::Literal(_) | Expr::Variable(_) | Expr::Output(_) | Expr::Port { .. } | Expr::Unknown(_) => {}
        Expr::Field(of, _) | Expr::Unary(_, of) => part_of(of, change),
        Expr::Index(a, b) | Expr::Binary(_, a, b) => {
            part_of(a, change);
            part_of(b, change);
        }
        Expr::List(items) | Expr::Call(_, items) | Expr::Query(items) => {
            items.iter_mut().for_each(|item| part_of(item, change));
        }
        Expr::Map(fields) => fields.iter_mut().for_each(|(_, item)| part_of(item, change)),
        Expr::Fact(f) | Expr::Exists(f) => fact(f, change),
    }
}

fn fact(f: &mut FactExpr, change: &dyn Fn(&mut Expr)) {
    f.arguments.iter_mut().flatten().for_each(|argument| part_of(argument, change));
}

fn effect(of: &mut EffectExpr, change: &dyn Fn(&mut Expr)) {
    match of {
        EffectExpr::Set(f, value) | EffectExpr::Increase(f, value) => {
            fact(f, change);
            part_of(value, change);
        }
        EffectExpr::Delete(f) => fact(f, change),
        EffectExpr::ForEach { collection, effects, .. } => {
            part_of(collection, change);
            effects.iter_mut().for_each(|e| effect(e, change));
        }
    }
}
