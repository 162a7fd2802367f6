//! Data flows that no order of execution can satisfy: the source comes later, contains the target, or may not have run.
//!
//! Whether an output exists is derived from the control flow ([`super::graph`]). All flows together form another graph (petgraph), which
//! distinguishes a flow that reordering would repair from a cycle.

use super::graph::{ControlFlow, Point, decided, one_succeeds};
use super::ways::{Flow, ways};
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
    let of = |state| expressions(program, state).into_iter().map(move |part| (state, part));
    let all = || program.states.iter().flat_map(of);
    let flows = all().flat_map(|(to, (_, expr))| expr.flows().into_iter().map(move |from| (from, to.id)));
    let graph = graph(program, flows);
    for (to, (slot, expr)) in all() {
        let ways = ways(expr);
        let needed = ways.needed.into_iter().filter_map(|flow| refused(subject, &graph, (to, slot), flow, false));
        let either = ways.either.iter().flat_map(|either| none_refused(subject, &graph, (to, slot), either));
        let own = left_out(subject, to, slot, expr).into_iter();
        for (rule, message, help) in needed.chain(either).chain(own) {
            findings.error(rule, subject.place_of(to, slot), &to.path, message, help);
        }
    }
}

/// A refused flow: the rule, the message, what to do.
type Refused = (&'static str, String, String);

/// The violation if the state's own output may be missing when it ends.
fn left_out(subject: &Subject<'_>, to: &State, slot: Slot<'_>, expr: &Expr) -> Option<Refused> {
    let control = subject.control;
    let only = match slot {
        Slot::Effect(outcome) => Some(outcome),
        Slot::Assign(_) => None,
        _ => return None,
    };
    let outcomes = control.outcomes(to.id).iter().enumerate().filter(|(number, outcome)| {
        only.is_none_or(|only| only == *outcome)
            && !is_failure(outcome)
            && control.is_reached(Point::End(to.id, *number))
    });
    let outcomes: Vec<&String> = outcomes.map(|(_, outcome)| outcome).collect();
    let mut found = None;
    expr.visit(&mut |part| {
        let Expr::Output(name) = part else { return };
        if let Some(outcome) = outcomes.iter().find(|outcome| !control.gives((to.id, name), outcome)) {
            found = Some((name.clone(), (*outcome).clone()));
        }
    });
    let (name, outcome) = found?;
    let message = format!("the output `{name}` may not have been written where this state ends by `{outcome}`");
    Some(("branch-may-not-have-written", message, "give the output a default".to_owned()))
}

/// The violation by an output in an expression. `is_one_of_several`: it is an argument of `either`, so it need not exist on every path.
fn refused(
    subject: &Subject<'_>,
    graph: &FlowGraph,
    (to, slot): (&State, Slot<'_>),
    (from, port): Flow<'_>,
    is_one_of_several: bool,
) -> Option<Refused> {
    let program = subject.program;
    let source = program.state(from);
    let flow = format!("`{}.{port}`", source.name);
    let maybe = may_be_written(subject.control, to, slot, (from, port));
    let relation = relation(subject, to, slot, source);
    if !matches!(relation, Relation::Hidden(_) | Relation::Beside) {
        // Outputs inside of a state are removed when the state is entered, so they are missing even as one of several.
        let is_forgotten = matches!(relation, Relation::Inside);
        if is_there(subject, to, slot, (from, port)) || (maybe && is_one_of_several && !is_forgotten) {
            return None;
        }
        if maybe {
            let message =
                format!("{flow} may not have been written when this state needs it: not on every way that leads here");
            let help = "give the port a default, use it only where it was written, or say with `either(…)` what is used instead";
            return Some(("branch-may-not-have-written", message, help.to_owned()));
        }
    }
    let (rule, message, help) = match relation {
        // The run begins behind the state that writes the output.
        Relation::Before
            if subject.begins_elsewhere && !is_one_of_several && subject.control.is_reached(Point::Begin(to.id)) =>
        {
            let message = format!("{flow} is not there: the run begins behind `{}`, which writes it", source.path);
            ("branch-may-not-have-written", message, "let it begin there, or before it".to_owned())
        }
        Relation::Before => return None,
        Relation::Beside => {
            let message = format!("{flow} is written in another region, which may come before or after this one");
            let help = "put both into one region, or use it behind the concurrency, which puts it out";
            ("unservable-flow", message, help.to_owned())
        }
        Relation::Itself => {
            let message = format!("{flow} is an output of this state itself, which needs it to start");
            ("unservable-flow", message, "take it from a state before this one".to_owned())
        }
        Relation::Around => {
            let message = format!("{flow} is written when `{}` ends, and this state is inside of it", source.path);
            ("unservable-flow", message, "take it from the state that computes it".to_owned())
        }
        Relation::Inside => {
            let message = format!("{flow} is written inside of this state, which needs it to start");
            ("unservable-flow", message, "take it from a state before this one".to_owned())
        }
        Relation::After => {
            let message = format!("{flow} is written by `{}`, which comes later", source.path);
            let help = match cycle(program, graph, to.id, from) {
                Some(cycle) => format!("each waits for the next: {cycle}; break the cycle"),
                None => format!("move `{}` before `{}`", source.path, to.path),
            };
            ("unservable-flow", message, help)
        }
        Relation::OtherBranch => {
            let message = format!("{flow} is written on the other branch: never both run");
            ("branch-may-not-have-written", message, "take it from before the condition".to_owned())
        }
        Relation::Maybe(container) => {
            let message = format!("{flow} is written inside of `{}`, where it may never run", container.path);
            let help = format!("put it out with a default (`outputs` of `{}`), or use it inside", container.path);
            ("branch-may-not-have-written", message, help)
        }
        Relation::Hidden(container) => {
            let message = format!("{flow} is written inside of `{}` and not seen from here", container.path);
            let help = format!("add it to the `outputs` of `{}` and use `{}.{port}`", container.path, container.name);
            ("unknown-state", message, help)
        }
    };
    Some((rule, message, help))
}

/// Where the source of a flow is, seen from its target.
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
    // A state put around a loop's body (`is_pass`) does not count.
    let is_between = |state: &&State| subject.program.is_pass(state.id) && !up.iter().any(|other| other.id == state.id);
    let down: Vec<&'a State> = subject.around(from.id).filter(|state| !is_between(state)).collect();
    if from.id == to.id {
        return Relation::Itself;
    }
    if up.iter().any(|state| state.id == from.id) {
        return Relation::Around;
    }
    // The innermost state that contains both (or is the target), and the source-side child of it.
    let Some(depth) = down.iter().position(|state| up.iter().any(|other| other.id == state.id)) else {
        return Relation::After;
    };
    let (shared, side) = (down[depth], down[depth - 1]);
    if shared.id == to.id {
        let at_its_end = is_at_end(slot) || matches!(slot, Slot::Decide(_) | Slot::While);
        if !at_its_end {
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
    // From that child down to the source, every state must always run and make its outputs visible.
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

/// Whether the source has certainly written its outputs when the target's expression is evaluated.
fn is_written(control: &ControlFlow, to: &State, slot: Slot<'_>, from: Flow<'_>) -> bool {
    points(control, to, slot).into_iter().all(|point| control.written(point, from).0)
}

/// Whether it may have written them. For an output this includes the ends by the state's own outcomes.
fn may_be_written(control: &ControlFlow, to: &State, slot: Slot<'_>, from: Flow<'_>) -> bool {
    let mut all = points(control, to, slot);
    if matches!(slot, Slot::Output(_)) {
        all.extend(ends(control, to, None));
    }
    all.into_iter().any(|point| control.written(point, from).1)
}

/// The points at which the target's expression is evaluated.
fn points(control: &ControlFlow, to: &State, slot: Slot<'_>) -> Vec<Point> {
    let in_the_middle = match slot {
        Slot::Decide(_) | Slot::While => true,
        Slot::Output(_) => matches!(to.kind, StateKind::Concurrency { .. }),
        _ => false,
    };
    if in_the_middle {
        return vec![Point::Middle(to.id)];
    }
    if matches!(to.kind, StateKind::Action { .. }) || !is_at_end(slot) {
        return vec![Point::Begin(to.id)];
    }
    // At the end by an outcome of its own, a state leaves out an output whose inputs are missing.
    let only = match slot {
        Slot::Effect(outcome) => Some(outcome),
        Slot::Output(_) => Some(SUCCESS),
        _ => None,
    };
    ends(control, to, only)
}

/// The ends of a state by this outcome, or by any that is no failure.
fn ends(control: &ControlFlow, to: &State, only: Option<&str>) -> Vec<Point> {
    let outcomes = control.outcomes(to.id).iter().enumerate().filter(|(_, outcome)| match only {
        Some(only) => outcome.as_str() == only,
        None => !is_failure(outcome),
    });
    outcomes.map(|(number, _)| Point::End(to.id, number)).filter(|point| control.is_reached(*point)).collect()
}

fn is_at_end(slot: Slot<'_>) -> bool {
    matches!(slot, Slot::Output(_) | Slot::Effect(_) | Slot::Assign(_))
}

fn at_join(to: &State, slot: Slot<'_>) -> bool {
    matches!(to.kind, StateKind::Concurrency { .. })
        && matches!(slot, Slot::Decide(_) | Slot::Output(_) | Slot::Effect(_))
}

/// The violations by an `either`, whose first available argument is taken.
fn none_refused(
    subject: &Subject<'_>,
    graph: &FlowGraph,
    (to, slot): (&State, Slot<'_>),
    either: &[BTreeSet<Flow<'_>>],
) -> Vec<Refused> {
    let each = either.iter().flatten().filter_map(|flow| refused(subject, graph, (to, slot), *flow, true));
    let each: Vec<Refused> = each.collect();
    if !each.is_empty() || either.iter().any(|way| way.iter().all(|flow| is_there(subject, to, slot, *flow))) {
        return each;
    }
    // An argument with several outputs is ignored here: one of them may exist without the others.
    let of_one: BTreeSet<Flow<'_>> = either.iter().filter_map(|way| subject.control.one_of(way)).collect();
    let from: BTreeSet<StateId> = of_one.iter().map(|(from, _)| *from).collect();
    let is_covered = match join(subject, to, slot, &from) {
        Some(ends_with_one) => ends_with_one,
        None => {
            let mut points = points(subject.control, to, slot).into_iter();
            points.all(|point| subject.control.one_is_written(subject.program, point, &of_one))
        }
    };
    if is_covered {
        return Vec::new();
    }
    let name = |(from, port): &Flow<'_>| format!("`{}.{port}`", subject.program.state(*from).name);
    let names: BTreeSet<String> = either.iter().flatten().map(name).collect();
    let names = names.into_iter().collect::<Vec<_>>().join(", ");
    let message = format!("on some way that leads here none of {names} has been written");
    let help = "give what is used then as the last of them, or as the `default` of the output";
    vec![("branch-may-not-have-written", message, help.to_owned())]
}

/// Whether an output certainly exists: it is written on every path, or has a default.
fn is_there(subject: &Subject<'_>, to: &State, slot: Slot<'_>, (from, port): Flow<'_>) -> bool {
    let source = subject.program.state(from);
    source.defaults.contains_key(port)
        || is_written(subject.control, to, slot, (from, port))
        || (port == "outcome" && is_region_of(to, from) && at_join(to, slot))
        || join(subject, to, slot, &BTreeSet::from([from])) == Some(true)
}

fn is_region_of(to: &State, from: StateId) -> bool {
    matches!(&to.kind, StateKind::Concurrency { regions, .. } if regions.contains(&from))
}

/// Whether one of these regions has certainly written its outputs when the concurrency ends with success, as far as it is known; `None` if the
/// flow is not from a region.
fn join(subject: &Subject<'_>, to: &State, slot: Slot<'_>, from: &BTreeSet<StateId>) -> Option<bool> {
    let StateKind::Concurrency { regions, preemptive, successes, .. } = &to.kind else { return None };
    let ours = regions.iter().filter(|region| from.contains(region)).count();
    if ours == 0 || !at_join(to, slot) {
        return None;
    }
    let watches = regions.iter().filter(|region| subject.program.state(**region).is_watch()).count();
    // The author of a decider or an effect is responsible for the outcomes.
    if !matches!(slot, Slot::Output(_)) {
        return Some(true);
    }
    if let Some(holds) = decided(to, SUCCESS) {
        return Some(one_succeeds(holds, from));
    }
    Some(match successes {
        Some(wanted) => ours + *wanted as usize > regions.len(),
        None => !preemptive || ours + watches == regions.len(),
    })
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

/// The path along the flows from one state to the other and back to the first, if there is one.
fn cycle(program: &Program, graph: &FlowGraph, from: StateId, to: StateId) -> Option<String> {
    let goal = node(to);
    let (_, way) = petgraph::algo::astar(graph, node(from), |n| n == goal, |_| 1_u32, |_| 0)?;
    let name = |n: &NodeIndex| graph.node_weight(*n).map_or("", |id| program.state(*id).path.as_str());
    let names: Vec<&str> = way.iter().chain(way.first()).map(name).collect();
    Some(names.join(" → "))
}
