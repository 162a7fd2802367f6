//! Who looks at the world gets a projection of it. What computes or senses may begin before older states have ended: without one it would see the
//! world in which their effects are still missing. So a state that reads facts blocks room for a projection, whether or not anybody says so.

use crate::id::StateId;
use crate::program::{Annotations, Nature, Origin, ResourceExpr, State, StateKind, WORLD_MODEL};
use crate::resource::ResourceOperation;

/// Adds the block of every state that looks at the world and has none, its own or of a state around it.
pub(super) fn imply(states: &mut [State]) {
    let looks: Vec<StateId> =
        states.iter().filter(|state| looks_at_root(states, state)).map(|state| state.id).collect();
    for id in looks {
        let annotations = &mut states[id.0 as usize].annotations;
        annotations.resources.push(ResourceExpr::new(ResourceOperation::Block, WORLD_MODEL));
        annotations.origin.insert(WORLD_MODEL.to_owned(), Origin::Reads);
    }
}

/// Whether it may begin ahead of its place and read facts, without a projection.
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
