//! A step of the outline → a state: its kind with all expressions, and its annotations.

use super::action::Sources;
use super::fields::{Fields, Output};
use super::names::{Task, View};
use super::outline::{Form, Step, Tests};
use super::yaml::{Content, Node};
use super::{effects, flow, library, outputs, resources, wait};
use crate::expression::parse::parse_expression;
use crate::expression::{Expr, FactExpr, UnaryOperator};
use crate::fact::SCENE_PREDICATES;
use crate::id::StateId;
use crate::list::List;
use crate::program::{ABORTED, Annotations, Nature, PREEMPTED, SUCCESS, State, StateKind};
use crate::value::{Type, Value};

const ACTION_KEYS: [&str; 3] = ["action", "in", "out"];
const SEQUENCE_KEYS: [&str; 3] = ["states", "outputs", "variables"];
const LOOP_KEYS: [&str; 4] = ["for", "index", "do", "outputs"];
const WHILE_KEYS: [&str; 6] = ["while", "do_while", "until", "index", "do", "outputs"];
const CONDITION_KEYS: [&str; 4] = ["condition", "then", "else", "outputs"];
const CONCURRENCY_KEYS: [&str; 4] = ["concurrency", "regions", "decide", "outputs"];
const LIBRARY_KEYS: [&str; 2] = ["library", "with"];
const WAIT_KEYS: [&str; 2] = ["wait", "ask"];
/// Keys of a state that waits; it holds no resources and changes nothing.
const WAITING_KEYS: [&str; 7] = ["retry", "duration", "description", "transitions", "exceptional", "assign", "shared"];
const NODE_KEYS: [&str; 14] = [
    "retry",
    "finally",
    "timeout",
    "while",
    "reads",
    "routine",
    "duration",
    "resources",
    "description",
    "transitions",
    "exceptional",
    "exceptions",
    "assign",
    "shared",
];
const BOUNDARY_KEYS: [&str; 2] = ["requires", "effects"];
const NATURE_KEYS: [&str; 5] = ["computes", "senses", "pia", "attempts", "deterministic"];

/// Reads one step.
pub(crate) fn state(task: &Task<'_>, id: StateId, out: &mut Output) -> State {
    let step = task.outline.step(id);
    let view = View { state: Some(id), ..View::default() };
    let mut fields = Fields { task, view, path: step.path.clone(), out };
    if id.0 > 0 {
        fields.keys(step.body, &known_keys(&step.form));
    }
    let mut kind = kind(&mut fields, step);
    let outcomes = flow::outcomes(&mut fields, id);
    let transitions = flow::transitions(&mut fields, id);
    let variables = match step.form {
        Form::Library { .. } => library::parameters(&mut fields, id, step.body),
        _ => flow::variables(&mut fields, step.body),
    };
    let assign = flow::assign(&mut fields, id, step.body);
    let defaults = defaults(&mut fields, step.body);
    if let Some(outputs) = kind.outputs_mut() {
        outputs::with_defaults(outputs, &defaults);
    }
    let annotations = if id.0 > 0 { annotations(&mut fields, step, &kind) } else { boundary(Vec::new()) };
    let mut state = State {
        id,
        name: step.name.clone(),
        path: step.path.clone(),
        parent: step.parent,
        kind,
        outcomes,
        transitions,
        variables,
        assign,
        defaults,
        annotations,
        location: step.at,
    };
    flow::lead_violated(&fields, id, &mut state);
    state
}

