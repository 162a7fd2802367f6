//! What others may change while a state waits. A wait changes nothing itself, but time passes, and the regions beside it go on. So the
//! `shared` facts that they write are unknown until the wait is over, and nothing is computed from their earlier values.

use super::{Effects, Predicate, Subject, footprint};
use ratn_model::expression::scope::NothingKnown;
use ratn_model::expression::{EffectExpr, Expr, FactExpr};
use ratn_model::fact::{FactPattern, Footprint, Term};
use ratn_model::program::{Program, State, StateKind};
use ratn_model::value::Value;

/// The number of states that wait and of routines with waits inside: sensing nodes behind them run after the wait.
pub(crate) const WAITS: Predicate = 1;

/// The shared facts that regions beside a waiting state may write, with unknown values; `Unknown` if such a region may write
/// any fact.
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
                // The effects that a wait foresees are made by somebody else.
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

/// A state and everything inside of it.
fn within<'p>(program: &'p Program, state: &'p State) -> Vec<&'p State> {
    let mut all = vec![state];
    let mut next = 0;
    while next < all.len() {
        all.extend(all[next].children().map(|child| program.state(child)));
        next += 1;
    }
    all
}

/// The overlaps of the patterns of both footprints: of each overlapping pair the narrower pattern.
fn both<'f>(shared: &'f Footprint, written: &'f Footprint) -> impl Iterator<Item = FactPattern> + 'f {
    let patterns = |footprint: &'f Footprint| match footprint {
        Footprint::Patterns(patterns) => patterns.as_slice(),
        // Does not occur: annotations name their facts.
        Footprint::Everything => &[],
    };
    patterns(written).iter().flat_map(move |written| {
        let overlapping = patterns(shared).iter().filter(|shared| shared.overlaps(written));
        overlapping.map(|shared| if written.covers(shared) { shared.clone() } else { written.clone() })
    })
}

/// An effect with unknown value on the facts of a pattern.
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
