//! The story of a run, in the terms of the safety theorem: which PIAs started and ended when, which instances retired with which
//! results, which changes became real.

use super::anytime::without_cost;
use super::{around, compared_as, is_in_routine, is_preemptive, plain, state_of};
use ratn_executive::protocol::{Command, Event, Goal, LogEntry, Note};
use ratn_model::fact::Change;
use ratn_model::id::InstanceId;
use ratn_model::program::{ABORTED, Nature, PREEMPTED, Program, State, StateKind, VIOLATED};
use ratn_model::value::Value;
use ratn_simulation::run::Run;
use std::collections::BTreeMap;

/// One goal of a PIA.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Act {
    pub(super) path: String,
    /// Its try (as the seed derived from it) and its inputs.
    pub(super) goal: String,
    /// The acts that had not ended when it started.
    pub(super) running: Vec<usize>,
}

/// The result of a retired action.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Real {
    pub(super) outcome: String,
    pub(super) data: Data,
}

/// Inputs and outputs.
type Ports = (BTreeMap<String, Value>, BTreeMap<String, Value>);

/// The inputs and outputs of an action.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Data {
    /// It failed; the reason is not compared.
    Untold,
    /// Of the last attempt.
    Of(Ports),
    /// A reused result; the log does not tell which: one of those that were computed at this path.
    OneOf(Vec<Ports>),
}

impl Real {
    pub(super) fn new(outcome: String, data: Option<Ports>) -> Real {
        let data = data.map(|(inputs, outputs)| (without_cost(&inputs), without_cost(&outputs)));
        Real { outcome, data: data.map_or(Data::Untold, Data::Of) }
    }

    /// Whether both can be the same result.
    pub(super) fn may_be(&self, other: &Real) -> bool {
        let data = match (&self.data, &other.data) {
            (Data::Untold, _) | (_, Data::Untold) => true,
            (Data::Of(a), Data::Of(b)) => a == b,
            (Data::Of(one), Data::OneOf(all)) | (Data::OneOf(all), Data::Of(one)) => all.contains(one),
            (Data::OneOf(some), Data::OneOf(others)) => some.iter().any(|one| others.contains(one)),
        };
        self.outcome == other.outcome && data
    }
}

/// The try and the inputs of a goal.
pub(super) fn goal_text(goal: &Goal) -> String {
    format!("{:x} {:?}", goal.seed, without_cost(&goal.inputs))
}

/// The story of a run.
#[derive(Debug, Default)]
pub(super) struct Story {
    /// The PIAs' goals, in the order in which they started.
    pub(super) acts: Vec<Act>,
    /// The actions that retired, by path, except those inside of routines.
    pub(super) retired: BTreeMap<String, Vec<Real>>,
    /// The changes that became real, by predicate, or by fact if there are regions.
    pub(super) changes: BTreeMap<String, Vec<Change>>,
    /// PIAs that were discarded, or computed again, after they had started.
    pub(super) undone: Vec<String>,
    /// The acts that had not ended.
    pub(super) running: Vec<usize>,
}

#[derive(Default)]
struct Life {
    path: String,
    tells: bool,
    irreversible: bool,
    is_kept: bool,
    outcome: String,
    started: Option<usize>,
    attempt: u32,
    inputs: Option<BTreeMap<String, Value>>,
    outputs: BTreeMap<String, Value>,
    reused: bool,
}

