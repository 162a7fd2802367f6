//! The rules of `ratn check`, over a program whose names are resolved and the catalogue of a system.
//!
//! One file per family of rules. A rule reports every violation: where it is, what is wrong and what to do. Whatever
//! cannot be parsed has been reported by loading before ([`crate::load`]).
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
mod ways;

use crate::catalogue::Catalogue;
use crate::diagnostic::Findings;
use crate::expression::Expr;
use crate::id::StateId;
use crate::load::Places;
use crate::program::{Location, Program, State, StateKind};
use crate::slot::Slot;
use crate::value::Value;
use graph::ControlFlow;
use std::collections::BTreeMap;

/// The input of every rule.
pub(crate) struct Subject<'a> {
    pub(crate) program: &'a Program,
    pub(crate) catalogue: &'a Catalogue,
    /// Whether the task declares its initial world.
    pub(crate) declares_world: bool,
    /// Whether the run begins at another state than the first; then unreachable states are no mistake.
    pub(crate) begins_elsewhere: bool,
    pub(crate) places: &'a Places,
    /// The functions of the file: name, usage, number of arguments.
    pub(crate) functions: &'a [(String, String, usize)],
    pub(crate) control: &'a ControlFlow,
}

/// What the rules need besides the program.
pub(crate) struct Said<'a> {
    /// Whether the task declares its initial world.
    pub(crate) declares_world: bool,
    /// Whether the run begins at another state than the first; then unreachable states are no mistake.
    pub(crate) begins_elsewhere: bool,
    pub(crate) places: &'a Places,
    /// The functions of the file.
    pub(crate) functions: &'a [(String, String, usize)],
}

/// Applies every rule.
pub(crate) fn check(program: &Program, catalogue: &Catalogue, said: &Said<'_>, findings: &mut Findings) {
    let control = ControlFlow::of(program);
    let Said { declares_world, begins_elsewhere, places, functions } = *said;
    let subject =
        Subject { program, catalogue, declares_world, begins_elsewhere, places, functions, control: &control };
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
    pub(crate) fn place(&self, state: &State, part: &str) -> Location {
        self.places.of(state.id, part, state.location)
    }

    pub(crate) fn place_of(&self, state: &State, slot: Slot<'_>) -> Location {
        self.place(state, &slot.to_string())
    }

    /// The state and those around it, innermost first.
    pub(crate) fn around(&self, id: StateId) -> impl Iterator<Item = &'a State> + use<'a> {
        let program = self.program;
        std::iter::successors(Some(program.state(id)), |state| state.parent.map(|parent| program.state(parent)))
    }
}

/// Every expression of a state that is evaluated at run time. Facts that regions share (`shared`) are only compared.
pub(crate) fn expressions<'a>(program: &'a Program, state: &'a State) -> Vec<(Slot<'a>, &'a Expr)> {
    let mut all = program.expressions(state);
    all.retain(|(slot, _)| *slot != Slot::Shared);
    all
}

/// An expression with the names of states instead of their ids.
pub(crate) fn named(program: &Program, expr: &Expr) -> String {
    let mut named = expr.clone();
    named.rewrite(&mut |part| name_state(program, part));
    named.to_string()
}

/// Replaces a state's id by its name in an output, for display.
pub(crate) fn name_state(program: &Program, part: &mut Expr) {
    if let Expr::Port { state, port } = part {
        let name = Expr::Literal(Value::String(program.state(*state).name.clone()));
        *part = Expr::Field(Box::new(name), std::mem::take(port));
    }
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

/// The types of the variables in scope in a state.
pub(crate) type Variables = BTreeMap<String, crate::value::Type>;
