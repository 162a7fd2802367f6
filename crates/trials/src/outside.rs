//! The world changes from outside while a PIA is under way: both modes must then behave alike.
//!
//! When a PIA is under way, in both modes everything older is real and nothing younger is. So a change at that time belongs to one
//! place of the program, and the theorem holds as if the PIA had made it. With concurrent regions, which are at places of their own,
//! it holds if only the PIA's own region may write the changed facts, because then no other region reads them.
//!
//! - [`trial_from_outside`]: a change at the start of some PIA, in both modes.
//! - [`trial_at_any_moment`]: a change at some time in CDTN mode. If a PIA was under way then, HSM mode is disturbed at the start of
//!   that PIA. If none was, or if there are regions, the change belongs to no single place of the program: the run must end, nothing
//!   may be left over, and no PIA may be undone or started twice with the same goal.

use super::story::story;
use super::trial::{Conditions, Verdict, compare, execute_under, max_hsm_events, problem};
use super::{Dice, is_preemptive, state_of};
use super::{around, weak};
use ratn_executive::protocol::{Command, Event, LogEntry, Mode};
use ratn_model::fact::{Change, FactKey};
use ratn_model::id::Revision;
use ratn_model::program::{Program, State, StateKind};
use ratn_model::value::Value;
use ratn_model::wait::Wait;
use ratn_simulation::run::{Run, RunError, Trigger};
use std::collections::BTreeSet;
use std::sync::Arc;

/// Runs the program in both modes, changes some facts at the start of one of its PIAs, and compares.
pub fn trial_from_outside(program: &Arc<Program>, conditions: &Conditions) -> Verdict {
    let undisturbed = match execute_under(program, conditions, Mode::Hsm, max_hsm_events(program), Vec::new()) {
        Ok(run) => run,
        Err(RunError::Endless(_) | RunError::TooLong(_)) => return Verdict::LeftOut,
        Err(problem) => return Verdict::Differs(format!("HSM mode: {problem}")),
    };
    let mut dice = Dice(conditions.seed ^ 0x0000_0075_1de5);
    let acts = story(program, &undisturbed).acts;
    let mut facts = facts(&undisturbed, &mut dice);
    if acts.is_empty() || facts.is_empty() {
        return Verdict::LeftOut;
    }
    let path = acts[dice.below(acts.len() as u64) as usize].path.clone();
    if let Some(own) = own_predicates(program, &path) {
        facts.retain(|(fact, _)| own.contains(&fact.predicate));
        if facts.is_empty() {
            return Verdict::LeftOut;
        }
    }
    let event = Event::WorldChanged { revision: Revision(0), facts };
    compare(program, conditions, &[(Trigger::Starts(path), event)])
}

/// Runs the program in CDTN mode, changes some facts at some time, and compares as far as that is defined.
pub(super) fn trial_at_any_moment(program: &Arc<Program>, conditions: &Conditions, undisturbed: &Run) -> Verdict {
    let mut dice = Dice(conditions.seed ^ 0x0000_a117_03e7);
    let facts = facts(undisturbed, &mut dice);
    // Changes that fulfil the condition of a wait come from outside, too, at other times.
    let waits = program.states.iter().any(|state| matches!(state.wait(), Some(Wait::Condition(_))));
    if facts.is_empty() || waits || program.states.iter().any(is_preemptive) {
        return Verdict::LeftOut;
    }
    let at = dice.below(1_000) as f64 / 1_000.0 * undisturbed.end_s * 0.9;
    let event = Event::WorldChanged { revision: Revision(0), facts: facts.clone() };
    let most = 60 * undisturbed.log.len() + 10_000;
    let cdtn = match execute_under(program, conditions, Mode::Cdtn, most, vec![(Trigger::At(at), event.clone())]) {
        Ok(run) => run,
        Err(problem) => return Verdict::Differs(format!("CDTN mode: {problem}")),
    };
    let told = story(program, &cdtn);
    if let Some(path) = told.undone.first() {
        return Verdict::Differs(format!("{path} was discarded or computed again after it had started"));
    }
    let mut started = BTreeSet::new();
    if let Some(act) = told.acts.iter().find(|act| !started.insert((&act.path, &act.goal))) {
        return Verdict::Differs(format!("{} started twice", act.path));
    }
    let has_regions = program.states.iter().any(|state| matches!(state.kind, StateKind::Concurrency { .. }));
    let acts = told.acts.len();
    let same = |hsm_s: f64| Verdict::Same { hsm_s, cdtn_s: cdtn.end_s, acts };
    let Some(path) = under_way(program, &cdtn).filter(|_| !has_regions) else { return same(undisturbed.end_s) };
    let outside = vec![(Trigger::Starts(path), event)];
    let hsm = match execute_under(program, conditions, Mode::Hsm, max_hsm_events(program), outside) {
        Ok(run) => run,
        Err(RunError::Endless(_) | RunError::TooLong(_)) => return Verdict::LeftOut,
        Err(problem) => return Verdict::Differs(format!("HSM mode: {problem}")),
    };
    match problem(program, &hsm, &cdtn, &(story(program, &hsm), told)) {
        Some(problem) => Verdict::Differs(format!("the world changed at {at:.3} s: {problem}")),
        None => same(hsm.end_s),
    }
}

/// The PIA that was under way, in its first try, when the world changed.
fn under_way(program: &Program, run: &Run) -> Option<String> {
    let changed = run.log.iter().position(|line| matches!(line.entry, LogEntry::Event(Event::WorldChanged { .. })))?;
    let until = Run { log: run.log[..changed].to_vec(), ..run.clone() };
    let acts = story(program, &until);
    let path = acts.running.first().map(|number| acts.acts[*number].path.clone())?;
    (acts.acts.iter().filter(|act| act.path == path).count() == 1).then_some(path)
}

/// The predicates that only the region around a PIA may write; `None` if it is in no region.
fn own_predicates(program: &Program, path: &str) -> Option<BTreeSet<String>> {
    let state = state_of(program, path)?;
    let chain: Vec<&State> = around(program, state).collect();
    let region = chain.windows(2).find(|pair| matches!(pair[1].kind, StateKind::Concurrency { .. }))?[0];
    // In a race several regions may write the same facts.
    let races = chain.iter().any(|state| is_preemptive(state));
    Some(if races { BTreeSet::new() } else { weak::written(program, region.id) })
}

/// Some facts that a run wrote, each deleted or with the value of another fact of its predicate.
fn facts(run: &Run, dice: &mut Dice) -> Vec<(FactKey, Option<Value>)> {
    let commits = run.log.iter().filter_map(|line| match &line.entry {
        LogEntry::Command(Command::Commit { changes, .. }) => Some(changes),
        _ => None,
    });
    let written: Vec<(&FactKey, &Value)> = commits
        .flatten()
        .filter_map(|change| match change {
            Change::Set { fact, value } => Some((fact, value)),
            _ => None,
        })
        .collect();
    let mut facts: Vec<(FactKey, Option<Value>)> = Vec::new();
    for _ in 0..3 {
        if written.is_empty() {
            break;
        }
        let (fact, _) = written[dice.below(written.len() as u64) as usize];
        let alike: Vec<&Value> =
            written.iter().filter(|(other, _)| other.predicate == fact.predicate).map(|(_, value)| *value).collect();
        let value = alike[dice.below(alike.len() as u64) as usize];
        facts.retain(|(known, _)| known != fact);
        facts.push((fact.clone(), (!dice.percent(25)).then(|| value.clone())));
    }
    facts
}
