//! Libraries: a task file used as a state of another.
//!
//! A library is loaded and checked by itself, with its own name in messages; then its states are put below the state that uses
//! it. Its parameters become scoped variables, its outputs output ports, its outcomes outcomes.

use super::fields::Fields;
use super::outline::{Form, Outline};
use super::yaml::{Content, Node};
use super::{Loading, names::suggestion};
use crate::diagnostic::{Diagnostic, Findings, Severity};
use crate::expression::Expr;
use crate::id::StateId;
use crate::program::{Program, State, StateKind, Target};
use std::collections::BTreeMap;

/// Libraries may use libraries this deep.
const MAX_DEPTH: usize = 8;
/// A task may not have more states with those of its libraries.
const MAX_STATES: usize = 20_000;

/// Where the texts of libraries come from.
pub trait Files {
    /// The name (for messages, and to know it again) and the text of the file that `using` calls `path`.
    ///
    /// # Errors
    /// Why it cannot be read.
    fn read(&self, using: &str, path: &str) -> Result<(String, String), String>;
}

/// No libraries.
pub(crate) struct NoFiles;

impl Files for NoFiles {
    fn read(&self, _: &str, _: &str) -> Result<(String, String), String> {
        Err("libraries cannot be read here".to_owned())
    }
}

/// Loads the libraries that the steps of an outline use. A library that is refused is refused with its own findings.
pub(crate) fn load_all(
    outline: &Outline<'_>,
    loading: &Loading<'_>,
    findings: &mut Findings,
    inner: &mut Vec<Diagnostic>,
) -> BTreeMap<StateId, Program> {
    let mut libraries = BTreeMap::new();
    for (index, step) in outline.steps.iter().enumerate() {
        let Form::Library { file } = &step.form else { continue };
        let Content::Text(path) = &file.content else {
            let help = "write `library: part.yaml`, relative to this file";
            findings.error("invalid-state", file.at, &step.path, "`library` is the name of a task file", help);
            continue;
        };
        let refuse = |findings: &mut Findings, message: String, help: &str| {
            findings.error("unknown-library", file.at, &step.path, message, help);
        };
        if loading.around.len() >= MAX_DEPTH {
            refuse(findings, format!("libraries use libraries at most {MAX_DEPTH} deep"), "");
            continue;
        }
        let (name, text) = match loading.files.read(loading.file, path) {
            Ok(read) => read,
            Err(why) => {
                refuse(findings, format!("`{path}` cannot be read: {why}"), "the path is relative to this file");
                continue;
            }
        };
        if loading.around.contains(&name) || name == loading.file {
            refuse(findings, format!("`{path}` uses itself, directly or over others"), "break the circle");
            continue;
        }
        let mut around = loading.around.clone();
        around.push(loading.file.to_owned());
        match super::load_within(&text, &Loading { file: &name, around, ..*loading }) {
            Ok(loaded) => {
                inner.extend(loaded.warnings);
                libraries.insert(StateId(index as u64), loaded.program);
            }
            Err(diagnostics) => {
                inner.extend(diagnostics);
                refuse(findings, format!("the library `{path}` is refused"), "see what is said of it");
            }
        }
    }
    if libraries.values().map(|library| library.states.len()).sum::<usize>() > MAX_STATES {
        findings.error(
            "invalid-state",
            Default::default(),
            "",
            format!("libraries bring more than {MAX_STATES} states"),
            "",
        );
        libraries.clear();
    }
    inner.retain(|diagnostic| diagnostic.severity == Severity::Error || !diagnostic.message.is_empty());
    libraries
}

