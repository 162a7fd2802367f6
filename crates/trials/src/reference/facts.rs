//! The facts that hold, in a map that is always searched completely.

use ratn_model::fact::{FactKey, FactPattern, Term};
use ratn_model::value::Value;
use std::collections::BTreeMap;

/// The facts that hold, in the order of keys.
pub(super) type Facts = BTreeMap<FactKey, Value>;

/// Whether a key has the pattern's predicate, arity and given arguments.
pub(super) fn fits(pattern: &FactPattern, key: &FactKey) -> bool {
    if pattern.predicate != key.predicate || pattern.arguments.len() != key.arguments.len() {
        return false;
    }
    for (wanted, there) in pattern.arguments.iter().zip(&key.arguments) {
        match wanted {
            Some(Term::Int(i)) if *there != Term::Int(*i) => return false,
            Some(Term::Name(name)) if *there != Term::Name(name.clone()) => return false,
            _ => {}
        }
    }
    true
}

/// The facts that match, in the order of keys.
pub(super) fn fitting<'f>(
    facts: &'f Facts,
    pattern: &'f FactPattern,
) -> impl Iterator<Item = (&'f FactKey, &'f Value)> {
    facts.iter().filter(|(key, _)| fits(pattern, key))
}
