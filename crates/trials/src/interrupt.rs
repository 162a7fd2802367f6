//! Runs that are aborted or reach their deadline at any moment, and runs in which the world changes at any moment.
//!
//! What is compared:
//!
//! | event | comparison |
//! |---|---|
//! | the user ends the run when a PIA starts, no regions | both modes end alike: PIAs, changes, world, outcome |
//! | the same with regions; at any moment; a deadline | for each mode: its PIAs are a closed subset of those of the undisturbed HSM run, with the same goals and in the same order; its changes are, by predicate (by fact if there are regions), the first changes of that run; without regions, they are its first changes in one order; the outcome is `preempted`, or `aborted` at the deadline, or the run had ended normally before |
//! | the same for a program with `finally` or with effects for `preempted` | for each mode: there is a place of the program, or one in each region, at which the reference, told to end there, performs the same PIAs with the same goals, makes the same changes, and leaves the same world; with races of regions, the outcome |
//! | the world changes at any moment | see [`super::outside`] |
//!
//! The simulation itself checks that nothing is left over in any of them.

use super::outside::trial_at_any_moment;
use super::story::story;
use super::trial::{
    Conditions, Verdict, closure, difference, execute_under, is_cut_somewhere, max_hsm_events, same_end,
};
use super::{Dice, is_long, is_preemptive};
use ratn_executive::protocol::{Command, Event, LogEntry, Mode};
use ratn_model::fact::Change;
use ratn_model::program::{ABORTED, PREEMPTED, Program, State, StateKind};
use ratn_simulation::run::{Run, RunError, Trigger};
use std::sync::Arc;

/// Runs the program undisturbed in HSM mode, then interrupted in both modes, and compares.
pub fn trial_interrupted(program: &Arc<Program>, conditions: &Conditions) -> Verdict {
    let whole = match execute_under(program, conditions, Mode::Hsm, max_hsm_events(program), Vec::new()) {
        Ok(run) => run,
        Err(RunError::Endless(_) | RunError::TooLong(_)) => return Verdict::LeftOut,
        Err(problem) => return Verdict::Differs(format!("HSM mode: {problem}")),
    };
    let mut dice = Dice(conditions.seed ^ 0x1e77_0b7e);
    let has_regions = program.states.iter().any(|state| matches!(state.kind, StateKind::Concurrency { .. }));
    let ask = || Event::AbortRequested { reason: "that is enough".to_owned(), at_once: false };
    let at = dice.below(1_000) as f64 / 1_000.0 * whole.end_s;
    match dice.below(4) {
        0 => {
            let acts = story(program, &whole).acts;
            if acts.is_empty() {
                return Verdict::LeftOut;
            }
            let path = acts[dice.below(acts.len() as u64) as usize].path.clone();
            parts(program, conditions, &whole, (&[(Trigger::Starts(path), ask())], PREEMPTED), !has_regions)
        }
        1 => parts(program, conditions, &whole, (&[(Trigger::At(at), ask())], PREEMPTED), false),
        2 => {
            let mut limited = (**program).clone();
            limited.deadline_s = Some(at);
            parts_of(&Arc::new(limited), program, conditions, &whole, (&[], ABORTED), false)
        }
        _ => trial_at_any_moment(program, conditions, &whole),
    }
}

/// Checks that both modes do a first part of the undisturbed HSM run and end by this outcome; with `alike`, in the same
/// way.
fn parts(
    program: &Arc<Program>,
    conditions: &Conditions,
    whole: &Run,
    (outside, outcome): (&[(Trigger, Event)], &str),
    alike: bool,
) -> Verdict {
    parts_of(program, program, conditions, whole, (outside, outcome), alike)
}

