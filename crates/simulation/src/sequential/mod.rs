//! What keeps a task sequential: it is simulated as written and as a dataflow network with the durations that are known, and again
//! with states annotated that say too little.
//!
//! What the actions will answer is not known here: they succeed, with assumed outputs of the declared types. So a figure
//! is what an annotation is worth if it is true, not a promise.

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

/// Of more states that say too little, those that take longest are looked at …
const MAX_CANDIDATES: usize = 40;
/// … and so few that all simulations together have about so many goals.
const MAX_GOALS: usize = 20_000;
/// Of each state: it alone, and all but it.
const SIMULATIONS: usize = 2;
/// A gain below this, in seconds, is none.
const NO_GAIN_S: f64 = 1e-6;

/// What is assumed where nothing is known.
#[derive(Debug, Clone, PartialEq)]
pub struct Assumptions {
    /// The task's parameters, all bound.
    pub parameters: BTreeMap<String, Value>,
    /// How many elements a list has that an action answers.
    pub elements: usize,
    /// Durations that earlier runs have taught, by plain path, in seconds.
    pub durations_s: BTreeMap<String, f64>,
    /// How much there is of each resource kind, where it is not as much as the catalogue allows.
    pub units: BTreeMap<String, Quantity>,
    /// What the attributes of the resources of a kind are, one after the other: those of arms say which arm they are.
    pub attributes: BTreeMap<String, Vec<BTreeMap<String, Value>>>,
}

/// What keeps a task sequential.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Sequential {
    /// As written, in seconds.
    pub hsm_s: f64,
    /// As a dataflow network, in seconds.
    pub cdtn_s: f64,
    /// Of the latter, what waited for what, from the first to the last.
    pub chain: Vec<Link>,
    /// The states that say too little, those whose annotation gains most first.
    pub gains: Vec<Gain>,
    /// As a dataflow network if all of these were annotated, in seconds; `None` where that cannot be simulated.
    pub annotated_s: Option<f64>,
    /// The states whose failure is handled, and what `exceptional: [aborted]` would gain: what follows a failure would not be computed
    /// ahead. The same of the timeout of a wait, and of the answers to a question that are not assumed. Only those that gain something.
    pub exceptional: Vec<Gain>,
    /// The actions whose duration nobody knows: a second is assumed.
    pub unknown_durations: Vec<String>,
}

/// What annotating a state would gain.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Gain {
    /// The state.
    pub path: String,
    /// What it does not say: `reads`, `effects`, `computes`.
    pub missing: Vec<Cow<'static, str>>,
    /// Seconds by which the task is shorter, if only this state is annotated.
    pub alone_s: f64,
    /// The same, in percent.
    pub alone_percent: f64,
    /// Seconds by which the task is shorter than if all the others are annotated and this one is not.
    pub last_s: f64,
}

/// Why nothing can be said.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Obstacle {
    /// A core gave up.
    #[error("the simulation in {mode} mode comes to no end: {source}")]
    Run {
        /// In which mode.
        mode: &'static str,
        /// Why.
        source: RunError,
    },
    /// It ended otherwise than tasks should.
    #[error("with assumed outputs the task ends in {mode} mode with `{outcome}`: {reason}")]
    Outcome {
        /// In which mode.
        mode: &'static str,
        /// How.
        outcome: String,
        /// Why.
        reason: String,
    },
}

/// Simulates a checked program.
///
/// # Errors
/// [`Obstacle`] where the task does not come to a successful end with what is assumed.
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

/// How long a checked program takes as a dataflow network, in seconds, with what is assumed. It is given up after so many events, which bounds how
/// much memory that takes, and when `goes_on`, which is asked before every event, no longer holds.
///
/// # Errors
/// [`Obstacle`] where the task does not come to a successful end with what is assumed.
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

/// The states of which outcomes that are handled could be exceptional, with what that gains.
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

/// The outcomes of a state whose handlers are computed ahead, and that may be seldom: a failure; of a state that waits the time that is over, and the
/// answers that are not assumed.
fn seldom(program: &Program, came: &BTreeSet<(StateId, &str)>, id: StateId) -> Vec<String> {
    let waits = matches!(program.state(id).wait(), Some(Wait::Condition(_) | Wait::Signal(_) | Wait::Answer(_)));
    let may_be = |outcome: &&str| *outcome == ABORTED || (waits && ![SUCCESS, PREEMPTED].contains(outcome));
    let outcomes = program.outcomes(id).filter(may_be);
    let handled = outcomes.filter(|outcome| !program.is_exceptional(id, outcome) && !came.contains(&(id, *outcome)));
    handled.map(str::to_owned).collect()
}

/// By which outcomes states have ended.
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

/// A gain to the microsecond.
fn rounded(seconds: f64) -> f64 {
    if seconds.abs() < NO_GAIN_S { 0.0 } else { (seconds * 1e6).round() / 1e6 }
}

/// The states that are executed and of such a kind; of many, those that take longest.
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

/// When a simulation is given up.
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
    // How long it may take is not asked here.
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
