//! The facts that a state reads, senses, looks up and may write.

use super::outcomes::{EVERYTHING, Effects, Ends};
use super::written::{self, Written};
use super::{Names, Predicate, Subject, is_action, nature};
use crate::effects;
use ratn_model::expression::{EffectExpr, Expr, FactExpr};
use ratn_model::id::StateId;
use ratn_model::program::{Nature, ResourceExpr, State, StateKind, is_failure};
use ratn_model::slot::Slot;
use std::collections::BTreeSet;

/// The facts that a state reads; `None`: it may read every fact.
pub(super) fn reads(subject: &Subject<'_>, requirements: &[ResourceExpr]) -> Option<Vec<FactExpr>> {
    let mut all: Vec<FactExpr> = Vec::new();
    for state in &subject.contained {
        match &state.annotations.reads {
            Some(reads) => all.extend(reads.iter().cloned()),
            // A sensing node reads what it senses; any other action without the annotation may read everything.
            None if is_action(state) && !matches!(state.annotations.nature, Nature::Senses(_)) => return None,
            None => {}
        }
        all.extend(state.annotations.senses().iter().cloned());
        for (slot, expression) in state.expressions() {
            let is_read = match slot {
                Slot::Duration | Slot::Shared => false,
                // The effects and resources of the parts are evaluated within the same node.
                Slot::Effect(_) | Slot::Resource(..) => subject.contains_others(),
                _ => true,
            };
            if is_read {
                all.extend(expression.fact_expressions().into_iter().cloned());
            }
        }
    }
    all.extend(subject.around.iter().flat_map(|state| &state.annotations.reads).flatten().cloned());
    let selectors = requirements.iter().flat_map(|r| r.expressions());
    all.extend(selectors.flat_map(|expression| expression.fact_expressions()).cloned());
    if subject.is_routine() {
        // On a projection the parts change facts in turn, so the earlier values must be visible. An ontology also looks at other facts of the
        // predicate.
        let whole = subject.program.ontology.is_some();
        for effect in subject.contained.iter().flat_map(|state| state.annotations.effects.values()).flatten() {
            let any = |fact: &FactExpr| FactExpr { arguments: vec![None; fact.arguments.len()], ..fact.clone() };
            all.extend(effect.written().into_iter().map(|fact| if whole { any(fact) } else { fact.clone() }));
        }
        let inside = Inside::of(subject);
        all.iter_mut().for_each(|fact| inside.hide(fact));
    }
    Some(all)
}

/// States and variables inside of a routine: at the routine's own place their values are unknown.
struct Inside {
    states: BTreeSet<StateId>,
    variables: BTreeSet<String>,
}

/// The variables that an effect binds.
fn quantified(effect: &EffectExpr, into: &mut BTreeSet<String>) {
    if let EffectExpr::ForEach { variable, effects, .. } = effect {
        into.insert(variable.clone());
        effects.iter().for_each(|effect| quantified(effect, into));
    }
}

impl Inside {
    fn of(subject: &Subject<'_>) -> Inside {
        let mut variables: BTreeSet<String> = BTreeSet::new();
        for state in &subject.contained {
            variables.extend(state.variables.iter().chain(&state.assign).map(|(name, _)| name.clone()));
            match &state.kind {
                StateKind::ForEach { variable, index, .. } => {
                    variables.insert(variable.clone());
                    variables.extend(index.clone());
                }
                StateKind::While { index, .. } => variables.extend(index.clone()),
                _ => {}
            }
            state.annotations.effects.values().flatten().for_each(|effect| quantified(effect, &mut variables));
        }
        Inside { states: subject.contained.iter().map(|state| state.id).collect(), variables }
    }

    /// Whether a value may differ between the inside and the place of the routine.
    fn has(&self, expression: &Expr) -> bool {
        let mut has = false;
        expression.visit(&mut |part| {
            has |= match part {
                Expr::Port { state, .. } => self.states.contains(state),
                Expr::Variable(name) => self.variables.contains(name),
                Expr::Fact(_) | Expr::Exists(_) | Expr::Query(_) | Expr::Find(..) | Expr::Output(_) => true,
                _ => false,
            };
        });
        has
    }

    /// Replaces arguments that are known only inside by `?`.
    fn hide(&self, fact: &mut FactExpr) {
        for argument in &mut fact.arguments {
            if argument.as_ref().is_some_and(|argument| self.has(argument)) {
                *argument = None;
            }
        }
    }

    fn hide_in(&self, effect: &mut EffectExpr) {
        match effect {
            EffectExpr::Set(fact, _) | EffectExpr::Delete(fact) | EffectExpr::Increase(fact, _) => self.hide(fact),
            EffectExpr::ForEach { collection, effects, .. } => {
                if self.has(collection) {
                    // No scope has this output: the variable may have any value.
                    *collection = Expr::Output(String::new());
                }
                effects.iter_mut().for_each(|effect| self.hide_in(effect));
            }
        }
    }
}

/// The facts that a state senses, with those of what it contains.
pub(super) fn senses(subject: &Subject<'_>) -> Vec<FactExpr> {
    subject.contained.iter().flat_map(|state| state.annotations.senses()).cloned().collect()
}

