//! A query of one world, evaluated outside the actor's thread.
//!
//! The actor only determines the world and its visible part; worlds share their common data, so that costs nothing. The call itself
//! searches the facts, in order, from the beginning of a page until it is full. So commits and projections of other callers do not
//! wait, however large the world is.
//!
//! A query that goes through the world once is answered, whatever the size of the world. Several patterns may look at a fact many
//! times; the query is refused where that takes more than [`MORE`] further looks.

use ratn_model::fact::{FactKey, FactPattern, Footprint};
use ratn_model::id::Revision;
pub(super) use ratn_world::search::Found;
use ratn_world::world::{Fact, World};

/// Allowed looks at facts, beyond one look at each fact of the world.
pub(super) const MORE: usize = 2_000_000;

/// The world that a query asks, and the visible part.
#[derive(Debug, Clone)]
pub(super) struct View {
    pub(super) world: World,
    /// The revision of the root, or of the projection's base.
    pub(super) revision: Revision,
    pub(super) shown: Footprint,
}

/// The query would look at too many facts.
#[derive(Debug, thiserror::Error)]
#[error(
    "the query looks at more than {most} facts: as many as there are, and {MORE} more; ask with fewer patterns, or name the subject or \
     the object in them"
)]
pub(super) struct TooMuch {
    most: usize,
}

impl View {
    /// Maximum number of facts that a query may look at.
    pub(super) fn most(&self) -> usize {
        self.world.len().saturating_add(MORE)
    }

    /// The refusal of a query that would look at more.
    pub(super) fn too_much(&self) -> TooMuch {
        TooMuch { most: self.most() }
    }

    /// Visits the facts that match any of the patterns, each once, in the order of keys, until `visit` says stop; without a pattern all
    /// visible facts. At most `most` facts are looked at, those that do not match included; without a pattern there is no limit.
    pub(super) fn find(
        &self,
        patterns: &[FactPattern],
        most: usize,
        visit: &mut dyn FnMut(&FactKey, &Fact) -> bool,
    ) -> Found {
        if patterns.is_empty() {
            let shown = self.world.iter().filter(|(key, _)| self.shown.contains(key));
            for (key, fact) in shown {
                if !visit(key, fact) {
                    break;
                }
            }
            return Found::All;
        }
        self.world.search(patterns, most, visit)
    }
}

#[cfg(test)]
mod tests {
    #[test]
    fn a_query_that_is_refused_hears_how_much_it_may_look_at() {
        use super::*;
        use ratn_model::fact::Term;
        use ratn_model::value::Value;
        let fact = |i| (FactKey { predicate: "p".to_owned(), arguments: vec![Term::Int(i)] }, Value::Int(i));
        let world = World::from_facts((0..1_000).map(fact), Revision(3));
        let message = View { world, revision: Revision(3), shown: Footprint::Everything }.too_much().to_string();
        assert!(message.contains("more than 2001000 facts: as many as there are, and 2000000 more"), "{message}");
    }
}
