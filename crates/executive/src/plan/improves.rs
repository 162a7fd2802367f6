//! Which results may be improved after they were given: those of anytime actions, in the outputs that nobody uses before a motion begins.
//!
//! ```text
//! plan_approach ─ trajectory ─► in: { trajectory } of move_approach      free: looked at when that motion begins, and not before
//!       └──────── end ────────► effects of move_approach, plan_transfer  kept: what is computed ahead is made of it
//! ```
//! So nothing is ever made again because of an improvement: what somebody may have used stays as it was at first. What senses may go on looking in
//! the same way, until a motion begins that uses what it saw or changes what it looks at.

use super::{NodeNature, Plan, is_action};
use ratn_model::expression::Expr;
use ratn_model::id::StateId;
use ratn_model::program::{Program, State, StateKind};
use ratn_model::slot::Slot;
use std::collections::{BTreeMap, BTreeSet};

/// Of every anytime action with an output that is used so, the outputs that have to stay as they were at first.
pub(super) fn of(program: &Program, plan: &Plan) -> BTreeMap<StateId, Box<[String]>> {
    let mut free: BTreeSet<(StateId, &str)> = BTreeSet::new();
    let mut kept: BTreeSet<(StateId, &str)> = BTreeSet::new();
    for state in &program.states {
        for (slot, expression) in program.expressions(state) {
            let ports = match use_of(plan, state, slot) {
                Use::None => continue,
                Use::AtItsBeginning => &mut free,
                Use::Ahead => &mut kept,
            };
            expression.visit(&mut |part| {
                match part {
                    Expr::Port { state, port } => drop(ports.insert((*state, port))),
                    // Its own, in what it assigns.
                    Expr::Output(port) => drop(ports.insert((state.id, port))),
                    _ => {}
                }
            });
        }
    }
    let improves = |state: &State| {
        let StateKind::Action { outputs, .. } = &state.kind else { return None };
        let own = plan.state(state.id);
        let can = state.annotations.anytime
            && own.nature != NodeNature::Irreversible
            // What it changes, and measures, is said once, at its end.
            && own.may_write.as_ref().is_some_and(Vec::is_empty)
            && is_own_node(program, plan, state);
        let is_free = |port: &&String| {
            let port = (state.id, port.as_str());
            free.contains(&port) && !kept.contains(&port)
        };
        if !can || !outputs.keys().any(|port| is_free(&port)) {
            return None;
        }
        let kept = outputs.keys().filter(|port| kept.contains(&(state.id, port.as_str())));
        Some((state.id, kept.cloned().collect()))
    };
    program.states.iter().filter_map(improves).collect()
}

enum Use {
    /// It is only for people, or an estimate.
    None,
    /// When a motion begins: everything older is real then.
    AtItsBeginning,
    /// Whenever it is known.
    Ahead,
}

fn use_of(plan: &Plan, state: &State, slot: Slot<'_>) -> Use {
    let is_motion = is_action(state) && !state.is_pause() && plan.state(state.id).nature == NodeNature::Irreversible;
    match slot {
        Slot::Shared => Use::None,
        Slot::Input(_) if is_motion => Use::AtItsBeginning,
        _ => Use::Ahead,
    }
}

/// Whether a state is a node of the window itself, and not inside of a routine.
fn is_own_node(program: &Program, plan: &Plan, state: &State) -> bool {
    let mut around = std::iter::successors(state.parent, |id| program.state(*id).parent);
    plan.state(state.id).is_node && !around.any(|id| plan.state(id).is_routine)
}
