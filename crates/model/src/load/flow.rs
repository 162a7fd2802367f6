//! How control and values flow between states: outcomes, transitions, scoped variables, retry, timeouts, conditions.

use super::fields::{Fields, Output};
use super::names::{OfLoop, Task, suggestion};
use super::outline::{Branch, Form, Step};
use super::yaml::{Content, Node};
use crate::expression::Expr;
use crate::guard::{Limits, Retried};
use crate::id::StateId;
use crate::program::{
    ABORTED, Annotations, Exceptions, Location, Nature, PREEMPTED, Program, Retry, SUCCESS, State, StateKind, Target,
    VIOLATED,
};
use crate::wait::Wait;
use std::collections::BTreeMap;

/// Limit of the outcomes of one state.
const MAX_OUTCOMES: usize = 60;

/// Reads the custom outcomes of a state.
pub(crate) fn outcomes(fields: &mut Fields<'_, '_>, id: StateId) -> Vec<String> {
    let (task, step) = (fields.task, fields.task.outline.step(id));
    let mut own: Vec<String> = match &step.form {
        Form::Action { action } => {
            let signature = super::state::action_name(action).and_then(|(p, a)| task.catalogue.action(&p, &a));
            signature.map(|signature| signature.outcomes.clone()).unwrap_or_default()
        }
        Form::Library { .. } => task.libraries.get(&id).map(|l| l.states[0].outcomes.clone()).unwrap_or_default(),
        Form::Wait { node, asks } => super::wait::outcomes(step, node, *asks),
        Form::Concurrency { .. } => {
            let decided = step.body.get("decide").map(Node::entries).unwrap_or_default();
            decided.iter().map(|entry| entry.key.clone()).collect()
        }
        _ => Vec::new(),
    };
    own.extend(step.holds().map(|_| VIOLATED.to_owned()));
    let declared = step.body.get("outcomes");
    for node in declared.into_iter().flat_map(Node::items) {
        own.extend(fields.word(node, "an outcome").map(str::to_owned));
    }
    own.retain(|outcome| !is_common(outcome));
    let mut seen = Vec::new();
    own.retain(|outcome| {
        !seen.contains(outcome) && {
            seen.push(outcome.clone());
            true
        }
    });
    if own.len() > MAX_OUTCOMES {
        let at = declared.map_or(step.at, |node| node.at);
        fields.error("invalid-state", at, format!("a state has at most {MAX_OUTCOMES} outcomes"), "");
    }
    own
}

fn is_common(outcome: &str) -> bool {
    matches!(outcome, SUCCESS | ABORTED | PREEMPTED)
}

/// Reads `transitions: {aborted: give_up}`: to a sibling, else to an outcome of the state around it.
pub(crate) fn transitions(fields: &mut Fields<'_, '_>, id: StateId) -> BTreeMap<String, Target> {
    let mut transitions = BTreeMap::new();
    let step = fields.task.outline.step(id);
    let Some(node) = step.body.get("transitions") else { return transitions };
    let parent = step.parent.map(|parent| fields.task.outline.step(parent));
    let Some(around) = parent.filter(|_| !fields.task.outline.is_region(id)) else {
        let help = "use its outcome in `decide`";
        fields.error("invalid-state", node.at, "a region has no transitions: all regions are waited for", help);
        return transitions;
    };
    let siblings: Vec<(StateId, &str)> =
        fields.task.outline.siblings(id).iter().map(|id| (*id, fields.task.outline.step(*id).name.as_str())).collect();
    let is_inside = matches!(step.branch, Branch::First | Branch::Otherwise);
    let leaving = if is_inside { leaving(around) } else { [SUCCESS, ABORTED, PREEMPTED].map(str::to_owned).into() };
    for entry in fields.mapping(step.body, "transitions", "{ aborted: give_up }") {
        fields.note(format!("transitions.{}", entry.key), entry.at);
        let Some(to) = fields.word(&entry.value, "a state or an outcome") else { continue };
        let sibling = siblings.iter().find(|(_, name)| *name == to).map(|(id, _)| Target::State(*id));
        let outcome = || leaving.iter().any(|outcome| outcome == to).then(|| Target::Outcome(to.to_owned()));
        match sibling.or_else(outcome) {
            Some(target) => {
                transitions.insert(entry.key.clone(), target);
            }
            None => {
                let known = siblings.iter().map(|(_, name)| *name).chain(leaving.iter().map(String::as_str));
                let help =
                    suggestion(to, known, "", "name a state beside this one, or an outcome of the state around it");
                let message =
                    format!("`{to}` is neither a state beside this one nor an outcome of the state around it");
                fields.error("unknown-target", entry.value.at, message, help);
            }
        }
    }
    transitions
}

