//! The facts that a goal sees: all of the actual world, or only the facts read of a projection.
//!
//! Read are the facts in `reads` (also of the states around) and those that the state's own expressions look up; an argument without
//! a value before the goal stands for any argument. A sensing state also reads what it senses.

use super::Reference;
use super::evaluate::{Place, Read, term};
use super::facts::{Facts, fits};
use ratn_model::expression::{Expr, FactExpr};
use ratn_model::fact::FactPattern;
use ratn_model::program::{Nature, State, StateKind, WORLD_MODEL};
use ratn_model::resource::ResourceOperation;

impl Reference<'_> {
    /// The facts that a goal of this action sees.
    pub(super) fn shown(&self, state: &State, place: &Place<'_>) -> Facts {
        let around: Vec<&State> =
            std::iter::successors(Some(state), |s| s.parent.map(|id| self.program.state(id))).collect();
        let blocks = around.iter().flat_map(|s| &s.annotations.resources);
        let mut blocks = blocks.filter(|line| line.operation == ResourceOperation::Block);
        if !blocks.any(|line| line.kind == WORLD_MODEL) {
            return self.result.facts.clone();
        }
        if state.annotations.reads.is_none() && !matches!(state.annotations.nature, Nature::Senses(_)) {
            return self.result.facts.clone();
        }
        let mut read: Vec<&FactExpr> = around.iter().flat_map(|s| s.annotations.reads.iter().flatten()).collect();
        read.extend(state.annotations.senses());
        let mut expressions: Vec<&Expr> = state.assign.iter().map(|(_, value)| value).collect();
        if let StateKind::Action { inputs, .. } = &state.kind {
            expressions.extend(inputs.iter().map(|(_, value)| value));
        }
        expressions.extend(&state.annotations.requires);
        expressions.extend(around.iter().flat_map(|s| &s.annotations.resources).flat_map(|line| line.expressions()));
        for expression in expressions {
            expression.visit(&mut |part| {
                if let Expr::Fact(fact) | Expr::Exists(fact) = part {
                    read.push(fact);
                }
            });
        }
        let patterns: Vec<FactPattern> = read.into_iter().map(|fact| as_far_as_known(fact, place)).collect();
        let facts = self.result.facts.iter().filter(|(key, _)| patterns.iter().any(|pattern| fits(pattern, key)));
        facts.map(|(key, value)| (key.clone(), value.clone())).collect()
    }
}

fn as_far_as_known(fact: &FactExpr, place: &Place<'_>) -> FactPattern {
    let known = |argument: &Expr| argument.read(place).ok().and_then(|value| term(&value).ok());
    let arguments = fact.arguments.iter().map(|argument| argument.as_ref().and_then(known)).collect();
    FactPattern { predicate: fact.predicate.clone(), arguments }
}
