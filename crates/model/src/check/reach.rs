//! Unreachable states, states without a way out, loops that do not fit into the window, and conflicts between regions.

use super::graph::Point;
use super::{Subject, expressions};
use crate::diagnostic::Findings;
use crate::expression::scope::NothingKnown;
use crate::expression::{EffectExpr, Expr, FactExpr};
use crate::fact::{FactPattern, Footprint};
use crate::program::{Nature, Program, ResourceExpr, State, StateKind};
use crate::resource::ResourceOperation;
use std::collections::BTreeSet;

pub(super) fn check(subject: &Subject<'_>, findings: &mut Findings) {
    unreachable(subject, findings);
    dead_ends(subject, findings);
    horizons(subject, findings);
    for state in &subject.program.states {
        if let StateKind::Concurrency { regions, .. } = &state.kind {
            let regions: Vec<&State> = regions.iter().map(|id| subject.program.state(*id)).collect();
            conflicts(subject, &regions, findings);
        }
    }
}

fn unreachable(subject: &Subject<'_>, findings: &mut Findings) {
    if subject.begins_elsewhere {
        return;
    }
    // A `finally` is written once and copied for every outcome. The copy for `preempted` is used when the state is cut short, even if nothing inside
    // ends so.
    let finally = |state: &State| {
        let around = state.parent.and_then(|id| subject.program.state(id).annotations.finally.as_ref());
        around.is_some_and(|finally| finally.lastly.values().any(|lastly| *lastly == state.id))
    };
    for state in &subject.program.states {
        let reached = |id| subject.control.is_reached(Point::Begin(id));
        // States inside of an unreachable state are not reported again.
        if !reached(state.id) && state.parent.is_none_or(reached) && !finally(state) {
            let help = "let a transition lead here, or remove it";
            findings.error("unreachable-state", state.location, &state.path, "nothing leads to this state", help);
        }
    }
}

fn dead_ends(subject: &Subject<'_>, findings: &mut Findings) {
    let mut told = BTreeSet::new();
    for point in subject.control.dead_ends() {
        let (Point::Begin(id) | Point::Middle(id) | Point::End(id, _)) = point;
        let state = subject.program.state(id);
        if told.insert(id) && !matches!(state.parent, Some(parent) if told.contains(&parent)) {
            let message = "from here no outcome of the task can be reached: its transitions go in circles";
            findings.error("no-way-out", state.location, &state.path, message, "let one of them lead out");
        }
    }
}

/// The window must be able to hold the states that one iteration visits, so that it can look beyond the iteration.
fn horizons(subject: &Subject<'_>, findings: &mut Findings) {
    for state in &subject.program.states {
        let (StateKind::ForEach { body, .. } | StateKind::While { body, .. }) = &state.kind else { continue };
        let nodes: usize = body.iter().map(|id| nodes(subject.program, subject.program.state(*id))).sum();
        if nodes > subject.program.horizon {
            let message = format!(
                "one iteration has {nodes} states and the horizon is {}: no iteration is seen whole",
                subject.program.horizon
            );
            let help = format!("give the task a `horizon` of {} or more", 2 * nodes);
            findings.error("horizon-too-small", state.location, &state.path, message, help);
        }
    }
}

fn nodes(program: &Program, state: &State) -> usize {
    if state.is_routine() || matches!(state.kind, StateKind::Action { .. }) {
        return 1;
    }
    // For a condition the longer branch.
    let list =
        |list: &[crate::id::StateId]| -> usize { list.iter().map(|id| nodes(program, program.state(*id))).sum() };
    match &state.kind {
        StateKind::Condition { then, otherwise, .. } => 1 + list(then).max(list(otherwise)),
        _ => state.lists().into_iter().map(list).sum(),
    }
}

/// What the states of a region use.
struct Touched<'a> {
    reads: Footprint,
    /// The path of the first computing state without `reads`.
    reads_everything: Option<String>,
    writes: Footprint,
    /// The facts of functional predicates that must not hold together with those that it sets.
    rivals: Vec<FactPattern>,
    shared: Vec<FactExpr>,
    assigns: BTreeSet<String>,
    uses: BTreeSet<String>,
    resources: Vec<&'a ResourceExpr>,
    unannotated: Option<String>,
}

