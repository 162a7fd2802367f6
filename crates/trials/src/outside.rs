//! The world changes from outside, once, while a PIA is under way: both modes then do the same.
//!
//! When a PIA starts, everything older is real and nothing younger is, in both modes. So what changes at that moment changes at one place
//! of the program, and the theorem holds as if the PIA had done it. Not beside regions, where others are at places of their own.

use super::Dice;
use super::story::story;
use super::trial::{Conditions, Verdict, compare, execute_under};
use ratn_executive::protocol::{Command, Event, LogEntry, Mode};
use ratn_model::fact::{Change, FactKey};
use ratn_model::id::Revision;
use ratn_model::program::Program;
use ratn_model::value::Value;
use ratn_simulation::run::{Run, RunError, Trigger};
use std::sync::Arc;

/// More events in HSM mode than this is a program that is left out.
const MAX_EVENTS: usize = 6_000;

/// Runs the program in both modes, while some facts become otherwise at the start of one of its PIAs, and compares.
pub fn trial_from_outside(program: &Arc<Program>, conditions: &Conditions) -> Verdict {
    let undisturbed = match execute_under(program, conditions, Mode::Hsm, MAX_EVENTS, Vec::new()) {
        Ok(run) => run,
        Err(RunError::Endless(_)) => return Verdict::LeftOut,
        Err(problem) => return Verdict::Differs(format!("HSM mode: {problem}")),
    };
    let mut dice = Dice(conditions.seed ^ 0x0000_0075_1de5);
    let acts = story(program, &undisturbed).acts;
    let facts = facts(&undisturbed, &mut dice);
    if acts.is_empty() || facts.is_empty() {
        return Verdict::LeftOut;
    }
    let path = acts[dice.below(acts.len() as u64) as usize].path.clone();
    let event = Event::WorldChanged { revision: Revision(0), facts };
    compare(program, conditions, &[(Trigger::Starts(path), event)])
}

/// A few of the facts that a run wrote, each gone or with what another of its predicate was.
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
