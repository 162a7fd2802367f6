//! What an expression mentions: outputs of other states, facts, variables.

use super::{EffectExpr, Expr, FactExpr};
use crate::id::StateId;
use std::collections::BTreeSet;

impl Expr {
    /// Calls `visit` for this expression and every part of it, outermost first.
    pub fn visit<'a>(&'a self, visit: &mut dyn FnMut(&'a Expr)) {
        visit(self);
        match self {
            Expr::Literal(_) | Expr::Variable(_) | Expr::Output(_) | Expr::Port { .. } => {}
            Expr::Field(of, _) | Expr::Unary(_, of) => of.visit(visit),
            Expr::Index(a, b) | Expr::Binary(_, a, b) => {
                a.visit(visit);
                b.visit(visit);
            }
            Expr::List(items) | Expr::Call(_, items) => items.iter().for_each(|item| item.visit(visit)),
            Expr::Map(fields) => fields.iter().for_each(|(_, item)| item.visit(visit)),
            Expr::Fact(fact) | Expr::Exists(fact) => fact.visit(visit),
        }
    }

    /// The states whose outputs it uses.
    pub fn flows(&self) -> BTreeSet<StateId> {
        let mut states = BTreeSet::new();
        self.visit(&mut |part| {
            if let Expr::Port { state, .. } = part {
                states.insert(*state);
            }
        });
        states
    }

    /// The facts that it reads, outermost first.
    pub fn fact_expressions(&self) -> Vec<&FactExpr> {
        let mut facts = Vec::new();
        self.visit(&mut |part| {
            if let Expr::Fact(fact) | Expr::Exists(fact) = part {
                facts.push(fact);
            }
        });
        facts
    }

    /// The variables that it uses, without `$`.
    pub fn variables(&self) -> BTreeSet<&str> {
        let mut names = BTreeSet::new();
        self.visit(&mut |part| {
            if let Expr::Variable(name) = part {
                names.insert(name.as_str());
            }
        });
        names
    }
}

impl Expr {
    /// Names other states: where one program's states are put into another.
    pub(crate) fn move_states(&mut self, moved: &dyn Fn(StateId) -> StateId) {
        match self {
            Expr::Literal(_) | Expr::Variable(_) | Expr::Output(_) => {}
            Expr::Port { state, .. } => *state = moved(*state),
            Expr::Field(of, _) | Expr::Unary(_, of) => of.move_states(moved),
            Expr::Index(a, b) | Expr::Binary(_, a, b) => {
                a.move_states(moved);
                b.move_states(moved);
            }
            Expr::List(items) | Expr::Call(_, items) => items.iter_mut().for_each(|item| item.move_states(moved)),
            Expr::Map(fields) => fields.iter_mut().for_each(|(_, item)| item.move_states(moved)),
            Expr::Fact(fact) | Expr::Exists(fact) => fact.move_states(moved),
        }
    }
}

impl FactExpr {
    /// As [`Expr::move_states`].
    pub(crate) fn move_states(&mut self, moved: &dyn Fn(StateId) -> StateId) {
        self.arguments.iter_mut().flatten().for_each(|argument| argument.move_states(moved));
    }

    /// Calls `visit` for every argument and every part of it.
    pub fn visit<'a>(&'a self, visit: &mut dyn FnMut(&'a Expr)) {
        self.arguments.iter().flatten().for_each(|argument| argument.visit(visit));
    }
}

impl EffectExpr {
    /// As [`Expr::move_states`].
    pub(crate) fn move_states(&mut self, moved: &dyn Fn(StateId) -> StateId) {
        match self {
            EffectExpr::Set(fact, value) | EffectExpr::Increase(fact, value) => {
                fact.move_states(moved);
                value.move_states(moved);
            }
            EffectExpr::Delete(fact) => fact.move_states(moved),
            EffectExpr::ForEach { collection, effects, .. } => {
                collection.move_states(moved);
                effects.iter_mut().for_each(|effect| effect.move_states(moved));
            }
        }
    }

    /// Calls `visit` for every expression in the effect and every part of it.
    pub fn visit<'a>(&'a self, visit: &mut dyn FnMut(&'a Expr)) {
        match self {
            EffectExpr::Set(fact, value) | EffectExpr::Increase(fact, value) => {
                fact.visit(visit);
                value.visit(visit);
            }
            EffectExpr::Delete(fact) => fact.visit(visit),
            EffectExpr::ForEach { collection, effects, .. } => {
                collection.visit(visit);
                effects.iter().for_each(|effect| effect.visit(visit));
            }
        }
    }

    /// The states whose outputs the effects use.
    pub fn flows(effects: &[EffectExpr]) -> BTreeSet<StateId> {
        let mut states = BTreeSet::new();
        effects.iter().for_each(|effect| {
            effect.visit(&mut |part| {
                if let Expr::Port { state, .. } = part {
                    states.insert(*state);
                }
            });
        });
        states
    }

    /// The facts that the effects read (not those that they write).
    pub fn fact_expressions(effects: &[EffectExpr]) -> Vec<&FactExpr> {
        let mut facts = Vec::new();
        effects.iter().for_each(|effect| {
            effect.visit(&mut |part| {
                if let Expr::Fact(fact) | Expr::Exists(fact) = part {
                    facts.push(fact);
                }
            });
        });
        facts
    }
}
