//! Removes facts from an action's annotations whose predicate the task's ontology does not have, or has with another number of arguments: a fact
//! that cannot exist can neither be read nor change.

use crate::expression::{EffectExpr, Expr, FactExpr};
use crate::ontology::Ontology;
use crate::program::ResourceExpr;
use std::collections::BTreeMap;

/// The value of one of an action's annotations.
pub(super) trait OfAction {
    /// Removes facts that the ontology does not allow.
    fn leave_out(&mut self, _: &Ontology) {}
}

impl OfAction for Vec<FactExpr> {
    fn leave_out(&mut self, ontology: &Ontology) {
        self.retain(|fact| can_be(ontology, fact));
    }
}

/// Requirements.
impl OfAction for Vec<Expr> {
    fn leave_out(&mut self, ontology: &Ontology) {
        self.retain(|required| required.fact_expressions().into_iter().all(|fact| can_be(ontology, fact)));
    }
}

/// Effects by outcome.
impl OfAction for BTreeMap<String, Vec<EffectExpr>> {
    fn leave_out(&mut self, ontology: &Ontology) {
        self.values_mut().for_each(|effects| retain(ontology, effects));
    }
}

impl OfAction for Vec<ResourceExpr> {}

/// A duration.
impl OfAction for Option<Expr> {}

fn retain(ontology: &Ontology, effects: &mut Vec<EffectExpr>) {
    effects.retain_mut(|effect| match effect {
        EffectExpr::Set(fact, _) | EffectExpr::Delete(fact) | EffectExpr::Increase(fact, _) => can_be(ontology, fact),
        EffectExpr::ForEach { effects, .. } => {
            retain(ontology, effects);
            !effects.is_empty()
        }
    });
}

fn can_be(ontology: &Ontology, fact: &FactExpr) -> bool {
    ontology.predicate(&fact.predicate).is_some_and(|predicate| predicate.domain.len() == fact.arguments.len())
}
