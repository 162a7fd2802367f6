//! Outcomes of a state: where each leads, which are computed ahead, and the effects of each.

use super::nature::NodeNature;
use super::{Names, Predicate, Subject, index};
use crate::effects;
use ratn_model::expression::EffectExpr;
use ratn_model::id::StateId;
use ratn_model::program::{Program, ResourceExpr, SUCCESS, State, Target, is_failure};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// The number of writers that may write every fact.
pub(crate) const EVERYTHING: Predicate = 0;

/// An outcome of a state: its index in [`super::StatePlan::outcomes`].
pub(crate) type Outcome = usize;

/// The outcome `success`, which every state has.
pub(crate) const SUCCEEDED: Outcome = 0;

/// A set of outcomes as bits; it holds the first [`MAX_OUTCOMES`].
pub(crate) type Outcomes = u64;

/// Outcomes beyond this number are exceptional, whatever they lead to.
pub(crate) const MAX_OUTCOMES: usize = 64;

/// Outcomes with the same target that agree on whether there are outputs.
#[derive(Debug, Clone)]
pub(crate) struct ArmPlan {
    /// All of them.
    pub(crate) outcomes: Outcomes,
    /// One of them, to look up target and name.
    pub(crate) outcome: Outcome,
    /// Whether all have the same effects; if not, the changes are known only when the node has ended.
    pub(crate) same_effects: bool,
}

/// The effects of an outcome.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Effects {
    /// Any fact may change; known when the node has ended.
    Unknown,
    /// The declared effects.
    Declared(Vec<EffectExpr>),
}

/// Whether a state with this outcome has outputs and assigns variables.
pub(crate) fn gives_outputs(outcome: &str) -> bool {
    !is_failure(outcome)
}

/// The outcomes of all states, and the targets of outcomes without a transition.
pub(super) struct Transitions {
    outcomes: Vec<Vec<String>>,
    next: Vec<Option<StateId>>,
    repeats: Vec<bool>,
}

impl Transitions {
    pub(super) fn of(program: &Program) -> Transitions {
        let mut next = vec![None; program.states.len()];
        let mut repeats = vec![false; program.states.len()];
        for state in &program.states {
            for list in state.lists() {
                for (place, child) in list.iter().enumerate() {
                    next[index(*child)] = list.get(place + 1).copied();
                }
                repeats[index(state.id)] |= leads_back(program, list);
            }
        }
        Transitions { outcomes: program.all_outcomes(), next, repeats }
    }

    /// Whether states of its lists may be visited more than once in one activation.
    pub(super) fn repeats(&self, id: StateId) -> bool {
        self.repeats[index(id)]
    }

    fn target(&self, state: &State, outcome: &str) -> Target {
        match (state.transitions.get(outcome), outcome, self.next[index(state.id)]) {
            (Some(target), _, _) => target.clone(),
            (None, SUCCESS, Some(next)) => Target::State(next),
            (None, outcome, _) => Target::Outcome(outcome.to_owned()),
        }
    }
}

/// Whether a transition leads from a state of a list to itself or to an earlier state.
fn leads_back(program: &Program, list: &[StateId]) -> bool {
    let position: BTreeMap<StateId, usize> = list.iter().enumerate().map(|(place, id)| (*id, place)).collect();
    list.iter().any(|id| {
        program.state(*id).transitions.values().any(|target| match target {
            Target::State(to) => position.get(to) <= position.get(id),
            Target::Outcome(_) => false,
        })
    })
}

/// The possible ends of one state; every field is by outcome.
pub(super) struct Ends {
    pub(super) names: Vec<Arc<str>>,
    pub(super) targets: Vec<Target>,
    pub(super) arms: Vec<ArmPlan>,
    pub(super) effects: Vec<Effects>,
    pub(super) predicates: Vec<Vec<Predicate>>,
}

