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
            .map(|(other, earlier)| (bond(program, &visits, *other, id), *other, earlier))
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
    /// They only ended and began together, as far as the program says.
    Coincidence,
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
            Bond::Coincidence => "the one before ended just then".to_owned(),
        }
    }
}

/// Why the visit `behind` waits for the visit `before`. Where a state is visited several times, each visit takes the outputs of one visit.
fn bond(program: &Program, visits: &BTreeMap<InstanceId, Visit>, before: InstanceId, behind: InstanceId) -> Bond {
    let (earlier, visit) = (&visits[&before], &visits[&behind]);
    let state = program.state(visit.state);
    let takes = |expression: &Expr| {
        expression.flows().into_iter().any(|source| {
            is_within(program, earlier.state, source) && source_visit(program, visits, source, behind) == Some(before)
        })
    };
    let takes_in = |state: &State, is_meant: fn(Slot<'_>) -> bool| {
        state.expressions().into_iter().any(|(slot, expression)| is_meant(slot) && takes(expression))
    };
    if takes_in(state, |slot| matches!(slot, Slot::Input(_))) {
        return Bond::Output;
    }
    let decides = |slot: Slot<'_>| matches!(slot, Slot::Collection | Slot::While | Slot::Condition);
    if around(program, state).any(|state| takes_in(state, decides)) {
        return Bond::Decision;
    }
    let blocked_before = || blocked(program, program.state(earlier.state));
    if let Some(kind) = blocked(program, state).find(|kind| blocked_before().any(|k| k == *kind)) {
        return Bond::Resource(kind.to_owned());
    }
    // What is younger is waited for over its resources only.
    if before > behind {
        return Bond::Coincidence;
    }
    match state.annotations.nature {
        Nature::Senses(_) => Bond::Looking,
        Nature::Irreversible => Bond::Order,
        Nature::Computes => Bond::World,
    }
}

/// Whether a state is another one or within it.
fn is_within(program: &Program, state: StateId, outer: StateId) -> bool {
    std::iter::successors(Some(state), |id| program.state(*id).parent).any(|ancestor| ancestor == outer)
}

/// The visit that writes what a visit takes of `source`: the latest before it, in the same iterations of the loops around both, and of
/// what is within `source` the one that ended last.
fn source_visit(
    program: &Program,
    visits: &BTreeMap<InstanceId, Visit>,
    source: StateId,
    behind: InstanceId,
) -> Option<InstanceId> {
    // The states around the source, which are those around the visit too, with their iterations and visits.
    let depth = program.state(source).path.split('/').count() - 1;
    let place = |path: &str, depth: usize| path.split('/').take(depth).map(str::to_owned).collect::<Vec<_>>();
    let shared = place(&visits[&behind].path, depth);
    let written = visits.range(..behind).filter(|(_, visit)| {
        visit.began.is_some() && is_within(program, visit.state, source) && place(&visit.path, depth) == shared
    });
    // All that is within one visit of the source has its place in common.
    let (_, latest) = written.clone().next_back()?;
    let own = place(&latest.path, depth + 1);
    let within = written.filter(|(_, visit)| place(&visit.path, depth + 1) == own);
    within.max_by_key(|(id, visit)| (visit.ended, **id)).map(|(id, _)| *id)
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
