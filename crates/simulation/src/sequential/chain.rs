//! The critical chain of a run: from the last end back over what each state waited for.

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
    /// Why it could not begin before the previous state of the chain had ended.
    pub because: String,
}

#[derive(Debug, Clone)]
struct Visit {
    path: String,
    state: StateId,
    began: Option<Timestamp>,
    ended: Option<Timestamp>,
}

/// The chain, first state first.
pub(super) fn chain(program: &Program, log: &[LogLine]) -> Vec<Link> {
    let visits = Visits::of(log);
    let mut links = Vec::new();
    let last = visits.all.iter().filter(|(_, visit)| visit.began.is_some());
    let mut at = last.max_by_key(|(id, visit)| (visit.ended, **id)).map(|(id, visit)| (*id, visit));
    while let Some((id, visit)) = at {
        let (Some(began), Some(ended)) = (visit.began, visit.ended) else { break };
        // Of those that ended then: the closest bond, then the youngest.
        let before = visits
            .ended_at(began)
            .filter(|(other, earlier)| *other != id && earlier.began.is_some_and(|b| b < began))
            .map(|(other, earlier)| (bond(program, &visits, other, id), other, earlier))
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

/// The visits of states, with their times.
struct Visits {
    all: BTreeMap<InstanceId, Visit>,
    by_end: BTreeMap<Timestamp, Vec<InstanceId>>,
    /// Visits that began, by every path (with visits) that they are at or inside of, the oldest first.
    within: BTreeMap<String, Vec<InstanceId>>,
    /// The same by the path around and the name of the state, for all visits of it.
    of_state: BTreeMap<(String, String), Vec<InstanceId>>,
}

impl Visits {
    fn of(log: &[LogLine]) -> Visits {
        let all = visits(log);
        let (mut by_end, mut within, mut of_state) =
            (BTreeMap::<Timestamp, Vec<InstanceId>>::new(), BTreeMap::<_, Vec<_>>::new(), BTreeMap::<_, Vec<_>>::new());
        for (id, visit) in &all {
            visit.ended.iter().for_each(|ended| by_end.entry(*ended).or_default().push(*id));
            let parts: Vec<&str> = visit.path.split('/').collect();
            for depth in (0..parts.len()).filter(|_| visit.began.is_some()) {
                let name = parts[depth].split(['[', '#']).next().unwrap_or_default();
                within.entry(parts[..=depth].join("/")).or_default().push(*id);
                of_state.entry((parts[..depth].join("/"), name.to_owned())).or_default().push(*id);
            }
        }
        Visits { all, by_end, within, of_state }
    }

    fn ended_at(&self, at: Timestamp) -> impl Iterator<Item = (InstanceId, &Visit)> {
        self.by_end.get(&at).into_iter().flatten().map(|id| (*id, &self.all[id]))
    }

    /// The visit that writes what a visit takes from `source`: the latest before it, in the same iterations of the loops around both; if
    /// `source` contains states, the inner visit that ended last.
    fn source(&self, program: &Program, source: StateId, behind: InstanceId) -> Option<InstanceId> {
        // The states around the source are also around the visit, in the same iterations and visits.
        let source = program.state(source);
        let depth = source.path.split('/').count() - 1;
        let place = |path: &str, depth: usize| path.split('/').take(depth).collect::<Vec<_>>().join("/");
        let older = |all: &'_ [InstanceId]| all.partition_point(|id| *id < behind);
        let around = place(&self.all[&behind].path, depth);
        let visits = self.of_state.get(&(around, source.name.clone()))?;
        let latest = visits[..older(visits)].last()?;
        // All visits inside of one visit of the source have the same place.
        let own = self.within.get(&place(&self.all[latest].path, depth + 1))?;
        own[..older(own)].iter().copied().max_by_key(|id| (self.all[id].ended, *id))
    }
}

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

/// Why one state waits for another, the closest bond first.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
enum Bond {
    Output,
    Decision,
    Resource(String),
    Looking,
    Order,
    World,
    /// They only ended and began at the same time; the program gives no reason.
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

/// The bond of the visit `behind` to the visit `before`. If a state is visited several times, each visit takes the outputs of one visit.
fn bond(program: &Program, visits: &Visits, before: InstanceId, behind: InstanceId) -> Bond {
    let (earlier, visit) = (&visits.all[&before], &visits.all[&behind]);
    let state = program.state(visit.state);
    let takes = |expression: &Expr| {
        expression.flows().into_iter().any(|source| {
            is_within(program, earlier.state, source) && visits.source(program, source, behind) == Some(before)
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
    // A state waits for a younger one only because of resources.
    if before > behind {
        return Bond::Coincidence;
    }
    match state.annotations.nature {
        Nature::Senses(_) => Bond::Looking,
        Nature::Irreversible => Bond::Order,
        Nature::Computes => Bond::World,
    }
}

/// Whether a state is another one or inside of it.
fn is_within(program: &Program, state: StateId, outer: StateId) -> bool {
    std::iter::successors(Some(state), |id| program.state(*id).parent).any(|ancestor| ancestor == outer)
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
