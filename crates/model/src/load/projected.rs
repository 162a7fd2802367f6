//! Implied projections. A computing or sensing state may begin before older states have ended; without a projection it would see a world without
//! their effects. So a state that reads facts blocks room for a projection, even if the file does not say so.

use crate::id::StateId;
use crate::program::{Annotations, Nature, Origin, ResourceExpr, State, StateKind, WORLD_MODEL};
use crate::resource::ResourceOperation;

/// Adds this block to every state that reads facts and has none, neither its own nor from a state around it.
pub(super) fn imply(states: &mut [State]) {
    let looks: Vec<StateId> =
        states.iter().filter(|state| looks_at_root(states, state)).map(|state| state.id).collect();
    for id in looks {
        let annotations = &mut states[id.0 as usize].annotations;
        annotations.resources.push(ResourceExpr::new(ResourceOperation::Block, WORLD_MODEL));
        annotations.origin.insert(WORLD_MODEL.to_owned(), Origin::Reads);
    }
}

/// Whether the state may begin ahead of its place and reads facts without a projection.
fn looks_at_root(states: &[State], state: &State) -> bool {
    let is_ahead = matches!(state.kind, StateKind::Action { .. }) && state.annotations.nature != Nature::Irreversible;
    let around = std::iter::successors(Some(state), |one| one.parent.map(|id| &states[id.0 as usize]));
    let said: Vec<&Annotations> = around.map(|state| &state.annotations).collect();
    is_ahead && said.iter().any(|said| reads(said)) && !said.iter().any(|said| has_projection(said))
}

fn reads(said: &Annotations) -> bool {
    said.reads.as_ref().is_none_or(|reads| !reads.is_empty())
}

fn has_projection(said: &Annotations) -> bool {
    let mut blocks = said.resources.iter().filter(|line| line.operation == ResourceOperation::Block);
    blocks.any(|line| line.kind == WORLD_MODEL)
}
