//! Checks that the preconditions of every motion of a run were true when it began, with the facts followed through the log.

use super::Fail;
use super::effects;
use super::evaluate::{Place, Read};
use super::facts::Facts;
use ratn_executive::protocol::{Command, Event, LogEntry, Note};
use ratn_model::expression::Expr;
use ratn_model::id::{InstanceId, StateId};
use ratn_model::program::{Nature, Program, StateKind};
use ratn_model::value::Value;
use ratn_simulation::run::Run;
use std::collections::BTreeMap;

/// The first motion that began although a precondition did not hold. Values of variables are taken from the inputs; preconditions
/// that need more than these and facts are skipped.
pub(in super::super) fn unmet(program: &Program, run: &Run) -> Option<String> {
    let mut facts = Facts::new();
    let mut states: BTreeMap<InstanceId, StateId> = BTreeMap::new();
    let (outputs, regions) = Default::default();
    for line in &run.log {
        match &line.entry {
            LogEntry::Event(Event::Started { world, .. }) => facts = world.iter().cloned().collect(),
            LogEntry::Event(Event::WorldChanged { facts: changed, .. }) => {
                for (key, value) in changed {
                    facts.remove(key);
                    facts.extend(value.clone().map(|value| (key.clone(), value)));
                }
            }
            LogEntry::Command(Command::Commit { changes, .. }) => match effects::applied(&facts, changes, None) {
                Ok(next) => facts = next,
                Err(problem) => return Some(format!("{changes:?} was made real: {problem:?}")),
            },
            LogEntry::Command(Command::Note(Note::Expanded { instance, state, .. })) => {
                states.insert(*instance, *state);
            }
            LogEntry::Command(Command::Start { instance, goal, .. }) => {
                let Some(state) = states.get(instance).map(|id| program.state(*id)) else { continue };
                let StateKind::Action { inputs, .. } = &state.kind else { continue };
                if state.annotations.nature != Nature::Irreversible || state.annotations.requires.is_empty() {
                    continue;
                }
                let named = |(port, value): &(String, Expr)| match value {
                    Expr::Variable(name) => Some((name.clone(), goal.inputs.get(port)?.clone())),
                    _ => None,
                };
                let variables: Vec<(String, Value)> = inputs.iter().filter_map(named).collect();
                let row = Vec::new();
                let place = Place {
                    program,
                    facts: &facts,
                    outputs: &outputs,
                    regions: &regions,
                    variables,
                    own: None,
                    elements: Vec::new(),
                    row,
                };
                for required in &state.annotations.requires {
                    match required.is_true(&place) {
                        Ok(true) | Err(Fail::Unwritten(_) | Fail::NotMine(_)) => {}
                        other => return Some(format!("{} began although `{required}` is {other:?}", state.path)),
                    }
                }
            }
            _ => {}
        }
    }
    None
}
