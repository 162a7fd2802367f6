//! One random program in both modes, and whether they did the same: the safety theorem, clause by clause.
//!
//! A log is in the order of events, so what is checked of every start of a PIA in it holds at every moment of the run.

use super::reference::{self, Fail, Given, Told};
use super::replay::replayed;
use super::story::{Act, Story, are_beside, story};
use super::weak;
use super::{Dice, Features, HashOracle, RESOURCES, is_in_routine, state_of};
use ratn_executive::protocol::{Event, Mode};
use ratn_model::catalogue::ResourceOffer;
use ratn_model::program::{Program, StateKind};
use ratn_model::resource::{Quantity, ResourceClass};
use ratn_model::tolerance::Tolerance;
use ratn_simulation::run::{Circumstances, Mischief, Oracle, Run, RunError, Setup, Trigger, run_under};
use std::collections::{BTreeMap, BTreeSet};
use std::num::NonZeroUsize;
use std::sync::Arc;
use std::time::Duration;

/// More events in HSM mode than this is a program that is left out.
pub(super) const MAX_HSM_EVENTS: usize = 6_000;
/// So many more events than HSM mode may CDTN mode take, which computes what is never needed, too.
pub(super) const MAX_CDTN_EVENTS: usize = 60;

/// What a program is tried under.
#[derive(Debug, Clone, PartialEq)]
pub struct Conditions {
    /// What the oracle and all faults are derived from.
    pub seed: u64,
    /// Without the theorem's assumptions.
    pub weak: bool,
    /// Of a hundred visits, how many fail.
    pub failures_percent: u64,
    /// Of a hundred attempts, how many crash.
    pub crashes_percent: u64,
    /// Of a hundred effects, how many are measured otherwise.
    pub deviations_percent: u64,
    /// Grants and projections take up to so long.
    pub latency_s: f64,
    /// Of a hundred messages, how many come late, twice, or after they were not wanted any more.
    pub mischief_percent: u64,
    /// Somebody pauses, steps and resumes.
    pub pauses: bool,
    /// Orders that a look ahead tries.
    pub orders: usize,
}

/// What came of a trial.
#[derive(Debug, Clone, PartialEq)]
pub enum Verdict {
    /// Both modes did the same; when they ended, in seconds.
    Same {
        /// In HSM mode.
        hsm_s: f64,
        /// In CDTN mode.
        cdtn_s: f64,
        /// PIAs started.
        acts: usize,
    },
    /// Nothing to compare: too long a run.
    LeftOut,
    /// The theorem does not hold: how.
    Differs(String),
}

impl Conditions {
    /// Those of a seed.
    pub fn of(seed: u64, features: &Features) -> Conditions {
        let mut dice = Dice(seed ^ 0x5eed_c0de);
        let mut some = |chance: u64, much: u64| if dice.percent(chance) { much } else { 0 };
        Conditions {
            seed,
            weak: features.weak,
            failures_percent: some(50, 5),
            crashes_percent: some(60, 12),
            deviations_percent: if features.measured { some(50, 30) } else { 0 },
            latency_s: if some(50, 1) == 1 { 1.5 } else { 0.0 },
            mischief_percent: some(40, 20),
            pauses: some(15, 1) == 1,
            orders: some(15, 12) as usize,
        }
    }
}

/// Runs the program in both modes and compares.
pub fn trial(program: &Arc<Program>, conditions: &Conditions) -> Verdict {
    compare(program, conditions, &[])
}

/// The same, while this comes from outside.
pub(super) fn compare(program: &Arc<Program>, conditions: &Conditions, outside: &[(Trigger, Event)]) -> Verdict {
    let hsm = match execute_under(program, conditions, Mode::Hsm, MAX_HSM_EVENTS, outside.to_vec()) {
        Ok(run) => run,
        Err(RunError::Endless(_)) => return Verdict::LeftOut,
        Err(problem) => return Verdict::Differs(format!("HSM mode: {problem}")),
    };
    let events = MAX_CDTN_EVENTS * hsm.log.len() + 10_000;
    let cdtn = match execute_under(program, conditions, Mode::Cdtn, events, outside.to_vec()) {
        Ok(run) => run,
        Err(problem) => return Verdict::Differs(format!("CDTN mode: {problem}")),
    };
    for (mode, run) in [("HSM", &hsm), ("CDTN", &cdtn)] {
        if let Some(problem) = replayed(program, run) {
            return Verdict::Differs(format!("{mode} mode: {problem}"));
        }
    }
    let stories = (story(program, &hsm), story(program, &cdtn));
    let problem = if conditions.weak {
        weak::problem(program, &hsm, &cdtn, &stories)
    } else {
        problem(program, &hsm, &cdtn, &stories)
    };
    match problem.or_else(|| against_reference(program, conditions, outside, (&hsm, &cdtn), &stories)) {
        Some(problem) => Verdict::Differs(problem),
        None => Verdict::Same { hsm_s: hsm.end_s, cdtn_s: cdtn.end_s, acts: stories.1.acts.len() },
    }
}

