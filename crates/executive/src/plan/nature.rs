//! The nature of a node: whether it computes, senses or acts on the environment.

use super::Subject;
use super::resources::operated;
use ratn_model::program::{Nature, State, StateKind};
use serde::{Deserialize, Serialize};

/// A node's effect on the environment. A routine computes if all its parts compute, else it is irreversible.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub(crate) enum NodeNature {
    /// Works on a projection.
    Computes,
    /// Looks at the environment.
    Senses,
    /// A potentially irreversible action.
    Irreversible,
}

pub(super) fn of(subject: &Subject<'_>) -> NodeNature {
    match subject.contained.iter().map(|state| own(state)).max() {
        // It may sense what it has just changed, so it runs at its place in the program.
        Some(NodeNature::Senses) if subject.contains_others() => NodeNature::Irreversible,
        nature => nature.unwrap_or(NodeNature::Computes),
    }
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
