//! Inserts the states of a library below the state that uses it.
//!
//! States get new ids and paths. If a variable of the library has the same name as one in scope at the state that uses it, the path of that
//! state is put before its name, because the two are unrelated. Generated variables ([`crate::guard`]) are always renamed so, because the
//! library may be used twice.

use crate::expression::{EffectExpr, Expr};
use crate::guard::is_made;
use crate::id::StateId;
use crate::program::{Exceptions, Program, State, StateKind, Target};
use std::collections::{BTreeMap, BTreeSet};

/// Inserts a library's states below the state `at`, which becomes the library's root; `in_sight` are the variables in scope there.
pub(crate) fn graft(states: &mut Vec<State>, at: StateId, library: &Program, in_sight: &BTreeSet<String>) {
    let (path, location) = (states[at.0 as usize].path.clone(), states[at.0 as usize].location);
    let taken = bound(library).into_iter().filter(|name| in_sight.contains(*name) || is_made(name));
    let renamed = taken.map(|name| (name.to_owned(), format!("{path}/{name}"))).collect();
    // The root becomes the state itself; the others are appended.
    let moving = Moving { at, offset: states.len() as u64, renamed };
    for state in library.states.iter().skip(1) {
        let mut state = state.clone();
        state.id = moving.moved(state.id);
        state.parent = state.parent.map(|parent| moving.moved(parent));
        state.path = format!("{path}/{}", state.path);
        state.location = location;
        if library.exceptions == Exceptions::Imprecise {
            state.annotations.exceptions.get_or_insert(Exceptions::Imprecise);
        }
        moving.state(&mut state);
        states.push(state);
    }
    let mut outputs = library.outputs.clone();
    outputs.iter_mut().for_each(|output| output.value.rewrite(&mut |part| moving.expression(part)));
    let children = library.states[0].children().map(|child| moving.moved(child)).collect();
    let root = &mut states[at.0 as usize];
    root.defaults.clone_from(&library.states[0].defaults);
    root.variables.iter_mut().for_each(|(name, _)| moving.variable(name));
    root.kind = StateKind::Sequence { children, outputs };
}

/// Every variable that the program binds, including its parameters.
fn bound(program: &Program) -> BTreeSet<&str> {
    let mut names: BTreeSet<&str> = program.parameters.iter().map(|parameter| parameter.name.as_str()).collect();
    for state in &program.states {
        names.extend(state.variables.iter().map(|(name, _)| name.as_str()));
        match &state.kind {
            StateKind::ForEach { variable, index, .. } => {
                names.extend(std::iter::once(variable).chain(index).map(String::as_str));
            }
            StateKind::While { index, .. } => names.extend(index.iter().map(String::as_str)),
            _ => {}
        }
    }
    names
}

struct Moving {
    at: StateId,
    offset: u64,
    renamed: BTreeMap<String, String>,
}

impl Moving {
    fn expression(&self, expr: &mut Expr) {
        match expr {
            Expr::Port { state, .. } => *state = self.moved(*state),
            Expr::Variable(name) => self.variable(name),
            _ => {}
        }
    }

    fn variable(&self, name: &mut String) {
        if let Some(new) = self.renamed.get(name) {
            name.clone_from(new);
        }
    }

    /// The variables that a quantified effect binds.
    fn quantifiers(&self, effect: &mut EffectExpr) {
        if let EffectExpr::ForEach { variable, effects, .. } = effect {
            self.variable(variable);
            effects.iter_mut().for_each(|inner| self.quantifiers(inner));
        }
    }

    fn moved(&self, id: StateId) -> StateId {
        if id == Program::ROOT { self.at } else { StateId(id.0 - 1 + self.offset) }
    }

    fn ids(&self, list: &mut [StateId]) {
        list.iter_mut().for_each(|id| *id = self.moved(*id));
    }

    fn state(&self, state: &mut State) {
        match &mut state.kind {
            StateKind::Action { .. } => {}
            StateKind::Sequence { children, .. } => self.ids(children),
            StateKind::ForEach { variable, index, body, .. } => {
                self.ids(body);
                std::iter::once(variable).chain(index).for_each(|name| self.variable(name));
            }
            StateKind::While { index, body, .. } => {
                self.ids(body);
                index.iter_mut().for_each(|name| self.variable(name));
            }
            StateKind::Condition { then, otherwise, .. } => {
                self.ids(then);
                self.ids(otherwise);
            }
            StateKind::Concurrency { regions, .. } => self.ids(regions),
        }
        for target in state.transitions.values_mut() {
            if let Target::State(id) = target {
                *id = self.moved(*id);
            }
        }
        state.annotations.each_mark_mut(&mut |marked| *marked = self.moved(*marked));
        state.variables.iter_mut().chain(&mut state.assign).for_each(|(name, _)| self.variable(name));
        state.annotations.effects.values_mut().flatten().for_each(|effect| self.quantifiers(effect));
        state.each_expression_mut(&mut |_, expression| expression.rewrite(&mut |part| self.expression(part)));
    }
}
