//! A task as its author wrote it: its states, also those that a log never mentions, and the data and decisions that go from one to another.
//! A log tells what happened; this shows what was intended. Pure: it takes a loaded program.

use crate::wire;
use ratn_executive::executive::Executive;
use ratn_model::expression::Expr;
use ratn_model::id::StateId;
use ratn_model::program::{Program, State, StateKind};
use ratn_model::slot::Slot;
use std::collections::BTreeSet;

/// Maximum number of states, and of flows.
const MOST: usize = 20_000;
/// Maximum depth to which outputs of outputs and variables of variables are followed.
const MOST_DEPTH: usize = 16;

/// The task in the pages' notation.
pub(crate) fn told(program: &Program) -> wire::Task {
    let shown = |state: &&State| is_shown(state);
    let states = program.states.iter().filter(shown).filter(|state| !is_within_routine(program, state)).take(MOST);
    let mut flows = BTreeSet::new();
    for state in &program.states {
        add_flows(program, state, &mut flows);
    }
    let path = |id: StateId| program.state(id).path.clone();
    let flows = flows.into_iter().filter(|(from, to, _)| from != to).take(MOST);
    wire::Task {
        known: true,
        note: String::new(),
        states: states.map(|state| wire::State { path: state.path.clone(), kind: kind(state) }).collect(),
        flows: flows.map(|(from, to, kind)| wire::Flow { from: path(from), to: path(to), kind }).collect(),
        stops: Executive::stopping(program).into_iter().take(MOST).map(str::to_owned).collect(),
    }
}

/// The answer without a task.
pub(crate) fn unknown(note: String) -> wire::Task {
    wire::Task { note, ..wire::Task::default() }
}

/// States that do or decide something are shown. The others contain these.
fn is_shown(state: &State) -> bool {
    state.is_routine() || matches!(state.kind, StateKind::Action { .. } | StateKind::Condition { .. })
}

/// Whether a state is executed as part of a routine, which is one node.
fn is_within_routine(program: &Program, state: &State) -> bool {
    let mut around = state.parent.map(|id| program.state(id));
    while let Some(outer) = around {
        if outer.is_routine() {
            return true;
        }
        around = outer.parent.map(|id| program.state(id));
    }
    false
}

fn kind(state: &State) -> &'static str {
    match state.kind {
        StateKind::Condition { .. } => "condition",
        _ => "action",
    }
}

type Flow = (StateId, StateId, &'static str);

fn add_flows(program: &Program, state: &State, flows: &mut BTreeSet<Flow>) {
    for (slot, expression) in state.expressions() {
        let from = sources(program, state, expression, 0);
        let (to, kind) = match slot {
            // Outputs and variables of a containing state are resolved by their readers.
            Slot::Output(_) | Slot::Variable(_) => continue,
            // Its value decides which inner states exist; later states depend on those at the beginning of each visit.
            Slot::Collection | Slot::While => (entries(program, state), "condition"),
            _ if is_shown(state) => (vec![state.id], "data"),
            _ => continue,
        };
        flows.extend(to.iter().flat_map(|to| from.iter().map(move |from| (*from, *to, kind))));
    }
    if matches!(state.kind, StateKind::Condition { .. }) {
        flows.extend(inside(program, state).into_iter().map(|to| (state.id, to, "condition")));
    }
}

/// The shown states inside a state, at any depth; a shown state hides those inside it.
fn inside(program: &Program, state: &State) -> Vec<StateId> {
    let mut found = Vec::new();
    let mut open: Vec<StateId> = state.children().collect();
    while let Some(id) = open.pop() {
        let state = program.state(id);
        if is_shown(state) {
            found.push(id);
        } else {
            open.extend(state.children());
        }
    }
    found
}

/// The shown states with which the content of a state begins.
fn entries(program: &Program, state: &State) -> Vec<StateId> {
    let first = state.lists().into_iter().filter_map(|list| list.first().copied());
    let entry = |id: StateId| {
        let state = program.state(id);
        if is_shown(state) { vec![id] } else { entries(program, state) }
    };
    first.flat_map(entry).collect()
}

/// The shown states whose results an expression in a state depends on.
fn sources(program: &Program, state: &State, expression: &Expr, depth: usize) -> BTreeSet<StateId> {
    let mut found = BTreeSet::new();
    if depth > MOST_DEPTH {
        return found;
    }
    for id in expression.flows() {
        let from = program.state(id);
        if is_shown(from) {
            found.insert(id);
            continue;
        }
        for (slot, output) in from.expressions() {
            if matches!(slot, Slot::Output(_) | Slot::Decide(_)) {
                found.extend(sources(program, from, output, depth + 1));
            }
        }
    }
    for name in expression.variables() {
        let mut around = Some(state);
        while let Some(scope) = around {
            let outer = scope.parent.map(|id| program.state(id));
            let bound = scope.variables.iter().find(|(variable, _)| variable == name).map(|(_, value)| value);
            let element = match &scope.kind {
                StateKind::ForEach { variable, collection, .. } if variable == name => Some(collection),
                _ => None,
            };
            if let Some(value) = bound.or(element) {
                found.extend(sources(program, outer.unwrap_or(scope), value, depth + 1));
                break;
            }
            around = outer;
        }
    }
    found
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use ratn_model::catalogue::Catalogue;

    fn example(name: &str) -> wire::Task {
        let file = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples").join(name);
        let source = std::fs::read_to_string(&file).unwrap();
        told(&ratn_model::load::load(&source, name, &Catalogue::standard()).unwrap().program)
    }

    #[test]
    fn states_stand_as_they_are_written_and_data_flows_from_one_to_another() {
        let task = example("fetch_boxes.yaml");
        assert!(task.states.iter().any(|one| one.path == "for_box/plan_transfer"), "{:?}", task.states);
        let has = |from: &str, to: &str, kind: &str| {
            task.flows.iter().any(|flow| flow.from == from && flow.to == to && flow.kind == kind)
        };
        assert!(has("for_box/plan_approach", "for_box/move_approach", "data"), "{:?}", task.flows);
        // The number of boxes is known when the table has been segmented.
        assert!(has("segment_table", "for_box/detect_pose", "condition"), "{:?}", task.flows);
        assert!(task.flows.iter().all(|flow| flow.from != flow.to));
        let stops = |path: &str| task.stops.iter().any(|stop| stop == path);
        assert!(
            stops("for_box") && stops("for_box/move_approach") && !stops("for_box/plan_approach"),
            "{:?}",
            task.stops
        );
    }
}
