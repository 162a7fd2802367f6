//! Resources: the system must be able to have them, an action must block its provider, and states that compute or sense
//! must not block anything that actuates.

use super::Subject;
use super::graph::Point;
use crate::diagnostic::Findings;
use crate::load::suggestion;
use crate::program::{Nature, Origin, ResourceExpr, State, StateKind, WORLD_MODEL};
use crate::resource::{Quantity, ResourceClass, ResourceOperation};
use std::collections::{BTreeMap, BTreeSet};

pub(super) fn check(subject: &Subject<'_>, findings: &mut Findings) {
    let lines = subject.program.states.iter().flat_map(|state| &state.annotations.resources);
    let mut created = Created::new();
    for line in lines.filter(|line| line.operation == ResourceOperation::Create) {
        *created.entry(&line.kind).or_default() |= line.divisible;
    }
    for state in &subject.program.states {
        for (i, resource) in state.annotations.resources.iter().enumerate() {
            offered(subject, state, i, resource, &created, findings);
        }
        too_many(subject, state, findings);
        parts_of_a_unit(subject, state, &created, findings);
        deletes_what_it_holds(subject, state, findings);
        exists_of_a_composite(subject, state, findings);
        if let StateKind::Action { provider, .. } = &state.kind {
            provider_blocked(subject, state, provider, findings);
            only_looks(subject, state, findings);
        }
    }
}

/// The kinds that the task creates, and whether they are divisible.
type Created<'a> = BTreeMap<&'a str, bool>;

fn is_task_class(resource: &ResourceExpr) -> bool {
    resource.class == Some(ResourceClass::Task)
}

fn offered(
    subject: &Subject<'_>,
    state: &State,
    i: usize,
    resource: &ResourceExpr,
    created: &Created<'_>,
    findings: &mut Findings,
) {
    let at = subject.place(state, &format!("resources.{i}"));
    let offer = subject.catalogue.resources.get(&resource.kind);
    let by_the_task = resource.operation == ResourceOperation::Create || created.contains_key(resource.kind.as_str());
    if offer.is_none() && !by_the_task {
        let known = subject.catalogue.resources.keys().map(String::as_str).chain(created.keys().copied());
        let message = format!("no template or module of the system provides `{}`", resource.kind);
        let is_implied =
            resource.kind == WORLD_MODEL && state.annotations.origin.get(WORLD_MODEL) == Some(&Origin::Reads);
        let help = if is_implied {
            // No line of the task names it.
            "the state reads facts, and so needs room for a projection: offer it (`[catalogue.resources.WorldModel]`), or say `reads: []`".to_owned()
        } else {
            let kind = &resource.kind;
            let offer = format!(
                "offer it in the catalogue of the system's config (`[catalogue.resources.{kind}]`), also where `ratn resource create {kind}` adds \
                 one, or create it in an older state"
            );
            suggestion(kind, known, "", &offer)
        };
        findings.error("unknown-resource", at, &state.path, message, help);
    }
    if let (Some(offer), Some(class)) = (offer, resource.class)
        && offer.class != class
    {
        let message = format!("`{}` is a {} resource, not a {class} one", resource.kind, offer.class);
        findings.error("unknown-resource", at, &state.path, message, "leave the class out");
    }
    if resource.operation == ResourceOperation::Create && !is_task_class(resource) {
        let message =
            format!("a task creates task resources only, and `{}` does not say that it is one", resource.kind);
        findings.error("unknown-resource", at, &state.path, message, "add `class: task`");
    }
}

/// Checks what one node acquires at once of each kind against the offer.
fn too_many(subject: &Subject<'_>, state: &State, findings: &mut Findings) {
    use ResourceOperation::{Block, Consume, Create, Delete, Exists};
    let mut own = BTreeMap::<&str, (Quantity, usize)>::new();
    for (i, resource) in state.annotations.resources.iter().enumerate() {
        let (count, _) = own.entry(&resource.kind).or_insert((Quantity::ZERO, i));
        match resource.operation {
            Block => *count += resource.count,
            // A composite state consumes at its end, when it holds nothing.
            Consume if matches!(state.kind, StateKind::Action { .. }) => *count += resource.count,
            Consume | Exists => *count = (*count).max(resource.count),
            Create | Delete => {}
        }
    }
    for (kind, (count, i)) in own {
        let (most, who, help) = match subject.catalogue.resources.get(kind) {
            Some(offer) => (offer.count, "the system can have", "ask for fewer, or offer more"),
            None => match created_at_most(subject, kind) {
                Some(most) => (most, "the task creates at most", "ask for fewer, or create more"),
                None => continue,
            },
        };
        if count > most {
            let message = format!("this asks for {count} of `{kind}` at once; {who} {most}");
            let at = subject.place(state, &format!("resources.{i}"));
            findings.error("too-many-resources", at, &state.path, message, help);
        }
    }
}

