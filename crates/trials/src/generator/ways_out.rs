//! `finally` of further states, including states inside of races, timeouts and regions, and effects for the outcome `preempted`.
//!
//! A `finally` contains a copy of an action of the same region, without its inputs, so it uses nothing that the region does not use.

use super::super::oracle::LONG_S;
use super::super::{BATTERY, Dice, POWER, RESOURCES, TOOL, around};
use ratn_model::expression::{EffectExpr, Expr, FactExpr};
use ratn_model::guard::Guard;
use ratn_model::id::StateId;
use ratn_model::program::{Nature, PREEMPTED, Program, SUCCESS, State, StateKind, Target};
use ratn_model::resource::ResourceOperation;
use ratn_model::value::Value;
use std::collections::BTreeMap;

/// Limit of additional states.
const MOST: usize = 6;

/// Adds a `finally` to some states, and effects for `preempted` to some.
pub(super) fn add(program: &mut Program, guards: &mut BTreeMap<StateId, Guard>, dice: &mut Dice) {
    let is_action = |state: &State| matches!(state.kind, StateKind::Action { .. }) && !state.is_pause();
    let donors: Vec<StateId> =
        program.states.iter().filter(|state| is_action(state) && is_closed(state)).map(|state| state.id).collect();
    let ids: Vec<StateId> = program.states.iter().skip(1).filter(|state| !state.is_pause()).map(|s| s.id).collect();
    limit(program, guards, dice);
    let is_limited = |state: &State| guards.get(&state.id).is_some_and(|guard| guard.limits.is_some());
    let cut_short: Vec<StateId> =
        program.states.iter().filter(|state| is_limited(state) || super::is_preemptive(state)).map(|s| s.id).collect();
    let mut made = 0;
    for id in &ids {
        let state = program.state(*id);
        let is_inside = around(program, state).skip(1).any(|state| cut_short.contains(&state.id));
        let own = region_of(program, *id);
        let donors: Vec<StateId> = donors.iter().copied().filter(|donor| region_of(program, *donor) == own).collect();
        let wanted = dice.percent(if is_inside { 50 } else { 20 });
        let Some(donor) = dice.one_of(&donors).copied().filter(|_| wanted && made < MOST) else { continue };
        let guard = guards.entry(*id).or_default();
        if guard.finally.is_empty() {
            guard.finally = vec![copy(program, donor, *id)];
            made += 1;
        }
    }
    for id in ids {
        let state = program.state(id);
        // A composite state may write what a state inside of it writes.
        let inside = program.states.iter().filter(|other| around(program, other).any(|out| out.id == id));
        let written: Vec<FactExpr> = inside.filter(|other| is_action(other)).filter_map(writes).collect();
        // A computing or sensing state changes nothing when it fails.
        let changes = !is_action(state) || state.annotations.nature == Nature::Irreversible;
        let says = dice.percent(40) && changes && !state.annotations.effects.contains_key(PREEMPTED);
        let Some(fact) = dice.one_of(&written).cloned().filter(|_| says) else { continue };
        let effect = EffectExpr::Set(fact, Expr::Literal(Value::Int(dice.below(5) as i64)));
        program.states[id.0 as usize].annotations.effects.insert(PREEMPTED.to_owned(), vec![effect]);
    }
}

/// Adds timeouts to states without concurrent neighbours, in which no state waits for what another one holds.
fn limit(program: &mut Program, guards: &mut BTreeMap<StateId, Guard>, dice: &mut Dice) {
    let is_concurrent = |state: &State| matches!(state.kind, StateKind::Concurrency { .. });
    let mut limited: Vec<StateId> = Vec::new();
    for id in (1..program.states.len() as u64).map(StateId) {
        let state = program.state(id);
        let is_beside = around(program, state).skip(1).any(is_concurrent);
        let is_alone = !is_beside && !around(program, state).any(|state| limited.contains(&state.id));
        let holds_some = state.children().next().is_some() && !super::is_preemptive(state);
        if holds_some && is_alone && dice.percent(25) && !contend(program, id) {
            limited.push(id);
        }
    }
    for id in limited {
        let inside: Vec<StateId> = inside(program, id).map(|state| state.id).collect();
        for id in inside {
            let state = &mut program.states[id.0 as usize];
            if state.children().next().is_some() {
                state.annotations.resources.retain(|resource| resource.operation != ResourceOperation::Block);
            }
        }
        let limits = guards.entry(id).or_default().limits.get_or_insert_default();
        // Never at the end of an action.
        limits.timeout_s = Some(LONG_S * dice.below(4) as f64 + LONG_S / 20.0);
    }
}

