//! The longest chain of a run: from what ended last, back over what each state waited for.

use ratn_executive::protocol::{Command, LogEntry, LogLine, Note};
use ratn_model::expression::Expr;
use ratn_model::id::{InstanceId, StateId};
use ratn_model::program::{Nature, Program, State};
use ratn_model::resource::ResourceOperation;
use ratn_model::slot::Slot;
use ratn_model::time::Timestamp;
use serde::Serialize;
use std::collections::BTreeMap;

/// One state of the chain.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Link {
    /// Its path with visits.
    pub path: String,
    /// When it began, in seconds.
    pub began_s: f64,
    /// When it ended, in seconds.
    pub ended_s: f64,
    /// Why it did not begin before the one before it in the chain had ended.
    pub because: String,
}

#[derive(Debug, Clone)]
struct Visit {
    path: String,
    state: StateId,
    began: Option<Timestamp>,
    ended: Option<Timestamp>,
}

/// The chain, from the first to the last.
pub(super) fn chain(program: &Program, log: &[LogLine]) -> Vec<Link> {
    let visits = visits(log);
    let mut links = Vec::new();
    let last = visits.iter().filter(|(_, visit)| visit.began.is_some()).max_by_key(|(id, visit)| (visit.ended, **id));
    let mut at = last.map(|(id, visit)| (*id, visit));
    while let Some((id, visit)) = at {
        let (Some(began), Some(ended)) = (visit.began, visit.ended) else { break };
        // What ended just then, the closest bond first. Of equals, the youngest.
        let before = visits
            .iter()
            .filter(|(other, earlier)| {
                **other != id && earlier.ended == Some(began) && earlier.began.is_some_and(|b| b < began)
            })
            .map(|(other, earlier)| (bond(program, earlier.state, visit.state), *other, earlier))
            .max_by_key(|(bond, other, _)| (std::cmp::Reverse(bond.clone()), *other));
        let because = match &before {
            Some((bond, _, _)) => bond.sentence(),
            None if began == Timestamp(0) => "it is the first".to_owned(),
            None => "it was tried again after a pause".to_owned(),
        };
        links.push(Link { path: visit.path.clone(), began_s: began.seconds(), ended_s: ended.seconds(), because });
        at = before.map(|(_, other, earlier)| (other, earlier));
    }
    links.reverse();
    links
}

/// What was executed, and when.
fn visits(log: &[LogLine]) -> BTreeMap<InstanceId, Visit> {
    let mut visits: BTreeMap<InstanceId, Visit> = BTreeMap::new();
    for line in log {
        let LogEntry::Command(Command::Note(note)) = &line.entry else { continue };
        match note {
            Note::Expanded { instance, state, path, .. } => {
                let visit = Visit { path: path.clone(), state: *state, began: None, ended: None };
                visits.insert(*instance, visit);
            }
            Note::Running { instance, .. } => {
                if let Some(visit) = visits.get_mut(instance) {
                    visit.began = Some(line.at);
                }
            }
            Note::Finished { instance, .. } => {
                if let Some(visit) = visits.get_mut(instance) {
                    visit.ended = Some(line.at);
                }
            }
            _ => {}
        }
    }
    visits
}

/// Why one state waits for another, the closest first.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
enum Bond {
    Output,
    Decision,
    Resource(String),
    Looking,
    Order,
    World,
}

impl Bond {
    fn sentence(&self) -> String {
        match self {
            Bond::Output => "it takes an output of the one before".to_owned(),
            Bond::Decision => "the one before decides whether or how often it comes".to_owned(),
            Bond::Resource(kind) => format!("the one before held {kind}"),
            Bond::Looking => "it looks at what the one before changes".to_owned(),
            Bond::Order => "it may be irreversible: everything older must have ended".to_owned(),
            Bond::World => "it reads what the one before may change".to_owned(),
        }
    }
}

fn bond(program: &Program, before: StateId, behind: StateId) -> Bond {
    let state = program.state(behind);
    let around = || around(program, state);
    let is_of_before = |id: StateId| {
        std::iter::successors(Some(before), |id| program.state(*id).parent).any(|ancestor| ancestor == id)
    };
    let takes = |expression: &Expr| expression.flows().into_iter().any(is_of_before);
    let takes_in = |state: &State, is_meant: fn(Slot<'_>) -> bool| {
        state.expressions().into_iter().any(|(slot, expression)| is_meant(slot) && takes(expression))
    };
    if takes_in(state, |slot| matches!(slot, Slot::Input(_))) {
        return Bond::Output;
    }
    let decides = |slot: Slot<'_>| matches!(slot, Slot::Collection | Slot::While | Slot::Condition);
    if around().any(|state| takes_in(state, decides)) {
        return Bond::Decision;
    }
    if let Some(kind) = blocked(program, state).find(|kind| blocked(program, program.state(before)).any(|k| k == *kind))
    {
        return Bond::Resource(kind.to_owned());
    }
    match state.annotations.nature {
        Nature::Senses(_) => Bond::Looking,
        Nature::Irreversible => Bond::Order,
        Nature::Computes => Bond::World,
    }
}

fn around<'a>(program: &'a Program, state: &'a State) -> impl Iterator<Item = &'a State> {
    std::iter::successors(Some(state), |state| state.parent.map(|parent| program.state(parent)))
}

fn blocked<'a>(program: &'a Program, state: &'a State) -> impl Iterator<Item = &'a str> {
    around(program, state)
        .flat_map(|state| &state.annotations.resources)
        .filter(|resource| resource.operation == ResourceOperation::Block)
        .map(|resource| resource.kind.as_str())
}
