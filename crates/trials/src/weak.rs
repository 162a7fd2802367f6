//! What still holds without the theorem's assumptions (with imprecise exceptions, unordered resources, shared facts): every PIA
//! started on a decided path with final inputs and true preconditions, and the run ends with nothing left over. The simulation
//! itself checks the latter, in every run.

use super::reference;
use super::story::Story;
use super::trial::same_end;
use ratn_executive::protocol::{Command, LogEntry, Note};
use ratn_model::expression::EffectExpr;
use ratn_model::id::{InstanceId, StateId};
use ratn_model::program::{ABORTED, Nature, PREEMPTED, Program, StateKind, VIOLATED};
use ratn_simulation::run::Run;
use std::collections::{BTreeMap, BTreeSet};

/// The first promise that is not kept.
pub(super) fn problem(program: &Program, hsm: &Run, cdtn: &Run, (_, told): &(Story, Story)) -> Option<String> {
    if let Some(path) = told.undone.first() {
        return Some(format!("{path} was discarded or computed again after it had started, and it is a PIA"));
    }
    inputs_were_final(program, cdtn).or_else(|| reference::unmet(program, cdtn)).or_else(|| {
        // Without failures and shared facts the world must still be that of HSM mode.
        let fails = fails(hsm) || fails(cdtn);
        (!fails && !shares(program)).then(|| same_end(hsm, cdtn)).flatten()
    })
}

/// Whether any node ended `aborted` or `preempted`, even if its result was discarded.
pub(super) fn fails(run: &Run) -> bool {
    run.log.iter().any(|line| {
        matches!(&line.entry, LogEntry::Command(Command::Note(Note::Finished { outcome, .. }))
            if matches!(&**outcome, ABORTED | PREEMPTED | VIOLATED))
    })
}

/// Whether regions of a concurrency write facts that others use.
pub(super) fn shares(program: &Program) -> bool {
    program.states.iter().any(|state| match &state.kind {
        StateKind::Concurrency { regions, preemptive: false, .. } => {
            let all: Vec<BTreeSet<String>> = regions.iter().map(|region| written(program, *region)).collect();
            let read: Vec<BTreeSet<String>> = regions.iter().map(|region| read(program, *region)).collect();
            (0..all.len()).any(|a| {
                (0..all.len()).any(|b| a != b && (!all[a].is_disjoint(&all[b]) || !all[a].is_disjoint(&read[b])))
            })
        }
        _ => false,
    })
}

fn inside(program: &Program, id: StateId) -> Vec<StateId> {
    let mut all = vec![id];
    let mut next = 0;
    while next < all.len() {
        all.extend(program.state(all[next]).children());
        next += 1;
    }
    all
}

pub(super) fn written(program: &Program, region: StateId) -> BTreeSet<String> {
    let states = inside(program, region);
    let effects = states.iter().flat_map(|id| program.state(*id).annotations.effects.values().flatten());
    effects.flat_map(EffectExpr::written).map(|fact| fact.predicate.clone()).collect()
}

fn read(program: &Program, region: StateId) -> BTreeSet<String> {
    let mut all = written(program, region);
    for state in inside(program, region).into_iter().map(|id| program.state(id)) {
        let annotations = &state.annotations;
        let looked_up = state.expressions().into_iter().flat_map(|(_, expression)| expression.fact_expressions());
        let named = annotations.reads.iter().flatten().chain(annotations.senses()).chain(&annotations.shared);
        all.extend(looked_up.chain(named).map(|fact| fact.predicate.clone()));
    }
    all
}

/// Checks that no PIA started with a value that was computed again afterwards.
fn inputs_were_final(program: &Program, cdtn: &Run) -> Option<String> {
    let mut states: BTreeMap<InstanceId, (StateId, String)> = BTreeMap::new();
    let mut used: BTreeMap<StateId, Vec<InstanceId>> = BTreeMap::new();
    for line in &cdtn.log {
        match &line.entry {
            LogEntry::Command(Command::Note(Note::Expanded { instance, state, path, .. })) => {
                states.insert(*instance, (*state, path.clone()));
            }
            LogEntry::Command(Command::Start { instance, .. }) => {
                let Some((state, _)) = states.get(instance) else { continue };
                let state = program.state(*state);
                if let (StateKind::Action { inputs, .. }, Nature::Irreversible) =
                    (&state.kind, &state.annotations.nature)
                {
                    let flows = inputs.iter().flat_map(|(_, e)| e.flows());
                    flows.for_each(|from| used.entry(from).or_default().push(*instance));
                }
            }
            LogEntry::Command(Command::Note(Note::Invalidated { instance, .. })) => {
                let Some((state, path)) = states.get(instance) else { continue };
                let younger = used.get(state).into_iter().flatten().filter(|user| *user > instance);
                let mut users = younger.filter_map(|user| states.get(user)).map(|(_, path)| path);
                if let Some(user) = users.find(|user| !is_in_an_older_iteration(user, path)) {
                    return Some(format!("{path} was computed again after {user} had started with its outputs"));
                }
            }
            _ => {}
        }
    }
    None
}

/// Whether a path is in an older iteration of a loop than another one: outputs there belong to another visit, although instances
/// inside of a routine get their numbers late.
fn is_in_an_older_iteration(path: &str, other: &str) -> bool {
    let iteration = |segment: &str| -> Option<(String, usize)> {
        let (state, number) = segment.strip_suffix(']')?.split_once('[')?;
        Some((state.to_owned(), number.parse().ok()?))
    };
    let differing = path.split('/').zip(other.split('/')).find(|(a, b)| a != b);
    match differing.and_then(|(a, b)| iteration(a).zip(iteration(b))) {
        Some(((state, number), (same, later))) => state == same && number < later,
        None => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_same_loop_has_older_iterations() {
        assert!(is_in_an_older_iteration("each[0]/part/move", "each[1]/plan"));
        assert!(!is_in_an_older_iteration("each[1]/part/move", "each[0]/plan"), "it may have come from there");
        assert!(!is_in_an_older_iteration("each[0]/part/move", "each[0]/plan"));
        assert!(!is_in_an_older_iteration("each[0]/move", "other[1]/plan"));
        assert!(!is_in_an_older_iteration("move", "plan"));
    }
}