/// The keys that a state of this form may have.
pub(crate) fn known_keys(form: &Form<'_>) -> Vec<&'static str> {
    let own: &[&str] = match form {
        Form::Action { .. } => &ACTION_KEYS,
        Form::Sequence { .. } => &SEQUENCE_KEYS,
        Form::ForEach { .. } => &LOOP_KEYS,
        Form::While { .. } => &WHILE_KEYS,
        Form::Condition { .. } => &CONDITION_KEYS,
        Form::Concurrency { .. } => &CONCURRENCY_KEYS,
        Form::Library { .. } => &LIBRARY_KEYS,
        Form::Wait { asks, .. } => std::slice::from_ref(&WAIT_KEYS[usize::from(*asks)]),
    };
    let of_all: &[&str] = if matches!(form, Form::Wait { .. }) { &WAITING_KEYS } else { &NODE_KEYS };
    let mut known = [own, of_all].concat();
    match form {
        Form::Action { .. } => known.extend(NATURE_KEYS.into_iter().chain(BOUNDARY_KEYS)),
        Form::Library { .. } => known.extend(BOUNDARY_KEYS),
        Form::Sequence { .. } | Form::Concurrency { .. } => known.extend(BOUNDARY_KEYS.into_iter().chain(["outcomes"])),
        Form::Wait { .. } => {}
        _ => known.push("outcomes"),
    }
    known
}

fn kind(fields: &mut Fields<'_, '_>, step: &Step<'_>) -> StateKind {
    let nothing = || Expr::Literal(Value::Null);
    match &step.form {
        Form::Action { action } => {
            fields.note("action", action.at);
            let (provider, name) = action_name(action).unwrap_or_default();
            if provider.is_empty() {
                fields.error("unknown-action", action.at, "expected `action: provider/action`", "");
            }
            StateKind::Action { provider, action: name, inputs: inputs(fields, step.body), outputs: ports(fields) }
        }
        Form::Sequence { children } => {
            let children = children.clone();
            StateKind::Sequence { children, outputs: outputs::read(fields, step) }
        }
        Form::ForEach { variable, collection, index, body } => {
            for name in std::iter::once(variable).chain(index) {
                flow::named_once(fields, name, collection.node.at);
            }
            if index.as_ref() == Some(variable) {
                fields.error("duplicate-name", collection.node.at, "element and index have the same name", "");
            }
            fields.note("for", collection.node.at);
            let list = fields.parsed(collection.node, &collection.collection, collection.offset, parse_expression);
            StateKind::ForEach {
                variable: variable.clone(),
                index: index.clone(),
                collection: list.unwrap_or_else(nothing),
                body: body.clone(),
                outputs: outputs::read(fields, step),
            }
        }
        Form::While { predicate, tests, index, body } => {
            if let Some(name) = index {
                flow::named_once(fields, name, predicate.at);
            }
            fields.note("while", predicate.at);
            fields.view.inside = true;
            let holds = fields.expression(predicate).unwrap_or_else(nothing);
            fields.view.inside = false;
            let predicate = match tests {
                Tests::Until => Expr::Unary(UnaryOperator::Not, Box::new(holds)),
                Tests::Before | Tests::After => holds,
            };
            let body_first = *tests != Tests::Before;
            let outputs = outputs::read(fields, step);
            StateKind::While { predicate, body_first, index: index.clone(), body: body.clone(), outputs }
        }
        Form::Concurrency { kind, regions } => {
            let (preemptive, successes) = match &kind.content {
                Content::Text(text) if text == "barrier" => (false, None),
                Content::Text(text) if text == "preemptive" => (true, None),
                Content::Int(n) if (1..=regions.len() as i64).contains(n) => (true, u32::try_from(*n).ok()),
                Content::Int(n) => {
                    let message = format!("{n} of {} regions cannot succeed", regions.len());
                    fields.error(
                        "invalid-state",
                        kind.at,
                        message,
                        "say 1 or more, and no more than there are regions",
                    );
                    (false, None)
                }
                _ => {
                    let message = "`concurrency` is `barrier`, `preemptive`, or how many regions have to succeed";
                    fields.error("invalid-state", kind.at, message, "");
                    (false, None)
                }
            };
            let decide = flow::decide(fields, step.body);
            let outputs = outputs::read(fields, step);
            StateKind::Concurrency { regions: regions.clone(), preemptive, successes, decide, outputs }
        }
        Form::Wait { node, asks } => wait::kind(fields, node, *asks),
        // The library's states are inserted below it when all states exist.
        Form::Library { .. } => StateKind::Sequence { children: Vec::new(), outputs: Vec::new() },
        Form::Condition { predicate, then, otherwise } => {
            fields.note("condition", predicate.at);
            let predicate = fields.expression(predicate).unwrap_or_else(nothing);
            let outputs = outputs::read(fields, step);
            StateKind::Condition { predicate, then: then.clone(), otherwise: otherwise.clone(), outputs }
        }
    }
}

/// `provider/action`
pub(crate) fn action_name(node: &Node) -> Option<(String, String)> {
    let Content::Text(text) = &node.content else { return None };
    let (provider, action) = text.split_once('/')?;
    (!provider.is_empty() && !action.is_empty()).then(|| (provider.to_owned(), action.to_owned()))
}

fn inputs(fields: &mut Fields<'_, '_>, body: &Node) -> Vec<(String, Expr)> {
    let Some(node) = body.get("in") else { return Vec::new() };
    if !matches!(node.content, Content::Map(_) | Content::Null) {
        let message = format!("expected input ports with values, found {}", node.described());
        fields.error("invalid-state", node.at, message, "write `in: {port: value}`");
    }
    let mut inputs = Vec::new();
    for entry in node.entries() {
        fields.note(format!("in.{}", entry.key), entry.at);
        if let Some(value) = fields.expression(&entry.value) {
            inputs.push((entry.key.clone(), value));
        }
    }
    inputs
}

fn ports(fields: &Fields<'_, '_>) -> std::collections::BTreeMap<String, Type> {
    let own = fields.view.state.map(|id| fields.task.ports[id.0 as usize].types.clone());
    own.unwrap_or_default()
}

/// Reads defaults: `out: {x: {type: int, default: 0}}`, and for a hierarchy `outputs: {x: {value: plan.n, default: 0}}`.
fn defaults(fields: &mut Fields<'_, '_>, body: &Node) -> std::collections::BTreeMap<String, Value> {
    let mut defaults = std::collections::BTreeMap::new();
    let of_action = body.get("out").map(Node::entries).unwrap_or_default();
    let of_hierarchy = body.get("outputs").map(Node::entries).unwrap_or_default();
    let long = of_action.iter().filter(|entry| super::is_port_form(&entry.value));
    for entry in long.chain(of_hierarchy.iter().filter(|entry| outputs::is_long(&entry.value))) {
        if let Some(node) = entry.value.get("default")
            && let Some(value) = super::constant(fields, node)
        {
            let own = fields.view.state.and_then(|id| fields.task.ports[id.0 as usize].types.get(&entry.key));
            if let Some(ty) = own {
                super::of_type(fields, node.at, &entry.key, ty, &value);
            }
            defaults.insert(entry.key.clone(), value);
        }
        // Before the first iteration the list is empty.
        if entry.value.get("each").is_some() {
            defaults.entry(entry.key.clone()).or_insert_with(|| Value::List(List::new()));
        }
    }
    defaults
}

/// Annotations of a composite state: it reads and changes nothing besides what its parts do and its own keys declare.
fn boundary(reads: Vec<FactExpr>) -> Annotations {
    let effects = [(SUCCESS.to_owned(), Vec::new())].into();
    Annotations { reads: Some(reads), effects, ..Annotations::default() }
}

fn annotations(fields: &mut Fields<'_, '_>, step: &Step<'_>, kind: &StateKind) -> Annotations {
    let body = step.body;
    let is_action = matches!(kind, StateKind::Action { .. });
    let mut annotations = match step.form {
        Form::Wait { node, asks } => wait::annotations(fields, step, (node, asks), kind),
        _ if is_action => Annotations::default(),
        _ => boundary(Vec::new()),
    };
    let waits_s = annotations.timeout_s;
    let mut sources = Sources::of(fields, step, kind);
    annotations.nature = sources.nature(fields, |fields| nature(fields, body));
    annotations.anytime = sources.is_anytime(&annotations.nature);
    let read = sources.read(fields, "reads", |fields, node| {
        fields.note("reads", node.at);
        node.items().into_iter().flat_map(|item| reads(fields, item)).collect()
    });
    if read.is_some() {
        annotations.reads = read;
    } else if matches!(annotations.nature, Nature::Senses(_)) {
        // A sensing state reads the facts that it senses.
        annotations.reads = Some(Vec::new());
    }
    annotations.requires = sources.read_each(fields, "requires", |fields, node| {
        let required = |(i, node): (usize, &Node)| {
            fields.note(format!("requires.{i}"), node.at);
            fields.expression(node)
        };
        node.items().into_iter().enumerate().filter_map(required).collect()
    });
    // States that cannot change the environment change nothing when they fail; a computing state never changes anything.
    if annotations.nature != Nature::Irreversible {
        for outcome in [ABORTED, PREEMPTED] {
            annotations.effects.insert(outcome.to_owned(), Vec::new());
        }
    }
    if annotations.nature == Nature::Computes {
        annotations.effects.insert(SUCCESS.to_owned(), Vec::new());
        if let StateKind::Action { provider, action, .. } = kind {
            let custom = fields.task.catalogue.action(provider, action).into_iter().flat_map(|a| &a.outcomes);
            annotations.effects.extend(custom.map(|outcome| (outcome.clone(), Vec::new())));
        }
    }
    let changed = sources.effects(fields, |fields, node| {
        // At the end of a hierarchy the outputs of its children are visible.
        fields.view.inside = matches!(kind, StateKind::Sequence { .. } | StateKind::Concurrency { .. });
        fields.view.own_outputs = true;
        let changed = effects::by_outcome(fields, node);
        fields.view.own_outputs = false;
        fields.view.inside = false;
        changed
    });
    annotations.effects.extend(changed);
    let resources = sources.read(fields, "resources", |fields, node| {
        // A created resource may use the state's outputs; blocks must not, which is checked separately.
        fields.view.own_outputs = true;
        let resources = resources::list(fields, node);
        fields.view.own_outputs = false;
        resources
    });
    annotations.resources = resources.unwrap_or_default();
    annotations.routine = body.get("routine").is_some_and(|node| fields.flag(node));
    let duration = sources.read(fields, "duration", |fields, node| {
        fields.note("duration", node.at);
        let duration = fields.expression(node);
        if duration.as_ref().is_some_and(|duration| !duration.fact_expressions().is_empty()) {
            let message = "an estimated duration cannot look up facts";
            fields.error("invalid-expression", node.at, message, "use a parameter");
        }
        duration
    });
    annotations.duration_s = duration.flatten().or(annotations.duration_s);
    annotations.origin = sources.origin;
    flow::annotate(fields, body, &mut annotations);
    annotations.timeout_s = annotations.timeout_s.or(waits_s);
    let holds = body.get("resources").into_iter().flat_map(Node::items).filter_map(|item| item.get("hold"));
    for node in holds {
        if is_action {
            let help = "leave it out: an action holds what it blocks anyway";
            fields.error("conflicting-annotations", node.at, "`hold` is for states that contain others", help);
        } else {
            annotations.routine |= fields.flag(node);
        }
    }
    annotations.attempts = body.get("attempts").and_then(|node| fields.count(node, "attempts", 1));
    annotations
}

fn nature(fields: &mut Fields<'_, '_>, body: &Node) -> Nature {
    let computes = body.get("computes").is_some_and(|node| fields.flag(node));
    let pia = body.get("pia").is_some_and(|node| fields.flag(node));
    let senses = body.get("senses");
    if usize::from(computes) + usize::from(pia) + usize::from(senses.is_some()) > 1 {
        let message = "a state computes, senses or is a PIA; this one says two of them";
        let help =
            "keep `pia: true` if it may change the environment, `senses` if it looks at it, else `computes: true`";
        fields.error("conflicting-annotations", body.at, message, help);
    }
    match senses {
        Some(node) => {
            fields.note("senses", node.at);
            Nature::Senses(node.items().into_iter().filter_map(|item| fields.fact(item)).collect())
        }
        None if computes => Nature::Computes,
        None => Nature::Irreversible,
    }
}

/// `scene` stands for the facts from which the geometry is derived: those of the ontology, if there is one.
fn reads(fields: &mut Fields<'_, '_>, item: &Node) -> Vec<FactExpr> {
    if !matches!(&item.content, Content::Text(text) if text == "scene") {
        return fields.fact(item).into_iter().collect();
    }
    let predicates = match &fields.task.ontology {
        None => SCENE_PREDICATES.to_vec(),
        Some(ontology) => ontology.scene(),
    };
    if predicates.is_empty() && fields.view.action.is_none() {
        let message = "the ontology has no geometric predicate, and `scene` stands for those";
        fields.error("unknown-predicate", item.at, message, "say `ratn:geometric true` of some, or name the facts");
    }
    let any = |(predicate, arity): &(&str, usize)| FactExpr {
        predicate: (*predicate).to_owned(),
        arguments: vec![None; *arity],
    };
    predicates.iter().map(any).collect()
}