pub(super) fn of(
    subject: &Subject<'_>,
    transitions: &Transitions,
    nature: NodeNature,
    awaited: &Effects,
    names: &mut Names,
) -> Ends {
    let state = subject.state;
    let outcomes = &transitions.outcomes[index(state.id)];
    let targets: Vec<Target> = outcomes.iter().map(|outcome| transitions.target(state, outcome)).collect();
    let effects: Vec<Effects> = outcomes.iter().map(|outcome| changes(subject, nature, awaited, outcome)).collect();
    Ends {
        arms: arms(state, outcomes, &targets, &effects),
        predicates: effects.iter().map(|effects| predicates(effects, names).into_iter().collect()).collect(),
        names: outcomes.iter().map(|outcome| Arc::from(outcome.as_str())).collect(),
        targets,
        effects,
    }
}

/// The effects of an outcome: of a routine, the unknown ones of its nodes; after a wait, also what others may have changed meanwhile.
fn changes(subject: &Subject<'_>, nature: NodeNature, awaited: &Effects, outcome: &str) -> Effects {
    let state = subject.state;
    let declared = if subject.is_routine() {
        None
    } else if subject.is_node {
        effects::declared(state, nature, outcome)
    } else {
        Some(state.annotations.effects.get(outcome).map_or(&[][..], Vec::as_slice))
    };
    let Effects::Declared(awaited) = awaited else { return Effects::Unknown };
    let foretold = |effect: &&EffectExpr| {
        let fact = effect.written();
        declared.into_iter().flatten().any(|known| known.written() == fact)
    };
    let unknown = awaited.iter().filter(|effect| !foretold(effect));
    declared.map_or(Effects::Unknown, |declared| Effects::Declared(declared.iter().chain(unknown).cloned().collect()))
}

/// The continuations that are computed ahead: those of outcomes that are not exceptional.
fn arms(state: &State, outcomes: &[String], targets: &[Target], effects: &[Effects]) -> Vec<ArmPlan> {
    let exceptional = |number: usize| {
        let outcome = outcomes[number].as_str();
        let marked = state.annotations.exceptional.iter().any(|marked| marked == outcome);
        let unhandled = !state.transitions.contains_key(outcome) || targets[number] == targets[0];
        marked || (!gives_outputs(outcome) && unhandled) || number >= MAX_OUTCOMES
    };
    let mut arms: Vec<ArmPlan> = Vec::new();
    for number in (0..outcomes.len()).filter(|number| !exceptional(*number)) {
        let same = |arm: &&mut ArmPlan| {
            targets[arm.outcome] == targets[number]
                && gives_outputs(&outcomes[arm.outcome]) == gives_outputs(&outcomes[number])
        };
        match arms.iter_mut().find(same) {
            Some(arm) => {
                arm.outcomes |= 1 << number;
                arm.same_effects &= effects[arm.outcome] == effects[number];
            }
            None => arms.push(ArmPlan { outcomes: 1 << number, outcome: number, same_effects: true }),
        }
    }
    arms
}

fn predicates(effects: &Effects, names: &mut Names) -> BTreeSet<Predicate> {
    match effects {
        Effects::Unknown => BTreeSet::from([EVERYTHING]),
        Effects::Declared(effects) => {
            effects.iter().flat_map(EffectExpr::written).map(|fact| names.of_predicate(&fact.predicate)).collect()
        }
    }
}

pub(super) fn every(ends: &Ends) -> Outcomes {
    let known = ends.names.iter().take(MAX_OUTCOMES).enumerate();
    known.fold(0, |all, (number, _)| all | 1 << number)
}

/// The outcomes with which the exit of a composite state has work to do.
pub(super) fn exits(state: &State, ends: &Ends, operations: &[ResourceExpr]) -> Outcomes {
    let gives = !state.outputs().is_empty() || !state.assign.is_empty();
    let mut exits = 0;
    for (number, outcome) in ends.names.iter().enumerate().take(MAX_OUTCOMES) {
        let changes = ends.effects[number] != Effects::Declared(Vec::new());
        let operates = number == 0 && !operations.is_empty();
        if changes || operates || (gives_outputs(outcome) && gives) {
            exits |= 1 << number;
        }
    }
    exits
}