pub(super) fn story(program: &Program, run: &Run) -> Story {
    let mut lives: BTreeMap<InstanceId, Life> = BTreeMap::new();
    let mut running: Vec<usize> = Vec::new();
    let mut answers: BTreeMap<String, Vec<Ports>> = BTreeMap::new();
    let mut story = Story::default();
    for line in &run.log {
        match &line.entry {
            LogEntry::Command(Command::Note(note)) => match note {
                Note::Expanded { instance, state, path, .. } => {
                    let state = program.state(*state);
                    let life = Life {
                        path: path.clone(),
                        tells: matches!(state.kind, StateKind::Action { .. }) && !is_in_routine(program, state),
                        irreversible: is_pia(state),
                        is_kept: is_pia(state) && !around(program, state).any(is_preemptive),
                        ..Life::default()
                    };
                    lives.insert(*instance, life);
                }
                Note::Finished { instance, outcome } => {
                    if let Some(life) = lives.get_mut(instance) {
                        life.outcome = outcome.to_string();
                        running.retain(|act| Some(*act) != life.started);
                    }
                }
                Note::Reused { instance } => {
                    if let Some(life) = lives.get_mut(instance) {
                        life.reused = true;
                    }
                }
                Note::Retired { instance } => {
                    if let Some(life) = lives.get(instance).filter(|life| life.tells) {
                        // Reasons of failures are not compared.
                        let data = match life.outcome.as_str() {
                            ABORTED | PREEMPTED | VIOLATED => Data::Untold,
                            _ if life.reused => Data::OneOf(answers.get(&life.path).cloned().unwrap_or_default()),
                            _ => Data::Of((life.inputs.clone().unwrap_or_default(), life.outputs.clone())),
                        };
                        let result = Real { outcome: life.outcome.clone(), data };
                        story.retired.entry(life.path.clone()).or_default().push(result);
                    }
                }
                Note::Squashed { instance } | Note::Invalidated { instance, .. } => {
                    if let Some(life) = lives.get_mut(instance) {
                        life.outcome.clear();
                        life.reused = false;
                    }
                    // A PIA under way is discarded only if another region has won a race.
                    if let Some(life) = lives.get(instance).filter(|life| life.is_kept && life.started.is_some()) {
                        story.undone.push(life.path.clone());
                    }
                }
                _ => {}
            },
            LogEntry::Command(Command::Start { instance, goal, attempt }) => {
                let Some(life) = lives.get_mut(instance) else { continue };
                life.attempt = *attempt;
                life.outcome.clear();
                life.inputs = Some(without_cost(&goal.inputs));
                life.outputs.clear();
                life.reused = false;
                if life.irreversible {
                    // An earlier try of the same PIA has ended.
                    running.retain(|act| Some(*act) != life.started);
                    let goal = goal_text(goal);
                    story.acts.push(Act { path: life.path.clone(), goal, running: running.clone() });
                    life.started = Some(story.acts.len() - 1);
                    running.extend(life.started);
                }
            }
            LogEntry::Command(Command::Cancel { instance, .. }) => {
                if let Some(life) = lives.get(instance) {
                    running.retain(|act| Some(*act) != life.started);
                }
            }
            LogEntry::Command(Command::Commit { changes, .. }) => {
                for change in changes {
                    story.changes.entry(compared_as(program, change)).or_default().push(change.clone());
                }
            }
            LogEntry::Event(
                Event::Finished { instance, attempt, outputs, .. } | Event::Improved { instance, attempt, outputs, .. },
            ) => {
                let is_answer = |life: &&mut Life| life.attempt == *attempt && life.outcome.is_empty();
                if let Some(life) = lives.get_mut(instance).filter(is_answer) {
                    life.outputs = without_cost(outputs);
                    if !life.irreversible {
                        let ports = (life.inputs.clone().unwrap_or_default(), life.outputs.clone());
                        answers.entry(life.path.clone()).or_default().push(ports);
                    }
                    running.retain(|act| Some(*act) != life.started);
                }
            }
            LogEntry::Event(Event::Crashed { instance, .. }) => {
                if let Some(life) = lives.get(instance) {
                    running.retain(|act| Some(*act) != life.started);
                }
            }
            _ => {}
        }
    }
    story.running = running;
    story
}

fn is_pia(state: &State) -> bool {
    matches!(state.kind, StateKind::Action { .. }) && state.annotations.nature == Nature::Irreversible
}

/// Whether two places of the program are unordered: in different regions of one visit of a concurrency.
pub(super) fn are_beside(program: &Program, a: &str, b: &str) -> bool {
    let (mut a, mut b) = (a.split('/'), b.split('/'));
    let mut common = String::new();
    loop {
        match (a.next(), b.next()) {
            (Some(x), Some(y)) if x == y => {
                if !common.is_empty() {
                    common.push('/');
                }
                common.push_str(x);
            }
            (Some(x), Some(y)) => {
                // Two iterations, or two visits, of one state are ordered.
                let both = state_of(program, &common);
                return plain(x) != plain(y)
                    && both.is_some_and(|state| matches!(state.kind, StateKind::Concurrency { .. }));
            }
            _ => return false,
        }
    }
}
