//! The annotations in force for a state, from its own and its action's annotations: the rule of docs/task-files.md, implemented here independently.
//!
//! A state's annotation replaces its action's under the same key; `effects` are combined by predicate. An annotation that needs an input which the
//! state does not give is not in force.

use ratn_model::expression::{EffectExpr, Expr, FactExpr};
use ratn_model::program::{ABORTED, Annotations, Nature, PREEMPTED, ResourceExpr, SUCCESS, WORLD_MODEL};
use ratn_model::resource::ResourceOperation;
use std::collections::{BTreeMap, BTreeSet};

/// The annotations of a state or of an action in the catalogue; `None` for a missing key.
#[derive(Debug, Clone, Default)]
pub(super) struct Said {
    pub(super) nature: Option<Nature>,
    pub(super) reads: Option<Vec<FactExpr>>,
    pub(super) requires: Option<Vec<Expr>>,
    pub(super) effects: Option<BTreeMap<String, Vec<EffectExpr>>>,
    pub(super) resources: Option<Vec<ResourceExpr>>,
    pub(super) duration: Option<Expr>,
    /// Of an action: predicates whose facts are unknown after a failure.
    pub(super) unknown: Vec<String>,
}

/// The state's expressions for the inputs of its action.
pub(super) type Inputs = BTreeMap<String, Expr>;

/// The annotations in force. `outcomes` are the action's own; `is_in_projection`: a state around it has room for a projection.
pub(super) fn in_force(
    state: &Said,
    action: &Said,
    given: &Inputs,
    outcomes: &[String],
    is_in_projection: bool,
) -> Annotations {
    let mut all = Annotations {
        nature: state.nature.clone().unwrap_or_else(|| match &action.nature {
            Some(Nature::Senses(facts)) => each(facts, given, fact).map(Nature::Senses).unwrap_or_default(),
            other => other.clone().unwrap_or_default(),
        }),
        ..Annotations::default()
    };
    let inherited = || action.reads.as_ref().and_then(|facts| each(facts, given, fact));
    all.reads = state.reads.clone().or_else(inherited);
    if matches!(all.nature, Nature::Senses(_)) {
        all.reads.get_or_insert_default();
    }
    all.requires = match (&state.requires, &action.requires) {
        (Some(own), _) => own.clone(),
        (None, of_action) => of_action.iter().flatten().filter_map(|one| replaced(one, given)).collect(),
    };
    if all.nature != Nature::Irreversible {
        all.effects.extend([ABORTED, PREEMPTED].map(|outcome| (outcome.to_owned(), Vec::new())));
    }
    if all.nature == Nature::Computes {
        let ends = outcomes.iter().map(String::as_str).chain([SUCCESS]);
        all.effects.extend(ends.map(|outcome| (outcome.to_owned(), Vec::new())));
    }
    all.effects.extend(effects(state, action, given, outcomes));
    let duration = || replaced(action.duration.as_ref()?, given);
    all.duration_s = state.duration.clone().or_else(duration);
    all.resources = state.resources.clone().or_else(|| action.resources.clone()).unwrap_or_default();
    let reads = all.reads.as_ref().is_none_or(|reads| !reads.is_empty());
    let has_room = |line: &ResourceExpr| line.operation == ResourceOperation::Block && line.kind == WORLD_MODEL;
    if all.nature != Nature::Irreversible && reads && !is_in_projection && !all.resources.iter().any(has_room) {
        all.resources.push(ResourceExpr::new(ResourceOperation::Block, WORLD_MODEL));
    }
    all
}

