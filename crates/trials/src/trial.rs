//! Executes one random program in both modes and compares them: the safety theorem, clause by clause.
//!
//! A log has the order of events, so a check at every start of a PIA in it covers every moment of the run.

use super::awaited::early_signals;
use super::blind;
use super::reference::{self, Fail, Given, ReferenceResult};
use super::replay::replayed;
use super::story::{Act, Story, are_beside, story};
use super::weak;
use super::{Dice, Features, HashOracle, RESOURCES, around, attributes, is_in_routine, is_long, offers, state_of};
use ratn_executive::protocol::{Event, Learned, Mode};
use ratn_model::program::{Program, SUCCESS, State, StateKind};
use ratn_model::resource::{Quantity, ResourceClass};
use ratn_model::tolerance::Tolerance;
use ratn_model::value::Value;
use ratn_simulation::run::{Checks, Circumstances, Mischief, Run, RunError, Setup, Trigger, run_under};
use std::collections::{BTreeMap, BTreeSet};
use std::num::NonZeroUsize;
use std::sync::Arc;
use std::time::Duration;

/// Limit of events in HSM mode; programs with more are left out.
pub(super) const MAX_HSM_EVENTS: usize = 6_000;
/// CDTN mode may need this many times more events, because it also computes what is never needed.
pub(super) const MAX_CDTN_EVENTS: usize = 60;

pub(super) fn max_hsm_events(program: &Program) -> usize {
    MAX_HSM_EVENTS * if is_long(program) { 20 } else { 1 }
}

/// The conditions of a trial.
#[derive(Debug, Clone, PartialEq)]
pub struct Conditions {
    /// Seed of the oracle and of all faults.
    pub seed: u64,
    /// Whether the theorem's assumptions do not hold.
    pub weak: bool,
    /// Whether nothing in the program reads the world.
    pub blind: bool,
    /// Percentage of visits that fail.
    pub failures_percent: u64,
    /// Percentage of attempts that crash.
    pub crashes_percent: u64,
    /// Percentage of effects whose measured values differ.
    pub deviations_percent: u64,
    /// Grants and projections take up to this long, in seconds.
    pub latency_s: f64,
    /// Percentage of messages that arrive late, twice, or after they are no longer wanted.
    pub mischief_percent: u64,
    /// Whether an operator pauses, steps and resumes.
    pub pauses: bool,
    /// Number of orders that look-ahead tries.
    pub orders: usize,
    /// Percentage of states whose acquires are never granted.
    pub refused_percent: u64,
    /// Whether there are emergency stops.
    pub stops: bool,
    /// After this number of events the run is resumed from its log.
    pub resume_after: Option<usize>,
    /// Whether earlier runs have taught something, right or wrong.
    pub learned: bool,
}

/// The result of a trial.
#[derive(Debug, Clone, PartialEq)]
pub enum Verdict {
    /// Both modes did the same; with their ends in seconds.
    Same {
        /// In HSM mode.
        hsm_s: f64,
        /// In CDTN mode.
        cdtn_s: f64,
        /// Number of PIAs started.
        acts: usize,
    },
    /// Not compared, because the run is too long.
    LeftOut,
    /// The theorem does not hold: the difference.
    Differs(String),
}

impl Conditions {
    /// The conditions of a seed.
    pub fn of(seed: u64, features: &Features) -> Conditions {
        let mut dice = Dice(seed ^ 0x5eed_c0de);
        let mut some = |chance: u64, much: u64| if dice.percent(chance) { much } else { 0 };
        let mut conditions = Conditions {
            seed,
            weak: features.weak,
            blind: features.blind,
            failures_percent: some(50, 5),
            crashes_percent: some(60, 12),
            deviations_percent: if features.measured { some(50, 30) } else { 0 },
            latency_s: if some(50, 1) == 1 { 1.5 } else { 0.0 },
            mischief_percent: some(40, 20),
            pauses: some(15, 1) == 1,
            orders: some(15, 12) as usize,
            refused_percent: 0,
            stops: false,
            resume_after: None,
            learned: false,
        };
        if features.blind {
            conditions.failures_percent = 20;
        }
        if features.patterns {
            conditions.deviations_percent = some(70, 50);
        }
        if features.incidents {
            conditions.refused_percent = some(12, 8);
            conditions.stops = some(50, 1) == 1;
            let after = some(30, 1 + seed % 150) as usize;
            conditions.resume_after = (after > 0).then_some(after);
        }
        if features.estimates {
            conditions.learned = some(25, 1) == 1;
        }
        conditions
    }
}