fn touched<'a>(program: &'a Program, region: &'a State) -> Touched<'a> {
    let mut touched = Touched {
        reads: Footprint::NOTHING,
        reads_everything: None,
        writes: Footprint::NOTHING,
        rivals: Vec::new(),
        shared: Vec::new(),
        assigns: BTreeSet::new(),
        uses: BTreeSet::new(),
        resources: Vec::new(),
        unannotated: None,
    };
    let mut declared: BTreeSet<&String> = BTreeSet::new();
    let mut open = vec![region];
    while let Some(state) = open.pop() {
        open.extend(state.children().map(|child| program.state(child)));
        declared.extend(state.variables.iter().map(|(name, _)| name));
        let annotations = &state.annotations;
        touched.shared.extend(annotations.shared.iter().cloned());
        touched.assigns.extend(state.assign.iter().map(|(name, _)| name.clone()));
        let expressions = expressions(program, state);
        touched.uses.extend(expressions.iter().flat_map(|(_, e)| e.variables()).map(str::to_owned));
        touched.resources.extend(&annotations.resources);
        let is_action = matches!(state.kind, StateKind::Action { .. });
        let looked_up = expressions.iter().flat_map(|(_, e)| e.fact_expressions());
        let named = annotations.reads.iter().flatten().chain(annotations.senses());
        let facts: Vec<FactExpr> = named.chain(looked_up).cloned().collect();
        let says_no_reads = is_action && annotations.reads.is_none();
        let open_reads = says_no_reads && annotations.nature != Nature::Computes;
        // A motion without `reads` gets a warning below, and no conflict here.
        if says_no_reads && annotations.nature == Nature::Computes {
            touched.reads = Footprint::Everything;
            touched.reads_everything.get_or_insert_with(|| state.path.clone());
        }
        let open_writes = is_action
            && annotations.nature != Nature::Computes
            && !annotations.effects.contains_key(crate::program::SUCCESS);
        if open_reads || open_writes {
            touched.unannotated.get_or_insert_with(|| state.path.clone());
        }
        let all = |f: Footprint, more: Footprint| f.union(more);
        touched.reads = all(touched.reads, FactExpr::footprint(&facts, &NothingKnown));
        // The effects that a wait foresees are made by somebody else.
        for effects in annotations.effects.values().filter(|_| !state.is_pause()) {
            touched.writes = all(touched.writes, EffectExpr::footprint(effects, &NothingKnown));
            let rivals = program.ontology.iter().flat_map(|o| effects.iter().flat_map(|effect| o.rivals_of(effect)));
            touched.rivals.extend(rivals.map(|rivals| rivals.pattern(&NothingKnown)));
        }
    }
    touched.assigns.retain(|name| !declared.contains(name));
    touched
}

/// The kind of a resource that one region creates, deletes or consumes while the other is affected. Blocking a created resource only waits.
fn clash<'a>(program: &Program, one: &Touched<'a>, other: &Touched<'_>) -> Option<&'a str> {
    use ResourceOperation::{Block, Consume, Create, Delete, Exists};
    let sees = |changed: &ResourceExpr, seen: &ResourceExpr| match changed.operation {
        Delete | Consume => true,
        Create => matches!(seen.operation, Create | Exists),
        Block | Exists => false,
    };
    let meets = |changed: &ResourceExpr| {
        other.resources.iter().any(|seen| may_be_one(program, changed, seen) && sees(changed, seen))
    };
    one.resources.iter().find(|changed| meets(changed)).map(|changed| changed.kind.as_str())
}

/// Whether both lines may mean the same resource: their kinds are the same or related, and they have no attribute with different values.
fn may_be_one(program: &Program, a: &ResourceExpr, b: &ResourceExpr) -> bool {
    let differ = |(name, value): &(String, Expr)| {
        let other = b.attributes.iter().find(|(other, _)| other == name).map(|(_, other)| other);
        matches!((value, other), (Expr::Literal(one), Some(Expr::Literal(another))) if one != another)
    };
    program.may_be_one(&a.kind, &b.kind) && !a.attributes.iter().any(differ)
}