/// What either mode did otherwise than the reference says.
fn against_reference(
    program: &Arc<Program>,
    conditions: &Conditions,
    outside: &[(Trigger, Event)],
    (hsm, cdtn): (&Run, &Run),
    (before, after): &(Story, Story),
) -> Option<String> {
    // What one region does another sees, at what moment ever.
    if conditions.weak && weak::shares(program) {
        return None;
    }
    let told = match should_be(program, conditions, outside) {
        Ok(told) => told,
        Err(Fail::NotMine(_)) => return None,
        Err(problem) => return Some(format!("the reference does not come to an end: {problem:?}")),
    };
    let of = |mode: &str, problem: Option<String>| problem.map(|p| format!("{mode} mode and the reference: {p}"));
    of("HSM", reference::disagreement(program, &told, hsm, before)).or_else(|| {
        // What is beside or behind an imprecise failure is not the prefix of a program.
        match conditions.weak {
            true if weak::fails(hsm) || weak::fails(cdtn) => None,
            true => of("CDTN", reference::end(&told, cdtn)),
            false => of("CDTN", reference::disagreement(program, &told, cdtn, after)),
        }
    })
}

/// What the reference says of a program.
fn should_be(program: &Program, conditions: &Conditions, outside: &[(Trigger, Event)]) -> Result<Told, Fail> {
    should_be_with(program, conditions, outside, &mut oracle(program, conditions))
}

pub(super) fn should_be_with(
    program: &Program,
    conditions: &Conditions,
    outside: &[(Trigger, Event)],
    oracle: &mut dyn Oracle,
) -> Result<Told, Fail> {
    let task_resources = RESOURCES.iter().filter(|(_, class, _)| *class == ResourceClass::Task);
    reference::evaluate(Given {
        program,
        seed: conditions.seed,
        parameters: BTreeMap::new(),
        facts: BTreeMap::new(),
        units: task_resources.map(|(kind, _, n)| ((*kind).to_owned(), Quantity::whole(*n).thousandths())).collect(),
        outside: outside.to_vec(),
        oracle,
    })
}

/// What nodes do under these conditions.
pub(super) fn oracle<'a>(program: &'a Program, conditions: &Conditions) -> HashOracle<'a> {
    HashOracle {
        program,
        seed: conditions.seed,
        failures_percent: conditions.failures_percent,
        crashes_percent: conditions.crashes_percent,
        deviations_percent: conditions.deviations_percent,
    }
}

/// One mode's run, to look at.
pub fn execute(
    program: &Arc<Program>,
    conditions: &Conditions,
    mode: Mode,
    max_events: usize,
) -> Result<Run, RunError> {
    execute_under(program, conditions, mode, max_events, Vec::new())
}

pub(super) fn execute_under(
    program: &Arc<Program>,
    conditions: &Conditions,
    mode: Mode,
    max_events: usize,
    outside: Vec<(Trigger, Event)>,
) -> Result<Run, RunError> {
    run_with(program, conditions, mode, max_events, outside, &mut oracle(program, conditions))
}

/// A run with an oracle of the caller's.
pub(super) fn run_with(
    program: &Arc<Program>,
    conditions: &Conditions,
    mode: Mode,
    max_events: usize,
    mut outside: Vec<(Trigger, Event)>,
    oracle: &mut dyn Oracle,
) -> Result<Run, RunError> {
    let seed = conditions.seed;
    let setup = Setup {
        program: program.clone(),
        mode,
        parameters: BTreeMap::new(),
        seed,
        resources: RESOURCES
            .iter()
            .map(|(kind, class, units)| ((*kind).to_owned(), ResourceOffer::new(*class, *units)))
            .collect(),
        world: Vec::new(),
        tolerance: Tolerance::EXACT,
        latency: Duration::from_secs_f64(conditions.latency_s),
    };
    let percent = conditions.mischief_percent;
    let mischief = Mischief { seed, twice_percent: percent, late_percent: percent, crossing_percent: 2 * percent };
    if conditions.pauses {
        outside.extend(pauses(seed));
    }
    let circumstances = Circumstances {
        orders: conditions.orders,
        max_events,
        events: outside,
        mischief,
        checks: true,
        checkpoint_every: Some(checkpoint_every(seed)),
    };
    run_under(setup, oracle, circumstances)
}

/// Often, seldom or in between: what is replayed from the log is never interrupted so.
fn checkpoint_every(seed: u64) -> NonZeroUsize {
    let some = NonZeroUsize::MIN;
    some.saturating_add(Dice(seed ^ 0xc4ec).below(30) as usize)
}

/// A pause, a step and what ends both.
fn pauses(seed: u64) -> Vec<(Trigger, Event)> {
    let mut dice = Dice(seed ^ 0xbea7);
    let mut at = 0.0;
    let mut later = |event: Event| {
        at += dice.below(60) as f64 / 10.0;
        (Trigger::At(at), event)
    };
    vec![
        later(Event::PauseRequested),
        later(Event::StepRequested),
        later(Event::ResumeRequested),
        later(Event::PauseRequested),
        later(Event::ResumeRequested),
    ]
}

