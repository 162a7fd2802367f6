//! What the window needs to know of every state before anything runs: where its outcomes lead, which of them are computed
//! ahead, and which predicates and kinds of task resources it touches, as small numbers.

use super::instance::gives_outputs;
use crate::analysis::{Analysis, NodeNature};
use crate::effects;
use ratn_model::expression::{EffectExpr, Expr, FactExpr};
use ratn_model::id::StateId;
use ratn_model::program::{ABORTED, Exceptions, PREEMPTED, Program, SUCCESS, State, StateKind, Target};
use ratn_model::resource::{ResourceClass, ResourceOperation};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// A predicate, or the task resources of one kind, as an index into [`super::table::Table`]s.
pub(crate) type Predicate = usize;

/// Writers that may write any fact stand here.
pub(crate) const EVERYTHING: Predicate = 0;

/// An outcome of a state: its place in [`StatePlan::outcomes`].
pub(crate) type Outcome = usize;

/// A set of outcomes by bits; a state has at most [`MAX_OUTCOMES`].
pub(crate) type Outcomes = u64;

/// More outcomes than this are exceptional, whatever they lead to.
pub(crate) const MAX_OUTCOMES: usize = 64;

/// The plan of a program.
#[derive(Debug)]
pub(crate) struct Plan {
    states: Vec<StatePlan>,
    predicates: BTreeMap<String, Predicate>,
    /// How many predicates there are, [`EVERYTHING`] and kinds of task resources included.
    pub(crate) width: usize,
}

/// The plan of one state.
#[derive(Debug)]
pub(crate) struct StatePlan {
    /// `success`, the state's own, `aborted`, `preempted`.
    pub(crate) outcomes: Vec<Arc<str>>,
    /// Where each leads.
    pub(crate) targets: Vec<Target>,
    /// The continuations that are computed ahead: outcomes with one target; the first has `success`.
    pub(crate) arms: Vec<ArmPlan>,
    /// What each outcome changes.
    pub(crate) effects: Vec<Effects>,
    /// The predicates and kinds that it writes with an outcome computed ahead; [`EVERYTHING`] alone if it may write anything.
    pub(crate) writes: Vec<Predicate>,
    /// The kinds of task resources that it depends on: those it blocks, consumes, creates, deletes or looks for.
    pub(crate) kinds: Vec<Predicate>,
    /// The predicates that each outcome's effects write.
    pub(crate) effect_predicates: Vec<Vec<Predicate>>,
    /// The kinds of task resources that it creates, deletes or consumes.
    pub(crate) operated: Vec<Predicate>,
    /// The states whose outputs any of its expressions reads.
    pub(crate) flows: Vec<StateId>,
    /// The variables that any of its expressions reads; of a routine, those of what it contains, too.
    pub(crate) variables: Vec<String>,
    /// Of an action: its provider and its name there.
    pub(crate) action: Option<(Arc<str>, Arc<str>)>,
    /// The variables that it, or a routine's inside, gives new values.
    pub(crate) assigns: Vec<String>,
    /// Somebody reads its outputs.
    pub(crate) is_read: bool,
    /// The states inside of it whose outputs somebody reads: forgotten when it is entered.
    pub(crate) read_inside: Vec<StateId>,
    /// States of its lists may be visited more than once in one activation.
    pub(crate) repeats: bool,
    /// An action or a routine: executed as one node.
    pub(crate) is_node: bool,
    /// A composite state that is one node.
    pub(crate) is_routine: bool,
    /// It has something to do when it is left by this outcome: [`StatePlan::outcomes`].
    pub(crate) exits: Outcomes,
    /// Younger PIAs may run beside it.
    pub(crate) imprecise: bool,
    /// A region of a concurrency.
    pub(crate) is_region: bool,
}

/// Outcomes that lead to the same place and agree on whether there are outputs.
#[derive(Debug, Clone)]
pub(crate) struct ArmPlan {
    pub(crate) outcomes: Outcomes,
    /// One of them, for looking up target and name.
    pub(crate) outcome: Outcome,
    /// All of them change the same; else what they change is known when it has ended.
    pub(crate) same_effects: bool,
}

/// What an outcome changes.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Effects {
    /// It may be anything, known when the node has ended.
    Unknown,
    /// These, each with its predicate; those in quantifiers are counted at the quantifier.
    Declared(Vec<EffectExpr>),
}