/// The effects of a state by outcome. What the action leaves unknown after a failure, and success would set, is deleted by every other outcome for
/// which the state says nothing of that predicate.
fn effects(state: &Said, action: &Said, given: &Inputs, outcomes: &[String]) -> BTreeMap<String, Vec<EffectExpr>> {
    let mut all = declared(state, action, given);
    let success = all.get(SUCCESS).into_iter().flatten();
    let lost: Vec<FactExpr> = success.filter_map(|effect| unknown(effect, action)).collect();
    for outcome in outcomes.iter().map(String::as_str).chain([ABORTED, PREEMPTED]).filter(|_| !lost.is_empty()) {
        let said = all.entry(outcome.to_owned()).or_default();
        let own: BTreeSet<String> = said.iter().filter_map(predicate).collect();
        said.extend(lost.iter().filter(|fact| !own.contains(&fact.predicate)).cloned().map(EffectExpr::Delete));
    }
    all
}

/// The fact that an effect sets, if that is unknown after a failure: its arguments are known then.
fn unknown(effect: &EffectExpr, action: &Said) -> Option<FactExpr> {
    let EffectExpr::Set(fact, _) = effect else { return None };
    let mut is_known = true;
    fact.arguments
        .iter()
        .flatten()
        .for_each(|argument| argument.visit(&mut |part| is_known &= !matches!(part, Expr::Output(_))));
    (is_known && action.unknown.contains(&fact.predicate)).then(|| fact.clone())
}

fn predicate(effect: &EffectExpr) -> Option<String> {
    match effect {
        EffectExpr::Set(fact, _) | EffectExpr::Delete(fact) | EffectExpr::Increase(fact, _) => {
            Some(fact.predicate.clone())
        }
        EffectExpr::ForEach { .. } => None,
    }
}

/// The effects of a state by outcome, as far as they are declared.
fn declared(state: &Said, action: &Said, given: &Inputs) -> BTreeMap<String, Vec<EffectExpr>> {
    let of_action = action.effects.as_ref().and_then(|effects| effects.get(SUCCESS));
    let Some(own) = &state.effects else {
        let whole = of_action.and_then(|effects| each(effects, given, effect));
        return whole.map(|effects| BTreeMap::from([(SUCCESS.to_owned(), effects)])).unwrap_or_default();
    };
    let mut all = own.clone();
    let said: BTreeSet<String> = own.get(SUCCESS).into_iter().flatten().filter_map(predicate).collect();
    let more = of_action.into_iter().flatten();
    let more = more.filter(|effect| predicate(effect).is_none_or(|predicate| !said.contains(&predicate)));
    let mut more: Vec<EffectExpr> = more.filter_map(|one| effect(one, given)).collect();
    let says_nothing = of_action.is_some_and(Vec::is_empty);
    if says_nothing || !more.is_empty() {
        let own = all.remove(SUCCESS).unwrap_or_default();
        more.extend(own);
        all.insert(SUCCESS.to_owned(), more);
    }
    all
}

fn each<T>(all: &[T], given: &Inputs, one: fn(&T, &Inputs) -> Option<T>) -> Option<Vec<T>> {
    all.iter().map(|item| one(item, given)).collect()
}

fn fact(fact: &FactExpr, given: &Inputs) -> Option<FactExpr> {
    let argument = |argument: &Option<Expr>| match argument {
        None => Some(None),
        Some(argument) => replaced(argument, given).map(Some),
    };
    let arguments = fact.arguments.iter().map(argument).collect::<Option<Vec<_>>>()?;
    Some(FactExpr { predicate: fact.predicate.clone(), arguments })
}

fn effect(effect: &EffectExpr, given: &Inputs) -> Option<EffectExpr> {
    let mut effect = effect.clone();
    let mut is_known = true;
    effect.each_expression_mut(&mut |expression| match replaced(expression, given) {
        Some(now) => *expression = now,
        None => is_known = false,
    });
    is_known.then_some(effect)
}

/// An expression of an action with the state's inputs inserted; `None` if it needs a missing input.
fn replaced(expression: &Expr, given: &Inputs) -> Option<Expr> {
    let mut is_known = true;
    let mut expression = expression.clone();
    expression.rewrite(&mut |part| {
        if let Expr::Variable(input) = part {
            match given.get(input) {
                Some(value) => *part = value.clone(),
                None => is_known = false,
            }
        }
    });
    is_known.then_some(expression)
}
