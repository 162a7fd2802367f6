//! Assumed providers, of which only the ports are known: every goal succeeds, after its known duration, with assumed outputs. Waits end,
//! too: conditions are made true, and questions get their default or their first choice as answer.

use super::Assumptions;
use crate::run::{Answer, Oracle, Performance};
use crate::timed::TimedProviders;
use ratn_executive::protocol::{Event, Goal};
use ratn_model::expression::EffectExpr;
use ratn_model::expression::scope::NothingKnown;
use ratn_model::fact::{Change, FactKey};
use ratn_model::id::{InstanceId, Revision};
use ratn_model::pose::Pose;
use ratn_model::program::{ABORTED, Program, SUCCESS, State, StateKind};
use ratn_model::value::{Trajectory, TrajectoryPoint, Type, Value};
use ratn_model::wait::Wait;
use ratn_world::world::World;
use std::collections::{BTreeMap, BTreeSet};

/// Assumed duration of an action, in seconds, if none is known.
const UNKNOWN_S: f64 = 1.0;
/// Limit of goals; further ones fail, because with these assumptions the task would never end.
const MAX_GOALS: usize = 5_000;
/// Length of an assumed list of numbers: a size or a position.
const NUMBERS: usize = 3;
/// Number of joints of an assumed arm.
const JOINTS: usize = 7;

pub(super) struct AssumedProviders {
    /// By the path of the state.
    outputs: BTreeMap<String, BTreeMap<String, Type>>,
    /// The states that wait, by path.
    waits: BTreeMap<String, State>,
    durations_s: BTreeMap<String, f64>,
    known: TimedProviders,
    elements: usize,
    unknown: BTreeSet<String>,
    goals: usize,
}

impl AssumedProviders {
    pub(super) fn new(program: &Program, assumptions: &Assumptions) -> AssumedProviders {
        let outputs = program.states.iter().filter_map(|state| match &state.kind {
            StateKind::Action { outputs, .. } => Some((state.path.clone(), outputs.clone())),
            _ => None,
        });
        AssumedProviders {
            outputs: outputs.collect(),
            waits: program
                .states
                .iter()
                .filter(|state| state.wait().is_some())
                .map(|state| (state.path.clone(), state.clone()))
                .collect(),
            durations_s: assumptions.durations_s.clone(),
            known: TimedProviders { boxes: assumptions.elements },
            elements: assumptions.elements,
            unknown: BTreeSet::new(),
            goals: 0,
        }
    }

    pub(super) fn unknown_durations(&mut self) -> BTreeSet<String> {
        std::mem::take(&mut self.unknown)
    }

    /// Why goals were made to fail, if they were.
    pub(super) fn gave_up(&self) -> Option<String> {
        (self.goals > MAX_GOALS).then(|| format!("it asks for more than {MAX_GOALS} goals"))
    }
}

impl Oracle for AssumedProviders {
    fn perform(&mut self, path: &str, _attempt: u32, goal: &Goal, _world: &World) -> Performance {
        self.goals += 1;
        let path = plain(path);
        let known_s = self.durations_s.get(&path).copied().or(goal.expected_s);
        if known_s.is_none() {
            self.unknown.insert(path.clone());
        }
        let has_given_up = self.goals > MAX_GOALS;
        let mut outputs = self.known.outputs(goal);
        if let Some(declared) = self.outputs.get(&path) {
            outputs.retain(|port, value| declared.get(port).is_some_and(|ty| ty.accepts(value)));
            for (port, ty) in declared {
                outputs.entry(port.clone()).or_insert_with(|| assumed(ty, port, self.elements));
            }
        }
        let outcome = if has_given_up { ABORTED } else { SUCCESS }.to_owned();
        let answer = Answer::Finished { outcome, outputs, measured: Vec::new() };
        Performance { duration_s: known_s.unwrap_or(UNKNOWN_S), answer }
    }