/// Refuses annotations for outcomes that a state cannot have. Outcomes by which inner states leave it are its own, too.
pub(crate) fn outcomes_exist(task: &Task<'_>, program: &Program, out: &mut Output) {
    let all = program.all_outcomes();
    let mut open = vec![false; program.states.len()];
    // Inner states have larger ids than the states around them; an action that is not in the catalogue may have any outcome.
    for state in program.states.iter().rev() {
        let unknown = match &state.kind {
            StateKind::Action { provider, action, .. } => {
                !state.is_pause() && task.catalogue.action(provider, action).is_none()
            }
            _ => task.outline.steps.get(state.id.0 as usize).is_some_and(|step| {
                matches!(step.form, Form::Library { .. }) && !task.libraries.contains_key(&state.id)
            }),
        };
        open[state.id.0 as usize] = unknown || state.children().any(|child| open[child.0 as usize]);
    }
    for state in program.states.iter().filter(|state| !open[state.id.0 as usize]) {
        let own = &all[state.id.0 as usize];
        let connected = state.transitions.keys().map(|outcome| (outcome, format!("transitions.{outcome}")));
        let marked = state.annotations.exceptional.iter().map(|outcome| (outcome, "exceptional".to_owned()));
        let retried = out.guards.get(&state.id).and_then(|guard| guard.retried.as_ref());
        let tried = retried.into_iter().flat_map(|retried| &retried.on).map(|outcome| (outcome, "retry.on".to_owned()));
        for (outcome, part) in connected.chain(marked).chain(tried).filter(|(outcome, _)| !own.contains(outcome)) {
            let at = out.places.of(state.id, &part, state.location);
            // A choice becomes an outcome of its question where it is connected.
            let choices = match state.wait() {
                Some(Wait::Answer(question)) => question.choices,
                _ => Vec::new(),
            };
            let known = own.iter().map(String::as_str).chain(choices);
            let help = suggestion(outcome, known, "", "declare it under `outcomes`");
            out.findings.error(
                "unknown-outcome",
                at,
                &state.path,
                format!("this state has no outcome `{outcome}`"),
                help,
            );
        }
    }
}

/// `exceptions` of a state hold for the states inside that do not say it themselves.
pub(crate) fn inherit_exceptions(states: &mut [State]) {
    // Inner states have larger ids than the states around them.
    for at in 1..states.len() {
        let around = states[at].parent.and_then(|parent| states[parent.0 as usize].annotations.exceptions);
        let own = &mut states[at].annotations.exceptions;
        *own = own.or(around);
    }
}

/// The outcomes by which a list may be left.
fn leaving(around: &Step<'_>) -> Vec<String> {
    let declared = around.body.get("outcomes").into_iter().flat_map(Node::items);
    let declared = declared.filter_map(|node| match &node.content {
        Content::Text(name) => Some(name.clone()),
        _ => None,
    });
    [SUCCESS, ABORTED, PREEMPTED].map(str::to_owned).into_iter().chain(declared).collect()
}

/// Reports a name that a variable around the state, or a parameter, already has.
pub(crate) fn named_once(fields: &mut Fields<'_, '_>, name: &str, at: Location) {
    let Some(id) = fields.view.state else { return };
    if fields.task.in_sight(id).contains(name) {
        let message = format!("the variable `${name}` exists already around this state");
        fields.error("duplicate-name", at, message, "give one of both another name");
    }
}

/// `variables: {n: 0}`
pub(crate) fn variables(fields: &mut Fields<'_, '_>, body: &Node) -> Vec<(String, Expr)> {
    let mut variables = Vec::new();
    for entry in fields.mapping(body, "variables", "{ tries: 0 }") {
        fields.note(format!("variables.{}", entry.key), entry.at);
        named_once(fields, &entry.key, entry.at);
        if !crate::expression::display::is_word(&entry.key) {
            let help = "use letters, digits and _, beginning with a letter";
            fields.error("invalid-name", entry.at, format!("`{}` cannot be a variable's name", entry.key), help);
        }
        if let Some(value) = fields.expression(&entry.value) {
            variables.push((entry.key.clone(), value));
        }
    }
    variables
}