/// The same for a program that differs from the undisturbed one in its deadline.
fn parts_of(
    program: &Arc<Program>,
    unlimited: &Program,
    conditions: &Conditions,
    whole: &Run,
    (outside, outcome): (&[(Trigger, Event)], &str),
    alike: bool,
) -> Verdict {
    let mut ends = Vec::new();
    for mode in [Mode::Hsm, Mode::Cdtn] {
        let most = 60 * whole.log.len() + 10_000;
        let part = match execute_under(program, conditions, mode, most, outside.to_vec()) {
            Ok(run) => run,
            Err(problem) => return Verdict::Differs(format!("{mode:?} mode, interrupted: {problem}")),
        };
        let changes =
            |state: &State| state.annotations.effects.get(PREEMPTED).is_some_and(|effects| !effects.is_empty());
        let is_otherwise = |state: &State| state.annotations.finally.is_some() || changes(state);
        let problem = match program.states.iter().any(is_otherwise) {
            true => leaves_otherwise(unlimited, conditions, whole, &part, outcome),
            false => is_no_part(program, whole, &part, outcome),
        };
        if let Some(problem) = problem {
            return Verdict::Differs(format!("{mode:?} mode, interrupted: {problem}"));
        }
        ends.push(part);
    }
    let stories = (story(program, &ends[0]), story(program, &ends[1]));
    if alike && let Some(problem) = difference(program, &ends[0], &ends[1], &stories) {
        return Verdict::Differs(format!("interrupted at the same place: {problem}"));
    }
    Verdict::Same { hsm_s: ends[0].end_s, cdtn_s: ends[1].end_s, acts: stories.1.acts.len() }
}

/// The difference of a run from every run that is told to end at some place and then executes its way out.
fn leaves_otherwise(
    program: &Program,
    conditions: &Conditions,
    whole: &Run,
    part: &Run,
    outcome: &str,
) -> Option<String> {
    let is_cut = part.outcome == outcome && part.outputs.is_empty();
    if !is_cut {
        let races = program.states.iter().any(is_preemptive);
        return (!races).then(|| same_end(whole, part)).flatten();
    }
    if is_long(program) || part.reason.contains("its way out took longer") {
        return None;
    }
    let told = story(program, part);
    let known = is_cut_somewhere(program, conditions, part, &told, outcome);
    // It may have been told to end after it had ended with the same outcome.
    let is_otherwise = known == Some(false) && same_end(whole, part).is_some();
    is_otherwise.then(|| {
        let acts: Vec<&str> = told.acts.iter().map(|act| act.path.as_str()).collect();
        format!(
            "there is no place at which a run that is told to end does this: {acts:?} {:?} {:?}, and leaves {:?}",
            told.changes,
            part.reason,
            part.world.iter().map(|(key, fact)| format!("{key} = {}", fact.value)).collect::<Vec<_>>()
        )
    })
}

fn is_no_part(program: &Program, whole: &Run, part: &Run, outcome: &str) -> Option<String> {
    let (before, after) = (story(program, whole), story(program, part));
    if let Some(problem) = closure(program, &before, &after) {
        return Some(problem);
    }
    for (predicate, changes) in &after.changes {
        let all = before.changes.get(predicate).map_or(&[][..], Vec::as_slice);
        if !all.starts_with(changes) {
            return Some(format!("what became real of {predicate}: {changes:?}, undisturbed {all:?}"));
        }
    }
    let has_regions = program.states.iter().any(|state| matches!(state.kind, StateKind::Concurrency { .. }));
    if !has_regions && !commits(whole).starts_with(&commits(part)) {
        return Some("what became real is not the first of what does undisturbed".to_owned());
    }
    let is_cut = part.outcome == outcome && part.outputs.is_empty();
    let races = program.states.iter().any(is_preemptive);
    (!is_cut && !races).then(|| same_end(whole, part)).flatten()
}

fn commits(run: &Run) -> Vec<&Change> {
    let commits = run.log.iter().filter_map(|line| match &line.entry {
        LogEntry::Command(Command::Commit { changes, .. }) => Some(changes),
        _ => None,
    });
    commits.flatten().collect()
}
