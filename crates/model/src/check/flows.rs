//! Data flows that no order of execution can serve: from a state that comes later, contains this one, or may not have run.
//!
//! Whether an output is there is read from the control flow ([`super::graph`]). The flows of the whole program form a graph, too
//! (petgraph): it tells a flow that reordering would repair from a cycle.

use super::graph::{ControlFlow, Point};
use super::{Subject, branches, expressions};
use crate::diagnostic::Findings;
use crate::expression::Expr;
use crate::id::StateId;
use crate::program::{Program, SUCCESS, State, StateKind, is_failure};
use crate::slot::Slot;
use petgraph::graph::{DiGraph, NodeIndex};
use std::collections::BTreeSet;

pub(super) fn check(subject: &Subject<'_>, findings: &mut Findings) {
    let program = subject.program;
    let flows: Vec<(&State, Slot<'_>, StateId, &str)> = program
        .states
        .iter()
        .flat_map(|state| {
            let parts = expressions(program, state);
            parts.into_iter().flat_map(move |(slot, expr)| {
                ports(expr).into_iter().map(move |(from, port)| (state, slot, from, port))
            })
        })
        .collect();
    let graph = graph(program, flows.iter().map(|(to, _, from, _)| (*from, to.id)));
    let control = subject.control;
    for (to, slot, from, port) in flows {
        let at = subject.place_of(to, slot);
        let source = program.state(from);
        let flow = format!("`{}.{port}`", source.name);
        let is_region =
            matches!(source.parent.map(|parent| &program.state(parent).kind), Some(StateKind::Concurrency { .. }));
        let (surely, maybe) = written(control, to, slot, from);
        let relation = relation(subject, to, slot, source);
        let hidden = matches!(relation, Relation::Hidden(_));
        let beside = matches!(relation, Relation::Beside);
        if !hidden && !beside && (surely || source.defaults.contains_key(port) || (is_region && at_join(to, slot))) {
            continue;
        }
        if !hidden && !beside && maybe {
            let message =
                format!("{flow} may not have been written when this state needs it: not on every way that leads here");
            let help = "give the port a default, or use it only where it was written";
            findings.error("branch-may-not-have-written", at, &to.path, message, help);
            continue;
        }
        match relation {
            // A run that begins behind the state that writes it.
            Relation::Before if subject.begins_elsewhere && control.is_reached(Point::Begin(to.id)) => {
                let message = format!("{flow} is not there: the run begins behind `{}`, which writes it", source.path);
                let help = "let it begin there, or before it";
                findings.error("branch-may-not-have-written", at, &to.path, message, help);
            }
            Relation::Before => {}
            Relation::Beside => {
                let message = format!("{flow} is written in another region, which may come before or after this one");
                let help = "put both into one region, or use it behind the concurrency, which puts it out";
                findings.error("unservable-flow", at, &to.path, message, help);
            }
            Relation::Itself => {
                let message = format!("{flow} is an output of this state itself, which needs it to start");
                findings.error("unservable-flow", at, &to.path, message, "take it from a state before this one");
            }
            Relation::Around => {
                let message = format!("{flow} is written when `{}` ends, and this state is inside of it", source.path);
                findings.error("unservable-flow", at, &to.path, message, "take it from the state that computes it");
            }
            Relation::Inside => {
                let message = format!("{flow} is written inside of this state, which needs it to start");
                findings.error("unservable-flow", at, &to.path, message, "take it from a state before this one");
            }
            Relation::After => {
                let message = format!("{flow} is written by `{}`, which comes later", source.path);
                let help = match cycle(program, &graph, to.id, from) {
                    Some(cycle) => format!("each waits for the next: {cycle}; break the cycle"),
                    None => format!("move `{}` before `{}`", source.path, to.path),
                };
                findings.error("unservable-flow", at, &to.path, message, help);
            }
            Relation::OtherBranch => {
                let message = format!("{flow} is written on the other branch: never both run");
                findings.error(
                    "branch-may-not-have-written",
                    at,
                    &to.path,
                    message,
                    "take it from before the condition",
                );
            }
            Relation::Maybe(container) => {
                let message = format!("{flow} is written inside of `{}`, where it may never run", container.path);
                let help = "let its effects say it as a fact, or use it inside";
                findings.error("branch-may-not-have-written", at, &to.path, message, help);
            }
            Relation::Hidden(container) => {
                let message = format!("{flow} is written inside of `{}` and not seen from here", container.path);
                let help =
                    format!("add it to the `outputs` of `{}` and use `{}.{port}`", container.path, container.name);
                findings.error("unknown-state", at, &to.path, message, help);
            }
        }
    }
}

/// How the source of a flow lies to its target in the program.
enum Relation<'a> {
    Before,
    Beside,
    Itself,
    Around,
    Inside,
    After,
    OtherBranch,
    Maybe(&'a State),
    Hidden(&'a State),
}

fn relation<'a>(subject: &Subject<'a>, to: &State, slot: Slot<'_>, from: &'a State) -> Relation<'a> {
    let up: Vec<&'a State> = subject.around(to.id).collect();
    let down: Vec<&'a State> = subject.around(from.id).collect();
    if from.id == to.id {
        return Relation::Itself;
    }
    if up.iter().any(|state| state.id == from.id) {
        return Relation::Around;
    }
    // The innermost state that contains both (or is the target), and its child on the source's side.
    let Some(depth) = down.iter().position(|state| up.iter().any(|other| other.id == state.id)) else {
        return Relation::After;
    };
    let (shared, side) = (down[depth], down[depth - 1]);
    if shared.id == to.id {
        let at_its_end = is_at_end(slot) || matches!(slot, Slot::Decide(_) | Slot::While);
        if !at_its_end || matches!(to.kind, StateKind::ForEach { .. } | StateKind::Condition { .. }) {
            return Relation::Inside;
        }
    } else {
        if matches!(shared.kind, StateKind::Concurrency { .. }) {
            return Relation::Beside;
        }
        let own = up.iter().find(|state| state.parent == Some(shared.id)).map_or(to.id, |state| state.id);
        let [first, second] = branches(shared);
        let position = |id: StateId| {
            let in_first = first.iter().position(|other| *other == id).map(|i| (0, i));
            in_first.or_else(|| second.iter().position(|other| *other == id).map(|i| (1, i)))
        };
        match (position(side.id), position(own)) {
            (Some((a, _)), Some((b, _))) if a != b => return Relation::OtherBranch,
            (Some(a), Some(b)) if a < b => {}
            _ => return Relation::After,
        }
    }
    // From the child down to the source: only what surely runs, and lets its outputs out.
    for container in down[..depth].iter().skip(1).rev() {
        match container.kind {
            StateKind::ForEach { .. } | StateKind::While { .. } | StateKind::Condition { .. } => {
                return Relation::Maybe(container);
            }
            _ => {}
        }
    }
    if depth > 1 { Relation::Hidden(side) } else { Relation::Before }
}

