//! Finds what keeps a task sequential: simulates it in HSM mode and in CDTN mode with the known durations, and again with missing annotations added.
//!
//! The actions' results are unknown: they succeed, with assumed outputs of the declared types. So a figure is the gain of an annotation if the
//! annotation is true, not a promise.

mod annotate;
mod chain;
mod providers;

pub use chain::Link;

use crate::run::{Checks, Circumstances, Run, RunError, Setup, run_while};
use annotate::{annotated, missing};
use providers::AssumedProviders;
use ratn_executive::protocol::{Command, LogEntry};
use ratn_executive::protocol::{Mode, Note};
use ratn_model::catalogue::{Catalogue, ResourceOffer};
use ratn_model::id::StateId;
use ratn_model::program::{ABORTED, PREEMPTED, Program, SUCCESS};
use ratn_model::resource::{Quantity, ResourceClass};
use ratn_model::tolerance::Tolerance;
use ratn_model::value::Value;
use ratn_model::wait::Wait;
use serde::Serialize;
use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

/// Limit of examined states; those with the longest durations are taken …
const MAX_CANDIDATES: usize = 40;
/// … and no more than give about this number of goals in all simulations together.
const MAX_GOALS: usize = 20_000;
/// Per state: it alone, and all but it.
const SIMULATIONS: usize = 2;
/// A smaller gain, in seconds, counts as none.
const NO_GAIN_S: f64 = 1e-6;

/// Assumptions for what is unknown.
#[derive(Debug, Clone, PartialEq)]
pub struct Assumptions {
    /// The task's parameters, all bound.
    pub parameters: BTreeMap<String, Value>,
    /// Number of elements in a list that an action returns.
    pub elements: usize,
    /// Learned durations, by path without visits, in seconds.
    pub durations_s: BTreeMap<String, f64>,
    /// Capacity of resource kinds, if not the catalogue's maximum.
    pub units: BTreeMap<String, Quantity>,
    /// Attributes of the units of a kind, in order: those of arms tell which arm they are.
    pub attributes: BTreeMap<String, Vec<BTreeMap<String, Value>>>,
}

/// The result.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Sequential {
    /// Makespan in HSM mode, in seconds.
    pub hsm_s: f64,
    /// Makespan in CDTN mode, in seconds.
    pub cdtn_s: f64,
    /// The critical chain in CDTN mode, first state first.
    pub chain: Vec<Link>,
    /// The states with missing annotations, the largest gain first.
    pub gains: Vec<Gain>,
    /// Makespan in CDTN mode if all of these were annotated, in seconds; `None` if that cannot be simulated.
    pub annotated_s: Option<f64>,
    /// The states whose failure is handled, with the gain of `exceptional: [aborted]`, with which the failure's handler is not computed ahead.
    /// Likewise for the timeout of a wait, and for answers to a question that are not assumed. Only states with a gain.
    pub exceptional: Vec<Gain>,
    /// The actions with unknown duration: one second is assumed.
    pub unknown_durations: Vec<String>,
}

/// The gain of annotating a state.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Gain {
    /// The path of the state.
    pub path: String,
    /// The missing annotations: `reads`, `effects`, `computes`.
    pub missing: Vec<Cow<'static, str>>,
    /// Seconds saved if only this state is annotated.
    pub alone_s: f64,
    /// The same in percent.
    pub alone_percent: f64,
    /// Seconds saved by annotating this state when all others are annotated.
    pub last_s: f64,
}

/// Error: the simulation did not succeed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Obstacle {
    /// The simulation failed.
    #[error("the simulation in {mode} mode comes to no end: {source}")]
    Run {
        /// In which mode.
        mode: &'static str,
        /// The cause.
        source: RunError,
    },
    /// The task did not succeed.
    #[error("with assumed outputs the task ends in {mode} mode with `{outcome}`: {reason}")]
    Outcome {
        /// In which mode.
        mode: &'static str,
        /// The outcome.
        outcome: String,
        /// Its reason.
        reason: String,
    },
}

