//! States that wait: for a time, for a condition on the world, for a signal that a client sends, for an operator's answer.
//!
//! The executive waits itself, so such a state is an action of the provider [`CLOCK`], which no task file can name. It is a PIA that
//! changes nothing and holds nothing: it begins at its place in the program, and younger states are computed ahead meanwhile.
//!
//! | action | inputs | ends |
//! |---|---|---|
//! | [`PAUSE`], [`SECONDS`] | `seconds` | `success`, so much later |
//! | [`UNTIL`] | `until` | `success`, when the run is so old |
//! | [`CONDITION`] | `for` | `success`, when that holds in the actual world |
//! | [`SIGNAL`] | `signal` | `success`, with the output `value`: each signal ends one wait |
//! | [`ASK`] | `question`, `choices`, `default` | by the choice where that is an outcome of the state, else `success`, with the output `answer` |
//! | [`WATCH`] | `for`, once or more | `violated`, when one of these does not hold in the actual world |
//! | [`LIMIT`] | `seconds` | `aborted`, so much later |
//!
//! Those for a condition, a signal and an answer may have a timeout ([`crate::program::Annotations::timeout_s`]): then they end by [`TIMEOUT`], a question with a
//! default by that.

use crate::expression::{BinaryOperator, EffectExpr, Expr, FactExpr, UnaryOperator};
use crate::program::{CLOCK, State, StateKind};
use crate::value::Value;

/// A pause that the loader has put between two tries.
pub const PAUSE: &str = "wait";
/// So many seconds.
pub const SECONDS: &str = "seconds";
/// Until the run is so many seconds old.
pub const UNTIL: &str = "until";
/// Until a condition holds.
pub const CONDITION: &str = "condition";
/// Until a client sends a signal.
pub const SIGNAL: &str = "signal";
/// Until an operator answers.
pub const ASK: &str = "ask";

/// Until a condition of the state beside it does not hold ([`crate::guard`]).
pub const WATCH: &str = "watch";
/// Until the state beside it has had its time ([`crate::guard`]).
pub const LIMIT: &str = "limit";

/// The outcome of a wait that took too long.
pub const TIMEOUT: &str = "timeout";
/// The output of a wait for a signal: what was sent with it, null where nothing was.
pub const VALUE: &str = "value";
/// The output of a question: the choice.
pub const ANSWER: &str = "answer";

