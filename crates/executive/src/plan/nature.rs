//! The nature of a node: whether it computes, senses or acts on the environment.

use super::resources::operated;
use super::{Subject, footprint};
use ratn_model::expression::scope::NothingKnown;
use ratn_model::expression::{EffectExpr, FactExpr};
use ratn_model::fact::Footprint;
use ratn_model::program::{Nature, State, StateKind};
use serde::{Deserialize, Serialize};

/// A node's effect on the environment. A routine computes if all its parts compute and it shares no facts with regions beside it, else it is
/// irreversible.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub(crate) enum NodeNature {
    /// Works on a projection.
    Computes,
    /// Looks at the environment.
    Senses,
    /// A potentially irreversible action.
    Irreversible,
}

/// The nature of a node; `crossing`: the facts through which regions may affect each other.
pub(super) fn of(subject: &Subject<'_>, crossing: &Footprint) -> NodeNature {
    match of_parts(subject) {
        // Each of its parts uses the facts as the regions beside it have left them by then, so it runs at its place in the program.
        NodeNature::Computes if subject.is_routine() && shares_facts(subject, crossing) => NodeNature::Irreversible,
        nature => nature,
    }
}

/// The nature of a node without regard to the regions beside it.
pub(super) fn of_parts(subject: &Subject<'_>) -> NodeNature {
    match subject.contained.iter().map(|state| own(state)).max() {
        // It may sense what it has just changed, so it runs at its place in the program.
        Some(NodeNature::Senses) if subject.contains_others() => NodeNature::Irreversible,
        nature => nature.unwrap_or(NodeNature::Computes),
    }
}

/// Whether a node is in a region, or is one, and uses or changes facts of `crossing`.
fn shares_facts(subject: &Subject<'_>, crossing: &Footprint) -> bool {
    let is_concurrency = |state: &&State| matches!(state.kind, StateKind::Concurrency { .. });
    if crossing.is_nothing() || !subject.around.iter().any(is_concurrency) {
        return false;
    }
    let reads = footprint::reads(subject, &[]);
    let reads = reads.map_or(Footprint::Everything, |facts| FactExpr::footprint(&facts, &NothingKnown));
    let writes = footprint::may_write(subject);
    let writes = writes.map_or(Footprint::Everything, |effects| EffectExpr::footprint(&effects, &NothingKnown));
    reads.union(writes).overlaps(crossing)
}

/// The nature of a state without its parts.
pub(super) fn own(state: &State) -> NodeNature {
    if operated(state).next().is_some() {
        return NodeNature::Irreversible;
    }
    match (&state.kind, &state.annotations.nature) {
        (StateKind::Action { .. }, Nature::Irreversible) => NodeNature::Irreversible,
        (StateKind::Action { .. }, Nature::Senses(_)) => NodeNature::Senses,
        _ => NodeNature::Computes,
    }
}
