//! Reads `wait: {…}` and `ask: {…}`: states in which the executive itself waits.

use super::fields::Fields;
use super::flow;
use super::outline::Step;
use super::yaml::{Content, Node};
use crate::expression::Expr;
use crate::expression::display::is_word;
use crate::program::{ABORTED, Annotations, CLOCK, PREEMPTED, SUCCESS, StateKind};
use crate::value::{Type, Value};
use crate::wait::{ANSWER, ASK, CONDITION, SECONDS, SIGNAL, TIMEOUT, UNTIL, VALUE, foreseen};
use std::collections::BTreeMap;

const WAIT_FOR_KEYS: [&str; 5] = ["for", "seconds", "until", "signal", "timeout"];
const QUESTION_KEYS: [&str; 4] = ["question", "choices", "default", "timeout"];
/// Keys for what is waited for.
const FORMS: [&str; 4] = ["for", "seconds", "until", "signal"];
/// Limit of choices.
const MAX_CHOICES: usize = 32;

/// The output port of such a state.
pub(crate) fn ports(node: &Node, asks: bool) -> BTreeMap<String, Type> {
    if asks {
        BTreeMap::from([(ANSWER.to_owned(), Type::String)])
    } else if node.get("signal").is_some() {
        BTreeMap::from([(VALUE.to_owned(), Type::Any)])
    } else {
        BTreeMap::new()
    }
}

/// The outcomes of such a state: the choices that its transitions name, and the timeout.
pub(crate) fn outcomes(step: &Step<'_>, node: &Node, asks: bool) -> Vec<String> {
    let connected = step.body.get("transitions").map(Node::entries).unwrap_or_default();
    let choices = node.get("choices").filter(|_| asks).into_iter().flat_map(Node::items).filter_map(as_text);
    let choices = choices.filter(|choice| connected.iter().any(|entry| entry.key == *choice));
    let mut own: Vec<String> = choices.map(str::to_owned).collect();
    if node.get("timeout").is_some() && !(asks && node.get("default").is_some()) {
        own.push(TIMEOUT.to_owned());
    }
    own
}

fn as_text(node: &Node) -> Option<&str> {
    match &node.content {
        Content::Text(text) => Some(text),
        _ => None,
    }
}

/// The action of such a state.
pub(crate) fn kind(fields: &mut Fields<'_, '_>, node: &Node, asks: bool) -> StateKind {
    let (form, example) = if asks {
        ("ask", "write `ask: { question: \"Go on?\", choices: [go, stop] }`")
    } else {
        ("wait", "write `wait: { for: door_open(front) }`, or one of `seconds`, `until`, `signal` for `for`")
    };
    let (action, inputs) = match node.content {
        Content::Map(_) if asks => (ASK, question(fields, node)),
        Content::Map(_) => wait(fields, node, example),
        _ => {
            let message = format!("`{form}` is a mapping, found {}", node.described());
            fields.error("invalid-state", node.at, message, example);
            (SECONDS, vec![("seconds".to_owned(), Expr::Literal(Value::Int(0)))])
        }
    };
    StateKind::Action { provider: CLOCK.to_owned(), action: action.to_owned(), inputs, outputs: ports(node, asks) }
}

fn wait(fields: &mut Fields<'_, '_>, node: &Node, example: &str) -> (&'static str, Vec<(String, Expr)>) {
    fields.keys(node, &WAIT_FOR_KEYS);
    let given: Vec<(&str, &Node)> = FORMS.iter().filter_map(|key| Some((*key, node.get(key)?))).collect();
    let [(key, value)] = given.as_slice() else {
        let message = match given.as_slice() {
            [(a, _), (b, _), ..] => format!("a state waits by `{a}` or by `{b}`, not by both"),
            _ => "nothing says what this waits for".to_owned(),
        };
        fields.error("invalid-state", node.at, message, example);
        return (SECONDS, vec![("seconds".to_owned(), Expr::Literal(Value::Int(0)))]);
    };
    fields.note(format!("in.{key}"), value.at);
    if matches!(*key, "seconds" | "until")
        && let Some(timeout) = node.get("timeout")
    {
        let help = "leave `timeout` out";
        fields.error("invalid-state", timeout.at, "a wait for a time is over by itself", help);
    }
    if *key == "signal" {
        let name = fields.word(value, "the name of a signal").unwrap_or_default();
        return (SIGNAL, vec![("signal".to_owned(), Expr::Literal(Value::String(name.to_owned())))]);
    }
    let Some(expression) = fields.expression(value) else { return (SECONDS, Vec::new()) };
    if *key == "for" && expression.fact_expressions().is_empty() {
        let message = "this condition looks up no fact, so waiting does not change it";
        fields.error("invalid-state", value.at, message, "wait for a fact, such as `for: door_open(front)`");
    }
    let action = match *key {
        "for" => CONDITION,
        "until" => UNTIL,
        _ => SECONDS,
    };
    (action, vec![((*key).to_owned(), expression)])
}