    fn awaited(&mut self, path: &str, instance: InstanceId) -> Option<(f64, Event)> {
        self.goals += 1;
        let path = plain(path);
        let state = self.waits.get(&path)?;
        let event = match state.wait()? {
            Wait::Seconds(_) | Wait::Until(_) | Wait::Limit(_) | Wait::Watch(_) => return None,
            Wait::Signal(signal) => {
                let value = assumed(&Type::Any, signal, self.elements);
                Event::Signalled { signal: signal.to_owned(), value }
            }
            Wait::Answer(question) => {
                let choice = question.default.or(question.choices.first().copied())?;
                Event::Answered { instance, choice: choice.to_owned() }
            }
            Wait::Condition(condition) => match made_true(state) {
                Some(facts) => Event::WorldChanged { revision: Revision(0), facts },
                None => {
                    let reason = format!("what makes `{condition}` hold of {path} is not known");
                    Event::AbortRequested { reason, at_once: true }
                }
            },
        };
        let declared = state.annotations.duration_s.as_ref().and_then(|duration| duration.evaluate(&NothingKnown).ok());
        let known_s = self.durations_s.get(&path).copied().or(declared.and_then(|value| value.as_number()));
        if known_s.is_none() {
            self.unknown.insert(path);
        }
        Some((known_s.unwrap_or(UNKNOWN_S), event))
    }
}

/// The facts that make the condition of a wait true, if it states them literally with constant arguments.
fn made_true(state: &State) -> Option<Vec<(FactKey, Option<Value>)>> {
    let foreseen = state.annotations.effects.get(SUCCESS)?;
    let changes = EffectExpr::bind(foreseen, &NothingKnown).ok().filter(|changes| !changes.is_empty())?;
    let fact = |change: Change| match change {
        Change::Set { fact, value } => Some((fact, Some(value))),
        Change::Delete { pattern } => {
            let arguments = pattern.arguments.into_iter().collect::<Option<Vec<_>>>()?;
            Some((FactKey { predicate: pattern.predicate, arguments }, None))
        }
        Change::Increase { .. } => None,
    };
    changes.into_iter().map(fact).collect()
}

/// A path without visits: `for[2]/look#3` is `for/look`.
fn plain(path: &str) -> String {
    let parts = path.split('/').map(|part| part.split(['[', '#']).next().unwrap_or_default());
    parts.collect::<Vec<_>>().join("/")
}

/// An assumed value of a type; strings and list elements use the port's name and are all different.
fn assumed(ty: &Type, name: &str, elements: usize) -> Value {
    match ty {
        Type::Bool => Value::Bool(true),
        Type::Int => Value::Int(1),
        Type::Float => Value::Float(0.1),
        Type::Any | Type::String => Value::String(name.to_owned()),
        Type::Pose => Value::Pose(Pose::at(0.5, 0.0, 0.5)),
        Type::Joints => Value::Joints(vec![0.0; JOINTS]),
        Type::Trajectory => {
            let point =
                |time_s| TrajectoryPoint { time_s, positions: vec![0.0; JOINTS], velocities: vec![0.0; JOINTS] };
            let joints = (1..=JOINTS).map(|joint| format!("joint_{joint}")).collect();
            Value::Trajectory(Trajectory { joints, points: vec![point(0.0), point(1.0)] })
        }
        Type::Bytes => Value::Bytes(Vec::new()),
        Type::List(element) => {
            let count = if matches!(**element, Type::Float | Type::Int) { NUMBERS } else { elements };
            Value::List((1..=count).map(|at| assumed(element, &format!("{name}_{at}"), elements)).collect())
        }
        Type::Map(value) => Value::Map(BTreeMap::from([(name.to_owned(), assumed(value, name, elements))])),
        Type::Record(fields) => {
            let field =
                |(field, ty): (&String, &Type)| (field.clone(), assumed(ty, &format!("{name}_{field}"), elements));
            Value::Map(fields.iter().map(field).collect())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_type_has_a_value_and_elements_differ() {
        let ty = Type::List(Box::new(Type::Record(BTreeMap::from([
            ("id".to_owned(), Type::String),
            ("size".to_owned(), Type::List(Box::new(Type::Float))),
            ("path".to_owned(), Type::Trajectory),
        ]))));
        let value = assumed(&ty, "boxes", 2);
        assert!(ty.accepts(&value), "{value:?}");
        let Value::List(boxes) = value else { unreachable!("it is a list") };
        assert_ne!(boxes[0].field("id"), boxes[1].field("id"));
        assert_eq!(plain("for[2]/look#3/a"), "for/look/a");
    }
}
