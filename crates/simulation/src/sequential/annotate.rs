//! Missing annotations of states, and their values if nothing unnamed is read or changed.

use ratn_model::catalogue::Catalogue;
use ratn_model::expression::FactExpr;
use ratn_model::id::StateId;
use ratn_model::program::{Annotations, Nature, Program, SUCCESS, State, StateKind};
use ratn_model::resource::ResourceOperation;
use ratn_model::slot::Slot;

/// The missing annotations of an action, in the words of task files; empty for other states.
pub(super) fn missing(program: &Program, catalogue: &Catalogue, id: StateId) -> Vec<&'static str> {
    let state = program.state(id);
    let annotations = &state.annotations;
    if !matches!(state.kind, StateKind::Action { .. }) || state.is_pause() {
        return Vec::new();
    }
    let mut missing = Vec::new();
    if annotations.reads.is_none() && !matches!(annotations.nature, Nature::Senses(_)) {
        missing.push("reads");
    }
    if annotations.nature != Nature::Computes && !annotations.effects.contains_key(SUCCESS) {
        missing.push("effects");
    }
    if could_compute(program, catalogue, state) {
        missing.push("computes");
    }
    missing
}

/// Whether no annotation of an irreversible action prevents it from being a computing one.
fn could_compute(program: &Program, catalogue: &Catalogue, state: &State) -> bool {
    let Annotations { nature, effects, .. } = &state.annotations;
    let around = std::iter::successors(Some(state), |state| state.parent.map(|parent| program.state(parent)));
    let acts = around.flat_map(|state| &state.annotations.resources).any(|resource| match resource.operation {
        ResourceOperation::Block => catalogue.resources.get(&resource.kind).is_some_and(|offer| offer.actuates),
        ResourceOperation::Exists => false,
        _ => true,
    });
    *nature == Nature::Irreversible && !acts && effects.values().all(Vec::is_empty)
}

/// The program with these states annotated: they read and change only what they name.
pub(super) fn annotated(program: &Program, catalogue: &Catalogue, ids: &[StateId]) -> Program {
    let mut annotated = program.clone();
    for id in ids {
        let computes = could_compute(program, catalogue, program.state(*id));
        let state = &mut annotated.states[id.0 as usize];
        let named = named_facts(state);
        state.annotations.reads.get_or_insert(named);
        state.annotations.effects.entry(SUCCESS.to_owned()).or_default();
        if computes {
            state.annotations.nature = Nature::Computes;
        }
    }
    annotated
}

/// The facts that its inputs and preconditions look up.
fn named_facts(state: &State) -> Vec<FactExpr> {
    let named = state.expressions().into_iter().filter(|(slot, _)| matches!(slot, Slot::Input(_) | Slot::Requires(_)));
    named.flat_map(|(_, expression)| expression.fact_expressions()).cloned().collect()
}