/// Whether the source has surely, and whether it may have, written its outputs when the expression of the target is evaluated.
fn written(control: &ControlFlow, to: &State, slot: Slot<'_>, from: StateId) -> (bool, bool) {
    let in_the_middle = match slot {
        Slot::Decide(_) | Slot::While => true,
        Slot::Output(_) => matches!(to.kind, StateKind::Concurrency { .. }),
        _ => false,
    };
    if in_the_middle {
        return control.written(Point::Middle(to.id), from);
    }
    if matches!(to.kind, StateKind::Action { .. }) || !is_at_end(slot) {
        return control.written(Point::Begin(to.id), from);
    }
    // What an output is made of may be missing where the state is left by an outcome of its own; then it is not written.
    let only = match slot {
        Slot::Effect(outcome) => Some(outcome),
        Slot::Output(_) => Some(SUCCESS),
        _ => None,
    };
    let outcomes = control.outcomes(to.id).iter().enumerate().filter(|(_, outcome)| match only {
        Some(only) => outcome.as_str() == only,
        None => !is_failure(outcome),
    });
    outcomes
        .map(|(number, _)| Point::End(to.id, number))
        .filter(|point| control.is_reached(*point))
        .map(|point| control.written(point, from))
        .fold((true, false), |(surely, maybe), (s, m)| (surely && s, maybe || m))
}

fn is_at_end(slot: Slot<'_>) -> bool {
    matches!(slot, Slot::Output(_) | Slot::Effect(_) | Slot::Assign(_))
}

fn at_join(to: &State, slot: Slot<'_>) -> bool {
    matches!(to.kind, StateKind::Concurrency { .. })
        && matches!(slot, Slot::Decide(_) | Slot::Output(_) | Slot::Effect(_))
}

fn ports(expr: &Expr) -> Vec<(StateId, &str)> {
    let mut ports = BTreeSet::new();
    expr.visit(&mut |part| {
        if let Expr::Port { state, port } = part {
            ports.insert((*state, port.as_str()));
        }
    });
    ports.into_iter().collect()
}

type FlowGraph = DiGraph<StateId, ()>;

fn graph(program: &Program, flows: impl Iterator<Item = (StateId, StateId)>) -> FlowGraph {
    let mut graph = DiGraph::new();
    program.states.iter().for_each(|state| {
        graph.add_node(state.id);
    });
    flows.for_each(|(from, to)| {
        graph.update_edge(node(from), node(to), ());
    });
    graph
}

fn node(id: StateId) -> NodeIndex {
    NodeIndex::new(usize::try_from(id.0).unwrap_or(usize::MAX))
}

/// The way along the flows from one state to the other, if there is one, back to the first.
fn cycle(program: &Program, graph: &FlowGraph, from: StateId, to: StateId) -> Option<String> {
    let goal = node(to);
    let (_, way) = petgraph::algo::astar(graph, node(from), |n| n == goal, |_| 1_u32, |_| 0)?;
    let name = |n: &NodeIndex| graph.node_weight(*n).map_or("", |id| program.state(*id).path.as_str());
    let names: Vec<&str> = way.iter().chain(way.first()).map(name).collect();
    Some(names.join(" → "))
}