/// The parameters of a library as scoped variables: what `with` says, else their defaults.
pub(crate) fn parameters(fields: &mut Fields<'_, '_>, id: StateId, body: &Node) -> Vec<(String, Expr)> {
    let Some(library) = fields.task.libraries.get(&id) else { return Vec::new() };
    let given = body.get("with").map(Node::entries).unwrap_or_default();
    for entry in given {
        if !library.parameters.iter().any(|parameter| parameter.name == entry.key) {
            let known = library.parameters.iter().map(|parameter| parameter.name.as_str());
            let help = suggestion(&entry.key, known, "", "it has no parameters");
            fields.error("unknown-port", entry.at, format!("the library has no parameter `{}`", entry.key), help);
        }
    }
    let mut bound = Vec::new();
    for parameter in &library.parameters {
        let value = match given.iter().find(|entry| entry.key == parameter.name) {
            Some(entry) => {
                fields.note(format!("variables.{}", parameter.name), entry.at);
                fields.expression(&entry.value)
            }
            None => match &parameter.default {
                Some(default) => Some(Expr::Literal(default.clone())),
                None => {
                    let message = format!("the library needs its parameter `{}`", parameter.name);
                    fields.error("missing-input", body.at, message, "give it under `with`");
                    None
                }
            },
        };
        bound.extend(value.map(|value| (parameter.name.clone(), value)));
    }
    bound.extend(library.states[0].variables.iter().cloned());
    bound
}

/// Puts the states of a library below the state that uses it.
pub(crate) fn graft(states: &mut Vec<State>, at: StateId, library: &Program) {
    // The root becomes the state itself; the others come behind all there are.
    let offset = states.len() as u64;
    let moved = |id: StateId| if id == Program::ROOT { at } else { StateId(id.0 - 1 + offset) };
    let (path, location) = (states[at.0 as usize].path.clone(), states[at.0 as usize].location);
    for state in library.states.iter().skip(1) {
        let mut state = state.clone();
        state.id = moved(state.id);
        state.parent = state.parent.map(moved);
        state.path = format!("{path}/{}", state.path);
        state.location = location;
        move_state(&mut state, &moved);
        states.push(state);
    }
    let root = &mut states[at.0 as usize];
    let mut outputs = library.outputs.clone();
    outputs.iter_mut().for_each(|output| output.value.move_states(&moved));
    let children = library.states[0].children().map(moved).collect();
    root.kind = StateKind::Sequence { children, outputs };
}

fn move_state(state: &mut State, moved: &dyn Fn(StateId) -> StateId) {
    let ids = |list: &mut Vec<StateId>| list.iter_mut().for_each(|id| *id = moved(*id));
    match &mut state.kind {
        StateKind::Action { inputs, .. } => inputs.iter_mut().for_each(|(_, e)| e.move_states(moved)),
        StateKind::Sequence { children, outputs } => {
            ids(children);
            outputs.iter_mut().for_each(|o| o.value.move_states(moved));
        }
        StateKind::ForEach { collection, body, .. } => {
            ids(body);
            collection.move_states(moved);
        }
        StateKind::While { predicate, body, .. } => {
            ids(body);
            predicate.move_states(moved);
        }
        StateKind::Condition { predicate, then, otherwise } => {
            ids(then);
            ids(otherwise);
            predicate.move_states(moved);
        }
        StateKind::Concurrency { regions, decide, outputs, .. } => {
            ids(regions);
            decide.iter_mut().for_each(|(_, e)| e.move_states(moved));
            outputs.iter_mut().for_each(|o| o.value.move_states(moved));
        }
    }
    for target in state.transitions.values_mut() {
        if let Target::State(id) = target {
            *id = moved(*id);
        }
    }
    state.variables.iter_mut().chain(&mut state.assign).for_each(|(_, e)| e.move_states(moved));
    let annotations = &mut state.annotations;
    if let crate::program::Nature::Senses(facts) = &mut annotations.nature {
        facts.iter_mut().for_each(|fact| fact.move_states(moved));
    }
    annotations.reads.iter_mut().flatten().chain(&mut annotations.shared).for_each(|fact| fact.move_states(moved));
    annotations.requires.iter_mut().chain(&mut annotations.duration_s).for_each(|e| e.move_states(moved));
    annotations.effects.values_mut().flatten().for_each(|effect| effect.move_states(moved));
    annotations.resources.iter_mut().flat_map(|r| &mut r.attributes).for_each(|(_, e)| e.move_states(moved));
}