impl Plan {
    /// The plan of a checked program.
    pub(crate) fn of(program: &Program, analysis: &Analysis) -> Plan {
        let operated: BTreeSet<&str> = program
            .states
            .iter()
            .flat_map(|state| &state.annotations.resources)
            .filter(|r| !matches!(r.operation, ResourceOperation::Block | ResourceOperation::Exists))
            .map(|r| r.kind.as_str())
            .collect();
        let mut names = Names { predicates: BTreeMap::new() };
        let read: BTreeSet<StateId> = program.states.iter().flat_map(read_states).chain(task_reads(program)).collect();
        let mut targets = vec![None; program.states.len()];
        let mut repeats = vec![false; program.states.len()];
        for state in &program.states {
            for list in state.lists() {
                for (place, child) in list.iter().enumerate() {
                    targets[index(*child)] = list.get(place + 1).copied();
                }
                let position: BTreeMap<StateId, usize> = list.iter().enumerate().map(|(i, id)| (*id, i)).collect();
                let back = |id: &StateId| {
                    program.state(*id).transitions.values().any(|target| match target {
                        Target::State(to) => position.get(to) <= position.get(id),
                        Target::Outcome(_) => false,
                    })
                };
                repeats[index(state.id)] |= list.iter().any(back);
            }
        }
        let outcomes = program.all_outcomes();
        let states = program
            .states
            .iter()
            .zip(&outcomes)
            .map(|(state, outcomes)| {
                let next = targets[index(state.id)];
                plan(program, analysis, state, outcomes, next, repeats[index(state.id)], &read, &operated, &mut names)
            })
            .collect();
        let mut plan = Plan { states, width: names.predicates.len() + 1, predicates: names.predicates };
        inside(program, &mut plan, &read);
        plan
    }

    /// The plan of one state.
    pub(crate) fn state(&self, id: StateId) -> &StatePlan {
        &self.states[index(id)]
    }

    /// The number of a predicate; `None` if the program never writes it by name.
    pub(crate) fn predicate(&self, name: &str) -> Option<Predicate> {
        self.predicates.get(name).copied()
    }

    /// All predicates and kinds.
    pub(crate) fn predicates(&self) -> impl Iterator<Item = Predicate> {
        0..self.width
    }

    /// How many states there are.
    pub(crate) fn len(&self) -> usize {
        self.states.len()
    }
}

impl StatePlan {
    /// The number of an outcome by its name.
    pub(crate) fn outcome(&self, name: &str) -> Option<Outcome> {
        self.outcomes.iter().position(|outcome| &**outcome == name)
    }
}

struct Names {
    predicates: BTreeMap<String, Predicate>,
}

impl Names {
    fn number(&mut self, name: &str) -> Predicate {
        if let Some(known) = self.predicates.get(name) {
            return *known;
        }
        let next = self.predicates.len() + 1;
        self.predicates.insert(name.to_owned(), next);
        next
    }
}

/// The name under which the task resources of a kind stand among the predicates: no predicate is called so.
pub(crate) fn kind_name(kind: &str) -> String {
    format!("#{kind}")
}

fn index(id: StateId) -> usize {
    id.0 as usize
}

