//! What a wait may find otherwise when it is over. It changes nothing itself; but it lets time pass, in which the regions beside it go on:
//! what they write of the facts that are `shared` is not what it was before, and nobody computes on what that was.

use super::{Effects, Predicate, Subject, footprint};
use ratn_model::expression::scope::NothingKnown;
use ratn_model::expression::{EffectExpr, Expr, FactExpr};
use ratn_model::fact::{FactPattern, Footprint, Term};
use ratn_model::program::{Program, State, StateKind};
use ratn_model::value::Value;

/// States that wait, and routines that contain some, stand under this number: who senses looks when they have waited.
pub(crate) const WAITS: Predicate = 1;

/// The shared facts that regions beside a state that waits may write, with values that are not known before it has waited; any fact where
/// such a region may write any.
pub(super) fn awaited(subject: &Subject<'_>) -> Effects {
    if !subject.is_node || !subject.contained.iter().any(|state| state.is_pause()) {
        return Effects::Declared(Vec::new());
    }
    let program = subject.program;
    let mut facts: Vec<FactPattern> = Vec::new();
    let mut inner = subject.state;
    for around in &subject.around {
        if let StateKind::Concurrency { regions, .. } = &around.kind {
            let own = within(program, inner);
            for beside in regions.iter().filter(|id| **id != inner.id) {
                if footprint::may_write(&Subject::of(program, program.state(*beside))).is_none() {
                    return Effects::Unknown;
                }
                let beside = within(program, program.state(*beside));
                let annotated = own.iter().chain(&beside).flat_map(|state| &state.annotations.shared);
                let shared = FactExpr::footprint(&annotated.cloned().collect::<Vec<_>>(), &NothingKnown);
                // What a wait foresees somebody else does.
                let effects =
                    beside.iter().filter(|state| !state.is_pause()).flat_map(|s| s.annotations.effects.values());
                let written = EffectExpr::footprint(&effects.flatten().cloned().collect::<Vec<_>>(), &NothingKnown);
                facts.extend(both(&shared, &written));
            }
        }
        inner = around;
    }
    facts.sort();
    facts.dedup();
    Effects::Declared(facts.into_iter().map(unknown).collect())
}

/// A state and all that it contains.
fn within<'p>(program: &'p Program, state: &'p State) -> Vec<&'p State> {
    let mut all = vec![state];
    let mut next = 0;
    while next < all.len() {
        all.extend(all[next].children().map(|child| program.state(child)));
        next += 1;
    }
    all
}

/// The patterns of one that overlap with some of the other, the narrower ones of both.
fn both<'f>(shared: &'f Footprint, written: &'f Footprint) -> impl Iterator<Item = FactPattern> + 'f {
    let patterns = |footprint: &'f Footprint| match footprint {
        Footprint::Patterns(patterns) => patterns.as_slice(),
        // Annotations name their facts.
        Footprint::Everything => &[],
    };
    patterns(written).iter().flat_map(move |written| {
        let overlapping = patterns(shared).iter().filter(|shared| shared.overlaps(written));
        overlapping.map(|shared| if written.covers(shared) { shared.clone() } else { written.clone() })
    })
}

/// An effect on the facts of a pattern whose value nothing gives.
fn unknown(pattern: FactPattern) -> EffectExpr {
    let term = |term: Term| match term {
        Term::Int(number) => Value::Int(number),
        Term::Name(name) => Value::String(name.to_string()),
    };
    let arguments = pattern.arguments.into_iter().map(|argument| argument.map(|known| Expr::Literal(term(known))));
    EffectExpr::Set(
        FactExpr { predicate: pattern.predicate, arguments: arguments.collect() },
        Expr::Output(String::new()),
    )
}
