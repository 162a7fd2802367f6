//! Removes a part of a program, with every reference to it, and renumbers the states. Names and paths of the other states do not
//! change, so the oracle behaves the same for them.

use ratn_model::expression::Expr;
use ratn_model::id::StateId;
use ratn_model::program::{Program, StateKind, Target};
use ratn_model::value::Value;
use std::collections::{BTreeMap, BTreeSet};

/// The program without a state and its inner states.
pub(super) fn without(program: &Program, id: StateId) -> Program {
    let mut gone = BTreeSet::from([id]);
    // Inner states have larger ids than the states around them.
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
        state.each_expression_mut(&mut |_, expression| expression.rewrite(&mut |part| renumber(part)));
        state.annotations.each_mark_mut(&mut |marked| *marked = numbers.get(marked).copied().unwrap_or(*marked));
    }
    next.outputs.iter_mut().for_each(|output| output.value.rewrite(&mut |part| renumber(part)));
    next
}

/// Whether a state belongs to an expanded `retry` or `finally`; these are left as they are.
pub(super) fn is_of_a_guard(program: &Program, id: StateId) -> bool {
    let is_marked = |id: StateId| {
        let annotations = &program.state(id).annotations;
        annotations.again.is_some() || annotations.finally.is_some()
    };
    let parent = program.state(id).parent;
    // The step that leaves the condition which counts the tries.
    let of_condition = parent.filter(|parent| matches!(program.state(*parent).kind, StateKind::Condition { .. }));
    is_marked(id)
        || parent.is_some_and(is_marked)
        || of_condition.and_then(|condition| program.state(condition).parent).is_some_and(is_marked)
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