/// The largest total of a kind that only the task creates; `None` if it is created repeatedly or never.
fn created_at_most(subject: &Subject<'_>, kind: &str) -> Option<Quantity> {
    let mut most = Quantity::ZERO;
    for state in &subject.program.states {
        let lines = state.annotations.resources.iter();
        let created = lines.filter(|line| line.operation == ResourceOperation::Create && line.kind == kind);
        let created: Quantity = created.map(|line| line.count).sum();
        if created.is_zero() {
            continue;
        }
        let mut ends = (0..subject.control.outcomes(state.id).len()).map(|n| Point::End(state.id, n));
        if ends.any(|end| subject.control.leads_to(end, Point::Begin(state.id))) {
            return None;
        }
        most = [most, created].into_iter().sum();
    }
    (!most.is_zero()).then_some(most)
}

/// Fractions of a unit may be required only of divisible resources, as the catalogue or the creating line of the task
/// says.
fn parts_of_a_unit(subject: &Subject<'_>, state: &State, created: &Created<'_>, findings: &mut Findings) {
    for (i, resource) in state.annotations.resources.iter().enumerate().filter(|(_, r)| !r.count.is_whole()) {
        let kind = resource.kind.as_str();
        let divisible = match (resource.operation, subject.catalogue.resources.get(kind)) {
            (ResourceOperation::Create, _) => resource.divisible,
            (_, Some(offer)) => offer.divisible || created.get(kind).is_some_and(|divisible| *divisible),
            (_, None) => created.get(kind).is_none_or(|divisible| *divisible),
        };
        if !divisible {
            let message = format!("this asks for {} of `{kind}`, of which there are whole units only", resource.count);
            let help = "ask for a whole number, or say `divisible: true` where it is created or offered";
            let at = subject.place(state, &format!("resources.{i}"));
            findings.error("indivisible-resource", at, &state.path, message, help);
        }
    }
}

fn blocked<'a>(subject: &Subject<'a>, state: &State) -> BTreeSet<&'a str> {
    let lines = subject.around(state.id).flat_map(|state| &state.annotations.resources);
    lines.filter(|r| r.operation == ResourceOperation::Block).map(|r| r.kind.as_str()).collect()
}

/// A state must not delete what it holds, because the resource manager would refuse.
fn deletes_what_it_holds(subject: &Subject<'_>, state: &State, findings: &mut Findings) {
    let held = blocked(subject, state);
    for (i, resource) in state.annotations.resources.iter().enumerate() {
        if resource.operation == ResourceOperation::Delete && held.contains(resource.kind.as_str()) {
            let message = format!("it blocks and deletes `{0}`: what it holds cannot be deleted", resource.kind);
            let help = format!("write `consume: {}` instead of both", resource.kind);
            let at = subject.place(state, &format!("resources.{i}"));
            findings.error("conflicting-annotations", at, &state.path, message, help);
        }
    }
}

/// `exists` is for nodes only; only they ask the resource manager.
fn exists_of_a_composite(subject: &Subject<'_>, state: &State, findings: &mut Findings) {
    if matches!(state.kind, StateKind::Action { .. }) || state.is_routine() {
        return;
    }
    for (i, resource) in state.annotations.resources.iter().enumerate() {
        if resource.operation == ResourceOperation::Exists {
            let message = format!("`exists: {}` of a state that contains others", resource.kind);
            let at = subject.place(state, &format!("resources.{i}"));
            let help = "put it on the states within that need it, or make it a `routine`";
            findings.error("not-supported-yet", at, &state.path, message, help);
        }
    }
}

fn provider_blocked(subject: &Subject<'_>, state: &State, provider: &str, findings: &mut Findings) {
    let Some(offered) = subject.catalogue.providers.get(provider) else { return };
    if !blocked(subject, state).contains(offered.resource.as_str()) {
        let message = format!(
            "an action of `{provider}` needs the resource `{0}`, which this state does not block",
            offered.resource
        );
        let help = format!("add `resources: [{{block: {}}}]`", offered.resource);
        findings.error("provider-not-blocked", subject.place(state, "action"), &state.path, message, help);
    }
}

fn only_looks(subject: &Subject<'_>, state: &State, findings: &mut Findings) {
    let claim = match state.annotations.nature {
        Nature::Irreversible => return,
        Nature::Computes => "computes",
        Nature::Senses(_) => "senses",
    };
    let help = "make it a PIA (`pia: true`), or leave the resource out";
    let at = |part: &str| subject.place(state, part);
    for kind in blocked(subject, state) {
        if subject.catalogue.resources.get(kind).is_some_and(|offer| offer.actuates) {
            let i = state.annotations.resources.iter().position(|r| r.kind == kind);
            let at = i.map_or(state.location, |i| at(&format!("resources.{i}")));
            let message = format!("a state that {claim} cannot block `{kind}`, which moves the robot");
            // A state around it blocks the resource all the time.
            let around = "a state around it blocks that for all its states: do this before that one begins, and give what it makes in; or, where that \
                          has to be held meanwhile (a camera on the arm), make it a PIA (`pia: true`)";
            let help = if i.is_none() { around } else { help };
            findings.error("computes-actuates", at, &state.path, message, help);
        }
    }
    for (i, resource) in state.annotations.resources.iter().enumerate() {
        use ResourceOperation::{Consume, Create, Delete};
        if matches!(resource.operation, Consume | Create | Delete) {
            let message = format!("a state that {claim} cannot {} `{}`", resource.operation, resource.kind);
            findings.error("computes-actuates", at(&format!("resources.{i}")), &state.path, message, help);
        }
    }
}
