//! States that wait: for a time, for a condition on the world, for a signal that a client sends, for an operator's answer.
//!
//! The executive itself waits, so such a state is an action of the provider [`CLOCK`], which no task file can name. It is a PIA that changes nothing and holds
//! no resources: it begins at its place in the program, and younger states are computed ahead meanwhile.
//!
//! | action | inputs | ends |
//! |---|---|---|
//! | [`PAUSE`], [`SECONDS`] | `seconds` | `success`, after that time |
//! | [`UNTIL`] | `until` | `success`, at that time since the start of the run |
//! | [`CONDITION`] | `for` | `success`, when the condition holds in the actual world |
//! | [`SIGNAL`] | `signal` | `success`, with the output `value`: each signal ends one wait |
//! | [`ASK`] | `question`, `choices`, `default` | by the choice if it is an outcome of the state, else `success`, with the output `answer` |
//! | [`WATCH`] | `for`, once or more | `violated`, when one of the conditions does not hold in the actual world |
//! | [`LIMIT`] | `seconds` | `aborted`, after that time |
//!
//! Waits for a condition, a signal and an answer may have a timeout ([`crate::program::Annotations::timeout_s`]): then they end by [`TIMEOUT`], and a question
//! with a default ends by its default.

use crate::expression::{BinaryOperator, EffectExpr, Expr, FactExpr, UnaryOperator};
use crate::program::{CLOCK, State, StateKind};
use crate::value::Value;

/// The backoff that the loader puts between two tries.
pub const PAUSE: &str = "wait";
/// Waits for some seconds.
pub const SECONDS: &str = "seconds";
/// Waits until a time since the start of the run.
pub const UNTIL: &str = "until";
/// Waits until a condition holds.
pub const CONDITION: &str = "condition";
/// Waits until a client sends a signal.
pub const SIGNAL: &str = "signal";
/// Waits until an operator answers.
pub const ASK: &str = "ask";

/// Watches until a `while` condition of the state beside it does not hold ([`crate::guard`]).
pub const WATCH: &str = "watch";
/// Waits until the state beside it has reached its timeout ([`crate::guard`]).
pub const LIMIT: &str = "limit";

/// The outcome of a wait that reached its timeout.
pub const TIMEOUT: &str = "timeout";
/// The output of a wait for a signal: the value sent with it, else null.
pub const VALUE: &str = "value";
/// The output of a question: the choice.
pub const ANSWER: &str = "answer";

/// What a state waits for.
#[derive(Debug, Clone, PartialEq)]
pub enum Wait<'s> {
    /// A duration in seconds of the robot's time.
    Seconds(&'s Expr),
    /// A time since the start of the run, in seconds of the robot's time.
    Until(&'s Expr),
    /// A condition on the actual world.
    Condition(&'s Expr),
    /// The first of these conditions that does not hold in the actual world.
    Watch(Vec<&'s Expr>),
    /// The timeout of another state, in seconds.
    Limit(&'s Expr),
    /// The next signal of this name.
    Signal(&'s str),
    /// An operator's answer.
    Answer(Question<'s>),
}

/// A question to an operator.
#[derive(Debug, Clone, PartialEq)]
pub struct Question<'s> {
    /// Evaluated to a text.
    pub text: &'s Expr,
    /// The possible answers.
    pub choices: Vec<&'s str>,
    /// The answer if nobody answers in time.
    pub default: Option<&'s str>,
}

impl State {
    /// What the state waits for; `None` if it does something else.
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

    /// Whether the loader has inserted it, so that it is not reported to users: a backoff between two tries, or a watch over another state.
    pub fn is_unsaid(&self) -> bool {
        matches!(&self.kind, StateKind::Action { provider, action, .. }
            if provider == CLOCK && [PAUSE, WATCH, LIMIT].contains(&action.as_str()))
    }

    /// Whether it watches another state: its `while` conditions or its timeout.
    pub fn is_watch(&self) -> bool {
        matches!(self.wait(), Some(Wait::Watch(_) | Wait::Limit(_)))
    }

    /// Whether it is the backoff between two tries.
    pub fn is_between_tries(&self) -> bool {
        matches!(&self.kind, StateKind::Action { provider, action, .. } if provider == CLOCK && action == PAUSE)
    }
}

/// The facts that a condition states literally, with the values that make it true. Younger states are computed ahead on them.
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
        // `not p(a)` is true if the fact is absent or false; the effect assumes that it is absent.
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

/// Whether it is a single fact whose arguments look up no other facts.
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