fn differ(what: &str, hsm: impl std::fmt::Debug, cdtn: impl std::fmt::Debug) -> Option<String> {
    Some(format!("{what} differ:\n hsm  {hsm:#?}\n cdtn {cdtn:#?}"))
}

/// The first clause of the theorem that does not hold.
fn problem(program: &Program, hsm: &Run, cdtn: &Run, (before, after): &(Story, Story)) -> Option<String> {
    closure(program, before, after)
        .or_else(|| same_end(hsm, cdtn))
        .or_else(|| {
            let missing: Vec<&str> = before.acts.iter().skip(after.acts.len()).map(|act| act.path.as_str()).collect();
            (before.acts.len() != after.acts.len())
                .then(|| format!("PIAs that never started, of the last: {missing:?}"))
        })
        .or_else(|| actuators(program, before, after))
        .or_else(|| changes(before, after))
        .or_else(|| retired(before, after))
}

/// Outcome, outputs, world and task resources.
pub(super) fn same_end(hsm: &Run, cdtn: &Run) -> Option<String> {
    let facts = |run: &Run| -> Vec<String> { run.world.iter().map(|(k, f)| format!("{k} = {}", f.value)).collect() };
    if hsm.outcome != cdtn.outcome {
        return differ("outcomes", (&hsm.outcome, &hsm.reason), (&cdtn.outcome, &cdtn.reason));
    }
    if hsm.outputs != cdtn.outputs {
        return differ("outputs", &hsm.outputs, &cdtn.outputs);
    }
    if facts(hsm) != facts(cdtn) {
        return differ("worlds", facts(hsm), facts(cdtn));
    }
    (hsm.units != cdtn.units).then(|| differ("task resources", &hsm.units, &cdtn.units)).flatten()
}

/// The PIAs started are at every moment some of HSM mode's, each once, with all that come before them in the program started and
/// ended.
fn closure(program: &Program, hsm: &Story, cdtn: &Story) -> Option<String> {
    if let Some(path) = cdtn.undone.first() {
        return Some(format!("{path} was discarded or computed again after it had started, and it is a PIA"));
    }
    let has_regions = program.states.iter().any(|s| matches!(s.kind, StateKind::Concurrency { .. }));
    let place: BTreeMap<(&str, &str), usize> =
        hsm.acts.iter().enumerate().map(|(n, act)| ((act.path.as_str(), act.goal.as_str()), n)).collect();
    let mut started: BTreeSet<usize> = BTreeSet::new();
    let beside = |a: &Act, b: &Act| has_regions && are_beside(program, &a.path, &b.path);
    for act in &cdtn.acts {
        let Some(number) = place.get(&(act.path.as_str(), act.goal.as_str())).copied() else {
            let same: Vec<&Act> = hsm.acts.iter().filter(|other| other.path == act.path).collect();
            return Some(format!("{} started with {}, HSM mode has {same:#?}", act.path, act.goal));
        };
        let missing = (0..number).find(|n| !started.contains(n) && !beside(&hsm.acts[*n], act));
        if let Some(missing) = missing {
            return Some(format!("{} started before {}", act.path, hsm.acts[missing].path));
        }
        if let Some(running) = act.running.iter().map(|n| &cdtn.acts[*n]).find(|other| !beside(other, act)) {
            return Some(format!("{} started while {} had not ended", act.path, running.path));
        }
        if !started.insert(number) {
            return Some(format!("{} started twice", act.path));
        }
    }
    None
}

/// Per actuator the same PIAs in the same order, but for those of the regions of a preemptive concurrency.
fn actuators(program: &Program, hsm: &Story, cdtn: &Story) -> Option<String> {
    let by_actuator = |story: &Story| {
        let mut all: BTreeMap<String, Vec<String>> = BTreeMap::new();
        for act in &story.acts {
            let Some(state) = state_of(program, &act.path) else { continue };
            if is_in_routine(program, state) {
                continue;
            }
            for resource in &state.annotations.resources {
                all.entry(resource.kind.clone()).or_default().push(act.path.clone());
            }
        }
        all.remove(super::PART);
        all
    };
    let (hsm, cdtn) = (by_actuator(hsm), by_actuator(cdtn));
    (hsm != cdtn).then(|| differ("the PIAs per actuator", &hsm, &cdtn)).flatten()
}

fn changes(hsm: &Story, cdtn: &Story) -> Option<String> {
    (hsm.changes != cdtn.changes).then(|| differ("what became real", &hsm.changes, &cdtn.changes)).flatten()
}

fn retired(hsm: &Story, cdtn: &Story) -> Option<String> {
    let paths = |story: &Story| story.retired.iter().map(|(p, all)| (p.clone(), all.len())).collect::<Vec<_>>();
    if paths(hsm) != paths(cdtn) {
        return differ("retired instances", paths(hsm), paths(cdtn));
    }
    let all = hsm.retired.iter().zip(&cdtn.retired);
    let mut pairs = all.flat_map(|((path, a), (_, b))| a.iter().zip(b).map(move |(a, b)| (path, a, b)));
    let (path, a, b) = pairs.find(|(_, a, b)| !a.may_be(b))?;
    differ(&format!("the results of {path}"), a, b)
}