/// Reads `assign: {n: $n + 1}`: variables of outer states.
pub(crate) fn assign(fields: &mut Fields<'_, '_>, id: StateId, body: &Node) -> Vec<(String, Expr)> {
    let mut assign = Vec::new();
    let inside = fields.view.inside;
    fields.view.own_outputs = true;
    fields.view.inside = !matches!(fields.task.outline.step(id).form, Form::Action { .. } | Form::Wait { .. });
    // The loop has ended, so its variables are out of scope.
    fields.view.of_loop = OfLoop::Nothing;
    for entry in fields.mapping(body, "assign", "{ tries: $tries + 1 }") {
        fields.note(format!("assign.{}", entry.key), entry.at);
        if !fields.task.scoped_variables(id, false).any(|known| known == entry.key) {
            let known: Vec<&str> = fields.task.scoped_variables(id, false).collect();
            let help = suggestion(&entry.key, known.into_iter(), "", "declare it under `variables` of a state around");
            let message = format!("there is no scoped variable `{}` around this state", entry.key);
            fields.error("unknown-variable", entry.at, message, help);
            continue;
        }
        if let Some(value) = fields.expression(&entry.value) {
            assign.push((entry.key.clone(), value));
        }
    }
    fields.view.own_outputs = false;
    fields.view.inside = inside;
    fields.view.of_loop = OfLoop::default();
    assign
}

/// `decide: {failed: "left.outcome = aborted"}`
pub(crate) fn decide(fields: &mut Fields<'_, '_>, body: &Node) -> Vec<(String, Expr)> {
    let mut decide = Vec::new();
    fields.view.inside = true;
    for entry in fields.mapping(body, "decide", "{ failed: left.outcome = aborted }") {
        fields.note(format!("decide.{}", entry.key), entry.at);
        if let Some(holds) = fields.expression(&entry.value) {
            decide.push((entry.key.clone(), holds));
        }
    }
    fields.view.inside = false;
    decide
}

/// Reads retry, timeout, exceptions, determinism and shared facts.
pub(crate) fn annotate(fields: &mut Fields<'_, '_>, body: &Node, annotations: &mut Annotations) {
    retry(fields, body, annotations);
    limits(fields, body, annotations);
    finally(fields, body);
    annotations.exceptions = body.get("exceptions").and_then(|node| exceptions(fields, node));
    annotations.deterministic = body.get("deterministic").is_some_and(|node| fields.flag(node));
    for node in body.get("exceptional").into_iter().flat_map(Node::items) {
        fields.note("exceptional", node.at);
        annotations.exceptional.extend(fields.word(node, "an outcome").map(str::to_owned));
    }
    let is_region = fields.view.state.is_some_and(|id| fields.task.outline.is_region(id));
    if let Some(node) = body.get("shared").filter(|_| !is_region) {
        let help = "say it of a region of a `concurrency`";
        fields.error("invalid-state", node.at, "`shared` is what two regions may both touch", help);
    }
    for node in body.get("shared").into_iter().flat_map(Node::items) {
        annotations.shared.extend(fields.fact(node));
    }
}

/// Reads `retry: 2` or `retry: {times, backoff, on, before}`. What the executive supports itself is stored in the action, the rest in a
/// guard around the state.
fn retry(fields: &mut Fields<'_, '_>, body: &Node, annotations: &mut Annotations) {
    let Some(id) = fields.view.state else { return };
    let step = fields.task.outline.step(id);
    let Some(node) = body.get("retry") else { return };
    let is_long = matches!(node.content, Content::Map(_));
    if is_long {
        fields.keys(node, &["times", "count", "backoff", "on", "before"]);
    }
    let times = node.get("times").or_else(|| node.get("count")).unwrap_or(node);
    let backoff_s = node.get("backoff").map_or(Some(0.0), |node| seconds(fields, node, "backoff"));
    let count = fields.count(times, "retry", 1);
    let mut on = Vec::new();
    for node in node.get("on").into_iter().flat_map(Node::items) {
        fields.note("retry.on", node.at);
        on.extend(fields.word(node, "an outcome").map(str::to_owned));
    }
    if on.iter().any(|outcome| outcome == SUCCESS) {
        let help = "name outcomes after which it is tried again; without `on` that is `aborted`";
        fields.error("invalid-state", node.at, "a state that has succeeded is not tried again", help);
    }
    on.sort();
    on.dedup();
    let by_itself = on.is_empty() || on == [ABORTED];
    if on.is_empty() {
        on.push(ABORTED.to_owned());
    }
    let is_action = matches!(step.form, Form::Action { .. });
    if let (Some(count), Some(backoff_s)) = (count, backoff_s) {
        if is_action && by_itself && step.before.is_empty() {
            annotations.retry = Some(Retry { count, backoff_s });
        } else {
            let retried = Retried { count, backoff_s, on, before: step.before.clone() };
            fields.out.guards.entry(id).or_default().retried = Some(retried);
        }
    }
}

