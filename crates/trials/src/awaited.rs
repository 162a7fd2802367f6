//! How the waits of random programs end: a function of their paths, the same in both modes.

use super::{Dice, Hash, HashOracle, state_of};
use ratn_executive::protocol::Event;
use ratn_model::expression::{BinaryOperator, Expr, FactExpr, UnaryOperator};
use ratn_model::fact::{FactKey, Term};
use ratn_model::id::{InstanceId, Revision};
use ratn_model::program::Program;
use ratn_model::value::Value;
use ratn_model::wait::Wait;

/// Percentage of waits with a timeout that reach it.
const LATE_PERCENT: u64 = 35;
/// Percentage of states that wait for a signal to which some signals are sent before they wait.
const EARLY_PERCENT: u64 = 30;

impl HashOracle<'_> {
    /// The event that ends a wait, and when; `None` if the wait ends by itself or never.
    pub(super) fn comes(&self, path: &str, instance: InstanceId) -> Option<(f64, Event)> {
        let state = state_of(self.program, path)?;
        let mut hash = Hash(self.seed);
        hash.add("awaited");
        hash.add(path);
        let mut dice = hash.dice();
        if state.annotations.timeout_s.is_some() && dice.percent(LATE_PERCENT) {
            return None;
        }
        let after_s = dice.below(80) as f64 / 10.0;
        let event = match state.wait()? {
            Wait::Seconds(_) | Wait::Until(_) | Wait::Limit(_) | Wait::Watch(_) => return None,
            Wait::Condition(condition) => {
                let mut facts = Vec::new();
                make(condition, true, &mut facts);
                Event::WorldChanged { revision: Revision(0), facts }
            }
            Wait::Signal(signal) => Event::Signalled { signal: signal.to_owned(), value: sent(&mut dice) },
            Wait::Answer(question) => {
                let choice = dice.one_of(&question.choices)?;
                Event::Answered { instance, choice: (*choice).to_owned() }
            }
        };
        Some((after_s, event))
    }
}

fn sent(dice: &mut Dice) -> Value {
    Value::Int(dice.below(3) as i64)
}

/// The signals that are sent before the run begins.
pub(super) fn early_signals(program: &Program, seed: u64) -> Vec<(String, Value)> {
    let mut dice = Dice(seed ^ 0x000e_a417);
    let mut early = Vec::new();
    for state in &program.states {
        let Some(Wait::Signal(signal)) = state.wait() else { continue };
        while dice.percent(EARLY_PERCENT) {
            early.push((signal.to_owned(), sent(&mut dice)));
        }
    }
    early
}

/// The facts that make a condition of the generator true (or false, by `holds`).
fn make(condition: &Expr, holds: bool, facts: &mut Vec<(FactKey, Option<Value>)>) {
    match condition {
        Expr::Binary(BinaryOperator::And, a, b) => {
            make(a, holds, facts);
            make(b, holds, facts);
        }
        Expr::Unary(UnaryOperator::Not, inner) => make(inner, !holds, facts),
        Expr::Exists(fact) => facts.push((key(fact), holds.then_some(Value::Int(1)))),
        Expr::Binary(BinaryOperator::Equal, fact, value) => {
            if let (Expr::Fact(fact), Expr::Literal(value)) = (&**fact, &**value) {
                facts.push((key(fact), Some(value.clone())));
            }
        }
        _ => {}
    }
}

fn key(fact: &FactExpr) -> FactKey {
    let argument = |argument: &Option<Expr>| match argument {
        Some(Expr::Literal(Value::Int(number))) => Term::Int(*number),
        _ => Term::Int(0),
    };
    FactKey { predicate: fact.predicate.clone(), arguments: fact.arguments.iter().map(argument).collect() }
}
