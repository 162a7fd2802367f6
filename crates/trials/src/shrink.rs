//! Shrinks a failing program: removes states and simplifies annotations, one at a time, as long as it still fails.

use super::rewrite::{is_of_a_guard, without};
use super::trial::{Conditions, Verdict, trial};
use super::{BATTERY, POWER, TOOL, around, is_preemptive};
use ratn_model::expression::{EffectExpr, Expr, Function};
use ratn_model::program::{Program, StateKind};
use ratn_model::resource::Quantity;
use ratn_model::value::Value;
use std::sync::Arc;

/// Limit of programs that are tried.
const MAX_TRIALS: usize = 6_000;

/// The shrunk program.
#[derive(Debug)]
pub struct Shrunk {
    /// The program.
    pub program: Program,
    /// The conditions under which it fails.
    pub conditions: Conditions,
    /// The failure.
    pub problem: String,
}

/// The smallest program found that still fails, perhaps in another way.
pub fn shrink(program: Program, conditions: Conditions, problem: String) -> Shrunk {
    shrink_by(trial, program, conditions, problem)
}

/// The same with another trial function.
pub fn shrink_by(
    trial: fn(&Arc<Program>, &Conditions) -> Verdict,
    program: Program,
    conditions: Conditions,
    problem: String,
) -> Shrunk {
    let mut best = Shrunk { program, conditions, problem };
    let mut trials = 0;
    loop {
        let mut smaller = false;
        let mut step = 0;
        while trials < MAX_TRIALS {
            let Some((program, conditions)) = candidate(&best, step) else { break };
            step += 1;
            if program == best.program && conditions == best.conditions {
                continue;
            }
            trials += 1;
            let program = Arc::new(program);
            if let Verdict::Differs(problem) = trial(&program, &conditions)
                && is_of_the_reference(&problem) == is_of_the_reference(&best.problem)
            {
                best = Shrunk { program: Arc::unwrap_or_clone(program), conditions, problem };
                smaller = true;
                // The steps before this one are not repeated until the next round.
                step -= 1;
            }
        }
        if !smaller || trials >= MAX_TRIALS {
            return best;
        }
    }
}

/// Whether the failure only shows an invalid program, which can result from removing a part.
fn is_of_the_reference(problem: &str) -> bool {
    problem.starts_with("the reference does not come to an end")
}

/// The program with one thing less; `None` after the last step.
fn candidate(best: &Shrunk, step: usize) -> Option<(Program, Conditions)> {
    let states = best.program.states.len();
    let (mut program, mut conditions) = (best.program.clone(), best.conditions.clone());
    if step < states {
        // From the last to the first, so that inner states are removed early; state 0 stays.
        let id = program.states[states - 1 - step].id;
        // Regions of a preemptive concurrency are removed only with it: without actions they would end at the same moment.
        let held = around(&program, program.state(id)).skip(1).any(is_preemptive);
        let is_whole = program.state(id).annotations.again.is_some() || program.state(id).annotations.finally.is_some();
        let stays = is_of_a_guard(&program, id)
            && !(is_whole && program.state(id).parent.is_some_and(|parent| !is_of_a_guard(&program, parent)));
        if id != Program::ROOT && !held && !stays {
            program = without(&program, id);
        }
        return Some((program, conditions));
    }
    let step = step - states;
    const SITUATIONS: usize = 22;
    if step < SITUATIONS {
        match step {
            0 => conditions.crashes_percent = 0,
            1 => conditions.failures_percent = 0,
            2 => conditions.deviations_percent = 0,
            3 => conditions.latency_s = 0.0,
            4 => conditions.mischief_percent = 0,
            5 => conditions.pauses = false,
            6 => conditions.orders = 0,
            7 => program.speculation_width = Program::DEFAULT_SPECULATION_WIDTH,
            8 => program.horizon = 60,
            9 => program.outputs.clear(),
            10 => conditions.refused_percent = 0,
            11 => conditions.stops = false,
            12 => conditions.resume_after = None,
            13 => conditions.learned = false,
            14 => program.ontology = None,
            15 => program.tolerances = Default::default(),
            16 => program.initial.clear(),
            _ => {
                let at = step - 17;
                if at < program.initial.len() {
                    program.initial.remove(at);
                }
            }
        }
        return Some((program, conditions));
    }
    let (at, what) = ((step - SITUATIONS) / CHANGES, (step - SITUATIONS) % CHANGES);
    if at >= states {
        return None;
    }
    let id = program.states[at].id;
    if !is_of_a_guard(&program, id) {
        simplify(&mut program, at, what);
    }
    Some((program, conditions))
}

