//! What still holds where the theorem's assumptions do not (imprecise exceptions, resources without order, regions that share
//! facts): every PIA started on a decided path with final inputs and its preconditions true, and the run ends with nothing left
//! over. The last is checked by the simulation itself, and in every run.

use super::story::story;
use super::trial::same_end;
use ratn_executive::protocol::{Command, LogEntry, Note};
use ratn_model::id::{InstanceId, StateId};
use ratn_model::program::{ABORTED, Nature, PREEMPTED, Program, StateKind};
use ratn_simulation::run::Run;
use std::collections::{BTreeMap, BTreeSet};

/// The first promise that is not kept.
pub(super) fn problem(program: &Program, hsm: &Run, cdtn: &Run) -> Option<String> {
    let told = story(program, cdtn);
    if let Some(path) = told.undone.first() {
        return Some(format!("{path} was discarded or computed again after it had started, and it is a PIA"));
    }
    inputs_were_final(program, cdtn).or_else(|| {
        // Without failures and without shared facts the world is HSM mode's all the same.
        let fails = [hsm, cdtn].iter().any(|run| {
            run.log.iter().any(|line| {
                matches!(&line.entry, LogEntry::Command(Command::Note(Note::Finished { outcome, .. }))
                    if matches!(&**outcome, ABORTED | PREEMPTED))
            })
        });
        (!fails && !shares(program)).then(|| same_end(hsm, cdtn)).flatten()
    })
}

/// Whether nothing in the program looks at the world.
pub(super) fn is_blind(program: &Program) -> bool {
    let blind = |state: &ratn_model::program::State| {
        let text =
            format!("{:?} {:?} {:?} {:?}", state.kind, state.variables, state.assign, state.annotations.requires);
        let looks = text.contains("predicate: \"p");
        let effects = format!("{:?}", state.annotations.effects);
        let reads = match (&state.kind, &state.annotations.nature) {
            (StateKind::Action { .. }, Nature::Senses(facts)) => !facts.is_empty(),
            (StateKind::Action { .. }, _) => state.annotations.reads.as_ref().is_none_or(|reads| !reads.is_empty()),
            _ => false,
        };
        !looks && !reads && !effects.contains("Fact(") && !effects.contains("Increase(")
    };
    program.states.iter().all(blind)
}

/// Of programs that never look at the world, with imprecise motions: both modes come to the same end by the same outcomes, and
/// what HSM mode does CDTN mode does, too. What it does besides, it had begun before the failure of the motion beside.
pub(super) fn blind_problem(program: &Program, hsm: &Run, cdtn: &Run) -> Option<String> {
    if hsm.outcome != cdtn.outcome || hsm.outputs != cdtn.outputs {
        return Some(format!(
            "HSM mode ends {} {:?} ({}), CDTN mode {} {:?} ({})",
            hsm.outcome, hsm.outputs, hsm.reason, cdtn.outcome, cdtn.outputs, cdtn.reason
        ));
    }
    let acts = |run: &Run| -> BTreeSet<(String, String)> {
        story(program, run).acts.into_iter().map(|act| (act.path, act.goal)).collect()
    };
    let (before, after) = (acts(hsm), acts(cdtn));
    before.difference(&after).next().map(|(path, _)| format!("{path} never starts in CDTN mode"))
}

/// Whether regions of a concurrency write facts of each other.
fn shares(program: &Program) -> bool {
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
    use ratn_model::expression::EffectExpr;
    fn predicates(effect: &EffectExpr, into: &mut BTreeSet<String>) {
        match effect {
            EffectExpr::Set(fact, _) | EffectExpr::Delete(fact) | EffectExpr::Increase(fact, _) => {
                into.insert(fact.predicate.clone());
            }
            EffectExpr::ForEach { effects, .. } => effects.iter().for_each(|e| predicates(e, into)),
        }
    }
    let mut all = BTreeSet::new();
    for id in inside(program, region) {
        program.state(id).annotations.effects.values().flatten().for_each(|e| predicates(e, &mut all));
    }
    all
}

fn read(program: &Program, region: StateId) -> BTreeSet<String> {
    let mut all = BTreeSet::new();
    for id in inside(program, region) {
        // What is looked up anywhere stands in the text of the state.
        let text = format!("{:?}", program.state(id));
        for predicate in 0..super::generator::facts::LAST {
            let name = format!("p{predicate}");
            if text.contains(&format!("predicate: \"{name}\"")) {
                all.insert(name);
            }
        }
    }
    all
}

/// No PIA started with something that was computed again afterwards.
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

/// Whether a path lies in an older iteration of a loop than another: what is there has its outputs from another visit, although the
/// instances inside of a routine get their numbers late.
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