#[expect(clippy::too_many_arguments, reason = "what the whole program says of one state")]
fn plan(
    program: &Program,
    analysis: &Analysis,
    state: &State,
    outcomes: &[String],
    next: Option<StateId>,
    repeats: bool,
    read: &BTreeSet<StateId>,
    operated: &BTreeSet<&str>,
    names: &mut Names,
) -> StatePlan {
    let is_node = matches!(state.kind, StateKind::Action { .. }) || state.is_routine();
    let outcomes: Vec<&str> = outcomes.iter().map(String::as_str).collect();
    let target = |outcome: &str| match (state.transitions.get(outcome), outcome, next) {
        (Some(target), _, _) => target.clone(),
        (None, SUCCESS, Some(next)) => Target::State(next),
        (None, outcome, _) => Target::Outcome(outcome.to_owned()),
    };
    let targets: Vec<Target> = outcomes.iter().map(|outcome| target(outcome)).collect();
    let nature = analysis.state(state.id).nature;
    let is_routine = is_node && !matches!(state.kind, StateKind::Action { .. });
    let effects: Vec<Effects> = outcomes
        .iter()
        .map(|outcome| {
            let declared = if is_routine {
                None
            } else if is_node {
                effects::declared(state, nature, outcome)
            } else {
                Some(state.annotations.effects.get(*outcome).map_or(&[][..], Vec::as_slice))
            };
            declared.map_or(Effects::Unknown, |declared| Effects::Declared(declared.to_vec()))
        })
        .collect();
    let success = &targets[0];
    let exceptional = |number: usize| {
        let outcome = outcomes[number];
        let marked = state.annotations.exceptional.iter().any(|marked| marked == outcome);
        let failure = matches!(outcome, ABORTED | PREEMPTED)
            && (!state.transitions.contains_key(outcome) || targets[number] == *success);
        marked || failure || number >= MAX_OUTCOMES
    };
    let mut arms: Vec<ArmPlan> = Vec::new();
    for number in (0..outcomes.len()).filter(|number| !exceptional(*number)) {
        let same = |arm: &&mut ArmPlan| {
            targets[arm.outcome] == targets[number]
                && gives_outputs(outcomes[arm.outcome]) == gives_outputs(outcomes[number])
        };
        match arms.iter_mut().find(same) {
            Some(arm) => {
                arm.outcomes |= 1 << number;
                arm.same_effects &= effects[arm.outcome] == effects[number];
            }
            None => arms.push(ArmPlan { outcomes: 1 << number, outcome: number, same_effects: true }),
        }
    }
    let effect_predicates: Vec<Vec<Predicate>> = effects
        .iter()
        .map(|effects| {
            let mut written = BTreeSet::new();
            match effects {
                Effects::Unknown => {
                    written.insert(EVERYTHING);
                }
                Effects::Declared(effects) => effects.iter().for_each(|e| write_predicates(e, names, &mut written)),
            }
            written.into_iter().collect()
        })
        .collect();
    let mut writes = BTreeSet::new();
    if is_routine {
        match &analysis.state(state.id).writes {
            None => {
                writes.insert(EVERYTHING);
            }
            Some(effects) => effects.iter().for_each(|effect| write_predicates(effect, names, &mut writes)),
        }
    } else {
        let ahead = (0..outcomes.len()).filter(|n| arms.iter().any(|arm| arm.outcomes & (1 << n) != 0));
        writes.extend(ahead.flat_map(|number| effect_predicates[number].iter().copied()));
    }
    if writes.contains(&EVERYTHING) {
        writes = BTreeSet::from([EVERYTHING]);
    }
    let operations = if is_node {
        analysis.state(state.id).operated.clone()
    } else {
        analysis.state(state.id).operations.iter().map(|r| r.kind.clone()).collect()
    };
    let operated_kinds: Vec<Predicate> = operations.iter().map(|kind| names.number(&kind_name(kind))).collect();
    writes.extend(operated_kinds.iter().copied());
    let uses = |r: &&ratn_model::program::ResourceExpr| {
        operated.contains(r.kind.as_str()) && (r.class.is_none_or(|class| class == ResourceClass::Task))
    };
    let kinds: BTreeSet<Predicate> = analysis
        .state(state.id)
        .requirements
        .iter()
        .filter(uses)
        .map(|r| r.kind.as_str())
        .chain(operations.iter().map(String::as_str))
        .map(|kind| names.number(&kind_name(kind)))
        .collect();
    let mut exits = 0;
    if !is_node {
        for (number, outcome) in outcomes.iter().enumerate().take(MAX_OUTCOMES) {
            let good = !matches!(*outcome, ABORTED | PREEMPTED);
            let outputs = matches!(&state.kind,
                StateKind::Sequence { outputs, .. } | StateKind::Concurrency { outputs, .. } if !outputs.is_empty());
            let changes = effects[number] != Effects::Declared(Vec::new());
            let operates = number == 0 && !analysis.state(state.id).operations.is_empty();
            if changes || operates || (good && (outputs || !state.assign.is_empty())) {
                exits |= 1 << number;
            }
        }
    }
    let region_of = state.parent.map(|parent| &program.state(parent).kind);
    StatePlan {
        outcomes: outcomes.iter().map(|outcome| Arc::from(*outcome)).collect(),
        targets,
        arms,
        effects,
        writes: writes.into_iter().collect(),
        kinds: kinds.into_iter().collect(),
        effect_predicates,
        operated: operated_kinds,
        flows: used_flows(program, state, is_node),
        action: match &state.kind {
            StateKind::Action { provider, action, .. } => Some((Arc::from(&**provider), Arc::from(&**action))),
            _ => None,
        },
        assigns: assigned_variables(program, state, is_node).into_iter().collect(),
        variables: {
            let mut variables = used_variables(program, state, is_node);
            if is_routine {
                // What it does not assign in the end is as it was before.
                variables.extend(assigned_variables(program, state, is_node));
            }
            variables.into_iter().collect()
        },
        is_read: read.contains(&state.id),
        read_inside: Vec::new(),
        repeats,
        is_node,
        is_routine,
        exits,
        imprecise: nature == NodeNature::Irreversible
            && state.annotations.exceptions.unwrap_or(program.exceptions) == Exceptions::Imprecise,
        is_region: matches!(region_of, Some(StateKind::Concurrency { .. })),
    }
}

