//! Data flows: the outputs of other states, and the variables, that the expressions of a state use.

use super::Subject;
use ratn_model::expression::Expr;
use ratn_model::id::StateId;
use ratn_model::program::Program;
use ratn_model::resource::ResourceOperation;
use ratn_model::slot::Slot;
use std::collections::BTreeSet;

/// The states whose outputs a state needs before it starts; of a composite state, those outside of it.
pub(super) fn start_flows(subject: &Subject<'_>) -> Vec<StateId> {
    let is_needed = |slot: Slot<'_>| match slot {
        Slot::Duration | Slot::Reads | Slot::Senses | Slot::Shared => false,
        // A node with parts needs the inputs of its parts' effects already, because it is one node.
        Slot::Effect(_) => subject.contains_others(),
        Slot::Resource(_, ResourceOperation::Create | ResourceOperation::Delete) => subject.contains_others(),
        _ => true,
    };
    let mut flows = BTreeSet::new();
    for state in &subject.contained {
        state.each_expression(&mut |slot, expression| {
            if is_needed(slot) {
                flows.extend(expression.flows());
            }
        });
    }
    // A loop's state that reads its own output means the visit before.
    if subject.contains_others() { without_inside(flows, subject) } else { flows.into_iter().collect() }
}

/// The states whose outputs any expression of a state reads; of a routine, those outside of it.
pub(super) fn flows(subject: &Subject<'_>) -> Vec<StateId> {
    let mut flows = BTreeSet::new();
    each_executed(subject, &mut |expression| flows.extend(expression.flows()));
    if subject.is_routine() { without_inside(flows, subject) } else { flows.into_iter().collect() }
}

/// The variables that any expression of a state reads; of a routine, with what it contains.
pub(super) fn variables(subject: &Subject<'_>) -> Vec<String> {
    let mut names = BTreeSet::new();
    each_executed(subject, &mut |expression| names.extend(expression.variables().into_iter().map(str::to_owned)));
    if subject.is_routine() {
        // A variable that the routine does not assign in the end keeps its earlier value.
        names.extend(assigns(subject));
    }
    names.into_iter().collect()
}

/// The variables to which a state assigns; of a routine, with what it contains, but without the variables declared inside of it.
pub(super) fn assigns(subject: &Subject<'_>) -> BTreeSet<String> {
    let executed = subject.executed();
    let declared: BTreeSet<&String> =
        executed.iter().flat_map(|state| &state.variables).map(|(name, _)| name).collect();
    let inner = executed.iter().filter(|state| state.id != subject.state.id).flat_map(|state| &state.assign);
    let inner = inner.map(|(name, _)| name).filter(|name| !declared.contains(name));
    subject.state.assign.iter().map(|(name, _)| name).chain(inner).cloned().collect()
}

pub(super) fn read_anywhere(program: &Program) -> BTreeSet<StateId> {
    let all = program.states.iter().flat_map(|state| program.expressions(state));
    all.filter(|(slot, _)| *slot != Slot::Shared).flat_map(|(_, expression)| expression.flows()).collect()
}

fn each_executed<'a>(subject: &Subject<'a>, visit: &mut dyn FnMut(&'a Expr)) {
    for state in subject.executed() {
        let all = subject.program.expressions(state).into_iter();
        all.filter(|(slot, _)| *slot != Slot::Shared).for_each(|(_, expression)| visit(expression));
    }
}

/// Removes states inside: their outputs are written while the state runs. Its own output means the visit before and comes from outside.
fn without_inside(mut flows: BTreeSet<StateId>, subject: &Subject<'_>) -> Vec<StateId> {
    let inside = subject.contained.iter().filter(|state| state.id != subject.state.id);
    inside.for_each(|state| {
        flows.remove(&state.id);
    });
    flows.into_iter().collect()
}
