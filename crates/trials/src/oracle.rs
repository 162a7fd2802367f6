//! The behaviour of nodes in random programs: a hash of what they are entitled to see, and nothing else.
//!
//! Faults depend on path and attempt, never on time. A PIA that crashes ends `aborted`, which is a result, so its crashes depend
//! on path and try, which are the same in both modes. Durations depend on path and try, too. Inside of a preemptive concurrency
//! the actions of its two regions take multiples of [`LONG_S`], in the second region plus [`SHIFT_S`] each. With at most three
//! actions per region, other delays (late messages, crashed workers: some tens of seconds) never change which region ends first,
//! so the outcome is the same in both modes.

use super::anytime;
use super::generator::tolerance::{OFF, TOLERANT};
use super::{AGAIN, ARGUMENTS, FOUND, PREDICATES, is_preemptive, plain, state_of};
use super::{Dice, Hash};
use ratn_executive::protocol::{Event, Goal};
use ratn_model::expression::{EffectExpr, Expr, FactExpr, Lookup, Scope};
use ratn_model::fact::{FactKey, FactPattern, Footprint, Term};
use ratn_model::id::{InstanceId, StateId};
use ratn_model::program::{ABORTED, Nature, PREEMPTED, Program, STOPPED, SUCCESS, State, StateKind};
use ratn_model::value::Value;
use ratn_simulation::run::{Answer, Better, Oracle, Performance};
use ratn_world::world::World;
use std::borrow::Cow;
use std::collections::BTreeMap;

/// Upper limit of a goal's duration, unless it never answers.
pub(super) const TIMEOUT_S: f64 = 60.0;
/// Smallest duration of actions in a preemptive concurrency.
pub(super) const LONG_S: f64 = 10_000.0;
/// Additional duration in its second region.
const SHIFT_S: f64 = 3_000.0;
/// Attempts from this number on do not crash.
const LAST_ATTEMPT: u32 = 3;
/// Visits from this number on do not lead back.
const LAST_VISIT: u64 = 3;

/// The oracle for random programs.
pub struct HashOracle<'a> {
    /// The program.
    pub program: &'a Program,
    /// The seed of all hashes.
    pub seed: u64,
    /// Percentage of visits that end `aborted` or `preempted`, or never; also of PIAs that crash.
    pub failures_percent: u64,
    /// Percentage of attempts of computing and sensing nodes that crash or lose their lease.
    pub crashes_percent: u64,
    /// Percentage of effects whose measured values differ from the predicted ones.
    pub deviations_percent: u64,
    /// Whether some of the visits that end `preempted` end by an emergency stop instead.
    pub stops: bool,
}

impl Oracle for HashOracle<'_> {
    fn perform(&mut self, path: &str, attempt: u32, goal: &Goal, world: &World) -> Performance {
        let Some(state) = state_of(self.program, path) else {
            return Performance { duration_s: 0.0, answer: Answer::Crashed };
        };
        let duration_s = self.duration_s(path, state, goal);
        if let Some(answer) = self.fault(path, attempt, state, goal) {
            return Performance { duration_s: duration_s.min(3.0), answer };
        }
        let mut hash = Hash(self.seed);
        if state.annotations.deterministic {
            hash.add(&plain(path));
        } else {
            hash.add(path);
            hash.add_number(goal.seed);
        }
        for (port, value) in goal.inputs.iter().filter(|(port, _)| anytime::depends_on(state, port)) {
            hash.add(port);
            hash.add(&value.to_string());
        }
        for (fact, value) in self.seen(state, goal, world) {
            hash.add(&fact);
            hash.add(&value);
        }
        let mut dice = hash.dice();
        if dice.percent(self.failures_percent) {
            return match dice.below(4) {
                0 if state.annotations.timeout_s.is_some() => Performance { duration_s: 1e6, answer: failed(ABORTED) },
                1 if self.stops && dice.percent(50) => Performance { duration_s, answer: failed(STOPPED) },
                1 => Performance { duration_s, answer: failed(PREEMPTED) },
                _ => Performance { duration_s, answer: failed(ABORTED) },
            };
        }
        let outcome = self.outcome(&mut dice, path, state);
        let x = dice.below(3) as i64;
        let list = (0..dice.below(4)).map(|_| Value::Int(dice.below(ARGUMENTS) as i64)).collect();
        let mut outputs = BTreeMap::from([("x".to_owned(), Value::Int(x)), ("list".to_owned(), Value::List(list))]);
        anytime::with_cost(state, &mut outputs);
        let measured = self.measured(&mut dice, state, goal, (&outcome, x));
        Performance { duration_s, answer: Answer::Finished { outcome, outputs, measured } }
    }

    fn better(&mut self, path: &str, attempt: u32, goal: &Goal, first: &BTreeMap<String, Value>) -> Option<Better> {
        anytime::later(self.seed, path, attempt, goal, first)
    }

    fn awaited(&mut self, path: &str, instance: InstanceId) -> Option<(f64, Event)> {
        self.comes(path, instance)
    }
}

