//! Requests that can never be granted: resources that cannot be held together, and circular waits.
//!
//! A node acquires everything it needs at once, and holds nothing while it waits (an action: its own blocks and those of the states
//! around it; a routine: also those of its parts). So holders never wait for each other. Two ways to wait for ever remain:
//!
//! - one request needs more of a kind than the system can have, because states around a state block other units than the state itself;
//! - a task resource is created only behind states that wait for it, directly or through others.
//!
//! The second is found in the control flow: a resource counts as created as soon as the control flow can reach its creator. States
//! that are reached, but wait for a kind that nothing has created by then, wait for ever.

use super::Subject;
use super::graph::{ControlFlow, Point};
use crate::diagnostic::Findings;
use crate::id::StateId;
use crate::program::{Program, ResourceExpr, SUCCESS, State, StateKind};
use crate::resource::{Quantity, ResourceOperation};
use std::collections::{BTreeMap, BTreeSet};

const RULE: &str = "may-deadlock";

pub(super) fn check(subject: &Subject<'_>, findings: &mut Findings) {
    for node in nodes(subject.program) {
        too_many_together(subject, node, findings);
    }
    waits(subject, findings);
}

/// The states that acquire resources: the outermost actions and routines.
fn nodes(program: &Program) -> Vec<&State> {
    let (mut nodes, mut open) = (Vec::new(), vec![Program::ROOT]);
    while let Some(id) = open.pop() {
        let state = program.state(id);
        if matches!(state.kind, StateKind::Action { .. }) || state.is_routine() {
            nodes.push(state);
        } else {
            open.extend(state.children());
        }
    }
    nodes
}

/// The resource lines of one request, each with its state: those of the node's parts, and the blocks around it.
fn lines<'a>(subject: &Subject<'a>, node: &'a State) -> Vec<(&'a State, &'a ResourceExpr)> {
    let mut lines = Vec::new();
    let mut open = vec![node];
    while let Some(state) = open.pop() {
        open.extend(state.children().map(|child| subject.program.state(child)));
        let is_action = matches!(state.kind, StateKind::Action { .. });
        lines.extend(state.annotations.resources.iter().map(|line| (state, line)).filter(|(_, line)| {
            match line.operation {
                ResourceOperation::Block | ResourceOperation::Exists => true,
                ResourceOperation::Consume => is_action,
                ResourceOperation::Create | ResourceOperation::Delete => false,
            }
        }));
    }
    for around in subject.around(node.id).skip(1) {
        let blocks = around.annotations.resources.iter().filter(|line| line.operation == ResourceOperation::Block);
        lines.extend(blocks.map(|line| (around, line)));
    }
    lines
}

/// Blocks with the same attributes merge; blocks with different attributes are acquired together.
fn too_many_together(subject: &Subject<'_>, node: &State, findings: &mut Findings) {
    let mut wanted = BTreeMap::<&str, Vec<(&State, &ResourceExpr)>>::new();
    for (state, line) in lines(subject, node) {
        if line.operation != ResourceOperation::Block {
            continue;
        }
        let of_kind = wanted.entry(&line.kind).or_default();
        match of_kind.iter_mut().find(|(_, other)| other.selects_the_same(line)) {
            Some(same) if same.1.count < line.count => *same = (state, line),
            Some(_) => {}
            None => of_kind.push((state, line)),
        }
    }
    for (kind, parts) in wanted {
        let Some(offer) = subject.catalogue.resources.get(kind) else { continue };
        let count = parts.iter().map(|(_, line)| line.count).sum::<Quantity>();
        let states: BTreeSet<StateId> = parts.iter().map(|(state, _)| state.id).collect();
        // What a single state requires is checked by another rule.
        if count <= offer.count || states.len() < 2 {
            continue;
        }
        let part = |(state, line): &(&State, &ResourceExpr)| format!("{} for {}", written(line), path(state));
        let all: Vec<String> = parts.iter().map(part).collect();
        let message = format!(
            "it asks for {count} of `{kind}` in one request, {}, and the system can have {}: it waits for itself for ever",
            all.join(" and "),
            offer.count
        );
        let help = "give these lines the same `where`, so that they are one, or take one of them away";
        findings.error(RULE, subject.place(node, "resources.0"), &node.path, message, help);
    }
}

fn written(line: &ResourceExpr) -> String {
    let attributes = line.attributes.iter().map(|(name, value)| format!("{name} = {value}"));
    let attributes: Vec<String> = attributes.chain(line.conditions.iter().map(ToString::to_string)).collect();
    let count = if line.count == Quantity::ONE { String::new() } else { format!("{} × ", line.count) };
    match attributes.is_empty() {
        true => format!("{count}`{}`", line.kind),
        false => format!("{count}`{}` where {}", line.kind, attributes.join(", ")),
    }
}

fn path(state: &State) -> String {
    if state.path.is_empty() { "the task".to_owned() } else { format!("`{}`", state.path) }
}

