//! Functional predicates: refuses changes that would give a subject two facts of such a predicate.

use crate::world::World;
use ratn_model::fact::{Change, FactKey};
use ratn_model::ontology::{Ontology, Violation};
use ratn_model::value::Value;

impl World {
    /// Whether the ontology allows these changes: each change by itself ([`Ontology::check_changes`]), and the facts that hold
    /// afterwards. Costs the changes. Changes that cannot be applied are reported by [`World::apply`].
    ///
    /// # Errors
    /// The first violated rule.
    pub fn admits(&self, ontology: &Ontology, changes: &[Change]) -> Result<(), Violation> {
        ontology.check_changes(changes)?;
        let is_functional = |change: &Change| match change {
            Change::Set { fact, .. } => ontology.rivals(fact).is_some(),
            _ => false,
        };
        if !changes.iter().any(is_functional) {
            return Ok(());
        }
        let Ok(after) = self.project(changes) else { return Ok(()) };
        let holds = |fact: &FactKey| !matches!(after.get(fact), None | Some(Value::Null | Value::Bool(false)));
        for change in changes {
            let Change::Set { fact, .. } = change else { continue };
            let Some(rivals) = ontology.rivals(fact).filter(|_| holds(fact)) else { continue };
            let rival = after.matching(&rivals).map(|(rival, _)| rival).find(|rival| *rival != fact && holds(rival));
            if let Some(rival) = rival {
                return Err(Violation::not_functional(fact, rival));
            }
        }
        Ok(())
    }
}
