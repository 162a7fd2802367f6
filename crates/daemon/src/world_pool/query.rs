//! A query of one world: what it shows, found away from the actor's thread.
//!
//! The actor only says which world is asked, and what of it is shown; worlds share what they have in common, so that costs nothing. The
//! facts are looked for by the call itself: in order, from where a page begins to where it is full. However much there is, commits and
//! projections of others do not wait for it.
//!
//! A query that goes through the world once is answered, whatever the size of that. Several patterns may look at a fact many
//! times, and are refused where they do so more than [`MORE`] times.

use ratn_model::fact::{FactKey, FactPattern, Footprint};
use ratn_model::id::Revision;
pub(super) use ratn_world::search::Found;
use ratn_world::world::{Fact, World};

/// Looks at facts, beyond one at each fact of the world.
pub(super) const MORE: usize = 2_000_000;

/// What is asked.
#[derive(Debug, Clone)]
pub(super) struct View {
    pub(super) world: World,
    /// Of the root, or of the root below the projection.
    pub(super) revision: Revision,
    pub(super) shown: Footprint,
}

/// A query that looks at more than it may.
#[derive(Debug, thiserror::Error)]
#[error(
    "the query looks at more than {most} facts: as many as there are, and {MORE} more; ask with fewer patterns, or name the subject or \
     the object in them"
)]
pub(super) struct TooMuch {
    most: usize,
}

impl View {
    /// How many facts a query may look at.
    pub(super) fn most(&self) -> usize {
        self.world.len().saturating_add(MORE)
    }

    /// Why it is not answered where it would look at more.
    pub(super) fn too_much(&self) -> TooMuch {
        TooMuch { most: self.most() }
    }

    /// Visits the facts that match any of the patterns, in the order of keys, each once, until told to stop; without a pattern all that
    /// is shown. No more than `most` facts are looked at, those that do not match included; without a pattern all are.
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
