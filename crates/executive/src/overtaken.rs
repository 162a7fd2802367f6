//! Whether what a run has decided, and has not committed yet, is still true when it comes back without what it held.

use ratn_model::expression::EffectExpr;
use ratn_model::fact::{Change, FactKey};
use ratn_model::program::Program;

/// Whether somebody else has changed, in this fact, what changes of a state overwrite or are made of. `writer` is its path, with visits.
#[must_use]
pub fn was_overtaken(program: &Program, writer: &str, changes: &[Change], key: &FactKey) -> bool {
    let parts = writer.split('/').map(|part| part.split(['[', '#']).next().unwrap_or(part));
    let path = parts.collect::<Vec<_>>().join("/");
    let state = program.states.iter().find(|state| state.path == path);
    let effects = state.into_iter().flat_map(|state| state.annotations.effects.values());
    let mut looked_up = effects.flat_map(|effects| EffectExpr::fact_expressions(effects));
    changes.iter().any(|change| change.pattern().matches(key)) || looked_up.any(|fact| fact.predicate == key.predicate)
}