/// Runs the program in both modes and compares.
pub fn trial(program: &Arc<Program>, conditions: &Conditions) -> Verdict {
    compare(program, conditions, &[])
}

/// The same with these events from outside.
pub(super) fn compare(program: &Arc<Program>, conditions: &Conditions, outside: &[(Trigger, Event)]) -> Verdict {
    let hsm = match execute_under(program, conditions, Mode::Hsm, max_hsm_events(program), outside.to_vec()) {
        Ok(run) => run,
        Err(RunError::Endless(_) | RunError::TooLong(_)) => return Verdict::LeftOut,
        Err(problem) => return Verdict::Differs(format!("HSM mode: {problem}")),
    };
    let events = MAX_CDTN_EVENTS * hsm.log.len() + 10_000;
    let cdtn = match execute_under(program, conditions, Mode::Cdtn, events, outside.to_vec()) {
        Ok(run) => run,
        Err(problem) => return Verdict::Differs(format!("CDTN mode: {problem}")),
    };
    let stories = (story(program, &hsm), story(program, &cdtn));
    let problem = if conditions.blind {
        blind::problem((&hsm, &stories.0), (&cdtn, &stories.1))
    } else if conditions.weak {
        weak::problem(program, &hsm, &cdtn, &stories)
    } else {
        problem(program, &hsm, &cdtn, &stories)
    };
    let problem = problem.or_else(|| against_reference(program, conditions, outside, (&hsm, &cdtn), &stories));
    match problem {
        Some(problem) => Verdict::Differs(problem),
        None => Verdict::Same { hsm_s: hsm.end_s, cdtn_s: cdtn.end_s, acts: stories.1.acts.len() },
    }
}

/// The first difference of either mode from the reference.
fn against_reference(
    program: &Arc<Program>,
    conditions: &Conditions,
    outside: &[(Trigger, Event)],
    (hsm, cdtn): (&Run, &Run),
    (before, after): &(Story, Story),
) -> Option<String> {
    // With shared facts, one region depends on the timing of another.
    let shares = conditions.weak && weak::shares(program);
    if shares && !conditions.blind {
        return None;
    }
    let wanted = match should_be(program, conditions, outside) {
        Ok(wanted) => wanted,
        Err(Fail::NotMine(_)) => return None,
        Err(problem) => return Some(format!("the reference does not come to an end: {problem:?}")),
    };
    let of = |mode: &str, problem: Option<String>| problem.map(|p| format!("{mode} mode and the reference: {p}"));
    if shares {
        return of("HSM", reference::outcomes(&wanted, hsm, before));
    }
    of("HSM", reference::disagreement(program, &wanted, hsm, before)).or_else(|| {
        // With an imprecise failure, the world beside and behind it is not that of a prefix of the program.
        match conditions.weak {
            true if weak::fails(hsm) || weak::fails(cdtn) => None,
            true => of("CDTN", reference::end(&wanted, cdtn)),
            false => of("CDTN", reference::disagreement(program, &wanted, cdtn, after)),
        }
    })
}

/// Why the reference has no verdict on a program, if it has none.
pub fn no_verdict(program: &Program, conditions: &Conditions) -> Option<&'static str> {
    if conditions.weak && !conditions.blind && weak::shares(program) {
        return Some("regions that share facts");
    }
    match should_be(program, conditions, &[]) {
        Err(Fail::NotMine(why)) => Some(why),
        _ => None,
    }
}

