//! What a waiting state waits for, and how its wait ends. Both modes call this, each at its own times.

use crate::binding::{self, BindError, Outputs};
use crate::protocol::Awaited;
use crate::signals::Signals;
use crate::span::span;
use ratn_model::expression::{EffectExpr, EvaluateError, Expr, Scope};
use ratn_model::fact::{Change, FactPattern};
use ratn_model::program::{ABORTED, SUCCESS, State, VIOLATED};
use ratn_model::time::Timestamp;
use ratn_model::value::Value;
use ratn_model::wait::{ANSWER, TIMEOUT, VALUE, Wait};
use ratn_world::world::World;

/// How a wait has ended.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct WaitEnd {
    pub(crate) outcome: String,
    pub(crate) outputs: Outputs,
    /// Reason, if the wait ended otherwise than by what it waited for.
    pub(crate) reason: String,
}

/// What a wait that begins now is waiting for, and its latest end.
pub(crate) fn begins(
    state: &State,
    now: Timestamp,
    scope: &dyn Scope,
) -> Result<(Awaited, Option<Timestamp>), BindError> {
    let seconds = |port: &str, expression: &Expr| {
        let value = expression.evaluate(scope).and_then(|value| {
            let number = value.as_number().filter(|seconds| seconds.is_finite());
            number.ok_or_else(|| EvaluateError::Wrong {
                expression: expression.to_string(),
                problem: format!("expected a number of seconds, found {value}"),
            })
        });
        value.map_err(BindError::at(format_args!("`{port}`"), state))
    };
    let timeout = state.annotations.timeout_s.map(|seconds| now + span(seconds));
    Ok(match state.wait() {
        None => (Awaited::Time, Some(now)),
        Some(Wait::Seconds(after)) => (Awaited::Time, Some(now + span(seconds("seconds", after)?))),
        Some(Wait::Until(at)) => {
            let at = Timestamp(0) + span(seconds("until", at)?);
            (Awaited::Time, Some(at.max(now)))
        }
        Some(Wait::Limit(after)) => (Awaited::Time, Some(now + span(seconds("seconds", after)?))),
        Some(Wait::Watch(holds)) => {
            let all: Vec<String> = holds.iter().map(|condition| format!("not ({condition})")).collect();
            (Awaited::Condition { condition: all.join(" or ") }, None)
        }
        Some(Wait::Condition(condition)) => (Awaited::Condition { condition: condition.to_string() }, timeout),
        Some(Wait::Signal(name)) => (Awaited::Signal { signal: name.to_owned() }, timeout),
        Some(Wait::Answer(question)) => {
            let text = question.text.evaluate(scope).map_err(BindError::at("`question`", state))?;
            let text = match text {
                Value::String(text) => text,
                other => other.to_string(),
            };
            let choices = question.choices.iter().map(|choice| (*choice).to_owned()).collect();
            let default = question.default.map(str::to_owned);
            (Awaited::Answer { question: text, choices, default }, timeout)
        }
    })
}

/// How a wait for a condition ends in the present world. `None`: the condition does not hold yet, or the state waits for
/// something else.
pub(crate) fn has_come(state: &State, scope: &dyn Scope) -> Result<Option<WaitEnd>, BindError> {
    match state.wait() {
        Some(Wait::Condition(condition)) => {
            let holds = condition.holds(scope).map_err(BindError::at("`for`", state))?;
            Ok(holds.then(|| success(Outputs::new())))
        }
        Some(Wait::Watch(holds)) => {
            let reason = binding::not_holding(holds, scope).map_err(BindError::at("`while`", state))?;
            Ok(reason.map(|reason| cut_short(VIOLATED, reason)))
        }
        _ => Ok(None),
    }
}

/// How a wait for a signal ends: takes the oldest kept signal of its name, if there is one.
pub(crate) fn takes(state: &State, signals: &mut Signals) -> Option<WaitEnd> {
    match state.wait() {
        Some(Wait::Signal(name)) => Some(success([(VALUE.to_owned(), signals.take(name)?)].into())),
        _ => None,
    }
}

/// How a wait ends when its time is up.
pub(crate) fn is_up(state: &State) -> WaitEnd {
    let late = |outputs| WaitEnd { outcome: TIMEOUT.to_owned(), outputs, reason: String::new() };
    match state.wait() {
        Some(Wait::Limit(seconds)) => cut_short(ABORTED, format!("it took longer than {seconds} s")),
        // Only its condition ends a watch.
        Some(Wait::Watch(_)) | None | Some(Wait::Seconds(_) | Wait::Until(_)) => success(Outputs::new()),
        Some(Wait::Condition(_)) => late(Outputs::new()),
        Some(Wait::Signal(_)) => late([(VALUE.to_owned(), Value::Null)].into()),
        Some(Wait::Answer(question)) => match question.default {
            Some(choice) => chosen(state, choice),
            None => late([(ANSWER.to_owned(), Value::Null)].into()),
        },
    }
}

/// How a question ends when answered with `choice`; `None` if it does not offer that.
pub(crate) fn answered(state: &State, choice: &str) -> Option<WaitEnd> {
    match state.wait() {
        Some(Wait::Answer(question)) if question.choices.contains(&choice) => Some(chosen(state, choice)),
        _ => None,
    }
}

/// The choice is the outcome if the state has one of that name.
fn chosen(state: &State, choice: &str) -> WaitEnd {
    let is_outcome = state.outcomes.iter().any(|outcome| outcome == choice);
    let outcome = if is_outcome { choice } else { SUCCESS };
    let outputs = [(ANSWER.to_owned(), Value::String(choice.to_owned()))].into();
    WaitEnd { outcome: outcome.to_owned(), outputs, reason: String::new() }
}

fn success(outputs: Outputs) -> WaitEnd {
    WaitEnd { outcome: SUCCESS.to_owned(), outputs, reason: String::new() }
}

/// An end without outputs: a `while` condition does not hold, or a timeout.
pub(crate) fn cut_short(outcome: &str, reason: String) -> WaitEnd {
    WaitEnd { outcome: outcome.to_owned(), outputs: Outputs::new(), reason }
}

/// The effects that the wait's condition foresees, with the values that the root shows now. The wait itself changes nothing.
pub(crate) fn as_it_is(foreseen: Option<&Vec<EffectExpr>>, scope: &dyn Scope, root: &World) -> Vec<Change> {
    let bound = foreseen.and_then(|effects| EffectExpr::bind(effects, scope).ok()).unwrap_or_default();
    let now = |pattern: FactPattern| {
        let known = root.matching(&pattern).next().map(|(fact, known)| (fact.clone(), known.value.clone()));
        match known {
            Some((fact, value)) => Change::Set { fact, value },
            None => Change::Delete { pattern },
        }
    };
    bound.iter().map(Change::pattern).map(now).collect()
}