/// The facts for which a node tolerates no deviation. An action, also inside of a routine, ignores tolerated deviations of what it reads; its
/// assignments are exact, and so is everything that a routine computes itself. The node's preconditions are checked in the actual world, too.
pub(super) fn exact(subject: &Subject<'_>) -> Vec<FactExpr> {
    let is_exact = |state: &State, slot: Slot<'_>| match slot {
        Slot::Assign(_) => true,
        Slot::Input(_) | Slot::Duration | Slot::Reads | Slot::Senses | Slot::Shared | Slot::Resource(..) => false,
        Slot::Requires(_) => state.id != subject.state.id,
        _ => subject.is_routine(),
    };
    let mut all: Vec<FactExpr> = Vec::new();
    for state in &subject.contained {
        for (_, expression) in state.expressions().into_iter().filter(|(slot, _)| is_exact(state, *slot)) {
            all.extend(expression.fact_expressions().into_iter().cloned());
        }
    }
    if subject.is_routine() {
        let inside = Inside::of(subject);
        all.iter_mut().for_each(|fact| inside.hide(fact));
    }
    all
}

/// The facts that are looked up when a state ends, whatever its outcome: by its effects, by its resource operations, and by the ontology, which
/// allows only one fact of a functional predicate for each subject.
pub(super) fn looked_up_at_end(subject: &Subject<'_>, operations: &[ResourceExpr]) -> Vec<FactExpr> {
    let effects = || subject.state.annotations.effects.values();
    let by_effects = effects().flat_map(|effects| EffectExpr::fact_expressions(effects));
    let by_operations = operations.iter().flat_map(ResourceExpr::expressions).flat_map(Expr::fact_expressions);
    let ontology = subject.program.ontology.iter();
    let rivals = ontology.flat_map(|ontology| effects().flatten().flat_map(|effect| ontology.rivals_of(effect)));
    by_effects.chain(by_operations).cloned().chain(rivals).collect()
}

/// The effects of every outcome with which the nodes inside of a state may end while the state goes on or ends well. `None`: it may write every
/// fact.
pub(super) fn may_write(subject: &Subject<'_>) -> Option<Vec<EffectExpr>> {
    let each = subject.contained.iter().map(|state| own_writes(subject, state));
    let mut all = each.collect::<Option<Vec<_>>>()?.concat();
    if subject.is_routine() {
        let inside = Inside::of(subject);
        all.iter_mut().for_each(|effect| inside.hide_in(effect));
    }
    Some(all)
}

fn own_writes(subject: &Subject<'_>, state: &State) -> Option<Vec<EffectExpr>> {
    if !is_action(state) {
        return Some(state.annotations.effects.values().flatten().cloned().collect());
    }
    let mut all = Vec::new();
    for outcome in subject.program.outcomes(state.id) {
        match effects::declared(state, nature::own(state), outcome) {
            Some(declared) => all.extend(declared.iter().cloned()),
            None if is_failure(outcome) && ends_all(subject, state, outcome) => {}
            None => return None,
        }
    }
    Some(all)
}

/// Whether this outcome of an inner state ends the whole state: no transition on the way handles it.
fn ends_all(subject: &Subject<'_>, state: &State, outcome: &str) -> bool {
    let outwards = std::iter::successors(Some(state), |inner| {
        inner.parent.filter(|_| inner.id != subject.state.id).map(|parent| subject.program.state(parent))
    });
    let passes = |state: &State| {
        !matches!(state.kind, StateKind::Concurrency { .. }) && !state.transitions.contains_key(outcome)
    };
    outwards.into_iter().all(passes)
}

/// The predicates that a state writes with an outcome that is computed ahead; [`EVERYTHING`] alone if it may write every fact.
pub(super) fn writes(
    subject: &Subject<'_>,
    ends: &Ends,
    may_write: Option<&[EffectExpr]>,
    names: &mut Names,
) -> BTreeSet<Predicate> {
    let writes: BTreeSet<Predicate> = if subject.is_routine() {
        let Some(effects) = may_write else { return BTreeSet::from([EVERYTHING]) };
        effects.iter().flat_map(EffectExpr::written).map(|fact| names.of_predicate(&fact.predicate)).collect()
    } else {
        let ahead = ends.arms.iter().fold(0, |all, arm| all | arm.outcomes);
        // Outcomes beyond the bits of the set are exceptional.
        let numbered = ends.predicates.iter().take(super::MAX_OUTCOMES).enumerate();
        numbered.filter(|(number, _)| ahead & (1 << number) != 0).flat_map(|(_, all)| all).copied().collect()
    };
    if writes.contains(&EVERYTHING) { BTreeSet::from([EVERYTHING]) } else { writes }
}

/// The keys that a state writes, over all outcomes that are computed ahead, and per outcome.
pub(super) fn written(
    subject: &Subject<'_>,
    ends: &Ends,
    may_write: Option<&[EffectExpr]>,
    names: &mut Names,
) -> (Vec<Written>, Vec<Vec<Written>>) {
    let declared = |effects: &'_ Effects| match effects {
        Effects::Unknown => Vec::new(),
        Effects::Declared(declared) => declared.clone(),
    };
    let each: Vec<Vec<EffectExpr>> = ends.effects.iter().map(declared).collect();
    let all: Vec<EffectExpr> = if subject.is_routine() {
        may_write.unwrap_or_default().to_vec()
    } else {
        let ahead = ends.arms.iter().fold(0, |all, arm| all | arm.outcomes);
        let numbered = each.iter().take(super::MAX_OUTCOMES).enumerate();
        numbered.filter(|(number, _)| ahead & (1 << number) != 0).flat_map(|(_, effects)| effects).cloned().collect()
    };
    (written::written(&all, names), each.iter().map(|effects| written::written(effects, names)).collect())
}