/// Whether the reference, told to end at some place, does what this run did; `None` if it has no verdict.
pub(super) fn is_cut_somewhere(
    program: &Program,
    conditions: &Conditions,
    run: &Run,
    story: &Story,
    outcome: &str,
) -> Option<bool> {
    const MOST_PLACES: usize = 2_000;
    let mut choices = reference::Choices::default();
    for _ in 0..MOST_PLACES {
        let mut oracle = oracle(program, conditions);
        let given = given(program, conditions, &[], &mut oracle);
        let (wanted, made) = reference::evaluate_cut(given, choices, outcome).ok()?;
        if wanted.is_some_and(|wanted| reference::is_cut(program, &wanted, run, story)) {
            return Some(true);
        }
        let Some(next) = made.next() else { return Some(false) };
        choices = next;
    }
    None
}

/// The reference's result for a program.
fn should_be(
    program: &Program,
    conditions: &Conditions,
    outside: &[(Trigger, Event)],
) -> Result<ReferenceResult, Fail> {
    reference::evaluate(given(program, conditions, outside, &mut oracle(program, conditions)))
}

fn given<'a>(
    program: &'a Program,
    conditions: &Conditions,
    outside: &[(Trigger, Event)],
    oracle: &'a mut HashOracle<'_>,
) -> Given<'a> {
    let task_resources = RESOURCES.iter().filter(|(_, class, _)| *class == ResourceClass::Task);
    Given {
        program,
        seed: conditions.seed,
        parameters: parameters(program),
        facts: BTreeMap::new(),
        units: task_resources.map(|(kind, _, n)| ((*kind).to_owned(), Quantity::whole(*n).thousandths())).collect(),
        refused: refused(program, conditions),
        outside: outside.to_vec(),
        signals: early_signals(program, conditions.seed),
        oracle,
    }
}

fn parameters(program: &Program) -> BTreeMap<String, Value> {
    program.parameters.iter().filter_map(|p| Some((p.name.clone(), p.default.clone()?))).collect()
}

pub(super) fn oracle<'a>(program: &'a Program, conditions: &Conditions) -> HashOracle<'a> {
    HashOracle {
        program,
        seed: conditions.seed,
        failures_percent: conditions.failures_percent,
        crashes_percent: conditions.crashes_percent,
        deviations_percent: conditions.deviations_percent,
        stops: conditions.stops,
    }
}

/// One run, in one mode, for inspection.
pub fn execute(
    program: &Arc<Program>,
    conditions: &Conditions,
    mode: Mode,
    max_events: usize,
) -> Result<Run, RunError> {
    execute_under(program, conditions, mode, max_events, Vec::new())
}

/// One run, replayed from its log.
pub(super) fn execute_under(
    program: &Arc<Program>,
    conditions: &Conditions,
    mode: Mode,
    max_events: usize,
    outside: Vec<(Trigger, Event)>,
) -> Result<Run, RunError> {
    let circumstances = Circumstances { resume_after: conditions.resume_after, ..circumstances(program, conditions) };
    let run = run_as(program, conditions, mode, outside, Circumstances { max_events, ..circumstances })?;
    match replayed(program, &run) {
        Some(problem) => Err(RunError::Broken { at_s: run.end_s, problem }),
        None => Ok(run),
    }
}

fn circumstances(program: &Program, conditions: &Conditions) -> Circumstances {
    let seed = conditions.seed;
    let percent = conditions.mischief_percent;
    Circumstances {
        orders: conditions.orders,
        events: if conditions.pauses { pauses(program, seed) } else { Vec::new() },
        mischief: Mischief { seed, twice_percent: percent, late_percent: percent, crossing_percent: 2 * percent },
        // Long programs are not examined, because that would take minutes.
        checks: if is_long(program) { Checks::Environment } else { Checks::Everything },
        examines: !is_long(program),
        checkpoint_every: (!is_long(program)).then(|| checkpoint_every(seed)),
        refused: refused(program, conditions),
        learned: if conditions.learned { learned(program, seed) } else { Learned::default() },
        attributes: attributes(),
        ..Circumstances::default()
    }
}

