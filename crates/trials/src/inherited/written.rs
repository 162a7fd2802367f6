//! A program as a task file in JSON, which is valid YAML: every state with its own annotations. Those of actions are given.

use super::super::{around, offers};
use ratn_model::expression::{EffectExpr, Expr, FactExpr};
use ratn_model::program::{Nature, Program, ResourceExpr, State, StateKind, Target, TaskOutput, WORLD_MODEL};
use ratn_model::resource::{Quantity, ResourceOperation};
use serde_json::{Map, Value as Json, json};
use std::collections::BTreeMap;

/// The task file of a program; `action` returns the keys of an action's state.
pub(super) fn task(program: &Program, action: &dyn Fn(&State) -> Map<String, Json>) -> String {
    let root = program.state(Program::ROOT);
    let mut task = Map::new();
    task.insert("task".into(), json!("inherited"));
    task.insert("horizon".into(), json!(program.horizon));
    task.insert("speculation_width".into(), json!(program.speculation_width));
    let parameters = program.parameters.iter().filter_map(|parameter| {
        let default = Expr::Literal(parameter.default.clone()?);
        Some((parameter.name.clone(), json!({ "type": "any", "default": text(program, &default) })))
    });
    put(&mut task, "parameters", parameters.collect());
    put(&mut task, "variables", named(program, &root.variables));
    put(&mut task, "outputs", outputs(program, &program.outputs));
    task.insert("outcomes".into(), json!(root.outcomes));
    task.insert("world".into(), effects(program, &program.initial));
    let children = root.lists().into_iter().flatten();
    task.insert("states".into(), children.map(|child| state(program, program.state(*child), action)).collect());
    Json::Object(task).to_string()
}

fn put(into: &mut Map<String, Json>, key: &str, entries: Map<String, Json>) {
    if !entries.is_empty() {
        into.insert(key.to_owned(), Json::Object(entries));
    }
}

fn named(program: &Program, all: &[(String, Expr)]) -> Map<String, Json> {
    all.iter().map(|(name, value)| (name.clone(), json!(text(program, value)))).collect()
}

fn outputs(program: &Program, all: &[TaskOutput]) -> Map<String, Json> {
    all.iter().map(|output| (output.name.clone(), json!(text(program, &output.value)))).collect()
}

fn state(program: &Program, state: &State, action: &dyn Fn(&State) -> Map<String, Json>) -> Json {
    let list = |ids: &[ratn_model::id::StateId]| -> Json {
        ids.iter().map(|id| self::state(program, program.state(*id), action)).collect()
    };
    let mut said = Map::new();
    match &state.kind {
        StateKind::Action { provider, action: name, inputs, outputs, .. } => {
            said.insert("action".into(), json!(format!("{provider}/{name}")));
            put(&mut said, "in", named(program, inputs));
            if !state.defaults.is_empty() {
                let port = |(name, ty): (&String, &ratn_model::value::Type)| {
                    let mut port = Map::from_iter([("type".to_owned(), json!(ty.to_string()))]);
                    let default = state.defaults.get(name).map(|value| text(program, &Expr::Literal(value.clone())));
                    port.extend(default.map(|default| ("default".to_owned(), json!(default))));
                    (name.clone(), Json::Object(port))
                };
                put(&mut said, "out", outputs.iter().map(port).collect());
            }
            said.extend(action(state));
        }
        StateKind::Sequence { children, outputs: declared } => {
            said.insert("states".into(), list(children));
            put(&mut said, "outputs", outputs(program, declared));
            put(&mut said, "variables", named(program, &state.variables));
        }
        StateKind::ForEach { variable, index, collection, body, .. } => {
            said.insert("for".into(), json!(format!("{variable} in {}", text(program, collection))));
            said.extend(index.clone().map(|index| ("index".to_owned(), json!(index))));
            said.insert("do".into(), list(body));
        }
        StateKind::While { predicate, body_first, index, body, .. } => {
            let key = if *body_first { "do_while" } else { "while" };
            said.insert(key.into(), json!(text(program, predicate)));
            said.extend(index.clone().map(|index| ("index".to_owned(), json!(index))));
            said.insert("do".into(), list(body));
        }
        StateKind::Concurrency { regions, preemptive, successes, decide, outputs: declared } => {
            let kind = match successes {
                Some(wanted) => json!(wanted),
                None => json!(if *preemptive { "preemptive" } else { "barrier" }),
            };
            said.insert("concurrency".into(), kind);
            said.insert("regions".into(), list(regions));
            put(&mut said, "decide", named(program, decide));
            put(&mut said, "outputs", outputs(program, declared));
        }
        StateKind::Condition { predicate, then, otherwise, .. } => {
            said.insert("condition".into(), json!(text(program, predicate)));
            said.insert("then".into(), list(then));
            said.insert("else".into(), list(otherwise));
        }
    }
    if !matches!(state.kind, StateKind::Action { .. }) {
        said.insert("outcomes".into(), json!(state.outcomes));
        boundary(program, state, &mut said);
    }
    let target = |target: &Target| match target {
        Target::State(id) => json!(program.state(*id).name),
        Target::Outcome(name) => json!(name),
    };
    put(&mut said, "transitions", state.transitions.iter().map(|(by, to)| (by.clone(), target(to))).collect());
    put(&mut said, "assign", named(program, &state.assign));
    json!({ state.name.clone(): said })
}

