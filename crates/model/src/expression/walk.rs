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

    /// Calls `visit` for every direct part.
    pub(crate) fn parts<'a>(&'a self, visit: &mut dyn FnMut(&'a Expr)) {
        match self {
            Expr::Literal(_)
            | Expr::Variable(_)
            | Expr::Output(_)
            | Expr::Port { .. }
            | Expr::Unknown(_)
            | Expr::Element(_) => {}
            Expr::Field(of, _) | Expr::Unary(_, of) => visit(of),
            Expr::Each { list, body, .. } => {
                visit(list);
                visit(body);
            }
            Expr::Index(a, b) | Expr::Binary(_, a, b) => {
                visit(a);
                visit(b);
            }
            Expr::List(items) | Expr::Call(_, items) | Expr::Query(items) | Expr::Find(_, items) => {
                items.iter().for_each(visit)
            }
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

impl Expr {
    /// Calls `change` for every part of this expression, innermost first, and then for the expression itself.
    pub fn rewrite(&mut self, change: &mut dyn FnMut(&mut Expr)) {
        match self {
            Expr::Literal(_)
            | Expr::Variable(_)
            | Expr::Output(_)
            | Expr::Port { .. }
            | Expr::Unknown(_)
            | Expr::Element(_) => {}
            Expr::Field(of, _) | Expr::Unary(_, of) => of.rewrite(change),
            Expr::Each { list, body, .. } => {
                list.rewrite(change);
                body.rewrite(change);
            }
            Expr::Index(a, b) | Expr::Binary(_, a, b) => {
                a.rewrite(change);
                b.rewrite(change);
            }
            Expr::List(items) | Expr::Call(_, items) | Expr::Query(items) | Expr::Find(_, items) => {
                items.iter_mut().for_each(|item| item.rewrite(change))
            }
            Expr::Map(fields) => fields.iter_mut().for_each(|(_, item)| item.rewrite(change)),
            Expr::Fact(fact) | Expr::Exists(fact) => {
                fact.arguments.iter_mut().flatten().for_each(|argument| argument.rewrite(change));
            }
        }
        change(self);
    }
}

impl EffectExpr {
    /// The facts that the effects look up (not those that they write).
    pub fn fact_expressions(effects: &[EffectExpr]) -> Vec<&FactExpr> {
        let mut facts = Vec::new();
        for effect in effects {
            effect.each_expression(&mut |expression| facts.extend(expression.fact_expressions()));
        }
        facts
    }
}