/// Analyses a checked program.
///
/// # Errors
/// [`Obstacle`] if the task does not succeed with the assumptions.
pub fn sequential(program: &Program, catalogue: &Catalogue, assumptions: &Assumptions) -> Result<Sequential, Obstacle> {
    let mut unknown = BTreeSet::new();
    let hsm = simulate(program, catalogue, assumptions, Mode::Hsm, &mut unknown)?;
    let cdtn = simulate(program, catalogue, assumptions, Mode::Cdtn, &mut unknown)?;
    let mut ends_s = |annotating: &[StateId]| {
        let program = annotated(program, catalogue, annotating);
        simulate(&program, catalogue, assumptions, Mode::Cdtn, &mut unknown).ok().map(|run| run.end_s)
    };
    let candidates = executed(&cdtn, |id| !missing(program, catalogue, id).is_empty());
    let annotated_s = if candidates.is_empty() { Some(cdtn.end_s) } else { ends_s(&candidates) };
    let mut gains: Vec<Gain> = candidates
        .iter()
        .filter_map(|id| {
            let alone_s = cdtn.end_s - ends_s(&[*id])?;
            let others: Vec<StateId> = candidates.iter().copied().filter(|other| other != id).collect();
            let last_s = ends_s(&others).zip(annotated_s).map_or(0.0, |(without_s, with_s)| without_s - with_s);
            Some(Gain {
                path: program.state(*id).path.clone(),
                missing: missing(program, catalogue, *id).into_iter().map(Cow::Borrowed).collect(),
                alone_s: rounded(alone_s),
                alone_percent: if cdtn.end_s > 0.0 { 100.0 * rounded(alone_s) / cdtn.end_s } else { 0.0 },
                last_s: rounded(last_s),
            })
        })
        .collect();
    gains.sort_by(|a, b| b.alone_s.total_cmp(&a.alone_s).then(b.last_s.total_cmp(&a.last_s)));
    let exceptional = exceptional(program, &cdtn, |program| {
        simulate(program, catalogue, assumptions, Mode::Cdtn, &mut unknown).ok().map(|run| run.end_s)
    });
    Ok(Sequential {
        hsm_s: hsm.end_s,
        cdtn_s: cdtn.end_s,
        chain: chain::chain(program, &cdtn.log),
        gains,
        annotated_s,
        exceptional,
        unknown_durations: unknown.into_iter().collect(),
    })
}

/// The makespan of a checked program in CDTN mode, in seconds, with the assumptions. The simulation stops after `max_events` events, which bounds its
/// memory, and when `goes_on`, which is called before every event, returns false.
///
/// # Errors
/// [`Obstacle`] if the task does not succeed with the assumptions.
pub fn makespan_s(
    program: &Program,
    catalogue: &Catalogue,
    assumptions: &Assumptions,
    max_events: usize,
    goes_on: &dyn Fn() -> bool,
) -> Result<f64, Obstacle> {
    let bound = Bound { max_events, goes_on };
    simulate_within(bound, program, catalogue, assumptions, Mode::Cdtn, &mut BTreeSet::new()).map(|run| run.end_s)
}

/// The states with handled outcomes that could be exceptional, and the gain.
fn exceptional(program: &Program, run: &Run, mut ends_s: impl FnMut(&Program) -> Option<f64>) -> Vec<Gain> {
    let came = outcomes(run);
    let is_meant = |id: StateId| !seldom(program, &came, id).is_empty();
    let handled: Vec<(StateId, Vec<String>)> =
        executed(run, is_meant).into_iter().map(|id| (id, seldom(program, &came, id))).collect();
    let mut gain_s = |meant: &[&(StateId, Vec<String>)]| {
        let mut marked = program.clone();
        for (id, outcomes) in meant {
            marked.states[id.0 as usize].annotations.exceptional.extend(outcomes.iter().cloned());
        }
        ends_s(&marked).map(|end_s| rounded(run.end_s - end_s))
    };
    let all: Vec<_> = handled.iter().collect();
    let Some(all_s) = gain_s(&all).filter(|gain_s| *gain_s > 0.0) else { return Vec::new() };
    let mut gains = Vec::new();
    for one in &handled {
        let others: Vec<_> = handled.iter().filter(|other| other.0 != one.0).collect();
        let alone_s = gain_s(&[one]).unwrap_or(0.0);
        let last_s = gain_s(&others).map_or(0.0, |without_s| rounded(all_s - without_s));
        if alone_s > 0.0 || last_s > 0.0 {
            gains.push(Gain {
                path: program.state(one.0).path.clone(),
                missing: vec![format!("exceptional: [{}]", one.1.join(", ")).into()],
                alone_s,
                alone_percent: 100.0 * alone_s / run.end_s,
                last_s,
            });
        }
    }
    gains.sort_by(|a, b| b.alone_s.total_cmp(&a.alone_s).then(b.last_s.total_cmp(&a.last_s)));
    gains
}

/// The outcomes of a state whose handlers are computed ahead although they may be rare: a failure; for a wait also its timeout, and answers that are
/// not assumed.
fn seldom(program: &Program, came: &BTreeSet<(StateId, &str)>, id: StateId) -> Vec<String> {
    let waits = matches!(program.state(id).wait(), Some(Wait::Condition(_) | Wait::Signal(_) | Wait::Answer(_)));
    let may_be = |outcome: &&str| *outcome == ABORTED || (waits && ![SUCCESS, PREEMPTED].contains(outcome));
    let outcomes = program.outcomes(id).filter(may_be);
    let handled = outcomes.filter(|outcome| !program.is_exceptional(id, outcome) && !came.contains(&(id, *outcome)));
    handled.map(str::to_owned).collect()
}