/// Number of ways to simplify a state.
const CHANGES: usize = 48;

fn simplify(program: &mut Program, at: usize, what: usize) {
    let state = &mut program.states[at];
    let a = &mut state.annotations;
    match what {
        0 => {
            a.requires.clear();
            a.holds.clear();
        }
        1 => a.routine = false,
        2 => a.retry = None,
        3 => a.timeout_s = None,
        4 => a.deterministic = false,
        5 => a.exceptional.clear(),
        6 => a.reads = Some(Vec::new()),
        7 => a.effects.values_mut().for_each(Vec::clear),
        8 => a.effects.values_mut().for_each(|effects| effects.truncate(1)),
        9 => {
            a.effects.insert("success".to_owned(), Vec::new());
        }
        10 => a.resources.retain(|r| r.operation == ratn_model::resource::ResourceOperation::Block),
        11 => a.resources.iter_mut().for_each(|r| r.count = Quantity::ONE),
        12 => state.assign.clear(),
        13 => state.defaults.clear(),
        14..18 => {
            if let Some(outcome) = state.transitions.keys().nth(what - 14).cloned() {
                state.transitions.remove(&outcome);
            }
        }
        18 | 19 => {
            let literal = Expr::Literal(Value::Bool(what == 18));
            match &mut state.kind {
                StateKind::Condition { predicate, .. } => *predicate = literal,
                StateKind::ForEach { collection, .. } => {
                    let items = if what == 18 { vec![Expr::Literal(Value::Int(0))] } else { Vec::new() };
                    *collection = Expr::List(items);
                }
                StateKind::Concurrency { decide, .. } => decide.clear(),
                StateKind::Sequence { outputs, .. } => outputs.clear(),
                _ => {}
            }
            if let Some(outputs) = state.kind.outputs_mut().filter(|_| what == 19) {
                outputs.pop();
            }
        }
        20..24 => {
            if let StateKind::Action { inputs, .. } = &mut state.kind
                && what - 20 < inputs.len()
                // The oracle knows the variables only from the inputs.
                && !matches!(inputs[what - 20].1, Expr::Variable(_))
            {
                inputs.remove(what - 20);
            }
        }
        24 => {
            if let ratn_model::program::Nature::Senses(facts) = &mut a.nature {
                facts.clear();
            }
        }
        25 => {
            if let Some(reads) = &mut a.reads {
                reads.truncate(1);
            }
        }
        26 => a.duration_s = None,
        27 => a.attempts = None,
        28 => a.resources.retain(|r| ![TOOL, POWER, BATTERY].contains(&r.kind.as_str())),
        29 => state.variables.iter_mut().for_each(|(_, value)| *value = Expr::Literal(Value::Int(0))),
        30 => {
            if let StateKind::ForEach { collection: Expr::Call(Function::Range, to), .. } = &mut state.kind
                && let [Expr::Literal(Value::Int(many))] = to.as_mut_slice()
            {
                *many /= 2;
            }
        }
        31..35 => remove(&mut a.requires, what - 31),
        35..38 => {
            if let Some(reads) = &mut a.reads {
                remove(reads, what - 35);
            }
        }
        38..44 => a.effects.values_mut().for_each(|effects| remove(effects, what - 38)),
        44 => a.effects.values_mut().flatten().for_each(|effect| {
            if let EffectExpr::ForEach { effects, .. } = effect
                && let [inner @ EffectExpr::ForEach { .. }] = effects.as_slice()
            {
                *effect = inner.clone();
            }
        }),
        45 => a.effects.values_mut().flatten().for_each(|effect| {
            if let EffectExpr::ForEach { collection, .. } = effect {
                *collection = Expr::List(vec![Expr::Literal(Value::Int(0))]);
            }
        }),
        46 => a.effects.values_mut().flatten().for_each(|effect| {
            if let EffectExpr::Set(_, value) | EffectExpr::Increase(_, value) = effect {
                *value = Expr::Literal(Value::Int(1));
            }
        }),
        _ => a.exceptions = None,
    }
}

fn remove<T>(from: &mut Vec<T>, at: usize) {
    if at < from.len() {
        from.remove(at);
    }
}