fn failed(outcome: &str) -> Answer {
    Answer::Finished { outcome: outcome.to_owned(), outputs: BTreeMap::new(), measured: Vec::new() }
}

impl HashOracle<'_> {
    fn duration_s(&self, path: &str, state: &State, goal: &Goal) -> f64 {
        let mut hash = Hash(self.seed);
        hash.add("duration");
        hash.add(path);
        let chain: Vec<&State> = super::around(self.program, state).collect();
        let region = chain.windows(2).find(|pair| is_preemptive(pair[1])).map(|pair| pair[0].id);
        if let Some(region) = region {
            let second = chain.iter().any(|s| s.children().position(|child| child == region) == Some(1));
            let shift = if second { SHIFT_S } else { 0.0 };
            return LONG_S * (1 + hash.dice().below(3)) as f64 + shift;
        }
        hash.add_number(goal.seed);
        let usual = 0.5 + hash.dice().below(40) as f64 / 10.0;
        // Some estimates are exact.
        goal.expected_s.filter(|_| hash.dice().percent(70)).map_or(usual, |expected| expected.min(TIMEOUT_S - 10.0))
    }

    fn fault(&self, path: &str, attempt: u32, state: &State, goal: &Goal) -> Option<Answer> {
        if super::around(self.program, state).any(is_preemptive) {
            // The other regions of the routine would wait for the worker's replacement, which could change the winner.
            return None;
        }
        let mut hash = Hash(self.seed);
        hash.add("fault");
        hash.add(path);
        if state.annotations.attempts.is_some() && state.annotations.nature != Nature::Irreversible {
            // The last attempt may have different numbers in the two modes, so either all attempts crash or none.
            hash.add("every attempt");
            hash.add_number(goal.seed);
            return hash.dice().percent(self.crashes_percent).then_some(Answer::Crashed);
        }
        let chance = if state.annotations.nature == Nature::Irreversible {
            hash.add_number(goal.seed);
            self.failures_percent.div_ceil(3)
        } else if attempt < LAST_ATTEMPT {
            hash.add_number(u64::from(attempt));
            self.crashes_percent
        } else {
            0
        };
        let mut dice = hash.dice();
        let fails = dice.percent(chance);
        fails.then(|| if dice.percent(50) { Answer::Crashed } else { Answer::LeaseLost })
    }

    fn outcome(&self, dice: &mut Dice, path: &str, state: &State) -> String {
        if state.outcomes.is_empty() || dice.percent(45) {
            return SUCCESS.to_owned();
        }
        let chosen = dice.one_of(&state.outcomes).map_or(SUCCESS, String::as_str);
        // Loops in the program must end.
        let back = chosen == AGAIN && (state.annotations.deterministic || visits(path) >= LAST_VISIT);
        if back { FOUND.to_owned() } else { chosen.to_owned() }
    }

    /// Facts whose measured values differ from the outcome's effects; `x` is the node's output.
    fn measured(
        &self,
        dice: &mut Dice,
        state: &State,
        goal: &Goal,
        (outcome, x): (&str, i64),
    ) -> Vec<(FactKey, Value)> {
        if self.deviations_percent == 0 {
            return Vec::new();
        }
        let scope = InputScope { state, goal };
        let mut measured: Vec<(FactKey, Value)> = Vec::new();
        match state.annotations.effects.get(outcome) {
            Some(effects) => {
                for effect in effects {
                    let EffectExpr::Set(fact, value) = effect else { continue };
                    let Some(key) = key(fact, &scope) else { continue };
                    if is_tolerant(&key) {
                        if !measured.iter().any(|(known, _)| *known == key) {
                            measured.extend(self.nearly(dice, value, x).map(|value| (key, value)));
                        }
                        continue;
                    }
                    if dice.percent(self.deviations_percent) && !measured.iter().any(|(known, _)| *known == key) {
                        measured.push((key, Value::Int(dice.below(4) as i64)));
                    }
                }
            }
            // Undeclared changes, which nobody could predict.
            None if state.annotations.nature == Nature::Irreversible && dice.percent(self.deviations_percent) => {
                let fact = super::generator::fact_at(dice.below(PREDICATES), dice.below(ARGUMENTS) as i64);
                measured.extend(key(&fact, &scope).map(|key| (key, Value::Int(dice.below(4) as i64))));
            }
            None => {}
        }
        measured
    }

    /// A value of the tolerant predicate: the predicted value or another one, with a small deviation.
    fn nearly(&self, dice: &mut Dice, predicted: &Expr, x: i64) -> Option<Value> {
        let predicted = match predicted {
            Expr::Literal(value) => value.as_number()?,
            _ => x as f64,
        };
        let whole = if dice.percent(self.deviations_percent) { dice.below(4) as f64 } else { predicted };
        let off = [0.0, OFF, -OFF][dice.below(3) as usize];
        Some(Value::Float(whole + off))
    }

    /// The facts that the node declares to read, sense or require, as shown by its world.
    fn seen(&self, state: &State, goal: &Goal, world: &World) -> Vec<(String, String)> {
        let scope = InputScope { state, goal };
        let annotations = &state.annotations;
        let mut declared: Vec<FactExpr> = match (&annotations.nature, &annotations.reads) {
            (Nature::Senses(facts), _) => facts.clone(),
            (_, Some(reads)) => reads.clone(),
            (_, None) => {
                return world.iter().map(|(k, f)| (k.to_string(), coarse(k, &f.value))).collect();
            }
        };
        if !matches!(annotations.nature, Nature::Senses(_)) {
            declared.extend(annotations.requires.iter().flat_map(Expr::fact_expressions).cloned());
        }
        let Footprint::Patterns(patterns) = FactExpr::footprint(&declared, &scope) else { return Vec::new() };
        let seen = |pattern: &FactPattern| -> Vec<(String, String)> {
            world.matching(pattern).map(|(k, f)| (k.to_string(), coarse(k, &f.value))).collect()
        };
        patterns.iter().flat_map(seen).collect()
    }
}