/// Adds the keys of a composite state.
fn boundary(program: &Program, state: &State, said: &mut Map<String, Json>) {
    let annotations = &state.annotations;
    if !annotations.requires.is_empty() {
        said.insert("requires".into(), annotations.requires.iter().map(|one| json!(text(program, one))).collect());
    }
    put(said, "effects", by_outcome(program, &annotations.effects));
    if !annotations.resources.is_empty() {
        said.insert("resources".into(), annotations.resources.iter().map(|one| resource(program, one)).collect());
    }
    if annotations.routine {
        said.insert("routine".into(), json!(true));
    }
}

pub(super) fn by_outcome(program: &Program, all: &BTreeMap<String, Vec<EffectExpr>>) -> Map<String, Json> {
    all.iter().map(|(outcome, list)| (outcome.clone(), effects(program, list))).collect()
}

fn effects(program: &Program, all: &[EffectExpr]) -> Json {
    all.iter().map(|one| effect(program, one)).collect()
}

fn effect(program: &Program, one: &EffectExpr) -> Json {
    match one {
        EffectExpr::ForEach { variable, collection, effects: inner } => {
            json!({ "for": format!("{variable} in {}", text(program, collection)), "do": effects(program, inner) })
        }
        one => {
            let mut one = one.clone();
            one.each_expression_mut(&mut |expression| expression.rewrite(&mut |part| say_states(program, part)));
            json!(one.to_string())
        }
    }
}

pub(super) fn nature(program: &Program, nature: &Nature) -> (String, Json) {
    match nature {
        Nature::Irreversible => ("pia".to_owned(), json!(true)),
        Nature::Computes => ("computes".to_owned(), json!(true)),
        Nature::Senses(facts) => ("senses".to_owned(), facts.iter().map(|one| json!(fact(program, one))).collect()),
    }
}

pub(super) fn resource(program: &Program, line: &ResourceExpr) -> Json {
    if line.operation == ResourceOperation::Block && line.kind == WORLD_MODEL {
        return json!("world_model");
    }
    let mut said = Map::from_iter([(line.operation.to_string(), json!(line.kind))]);
    said.extend(line.class.map(|class| ("class".to_owned(), json!(class.to_string()))));
    if line.count != Quantity::ONE {
        let count: f64 = line.count.to_string().parse().unwrap_or(1.0);
        said.insert("count".into(), if count.fract() == 0.0 { json!(count as u64) } else { json!(count) });
    }
    if !line.conditions.is_empty() {
        said.insert("where".into(), line.conditions.iter().map(|one| json!(one.to_string())).collect());
    } else {
        put(&mut said, "where", named(program, &line.attributes));
    }
    Json::Object(said)
}

pub(super) fn fact(program: &Program, fact: &FactExpr) -> String {
    text(program, &Expr::Fact(fact.clone()))
}

/// An expression as people write it.
pub(super) fn text(program: &Program, expression: &Expr) -> String {
    let mut expression = expression.clone();
    expression.rewrite(&mut |part| say_states(program, part));
    expression.to_string()
}

/// Replaces the ids of states by their names.
fn say_states(program: &Program, part: &mut Expr) {
    if let Expr::Port { state, port } = part {
        *part = Expr::Output(format!("{}.{port}", program.state(*state).name));
    }
}

pub(super) fn resources() -> BTreeMap<String, ratn_model::catalogue::ResourceOffer> {
    let actuates = |kind: &str| ["Arm", "Head", "Base"].contains(&kind);
    let offer = |(kind, mut offer): (String, ratn_model::catalogue::ResourceOffer)| {
        offer.actuates = actuates(&kind);
        (kind, offer)
    };
    offers().into_iter().map(offer).collect()
}

/// Whether a state around this one blocks room for a projection.
pub(super) fn is_in_projection(program: &Program, state: &State) -> bool {
    let blocks = |line: &ResourceExpr| line.operation == ResourceOperation::Block && line.kind == WORLD_MODEL;
    around(program, state).skip(1).any(|state| state.annotations.resources.iter().any(blocks))
}