/// Reads `while: [lit(lamp)]` and `timeout: 20`. The executive itself supports the timeout of an action and the conditions of a PIA; the
/// rest is stored in a guard around the state.
fn limits(fields: &mut Fields<'_, '_>, body: &Node, annotations: &mut Annotations) {
    let Some(id) = fields.view.state else { return };
    let step = fields.task.outline.step(id);
    let is_action = matches!(step.form, Form::Action { .. });
    let mut timeout_s = body.get("timeout").and_then(|node| positive(fields, node, "timeout"));
    if is_action || matches!(step.form, Form::Wait { .. }) {
        annotations.timeout_s = timeout_s.take();
    }
    let mut holds = step.holds().map(|node| conditions(fields, node)).unwrap_or_default();
    if is_action && annotations.nature == Nature::Irreversible {
        annotations.holds = std::mem::take(&mut holds);
    }
    if !holds.is_empty() || timeout_s.is_some() {
        fields.out.guards.entry(id).or_default().limits = Some(Limits { holds, timeout_s });
    }
}

/// Reads `finally: […]`.
fn finally(fields: &mut Fields<'_, '_>, body: &Node) {
    let Some(id) = fields.view.state else { return };
    let states = fields.task.outline.step(id).finally.clone();
    if let Some(node) = body.get("finally").filter(|node| node.items().is_empty()) {
        let help = "list the states that are run on every way out, or leave it out";
        fields.error("invalid-state", node.at, "nothing is done on the way out", help);
    }
    if !states.is_empty() {
        fields.out.guards.entry(id).or_default().finally = states;
    }
}

fn conditions(fields: &mut Fields<'_, '_>, node: &Node) -> Vec<Expr> {
    if node.items().is_empty() {
        let help = "name a fact, such as `while: [closed(door)]`, or leave it out";
        fields.error("invalid-state", node.at, "nothing has to hold meanwhile", help);
    }
    let mut all = Vec::new();
    for (number, node) in node.items().into_iter().enumerate() {
        fields.note(format!("while.{number}"), node.at);
        let Some(condition) = fields.expression(node) else { continue };
        if condition.fact_expressions().is_empty() {
            let message = "this condition looks up no fact, so nothing changes it meanwhile";
            fields.error("invalid-state", node.at, message, "name a fact, such as `while: [closed(door)]`");
        }
        all.push(condition);
    }
    all
}

/// By default the outcome `violated` has the target of a failure.
pub(crate) fn lead_violated(fields: &Fields<'_, '_>, id: StateId, state: &mut State) {
    let step = fields.task.outline.step(id);
    if step.holds().is_none() || fields.task.outline.is_region(id) || state.transitions.contains_key(VIOLATED) {
        return;
    }
    let failed = state.transitions.get(ABORTED).cloned();
    if failed.is_none() {
        state.annotations.exceptional.push(VIOLATED.to_owned());
    }
    let failed = failed.unwrap_or_else(|| Target::Outcome(ABORTED.to_owned()));
    state.transitions.insert(VIOLATED.to_owned(), failed);
}

/// Reads a number of seconds above 0.
pub(crate) fn positive(fields: &mut Fields<'_, '_>, node: &Node, what: &str) -> Option<f64> {
    let seconds = seconds(fields, node, what)?;
    if seconds == 0.0 {
        fields.error("type-mismatch", node.at, format!("`{what}` is a number of seconds above 0"), "leave it out");
        return None;
    }
    Some(seconds)
}

/// Limit of a duration in a task file, some thirty years: longer ones are mistakes and could overflow.
const LONGEST_S: f64 = 1e9;

/// Reads a number of seconds, 0 or more.
fn seconds(fields: &mut Fields<'_, '_>, node: &Node, what: &str) -> Option<f64> {
    let seconds = match node.content {
        Content::Int(seconds) => Some(seconds as f64),
        Content::Float(seconds) => Some(seconds),
        _ => None,
    };
    let seconds = seconds.filter(|s| (0.0..=LONGEST_S).contains(s));
    if seconds.is_none() {
        let is_with_unit =
            matches!(&node.content, Content::Text(text) if text.starts_with(|c: char| c.is_ascii_digit()));
        let help = if is_with_unit { "leave the unit out" } else { "" };
        fields.error("type-mismatch", node.at, format!("`{what}` is a number of seconds, from 0 to {LONGEST_S}"), help);
    }
    seconds
}

/// `precise` or `imprecise`.
pub(crate) fn exceptions(fields: &mut Fields<'_, '_>, node: &Node) -> Option<Exceptions> {
    match &node.content {
        Content::Text(text) if text == "precise" => Some(Exceptions::Precise),
        Content::Text(text) if text == "imprecise" => Some(Exceptions::Imprecise),
        _ => {
            fields.error("type-mismatch", node.at, "`exceptions` is `precise` or `imprecise`", "");
            None
        }
    }
}