/// For every composite the states inside of it that are read.
fn inside(program: &Program, plan: &mut Plan, read: &BTreeSet<StateId>) {
    for id in read {
        let mut around = program.state(*id).parent;
        while let Some(parent) = around {
            plan.states[index(parent)].read_inside.push(*id);
            around = program.state(parent).parent;
        }
    }
}

fn write_predicates(effect: &EffectExpr, names: &mut Names, into: &mut BTreeSet<Predicate>) {
    match effect {
        EffectExpr::Set(fact, _) | EffectExpr::Delete(fact) | EffectExpr::Increase(fact, _) => {
            into.insert(names.number(&fact.predicate));
        }
        EffectExpr::ForEach { effects, .. } => effects.iter().for_each(|e| write_predicates(e, names, into)),
    }
}

/// Every expression of a state.
fn visit_state<'a>(state: &'a State, visit: &mut dyn FnMut(&'a Expr)) {
    match &state.kind {
        StateKind::Action { inputs, .. } => inputs.iter().for_each(|(_, e)| e.visit(visit)),
        StateKind::Sequence { outputs, .. } => outputs.iter().for_each(|o| o.value.visit(visit)),
        StateKind::ForEach { collection, .. } => collection.visit(visit),
        StateKind::While { predicate, .. } | StateKind::Condition { predicate, .. } => predicate.visit(visit),
        StateKind::Concurrency { decide, outputs, .. } => {
            decide.iter().for_each(|(_, e)| e.visit(visit));
            outputs.iter().for_each(|o| o.value.visit(visit));
        }
    }
    state.variables.iter().chain(&state.assign).for_each(|(_, e)| e.visit(visit));
    let annotations = &state.annotations;
    annotations.requires.iter().chain(&annotations.duration_s).for_each(|e| e.visit(visit));
    let senses: &[FactExpr] = match &annotations.nature {
        ratn_model::program::Nature::Senses(facts) => facts,
        _ => &[],
    };
    annotations.reads.iter().flatten().chain(senses).for_each(|fact| fact.visit(visit));
    annotations.effects.values().flatten().for_each(|effect| effect.visit(visit));
    annotations.resources.iter().flat_map(|r| r.expressions()).for_each(|e| e.visit(visit));
}

/// What a routine contains, itself included; any other state alone.
fn contained<'a>(program: &'a Program, state: &'a State, is_node: bool) -> Vec<&'a State> {
    let mut all = vec![state];
    let mut next = 0;
    while is_node && next < all.len() {
        let children = all[next].children().map(|child| program.state(child));
        all.extend(children);
        next += 1;
    }
    all
}

fn used_flows(program: &Program, state: &State, is_node: bool) -> Vec<StateId> {
    let states = contained(program, state, is_node);
    let mut flows: BTreeSet<StateId> = states.iter().flat_map(|state| read_states(state)).collect();
    if states.len() > 1 {
        states.iter().for_each(|state| {
            flows.remove(&state.id);
        });
    }
    if state.id == Program::ROOT {
        flows.extend(task_reads(program));
    }
    flows.into_iter().collect()
}

fn assigned_variables(program: &Program, state: &State, is_node: bool) -> BTreeSet<String> {
    let states = contained(program, state, is_node);
    let inner = states.iter().skip(1).flat_map(|state| &state.assign);
    let declared: BTreeSet<&String> = states.iter().flat_map(|s| &s.variables).map(|(name, _)| name).collect();
    let inner = inner.map(|(name, _)| name).filter(|name| !declared.contains(name));
    state.assign.iter().map(|(name, _)| name).chain(inner).cloned().collect()
}

fn read_states(state: &State) -> Vec<StateId> {
    let mut states = Vec::new();
    visit_state(state, &mut |part| {
        if let Expr::Port { state, .. } = part {
            states.push(*state);
        }
    });
    states
}

fn task_reads(program: &Program) -> Vec<StateId> {
    program.outputs.iter().flat_map(|output| output.value.flows()).collect()
}

/// The variables that a state, or what a routine contains, uses.
fn used_variables(program: &Program, state: &State, is_node: bool) -> BTreeSet<String> {
    let mut names = BTreeSet::new();
    for state in contained(program, state, is_node) {
        visit_state(state, &mut |part| {
            if let Expr::Variable(name) = part {
                names.insert(name.clone());
            }
        });
    }
    if state.id == Program::ROOT {
        program.outputs.iter().for_each(|output| names.extend(output.value.variables().into_iter().map(str::to_owned)));
    }
    names
}