fn conflicts(subject: &Subject<'_>, regions: &[&State], findings: &mut Findings) {
    let all: Vec<Touched<'_>> = regions.iter().map(|region| touched(subject.program, region)).collect();
    // A watch changes nothing.
    let is_watched = regions.iter().any(|region| region.is_watch());
    for (region, touched) in regions.iter().zip(&all) {
        if let Some(path) = &touched.unannotated.as_ref().filter(|_| !is_watched) {
            let message =
                format!("`{path}` says neither what it reads nor what it changes, and runs beside other regions");
            let help = "give it `reads` and `effects`: then check can tell whether the regions get in each other's way";
            findings.warning("region-unannotated", region.location, &region.path, message, help);
        }
    }
    for (i, first) in all.iter().enumerate() {
        for (second, other) in all.iter().zip(regions).skip(i + 1) {
            let shared: Vec<FactExpr> = first.shared.iter().chain(&second.shared).cloned().collect();
            let shared = FactExpr::footprint(&shared, &NothingKnown);
            let covered = |p: &FactPattern| match &shared {
                Footprint::Patterns(shared) => shared.iter().any(|s| s.covers(p)),
                Footprint::Everything => true,
            };
            let both = |a: &Footprint, b: &Footprint| -> Option<String> {
                let pair = match (a, b) {
                    (Footprint::Patterns(a), Footprint::Patterns(b)) => {
                        a.iter().find_map(|x| b.iter().find(|y| x.overlaps(y) && !covered(x) && !covered(y)))
                    }
                    (Footprint::Patterns(some), Footprint::Everything)
                    | (Footprint::Everything, Footprint::Patterns(some)) => some.iter().find(|x| !covered(x)),
                    (Footprint::Everything, Footprint::Everything) => None,
                };
                Some(format!("the fact `{}`", pair?))
            };
            // A change of another fact decides whether a fact of a functional predicate may be set.
            let rival = |a: &Touched, b: &Touched| -> Option<String> {
                let Footprint::Patterns(written) = &a.writes else { return None };
                let meets = |rivals: &&FactPattern| !covered(rivals) && written.iter().any(|w| w.overlaps(rivals));
                let rivals = b.rivals.iter().find(meets)?;
                Some(format!("facts of `{rivals}`, of which only one may hold"))
            };
            let fact = both(&first.writes, &second.writes)
                .or_else(|| both(&first.writes, &second.reads))
                .or_else(|| both(&second.writes, &first.reads))
                .or_else(|| rival(first, second))
                .or_else(|| rival(second, first));
            let touches = |a: &Touched, b: &Touched| {
                let mut assigned = a.assigns.iter();
                assigned.find(|name| b.assigns.contains(*name) || b.uses.contains(*name)).cloned()
            };
            let variable = touches(first, second).or_else(|| touches(second, first));
            let variable = variable.map(|name| format!("the variable `${name}`"));
            let program = subject.program;
            let resource = clash(program, first, second).or_else(|| clash(program, second, first));
            let resource = resource.map(|kind| format!("the task resource {kind}"));
            // A watch reacts to a fact as soon as it is written, so it is no conflict.
            let is_watched = regions[i].is_watch() || other.is_watch();
            let fact = fact.filter(|_| !is_watched);
            let together = "put them into one region";
            let help = match (&fact, first.reads_everything.as_ref().or(second.reads_everything.as_ref())) {
                (None, _) => together.to_owned(),
                (Some(_), None) => format!("{together}, or mark the facts as `shared` if the order does not matter"),
                (Some(_), Some(path)) => format!(
                    "`{path}` says no `reads`, and so may read every fact: say which, {together}, or mark the facts as `shared` if the order does not matter"
                ),
            };
            if let Some(what) = fact.or(variable).or(resource) {
                let message =
                    format!("this region and `{}` both touch {what}, and nothing says in which order", other.name);
                let region = regions[i];
                findings.error("region-conflict", region.location, &region.path, message, help);
            }
        }
    }
}