/// A state that waits for a resource that only the task creates.
struct Waiting<'a> {
    node: &'a State,
    says: &'a State,
    line: &'a ResourceExpr,
}

fn waits(subject: &Subject<'_>, findings: &mut Findings) {
    let program = subject.program;
    let creators = |kind: &str| -> Vec<&State> {
        let creates = |state: &&State| {
            let mut lines = state.annotations.resources.iter();
            lines.any(|line| line.operation == ResourceOperation::Create && line.kind == kind)
        };
        program.states.iter().filter(creates).collect()
    };
    let mut by_kind = BTreeMap::<&str, Vec<&State>>::new();
    let mut gates = BTreeMap::<StateId, Vec<Waiting<'_>>>::new();
    for node in nodes(program) {
        for (says, line) in lines(subject, node) {
            if subject.catalogue.resources.contains_key(&line.kind) {
                continue;
            }
            by_kind.entry(&line.kind).or_insert_with(|| creators(&line.kind));
            gates.entry(node.id).or_default().push(Waiting { node, says, line });
        }
    }
    // A kind that nothing creates is reported elsewhere.
    let mut created: BTreeSet<&str> = by_kind.iter().filter(|(_, c)| c.is_empty()).map(|(kind, _)| *kind).collect();
    if gates.is_empty() {
        return;
    }
    let reached = loop {
        let passes = |id: StateId| gates.get(&id).is_none_or(|all| all.iter().all(|w| created.contains(&*w.line.kind)));
        let reached = subject.control.reached_when(program, &passes, &may_fail_first);
        let new: Vec<&str> = by_kind
            .iter()
            .filter(|(kind, by)| !created.contains(*kind) && by.iter().any(|c| has_ended(subject.control, &reached, c)))
            .map(|(kind, _)| *kind)
            .collect();
        if new.is_empty() {
            break reached;
        }
        created.extend(new);
    };
    let begins = |w: &&Waiting<'_>| subject.control.is_in(&reached, Point::Begin(w.node.id));
    let missing = |all: &'_ [Waiting<'_>]| all.iter().position(|w| !created.contains(&*w.line.kind));
    let stuck: Vec<&Waiting<'_>> = gates.values().filter_map(|all| all.get(missing(all)?)).filter(begins).collect();
    for waiting in &stuck {
        let message = format!("it waits for ever: {}", circle(subject, waiting, &stuck, &by_kind));
        let help = "create it in a state that does not come behind one that waits for it, or take the wait away";
        let i = waiting.says.annotations.resources.iter().position(|line| line == waiting.line).unwrap_or(0);
        findings.error(RULE, subject.place(waiting.says, &format!("resources.{i}")), &waiting.node.path, message, help);
    }
}

/// Whether a state can end before it acquires anything.
fn may_fail_first(state: &State) -> bool {
    !state.annotations.requires.is_empty()
        || state.annotations.resources.iter().any(|line| line.expressions().next().is_some())
}

fn has_ended(control: &ControlFlow, reached: &[bool], state: &State) -> bool {
    let of = control.outcomes(state.id);
    of.iter().position(|o| o == SUCCESS).is_some_and(|n| control.is_in(reached, Point::End(state.id, n)))
}

/// The circle of waits from one state on until a state repeats.
fn circle(
    subject: &Subject<'_>,
    first: &Waiting<'_>,
    stuck: &[&Waiting<'_>],
    by_kind: &BTreeMap<&str, Vec<&State>>,
) -> String {
    let mut sentences = Vec::new();
    let mut seen = BTreeSet::new();
    let mut at = first;
    while seen.insert(at.node.id) {
        let creators = by_kind.get(at.line.kind.as_str()).map(Vec::as_slice).unwrap_or_default();
        let Some(creator) = creators.first() else { break };
        let inside = subject.around(creator.id).any(|state| state.id == at.node.id);
        let own = |next: &&&Waiting<'_>| next.node.id == at.node.id;
        let holds_up = |next: &&&Waiting<'_>| {
            let mut ends = (0..subject.control.outcomes(next.node.id).len()).map(|n| Point::End(next.node.id, n));
            ends.any(|end| subject.control.leads_to(end, Point::Begin(creator.id)))
        };
        let next = stuck.iter().filter(|_| !inside).filter(holds_up).min_by_key(|next| own(next));
        let kind = &at.line.kind;
        match next {
            None if inside => {
                let (who, by) = (path(at.node), path(creator));
                sentences.push(format!(
                    "{who} asks for `{kind}` when it begins, and {by}, which creates it, is inside of it"
                ));
                break;
            }
            None => {
                sentences.push(format!("{} asks for `{kind}`, which {} creates", path(at.node), path(creator)));
                break;
            }
            Some(next) => {
                let (who, by, behind) = (path(at.node), path(creator), path(next.node));
                sentences.push(format!("{who} asks for `{kind}`, which {by} creates, which comes behind {behind}"));
                at = next;
            }
        }
    }
    sentences.join("; ")
}