fn run_as(
    program: &Arc<Program>,
    conditions: &Conditions,
    mode: Mode,
    mut outside: Vec<(Trigger, Event)>,
    mut circumstances: Circumstances,
) -> Result<Run, RunError> {
    let setup = Setup {
        program: program.clone(),
        mode,
        parameters: parameters(program),
        seed: conditions.seed,
        resources: offers(),
        world: Vec::new(),
        tolerance: Tolerance::EXACT,
        latency: Duration::from_secs_f64(conditions.latency_s),
    };
    let early = early_signals(program, conditions.seed).into_iter();
    outside.extend(early.map(|(signal, value)| (Trigger::Before, Event::Signalled { signal, value })));
    outside.append(&mut circumstances.events);
    circumstances.events = outside;
    run_under(setup, &mut oracle(program, conditions), circumstances)
}

/// States whose acquires are never granted, by their paths. States inside of a routine usually acquire nothing themselves.
fn refused(program: &Program, conditions: &Conditions) -> BTreeSet<String> {
    let mut dice = Dice(conditions.seed ^ 0x4ef5ed);
    let mut chosen = |state: &&State| {
        let inside = around(program, state).skip(1).any(State::is_routine);
        !inside && dice.percent(conditions.refused_percent)
    };
    program.states.iter().filter(|state| chosen(state)).map(|state| state.path.clone()).collect()
}

/// Random knowledge from earlier runs.
fn learned(program: &Program, seed: u64) -> Learned {
    let mut dice = Dice(seed ^ 0x1ea4);
    let mut learned = Learned::default();
    for state in &program.states {
        if dice.percent(40) {
            learned.durations_s.insert(state.path.clone(), dice.below(300) as f64 / 10.0);
        }
        if dice.percent(40) {
            let shares = [SUCCESS, "aborted", "again", "done", "then", "else", "found"]
                .map(|outcome| (outcome.to_owned(), dice.below(11) as f64 / 10.0));
            learned.outcomes.insert(state.path.clone(), BTreeMap::from(shares));
        }
    }
    learned
}

/// A random interval of checkpoints; the replay from the log uses no checkpoints.
fn checkpoint_every(seed: u64) -> NonZeroUsize {
    let some = NonZeroUsize::MIN;
    some.saturating_add(Dice(seed ^ 0xc4ec).below(30) as usize)
}

/// A pause, a step, breakpoints, and the events that end them.
fn pauses(program: &Program, seed: u64) -> Vec<(Trigger, Event)> {
    let mut dice = Dice(seed ^ 0xbea7);
    let mut some = Dice(seed ^ 0xb4ea);
    let states = program.states.iter().filter(|_| some.percent(30)).map(|state| state.path.clone()).collect();
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
        later(Event::BreakpointsSet { states }),
        later(Event::ResumeRequested),
        later(Event::ResumeRequested),
        later(Event::StepRequested),
        later(Event::BreakpointsSet { states: Vec::new() }),
        later(Event::ResumeRequested),
    ]
}

fn differ(what: &str, hsm: impl std::fmt::Debug, cdtn: impl std::fmt::Debug) -> Option<String> {
    Some(format!("{what} differ:\n hsm  {hsm:#?}\n cdtn {cdtn:#?}"))
}

/// The first clause of the theorem that does not hold.
pub(super) fn problem(program: &Program, hsm: &Run, cdtn: &Run, stories: &(Story, Story)) -> Option<String> {
    let undone = stories.1.undone.first();
    undone
        .map(|path| format!("{path} was discarded or computed again after it had started, and it is a PIA"))
        .or_else(|| difference(program, hsm, cdtn, stories))
}

/// The first difference between the modes.
pub(super) fn difference(program: &Program, hsm: &Run, cdtn: &Run, (before, after): &(Story, Story)) -> Option<String> {
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

/// Compares outcome, outputs, world and task resources.
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

/// At every moment the PIAs started are a subset of those of HSM mode, each started once, and all PIAs before them in the program
/// have started and ended.
pub(super) fn closure(program: &Program, hsm: &Story, cdtn: &Story) -> Option<String> {
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

/// Checks that each actuator has the same PIAs in the same order, except those in regions of a preemptive concurrency.
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
        // There are several units of these, or only fractions are used, so regions may use them in any order.
        [super::PART, super::TOOL, super::POWER, super::BATTERY].iter().for_each(|kind| drop(all.remove(*kind)));
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