fn question(fields: &mut Fields<'_, '_>, node: &Node) -> Vec<(String, Expr)> {
    fields.keys(node, &QUESTION_KEYS);
    let mut inputs = Vec::new();
    match node.get("question") {
        // A plain sentence is a text; an expression must be recognizable as one.
        Some(text) => {
            fields.note("in.question", text.at);
            let question = match &text.content {
                Content::Text(sentence) if !is_expression(sentence) => {
                    Some(Expr::Literal(Value::String(sentence.clone())))
                }
                _ => fields.expression(text),
            };
            inputs.extend(question.map(|question| ("question".to_owned(), question)));
        }
        None => fields.error("invalid-state", node.at, "nothing is asked", "add `question: \"…\"`"),
    }
    let mut choices: Vec<&str> = Vec::new();
    for item in node.get("choices").into_iter().flat_map(Node::items) {
        let Some(choice) = as_text(item).filter(|choice| is_word(choice)) else {
            let message = format!("expected a choice, a name, found {}", item.described());
            fields.error("invalid-name", item.at, message, "a choice is one word: an operator types it");
            continue;
        };
        if [SUCCESS, ABORTED, PREEMPTED, TIMEOUT].contains(&choice) {
            let message = format!("`{choice}` is an outcome of every state or of a wait, and no choice");
            fields.error("invalid-name", item.at, message, "give the choice another name");
        } else if choices.contains(&choice) {
            fields.error("duplicate-name", item.at, format!("the choice `{choice}` is there twice"), "");
        }
        choices.push(choice);
    }
    if choices.is_empty() || choices.len() > MAX_CHOICES {
        let at = node.get("choices").map_or(node.at, |choices| choices.at);
        let message = format!("a question has 1 to {MAX_CHOICES} choices");
        fields.error("invalid-state", at, message, "add `choices: [go, stop]`");
    }
    let literal = |text: &str| Expr::Literal(Value::String(text.to_owned()));
    inputs.push(("choices".to_owned(), Expr::List(choices.iter().map(|choice| literal(choice)).collect())));
    if let Some(default) = node.get("default") {
        match as_text(default).filter(|default| choices.contains(default)) {
            Some(choice) => inputs.push(("default".to_owned(), literal(choice))),
            None => {
                let known = choices.iter().copied();
                let help = super::names::suggestion(as_text(default).unwrap_or_default(), known, "", "");
                fields.error("invalid-state", default.at, "the default is none of the choices", help);
            }
        }
        if node.get("timeout").is_none() {
            let help = "add `timeout: …`, in seconds: after it the default is the answer";
            fields.error("invalid-state", default.at, "a default without a timeout is never taken", help);
        }
    }
    inputs
}

/// Whether a question is an expression: it begins with a quote, a variable or a function that returns text.
fn is_expression(sentence: &str) -> bool {
    sentence.starts_with(['\'', '"', '$']) || sentence.starts_with("concat(")
}

/// The annotations: it changes nothing, but foresees the facts that its condition states literally.
pub(crate) fn annotations(
    fields: &mut Fields<'_, '_>,
    step: &Step<'_>,
    (node, asks): (&Node, bool),
    kind: &StateKind,
) -> Annotations {
    let all = [SUCCESS, ABORTED, PREEMPTED].map(str::to_owned).into_iter().chain(outcomes(step, node, asks));
    let mut effects: BTreeMap<String, Vec<_>> = all.map(|outcome| (outcome, Vec::new())).collect();
    if let StateKind::Action { action, inputs, .. } = kind
        && action == CONDITION
        && let [(_, condition)] = inputs.as_slice()
    {
        effects.insert(SUCCESS.to_owned(), foreseen(condition));
    }
    // The duration of this wait is known.
    let duration_s = match kind {
        StateKind::Action { action, inputs, .. } if action == SECONDS => {
            inputs.first().map(|(_, seconds)| seconds.clone())
        }
        _ => None,
    };
    let duration_s = duration_s.filter(|seconds| seconds.fact_expressions().is_empty());
    let timeout_s = node.get("timeout").and_then(|node| flow::positive(fields, node, "timeout"));
    Annotations { reads: Some(Vec::new()), effects, timeout_s, duration_s, ..Annotations::default() }
}
