//! Which results an anytime action may go on to improve: those with outputs that nobody uses before a motion begins.
//!
//! ```text
//! plan_approach ─ trajectory ─► in: { trajectory } of move_approach      free: read when that motion begins, and not before
//!       └──────── end ────────► effects of move_approach, plan_transfer  kept: computing ahead has used it
//! ```
//! So an improvement never invalidates anything: an output that may have been used stays as it was in the first result. A sensing action may
//! likewise go on sensing, until a motion begins that uses its result or changes what it senses.

use super::{NodeNature, Plan, is_action};
use ratn_model::expression::Expr;
use ratn_model::id::StateId;
use ratn_model::program::{Program, State, StateKind};
use ratn_model::slot::Slot;
use std::collections::{BTreeMap, BTreeSet};

/// The anytime actions that may improve, each with the outputs that must stay as in the first result.
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
                    // The state's own output, in what it assigns.
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
            // Effects and measurements are reported once, at the end.
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
    /// It is only shown to people, or it is an estimate.
    None,
    /// When a motion begins: everything older has retired then.
    AtItsBeginning,
    /// As soon as it is known.
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
