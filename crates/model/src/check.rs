//! The rules of `ratn check`, over a program whose names are resolved and the catalogue of a system.
//!
//! One file per family of rules. A rule finds everything that breaks it and says where, what and what to do; loading has
//! found before whatever does not read at all ([`crate::load`]).
//!
//! | file | rules |
//! |---|---|
//! | [`actions`] | unknown-provider, unknown-action, unknown-port, missing-input, unknown-outcome |
//! | [`types`] | type-mismatch |
//! | [`constants`] | invalid-constant |
//! | [`functions`] | unknown-function |
//! | [`flows`] | unservable-flow, branch-may-not-have-written, unknown-state |
//! | [`reach`] | unreachable-state, no-way-out, horizon-too-small, region-conflict, region-unannotated |
//! | [`resources`] | unknown-resource, too-many-resources, indivisible-resource, provider-not-blocked, computes-actuates |
//! | [`deadlock`] | may-deadlock |
//! | [`preconditions`] | unestablished-precondition |
//! | [`ontology`] | unknown-predicate, outside-domain, outside-range |

mod actions;
pub(crate) mod constants;
mod deadlock;
mod flows;
mod functions;
mod graph;
mod ontology;
mod preconditions;
mod reach;
mod resources;
pub(crate) mod types;

use crate::catalogue::Catalogue;
use crate::diagnostic::Findings;
use crate::expression::{EffectExpr, Expr};
use crate::id::StateId;
use crate::load::Places;
use crate::program::{Location, Program, State, StateKind};
use graph::ControlFlow;
use std::collections::BTreeMap;

/// What a rule sees.
pub(crate) struct Subject<'a> {
    pub(crate) program: &'a Program,
    pub(crate) catalogue: &'a Catalogue,
    /// The task says what holds at the start.
    pub(crate) declares_world: bool,
    pub(crate) places: &'a Places,
    pub(crate) control: &'a ControlFlow,
}

/// Applies every rule.
pub(crate) fn check(
    program: &Program,
    catalogue: &Catalogue,
    declares_world: bool,
    places: &Places,
    findings: &mut Findings,
) {
    let control = ControlFlow::of(program);
    let subject = Subject { program, catalogue, declares_world, places, control: &control };
    actions::check(&subject, findings);
    types::check(&subject, findings);
    flows::check(&subject, findings);
    reach::check(&subject, findings);
    resources::check(&subject, findings);
    deadlock::check(&subject, findings);
    functions::check(&subject, findings);
    preconditions::check(&subject, findings);
    ontology::check(&subject, findings);
}

impl<'a> Subject<'a> {
    /// Where a part of a state stands.
    pub(crate) fn place(&self, state: &State, part: &str) -> Location {
        self.places.of(state.id, part, state.location)
    }

    /// The state and those around it, innermost first.
    pub(crate) fn around(&self, id: StateId) -> impl Iterator<Item = &'a State> + use<'a> {
        let program = self.program;
        std::iter::successors(Some(program.state(id)), |state| state.parent.map(|parent| program.state(parent)))
    }
}

/// Every expression of a state with the name of its part.
pub(crate) fn expressions<'a>(program: &'a Program, state: &'a State) -> Vec<(String, &'a Expr)> {
    let mut all: Vec<(String, &Expr)> = Vec::new();
    match &state.kind {
        StateKind::Action { inputs, .. } => all.extend(inputs.iter().map(|(port, e)| (format!("in.{port}"), e))),
        StateKind::Sequence { outputs, .. } => {
            let own = if state.id == Program::ROOT { &program.outputs } else { outputs };
            all.extend(own.iter().map(|o| (format!("outputs.{}", o.name), &o.value)));
        }
        StateKind::ForEach { collection, .. } => all.push(("for".to_owned(), collection)),
        StateKind::While { predicate, .. } => all.push(("while".to_owned(), predicate)),
        StateKind::Concurrency { decide, outputs, .. } => {
            all.extend(decide.iter().map(|(outcome, e)| (format!("decide.{outcome}"), e)));
            all.extend(outputs.iter().map(|o| (format!("outputs.{}", o.name), &o.value)));
        }
        StateKind::Condition { predicate, .. } => all.push(("condition".to_owned(), predicate)),
    }
    all.extend(state.variables.iter().map(|(name, e)| (format!("variables.{name}"), e)));
    all.extend(state.assign.iter().map(|(name, e)| (format!("assign.{name}"), e)));
    let annotations = &state.annotations;
    all.extend(annotations.requires.iter().enumerate().map(|(i, e)| (format!("requires.{i}"), e)));
    all.extend(annotations.duration_s.iter().map(|e| ("duration".to_owned(), e)));
    for (i, resource) in annotations.resources.iter().enumerate() {
        all.extend(resource.expressions().map(|e| (format!("resources.{i}"), e)));
    }
    let facts = annotations.reads.iter().flatten().map(|fact| ("reads", fact));
    let senses = match &annotations.nature {
        crate::program::Nature::Senses(facts) => facts.as_slice(),
        _ => &[],
    };
    for (part, fact) in facts.chain(senses.iter().map(|fact| ("senses", fact))) {
        all.extend(fact.arguments.iter().flatten().map(|e| (part.to_owned(), e)));
    }
    for (outcome, effects) in &annotations.effects {
        effects.iter().for_each(|effect| effect_expressions(effect, &format!("effects.{outcome}"), &mut all));
    }
    all
}

pub(crate) fn effect_expressions<'a>(effect: &'a EffectExpr, part: &str, all: &mut Vec<(String, &'a Expr)>) {
    let (fact, value) = match effect {
        EffectExpr::Set(fact, value) | EffectExpr::Increase(fact, value) => (Some(fact), Some(value)),
        EffectExpr::Delete(fact) => (Some(fact), None),
        EffectExpr::ForEach { collection, effects, .. } => {
            effects.iter().for_each(|inner| effect_expressions(inner, part, all));
            (None, Some(collection))
        }
    };
    all.extend(fact.into_iter().flat_map(|f| f.arguments.iter().flatten()).map(|e| (part.to_owned(), e)));
    all.extend(value.map(|e| (part.to_owned(), e)));
}

/// An expression with the names of states instead of their ids.
pub(crate) fn named(program: &Program, expr: &Expr) -> String {
    let mut text = expr.to_string();
    for id in expr.flows() {
        text = text.replace(&format!("{id}."), &format!("{}.", program.state(id).name));
    }
    text
}

/// The children of a state by branch.
pub(crate) fn branches(state: &State) -> [&[StateId]; 2] {
    match &state.kind {
        StateKind::Action { .. } => [&[], &[]],
        StateKind::Sequence { children, .. } => [children, &[]],
        StateKind::ForEach { body, .. } | StateKind::While { body, .. } => [body, &[]],
        StateKind::Concurrency { regions, .. } => [regions, &[]],
        StateKind::Condition { then, otherwise, .. } => [then, otherwise],
    }
}

/// The types of the variables that a state sees.
pub(crate) type Variables = BTreeMap<String, crate::value::Type>;
