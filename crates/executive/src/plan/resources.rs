//! Resources of a state: what it acquires when it starts, and what it creates, deletes or consumes when it ends.

use super::{Names, NodeNature, Predicate, Subject, is_action, nature};
use ratn_model::fact::Footprint;
use ratn_model::program::{Origin, Program, ResourceExpr, State, WORLD_MODEL};
use ratn_model::resource::{Quantity, ResourceClass, ResourceOperation};
use std::collections::BTreeSet;

/// The resources of one state; its fields are those of [`super::StatePlan`].
pub(super) struct Resources {
    pub(super) requirements: Vec<ResourceExpr>,
    pub(super) works_with: Vec<ResourceExpr>,
    pub(super) operations: Vec<ResourceExpr>,
    pub(super) kinds: Vec<Predicate>,
    pub(super) operated: Vec<Predicate>,
}

/// The resources of one state, given the kinds that any state of the program operates on.
pub(super) fn of(
    subject: &Subject<'_>,
    operated_anywhere: &BTreeSet<&str>,
    crossing: &Footprint,
    names: &mut Names,
) -> Resources {
    let program = subject.program;
    let requirements = requirements(subject, crossing);
    let operations = operations(subject.state);
    let operated: BTreeSet<&str> = if subject.is_node {
        subject.contained.iter().flat_map(|state| operated(state)).collect()
    } else {
        operations.iter().map(|r| r.kind.as_str()).collect()
    };
    let of_the_task = |r: &&ResourceExpr| {
        operated_anywhere.contains(r.kind.as_str()) && r.class.is_none_or(|class| class == ResourceClass::Task)
    };
    let used = requirements.iter().filter(of_the_task).map(|r| r.kind.as_str());
    let operated: BTreeSet<Predicate> = operated.into_iter().map(|kind| names.of_kind(program, kind)).collect();
    let used = used.map(|kind| names.of_kind(program, kind));
    let kinds = used.chain(operated.iter().copied()).collect::<BTreeSet<Predicate>>().into_iter().collect();
    let works_with = works_with(subject);
    let operated = operated.into_iter().collect();
    Resources { kinds, operated, requirements, works_with, operations }
}

/// What an action blocks itself, else what the innermost state around it that blocks anything blocks. World models are left out: many goals may
/// read one.
fn works_with(subject: &Subject<'_>) -> Vec<ResourceExpr> {
    if !is_action(subject.state) || subject.state.is_pause() {
        return Vec::new();
    }
    let blocks = |state: &State| {
        let lines = state.annotations.resources.iter();
        let blocked = lines.filter(|line| line.operation == ResourceOperation::Block && line.kind != WORLD_MODEL);
        let mut merged = Vec::new();
        let whole = blocked.filter(|line| line.count.is_whole());
        whole.for_each(|line| merge(&mut merged, line, |have, more| have + more));
        merged
    };
    let states = std::iter::once(subject.state).chain(subject.around.iter().copied());
    states.map(blocks).find(|blocked| !blocked.is_empty()).unwrap_or_default()
}

/// The kinds of resources that a state itself, without its parts, creates, deletes or consumes.
pub(super) fn operated(state: &State) -> impl Iterator<Item = &str> {
    let changes = |r: &&ResourceExpr| !matches!(r.operation, ResourceOperation::Block | ResourceOperation::Exists);
    state.annotations.resources.iter().filter(changes).map(|r| r.kind.as_str())
}

/// The kinds of resources that any state creates, deletes or consumes, with all related kinds.
pub(super) fn operated_anywhere(program: &Program) -> BTreeSet<&str> {
    program.states.iter().flat_map(operated).flat_map(|kind| program.family(kind)).collect()
}

/// Whether a state is in a routine that works on the actual world: a computing node there runs at its place in the program and reads the root.
/// So the room for a projection that only its `reads` imply is not needed; the routine would hold it to its end, through all its waits.
fn looks_at_root(subject: &Subject<'_>, crossing: &Footprint) -> bool {
    let acts = |routine: &State| nature::of(&Subject::of(subject.program, routine), crossing) != NodeNature::Computes;
    let states = std::iter::once(subject.state).chain(subject.around.iter().copied());
    states.filter(|state| state.is_routine()).any(acts)
}

/// Whether a block is implied by the state's `reads` and not written in the task.
fn is_implied(state: &State, line: &ResourceExpr) -> bool {
    line.kind == WORLD_MODEL && state.annotations.origin.get(WORLD_MODEL) == Some(&Origin::Reads)
}

/// Blocks of one state add up; blocks of nested states merge by maximum. Consumes and exists add up as they are, but only from the state itself
/// and its parts.
fn requirements(subject: &Subject<'_>, crossing: &Footprint) -> Vec<ResourceExpr> {
    // A wait holds nothing while time passes, whatever the states around it block.
    if subject.state.is_pause() {
        return Vec::new();
    }
    let within = subject.contained.iter().map(|state| (state, true));
    let around = subject.around.iter().map(|state| (state, false));
    let looks_at_root = looks_at_root(subject, crossing);
    let mut merged: Vec<ResourceExpr> = Vec::new();
    for (state, is_within) in within.chain(around) {
        let mut blocked: Vec<ResourceExpr> = Vec::new();
        for wanted in &state.annotations.resources {
            match wanted.operation {
                ResourceOperation::Block if looks_at_root && is_implied(state, wanted) => {}
                ResourceOperation::Block => merge(&mut blocked, wanted, |have, more| have + more),
                ResourceOperation::Exists if is_within => merged.push(wanted.clone()),
                ResourceOperation::Consume if is_action(state) => merged.push(wanted.clone()),
                _ => {}
            }
        }
        blocked.iter().for_each(|wanted| merge(&mut merged, wanted, Quantity::max));
    }
    merged
}

fn merge(into: &mut Vec<ResourceExpr>, wanted: &ResourceExpr, counts: impl FnOnce(Quantity, Quantity) -> Quantity) {
    let same = |have: &&mut ResourceExpr| have.operation == wanted.operation && have.selects_the_same(wanted);
    match into.iter_mut().find(same) {
        Some(have) => have.count = counts(have.count, wanted.count),
        None => into.push(wanted.clone()),
    }
}

/// Operations at the end of a state. A composite state consumes at its exit; an action has consumed at its acquire.
fn operations(state: &State) -> Vec<ResourceExpr> {
    let at_end = |r: &&ResourceExpr| match r.operation {
        ResourceOperation::Create | ResourceOperation::Delete => true,
        ResourceOperation::Consume => !is_action(state),
        ResourceOperation::Block | ResourceOperation::Exists => false,
    };
    state.annotations.resources.iter().filter(at_end).cloned().collect()
}
