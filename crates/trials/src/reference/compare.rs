//! Compares a run with the reference.

use super::ReferenceResult;
use crate::state_of;
use crate::story::Story;
use ratn_model::program::{Program, StateKind};
use ratn_model::value::Value;
use ratn_simulation::run::Run;
use std::collections::BTreeMap;

/// The goals of PIAs, in order, by thread of control.
type Threads<'a> = BTreeMap<String, Vec<(&'a str, &'a str)>>;

/// The first difference of a run from the reference.
pub(in super::super) fn disagreement(
    program: &Program,
    wanted: &ReferenceResult,
    run: &Run,
    story: &Story,
) -> Option<String> {
    end(wanted, run).or_else(|| acts(program, wanted, story)).or_else(|| results(wanted, story)).or_else(|| {
        (wanted.changes != story.changes).then(|| differ("what became real", &wanted.changes, &story.changes))
    })
}

/// Differences that do not depend on the world: how the task and its actions ended.
pub(in super::super) fn outcomes(wanted: &ReferenceResult, run: &Run, story: &Story) -> Option<String> {
    task(wanted, run).or_else(|| results(wanted, story))
}

/// Outcome and outputs.
fn task(wanted: &ReferenceResult, run: &Run) -> Option<String> {
    if wanted.outcome != run.outcome {
        return Some(differ("outcomes", &wanted.outcome, (&run.outcome, &run.reason)));
    }
    (wanted.outputs != run.outputs).then(|| differ("outputs", &wanted.outputs, &run.outputs))
}

/// Outcome, outputs, world and task resources.
pub(in super::super) fn end(wanted: &ReferenceResult, run: &Run) -> Option<String> {
    if let Some(problem) = task(wanted, run) {
        return Some(problem);
    }
    if !wanted.facts.iter().eq(run.world.iter().map(|(key, fact)| (key, &fact.value))) {
        let show = |all: Vec<(String, &Value)>| all.iter().map(|(k, v)| format!("{k} = {v}")).collect::<Vec<_>>();
        let expected = show(wanted.facts.iter().map(|(key, value)| (key.to_string(), value)).collect());
        let found = show(run.world.iter().map(|(key, fact)| (key.to_string(), &fact.value)).collect());
        return Some(differ("worlds", expected, found));
    }
    let left: BTreeMap<&str, u64> = wanted.units.iter().filter(|(_, n)| **n > 0).map(|(k, n)| (&**k, *n)).collect();
    let found = run.units.iter().map(|(kind, units)| (&**kind, units.thousandths())).filter(|(_, n)| *n > 0);
    let found: BTreeMap<&str, u64> = found.collect();
    (left != found).then(|| differ("task resources", left, found))
}

/// Whether a run that was told to end did exactly this: outcome, PIAs, changes, world. Task resources are not compared, because they depend on
/// requests under way.
pub(in super::super) fn is_cut(program: &Program, wanted: &ReferenceResult, run: &Run, story: &Story) -> bool {
    wanted.outcome == run.outcome
        && acts(program, wanted, story).is_none()
        && wanted.changes == story.changes
        && wanted.facts.iter().eq(run.world.iter().map(|(key, fact)| (key, &fact.value)))
}

fn acts(program: &Program, wanted: &ReferenceResult, story: &Story) -> Option<String> {
    let expected = threads(program, wanted.acts.iter().map(|(path, goal)| (&**path, &**goal)));
    let found = threads(program, story.acts.iter().map(|act| (&*act.path, &*act.goal)));
    (expected != found).then(|| differ("PIAs", expected, found))
}

fn threads<'a>(program: &Program, acts: impl Iterator<Item = (&'a str, &'a str)>) -> Threads<'a> {
    let has_regions = program.states.iter().any(|state| matches!(state.kind, StateKind::Concurrency { .. }));
    let mut threads = Threads::new();
    for act in acts {
        let of = if has_regions { thread(program, act.0) } else { "" };
        threads.entry(of.to_owned()).or_default().push(act);
    }
    threads
}

/// The visit of the innermost region around a path.
fn thread<'a>(program: &Program, path: &'a str) -> &'a str {
    let mut end = path.len();
    while end > 0 {
        let around = state_of(program, &path[..end]).and_then(|state| state.parent);
        if around.is_some_and(|id| matches!(program.state(id).kind, StateKind::Concurrency { .. })) {
            return &path[..end];
        }
        end = path[..end].rfind('/').unwrap_or(0);
    }
    ""
}

fn results(wanted: &ReferenceResult, story: &Story) -> Option<String> {
    let paths = |all: &BTreeMap<String, Vec<_>>| all.iter().map(|(p, all)| (p.clone(), all.len())).collect::<Vec<_>>();
    if paths(&wanted.results) != paths(&story.retired) {
        return Some(differ("retired instances", paths(&wanted.results), paths(&story.retired)));
    }
    for ((path, expected), found) in wanted.results.iter().zip(story.retired.values()) {
        for (expected, found) in expected.iter().zip(found) {
            if !expected.may_be(found) {
                return Some(differ(&format!("the results of {path}"), expected, found));
            }
        }
    }
    None
}

fn differ(what: &str, reference: impl std::fmt::Debug, run: impl std::fmt::Debug) -> String {
    format!("{what} differ:\n reference {reference:#?}\n run       {run:#?}")
}
