//! Functional predicates: changes are refused that would give a subject two facts of one.

use crate::world::World;
use ratn_model::fact::{Change, FactKey};
use ratn_model::ontology::{Ontology, Violation};
use ratn_model::value::Value;

impl World {
    /// Whether the ontology allows this world to change so: each change by itself ([`Ontology::check_changes`]), and what holds
    /// afterwards. Costs the changes. Changes that do not apply are the business of [`World::apply`].
    ///
    /// # Errors
    /// The rule that is broken first.
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