/// What a state waits for.
#[derive(Debug, Clone, PartialEq)]
pub enum Wait<'s> {
    /// So many seconds of the robot's time.
    Seconds(&'s Expr),
    /// Until the run is so many seconds of the robot's time old.
    Until(&'s Expr),
    /// A condition on the actual world.
    Condition(&'s Expr),
    /// Until one of these does not hold in the actual world.
    Watch(Vec<&'s Expr>),
    /// So many seconds, which are the limit of another state.
    Limit(&'s Expr),
    /// The next signal of this name.
    Signal(&'s str),
    /// An answer.
    Answer(Question<'s>),
}

/// A question to an operator.
#[derive(Debug, Clone, PartialEq)]
pub struct Question<'s> {
    /// Evaluated to a text.
    pub text: &'s Expr,
    /// What may be answered.
    pub choices: Vec<&'s str>,
    /// The answer when nobody has answered in time.
    pub default: Option<&'s str>,
}

impl State {
    /// What it waits for; `None` where it does something else.
    pub fn wait(&self) -> Option<Wait<'_>> {
        let StateKind::Action { provider, action, inputs, .. } = &self.kind else { return None };
        if provider != CLOCK {
            return None;
        }
        let input = |port: &str| inputs.iter().find(|(name, _)| name == port).map(|(_, value)| value);
        Some(match action.as_str() {
            PAUSE | SECONDS => Wait::Seconds(input("seconds")?),
            UNTIL => Wait::Until(input("until")?),
            CONDITION => Wait::Condition(input("for")?),
            WATCH => Wait::Watch(inputs.iter().filter(|(port, _)| port == "for").map(|(_, holds)| holds).collect()),
            LIMIT => Wait::Limit(input("seconds")?),
            SIGNAL => Wait::Signal(input("signal").and_then(text)?),
            ASK => Wait::Answer(Question {
                text: input("question")?,
                choices: input("choices").map(texts)?,
                default: input("default").and_then(text),
            }),
            _ => return None,
        })
    }

    /// Whether it was put into the program beside what is written there, so that nothing is said of it: a pause between two tries, or a
    /// watch over another state.
    pub fn is_unsaid(&self) -> bool {
        matches!(&self.kind, StateKind::Action { provider, action, .. }
            if provider == CLOCK && [PAUSE, WATCH, LIMIT].contains(&action.as_str()))
    }

    /// Whether it watches another state: a condition of that, or its time.
    pub fn is_watch(&self) -> bool {
        matches!(self.wait(), Some(Wait::Watch(_) | Wait::Limit(_)))
    }

    /// Whether it is a pause between two tries.
    pub fn is_between_tries(&self) -> bool {
        matches!(&self.kind, StateKind::Action { provider, action, .. } if provider == CLOCK && action == PAUSE)
    }
}

/// The facts that a condition says outright: as they will be when it holds. What younger states are computed on meanwhile.
pub fn foreseen(condition: &Expr) -> Vec<EffectExpr> {
    let mut all = Vec::new();
    foresee(condition, true, &mut all);
    all
}

fn foresee(condition: &Expr, holds: bool, into: &mut Vec<EffectExpr>) {
    match condition {
        Expr::Binary(BinaryOperator::And, a, b) if holds => {
            foresee(a, true, into);
            foresee(b, true, into);
        }
        Expr::Unary(UnaryOperator::Not, inner) => foresee(inner, !holds, into),
        Expr::Fact(fact) if holds && is_one(fact) => {
            into.push(EffectExpr::Set(fact.clone(), Expr::Literal(Value::Bool(true))));
        }
        // `not p(a)` holds of an absent fact and of one that is false; the former is what effects say.
        Expr::Fact(fact) | Expr::Exists(fact) if !holds && is_one(fact) => into.push(EffectExpr::Delete(fact.clone())),
        Expr::Binary(BinaryOperator::Equal, a, b) if holds => match (&**a, &**b) {
            (Expr::Fact(fact), value) | (value, Expr::Fact(fact)) if is_one(fact) && looks_up_nothing(value) => {
                into.push(EffectExpr::Set(fact.clone(), value.clone()));
            }
            _ => {}
        },
        _ => {}
    }
}

/// Whether it is one fact, whose arguments look up no others.
fn is_one(fact: &FactExpr) -> bool {
    fact.arguments.iter().all(|argument| argument.as_ref().is_some_and(looks_up_nothing))
}

fn looks_up_nothing(expression: &Expr) -> bool {
    expression.fact_expressions().is_empty()
}

fn text(value: &Expr) -> Option<&str> {
    match value {
        Expr::Literal(Value::String(text)) => Some(text),
        _ => None,
    }
}

fn texts(value: &Expr) -> Vec<&str> {
    match value {
        Expr::List(items) => items.iter().filter_map(text).collect(),
        _ => Vec::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::expression::parse::{NameError, Names, parse_expression};

    struct Nothing;

    impl Names for Nothing {
        fn variable(&mut self, name: &str) -> Result<Expr, NameError> {
            Ok(Expr::Variable(name.to_owned()))
        }

        fn word(&mut self, _: &str) -> Option<Expr> {
            None
        }

        fn port(&mut self, state: &str, _: &str) -> Result<Expr, NameError> {
            let (message, help) = (state.to_owned(), String::new());
            Err(NameError { rule: "unknown-state", message, help })
        }
    }

    fn said(condition: &str) -> String {
        let condition = parse_expression(condition, &mut Nothing).ok();
        let effect = |effect: &EffectExpr| match effect {
            EffectExpr::Set(fact, value) => format!("{fact} = {value}"),
            EffectExpr::Delete(fact) => format!("no {fact}"),
            _ => "?".to_owned(),
        };
        condition
            .map(|condition| foreseen(&condition).iter().map(effect).collect::<Vec<_>>().join(", "))
            .unwrap_or_default()
    }

    #[test]
    fn a_condition_foretells_the_facts_that_it_says_outright_and_no_others() {
        assert_eq!(said("open(door)"), "open(door) = true");
        assert_eq!(said("open(door) and on(cup) = $place and at(x) > 3"), "open(door) = true, on(cup) = $place");
        assert_eq!(said("not exists taken(cup) and not busy(arm)"), "no taken(cup), no busy(arm)");
        assert_eq!(said("not (not open(door))"), "open(door) = true");
        for nothing in ["open(a) or open(b)", "exists at(cup)", "open(?)", "at(a) = at(b)", "not (open(a) and open(b))"]
        {
            assert_eq!(said(nothing), "", "{nothing}");
        }
    }
}
