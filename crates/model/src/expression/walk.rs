//! What an expression mentions: outputs of other states, facts, variables.

use super::{EffectExpr, Expr, FactExpr};
use crate::id::StateId;
use std::collections::BTreeSet;

impl Expr {
    /// Calls `visit` for this expression and every part of it, outermost first.
    pub fn visit<'a>(&'a self, visit: &mut dyn FnMut(&'a Expr)) {
        visit(self);
        self.parts(&mut |part| part.visit(visit));
    }

    /// Calls `visit` for every expression that it is directly made of.
    pub(crate) fn parts<'a>(&'a self, visit: &mut dyn FnMut(&'a Expr)) {
        match self {
            Expr::Literal(_) | Expr::Variable(_) | Expr::Output(_) | Expr::Port { .. } | Expr::Unknown(_) => {}
            Expr::Field(of, _) | Expr::Unary(_, of) => visit(of),
            Expr::Index(a, b) | Expr::Binary(_, a, b) => {
                visit(a);
                visit(b);
            }
            Expr::List(items) | Expr::Call(_, items) | Expr::Query(items) => items.iter().for_each(visit),
            Expr::Map(fields) => fields.iter().for_each(|(_, item)| visit(item)),
            Expr::Fact(fact) | Expr::Exists(fact) => fact.arguments.iter().flatten().for_each(visit),
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

/// What puts the expressions of one program into another changes.
pub(crate) trait Rewrite {
    /// An expression whose parts have been rewritten.
    fn expression(&mut self, expr: &mut Expr);
    /// A name where it is bound.
    fn variable(&mut self, name: &mut String);
}

impl Expr {
    /// Rewrites every part of it, innermost first, and then itself.
    pub(crate) fn rewrite(&mut self, rewrite: &mut dyn Rewrite) {
        match self {
            Expr::Literal(_) | Expr::Variable(_) | Expr::Output(_) | Expr::Port { .. } | Expr::Unknown(_) => {}
            Expr::Field(of, _) | Expr::Unary(_, of) => of.rewrite(rewrite),
            Expr::Index(a, b) | Expr::Binary(_, a, b) => {
                a.rewrite(rewrite);
                b.rewrite(rewrite);
            }
            Expr::List(items) | Expr::Call(_, items) | Expr::Query(items) => {
                items.iter_mut().for_each(|item| item.rewrite(rewrite))
            }
            Expr::Map(fields) => fields.iter_mut().for_each(|(_, item)| item.rewrite(rewrite)),
            Expr::Fact(fact) | Expr::Exists(fact) => fact.rewrite(rewrite),
        }
        rewrite.expression(self);
    }
}

impl FactExpr {
    /// As [`Expr::rewrite`].
    pub(crate) fn rewrite(&mut self, rewrite: &mut dyn Rewrite) {
        self.arguments.iter_mut().flatten().for_each(|argument| argument.rewrite(rewrite));
    }

    /// Calls `visit` for every argument and every part of it.
    pub fn visit<'a>(&'a self, visit: &mut dyn FnMut(&'a Expr)) {
        self.arguments.iter().flatten().for_each(|argument| argument.visit(visit));
    }
}

impl EffectExpr {
    /// As [`Expr::rewrite`].
    pub(crate) fn rewrite(&mut self, rewrite: &mut dyn Rewrite) {
        match self {
            EffectExpr::Set(fact, value) | EffectExpr::Increase(fact, value) => {
                fact.rewrite(rewrite);
                value.rewrite(rewrite);
            }
            EffectExpr::Delete(fact) => fact.rewrite(rewrite),
            EffectExpr::ForEach { variable, collection, effects } => {
                rewrite.variable(variable);
                collection.rewrite(rewrite);
                effects.iter_mut().for_each(|effect| effect.rewrite(rewrite));
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