/// What a node sees of a value: for a tolerant predicate the nearest whole number.
fn coarse(key: &FactKey, value: &Value) -> String {
    match value.as_number().filter(|_| is_tolerant(key)) {
        // Turns -0 into 0.
        Some(number) => (number.round() + 0.0).to_string(),
        None => value.to_string(),
    }
}

fn is_tolerant(key: &FactKey) -> bool {
    key.predicate.strip_prefix('p').and_then(|number| number.parse().ok()) == Some(TOLERANT)
}

/// The largest visit number on a path.
fn visits(path: &str) -> u64 {
    let number = |part: &str| part.split('#').nth(1)?.split('[').next()?.parse().ok();
    path.split('/').filter_map(number).max().unwrap_or(1)
}

fn key(fact: &FactExpr, scope: &InputScope<'_>) -> Option<FactKey> {
    let pattern = fact.bind(scope).ok()?;
    let arguments = pattern.arguments.into_iter().collect::<Option<Vec<Term>>>()?;
    Some(FactKey { predicate: pattern.predicate, arguments })
}

/// The variables of a node, and the ports with which it looks up facts: random programs always pass them as inputs.
pub(super) struct InputScope<'a> {
    pub(super) state: &'a State,
    pub(super) goal: &'a Goal,
}

impl InputScope<'_> {
    /// The value of an expression that is passed as an input.
    fn input(&self, expression: &Expr) -> Option<Cow<'_, Value>> {
        let StateKind::Action { inputs, .. } = &self.state.kind else { return None };
        let port = inputs.iter().find(|(_, e)| e == expression).map(|(port, _)| port)?;
        self.goal.inputs.get(port).map(Cow::Borrowed)
    }
}

impl Scope for InputScope<'_> {
    fn variable(&self, name: &str) -> Option<Cow<'_, Value>> {
        self.input(&Expr::Variable(name.to_owned()))
    }

    fn output(&self, _: &str) -> Option<Cow<'_, Value>> {
        None
    }

    fn port(&self, state: StateId, port: &str) -> Option<Cow<'_, Value>> {
        self.input(&Expr::Port { state, port: port.to_owned() })
    }

    fn fact(&self, _: &FactPattern) -> Lookup<'_> {
        Lookup::Unknown
    }

    fn each_fact(&self, _: &FactPattern, _: &mut dyn FnMut(&FactKey, &Value) -> bool) -> bool {
        false
    }
}