/// The states inside of a state, including itself.
fn inside(program: &Program, id: StateId) -> impl Iterator<Item = &State> {
    program.states.iter().filter(move |state| around(program, state).any(|out| out.id == id))
}

/// Whether a state inside may wait for something that a concurrent one holds.
fn contend(program: &Program, id: StateId) -> bool {
    let concurrencies = inside(program, id).filter(|state| matches!(state.kind, StateKind::Concurrency { .. }));
    concurrencies.into_iter().any(|concurrency| {
        super::is_preemptive(concurrency)
            || RESOURCES.iter().map(|(kind, ..)| *kind).chain([TOOL, POWER, BATTERY]).any(|kind| {
                let most = |region: StateId| {
                    let lines = inside(program, region).flat_map(|state| &state.annotations.resources);
                    lines.filter(|line| line.kind == kind).map(|line| line.count.thousandths()).max().unwrap_or(0)
                };
                let wanted: Vec<u64> = concurrency.children().map(most).filter(|most| *most > 0).collect();
                let units = RESOURCES.iter().find(|(known, ..)| *known == kind).map_or(0, |(.., units)| *units);
                wanted.len() > 1 && wanted.iter().sum::<u64>() > u64::from(units) * 1_000
            })
    })
}

fn region_of(program: &Program, id: StateId) -> Option<StateId> {
    let is_region = |state: &&State| {
        state.parent.is_some_and(|parent| matches!(program.state(parent).kind, StateKind::Concurrency { .. }))
    };
    around(program, program.state(id)).find(is_region).map(|region| region.id)
}

/// Whether nothing in a state refers to a variable, an output or another state, and it consumes nothing.
fn is_closed(state: &State) -> bool {
    let mut bare = bared(state.clone());
    let mut names = false;
    bare.each_expression_mut(&mut |_, expression| {
        expression.rewrite(&mut |part| {
            names |= matches!(part, Expr::Variable(_) | Expr::Port { .. } | Expr::Output(_));
        });
    });
    !names && state.annotations.resources.iter().all(|resource| resource.operation == ResourceOperation::Block)
}

/// A state without its inputs and assignments.
fn bared(mut state: State) -> State {
    if let StateKind::Action { inputs, .. } = &mut state.kind {
        inputs.clear();
    }
    state.assign.clear();
    state.variables.clear();
    state.annotations.exceptional.clear();
    state.annotations.shared.clear();
    state
}

/// Adds a copy of a state as `finally` of another one; all its outcomes lead on.
fn copy(program: &mut Program, donor: StateId, of: StateId) -> StateId {
    let id = StateId(program.states.len() as u64);
    let mut state = bared(program.state(donor).clone());
    state.name = format!("c{}", id.0);
    state.path = format!("{}/{}", program.state(of).path, state.name);
    (state.id, state.parent) = (id, Some(of));
    let on = |outcome: &String| (outcome.clone(), Target::Outcome(SUCCESS.to_owned()));
    state.transitions = state.outcomes.iter().map(on).collect();
    program.states.push(state);
    id
}

/// A fact without variables that an action writes with success.
fn writes(state: &State) -> Option<FactExpr> {
    let is_fixed = |fact: &&FactExpr| fact.arguments.iter().all(|arg| matches!(arg, Some(Expr::Literal(_))));
    let effects = state.annotations.effects.get(SUCCESS)?;
    effects.iter().find_map(|effect| match effect {
        EffectExpr::Set(fact, _) => Some(fact).filter(is_fixed).cloned(),
        _ => None,
    })
}