fn outcomes(run: &Run) -> BTreeSet<(StateId, &str)> {
    let (mut states, mut came) = (BTreeMap::new(), BTreeSet::new());
    for line in &run.log {
        match &line.entry {
            LogEntry::Command(Command::Note(Note::Expanded { instance, state, .. })) => {
                states.insert(*instance, *state);
            }
            LogEntry::Command(Command::Note(Note::Finished { instance, outcome })) => {
                came.extend(states.get(instance).map(|state| (*state, &**outcome)));
            }
            _ => {}
        }
    }
    came
}

/// A gain, rounded to microseconds.
fn rounded(seconds: f64) -> f64 {
    if seconds.abs() < NO_GAIN_S { 0.0 } else { (seconds * 1e6).round() / 1e6 }
}

/// The executed states that satisfy `is_meant`; if there are many, those with the longest durations.
fn executed(run: &Run, is_meant: impl Fn(StateId) -> bool) -> Vec<StateId> {
    let mut busy_s: BTreeMap<StateId, f64> = BTreeMap::new();
    let mut states = BTreeMap::new();
    let mut began = BTreeMap::new();
    for line in &run.log {
        let LogEntry::Command(Command::Note(note)) = &line.entry else { continue };
        match note {
            Note::Expanded { instance, state, .. } => {
                states.insert(*instance, *state);
            }
            Note::Running { instance, .. } => {
                began.insert(*instance, line.at);
            }
            Note::Finished { instance, .. } => {
                if let (Some(state), Some(began)) = (states.get(instance), began.get(instance)) {
                    *busy_s.entry(*state).or_default() += line.at.since(*began).as_secs_f64();
                }
            }
            _ => {}
        }
    }
    let mut found: Vec<(StateId, f64)> = busy_s.into_iter().filter(|(id, _)| is_meant(*id)).collect();
    found.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
    let goals = began.len().max(1);
    found.truncate((MAX_GOALS / (SIMULATIONS * goals)).clamp(1, MAX_CANDIDATES));
    found.into_iter().map(|(id, _)| id).collect()
}

fn simulate(
    program: &Program,
    catalogue: &Catalogue,
    assumptions: &Assumptions,
    mode: Mode,
    unknown: &mut BTreeSet<String>,
) -> Result<Run, Obstacle> {
    let bound = Bound { max_events: Circumstances::default().max_events, goes_on: &|| true };
    simulate_within(bound, program, catalogue, assumptions, mode, unknown)
}

/// The limits of a simulation.
struct Bound<'b> {
    max_events: usize,
    goes_on: &'b dyn Fn() -> bool,
}

fn simulate_within(
    bound: Bound<'_>,
    program: &Program,
    catalogue: &Catalogue,
    assumptions: &Assumptions,
    mode: Mode,
    unknown: &mut BTreeSet<String>,
) -> Result<Run, Obstacle> {
    let name = match mode {
        Mode::Hsm => "HSM",
        Mode::Cdtn => "CDTN",
    };
    let assumed = |kind: &String, offer: &ResourceOffer| match assumptions.units.get(kind) {
        Some(units) => ResourceOffer { count: *units, ..offer.clone() },
        None => offer.clone(),
    };
    let offered = catalogue.resources.iter().filter(|(_, offer)| offer.class != ResourceClass::Task);
    let mut program = program.clone();
    // The task's deadline is ignored here.
    program.deadline_s = None;
    let program = Arc::new(program);
    let setup = Setup {
        program: program.clone(),
        mode,
        parameters: assumptions.parameters.clone(),
        seed: 1,
        resources: offered.map(|(kind, offer)| (kind.clone(), assumed(kind, offer))).collect(),
        world: Vec::new(),
        tolerance: Tolerance::EXACT,
        latency: Duration::ZERO,
    };
    let mut providers = AssumedProviders::new(&program, assumptions);
    let (attributes, max_events) = (assumptions.attributes.clone(), bound.max_events);
    let circumstances = Circumstances { attributes, max_events, checks: Checks::Nothing, ..Circumstances::default() };
    let run = run_while(setup, &mut providers, circumstances, bound.goes_on);
    let run = run.map_err(|source| Obstacle::Run { mode: name, source })?;
    unknown.extend(providers.unknown_durations());
    if run.outcome == SUCCESS {
        Ok(run)
    } else {
        let reason = providers.gave_up().unwrap_or(run.reason);
        Err(Obstacle::Outcome { mode: name, outcome: run.outcome, reason })
    }
}
