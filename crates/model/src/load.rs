//! Loading: task file → [`Program`].
//!
//! In three passes: the outline (which states there are, in which order), the expressions (with every name resolved), and the rules of `check`.
//! All errors are collected, each with its location; a program is returned only if there is none. Features that are planned but missing are
//! refused by name, never ignored.
//!
//! ```yaml
//! task: name
//! horizon: 120
//! parameters: {boxes: {type: int, default: 3}}
//! world: ["hand_empty(gripper)"]
//! outputs: {delivered: "len(look.boxes)"}
//! states:
//!   - look: { action: detector/segment, in: {region: {...}}, out: {boxes}, senses: ["at(table)"], resources: [...] }
//!   - for: box in look.boxes
//!     do: [...]
//! ```

mod action;
mod advice;
mod allowed;
mod begin_at;
mod document;
pub mod edit;
mod effects;
mod fields;
mod flow;
mod functions;
mod graft;
mod library;
mod names;
mod outline;
mod outputs;
mod projected;
mod resources;
mod state;
mod tolerance;
mod wait;
mod written_out;
mod yaml;

pub use document::Document;
pub(crate) use fields::Places;
pub use library::Files;
pub(crate) use names::distance;
pub use names::suggestion;
pub use yaml::MAX_SOURCE;

use crate::catalogue::Catalogue;
use crate::check;
use crate::diagnostic::{Diagnostic, Findings, Severity};
use crate::expression::EffectExpr;
use crate::expression::scope::NothingKnown;
use crate::guard;
use crate::id::StateId;
use crate::ontology::Ontology;
use crate::ontology::turtle::{self, OntologyError};
use crate::program::{Origin, Parameter, Program, State, StateKind, TaskOutput};
use crate::value::{Type, Value};
use fields::{Fields, Output};
use names::{Ports, Task, View};
use outline::{Form, Outline};
use std::collections::BTreeMap;
use yaml::{Content, Node};

/// The default horizon.
pub const DEFAULT_HORIZON: usize = 120;

const TASK_KEYS: [&str; 15] = [
    "task",
    "description",
    "horizon",
    "speculation_width",
    "deadline",
    "exceptions",
    "parameters",
    "variables",
    "functions",
    "ontology",
    "tolerance",
    "world",
    "outputs",
    "outcomes",
    "states",
];

/// A program and its warnings.
#[derive(Debug, Clone, PartialEq)]
pub struct Loaded {
    /// The program.
    pub program: Program,
    /// Findings that do not cause a refusal.
    pub warnings: Vec<Diagnostic>,
}

/// Loads and checks a task file that uses no libraries; `file` is its name in messages.
///
/// # Errors
/// Every finding, at least one of them an error, in the order of the file.
pub fn load(source: &str, file: &str, catalogue: &Catalogue) -> Result<Loaded, Vec<Diagnostic>> {
    load_with(source, file, catalogue, &library::NoFiles)
}

/// Loads and checks a task file; its libraries are read from `files`.
///
/// # Errors
/// Every finding, at least one of them an error: those of libraries first, each file's in its order.
pub fn load_with(
    source: &str,
    file: &str,
    catalogue: &Catalogue,
    files: &dyn Files,
) -> Result<Loaded, Vec<Diagnostic>> {
    load_beginning(source, file, catalogue, files, None)
}

/// As [`load_with`], for a run that begins at the state of this name in the task's own list, in the present world: the task's initial world is
/// not written, and outputs of earlier states may be missing.
///
/// # Errors
/// As [`load_with`]; also if there is no such state.
pub fn load_beginning(
    source: &str,
    file: &str,
    catalogue: &Catalogue,
    files: &dyn Files,
    from: Option<&str>,
) -> Result<Loaded, Vec<Diagnostic>> {
    let known = library::Known::default();
    load_within(source, &Loading { file, catalogue, files, known: &known, around: Vec::new(), from })
}

/// The context of loading one file.
#[derive(Clone)]
pub(crate) struct Loading<'a> {
    /// The file's name.
    pub(crate) file: &'a str,
    pub(crate) catalogue: &'a Catalogue,
    pub(crate) files: &'a dyn Files,
    /// Libraries that are already loaded.
    pub(crate) known: &'a library::Known,
    /// The files that use this one, outermost first.
    pub(crate) around: Vec<String>,
    /// The state at which the run begins; by default the first one.
    pub(crate) from: Option<&'a str>,
}

pub(crate) fn load_within(source: &str, loading: &Loading<'_>) -> Result<Loaded, Vec<Diagnostic>> {
    let mut out = Output::default();
    let mut findings = Vec::new();
    let program = read(source, loading, &mut out, &mut findings);
    if let Some(program) = &program
        && !out.findings.has_errors()
    {
        let (declares_world, begins_elsewhere) = (out.declares_world, loading.from.is_some());
        let said = check::Said { declares_world, begins_elsewhere, places: &out.places, functions: &out.functions };
        check::check(program, loading.catalogue, &said, &mut out.findings);
    }
    let refused = out.findings.has_errors();
    // Warnings of a library were reported under its own name.
    let own = |finding: &Diagnostic| {
        let below = |path: &String| finding.path.strip_prefix(path.as_str()).is_some_and(|rest| rest.starts_with('/'));
        finding.severity == Severity::Error
            || library::depends_on_use(&finding.rule)
            || !out.libraries.iter().any(below)
    };
    findings.extend(out.findings.in_file(loading.file).into_iter().filter(own));
    match program {
        Some(program) if !refused => Ok(Loaded { program, warnings: findings }),
        _ => Err(findings),
    }
}

fn read(source: &str, loading: &Loading<'_>, out: &mut Output, of_libraries: &mut Vec<Diagnostic>) -> Option<Program> {
    let catalogue = loading.catalogue;
    let mut root = match yaml::read(source) {
        Ok(root) => root,
        Err(error) => {
            let help = advice::advice(source, &error);
            out.findings.error("invalid-yaml", error.at, "", error.message, help);
            return None;
        }
    };
    if !matches!(root.content, Content::Map(_)) {
        let message = format!("a task file is a mapping, found {}", root.described());
        out.findings.error("invalid-yaml", root.at, "", message, "begin it with `task: name`");
        return None;
    }
    let name = match root.get("task").map(|node| &node.content) {
        Some(Content::Text(name)) => name.clone(),
        _ => {
            out.findings.error(
                "invalid-state",
                root.at,
                "",
                "the task has no name",
                "begin the file with `task: name`",
            );
            String::new()
        }
    };
    if let Content::Map(entries) = &mut root.content
        && let Some(states) = entries.iter_mut().find(|entry| entry.key == "states")
    {
        written_out::write_out(&mut states.value, &mut out.findings);
        if let Some(from) = loading.from {
            begin_at::begin_at(&mut states.value, from, &mut out.findings);
        }
    }
    let outline = outline::outline(&name, &root, &mut out.findings);
    let libraries = library::load_all(&outline, loading, &mut out.findings, of_libraries);
    let ports = ports(&outline, catalogue, &libraries, &mut out.findings);
    let parameters = root.get("parameters").map(Node::entries).unwrap_or_default();
    let parameters = parameters.iter().map(|entry| entry.key.clone()).collect();
    let described = root.get("ontology").and_then(|node| ontology(node, loading, &mut out.findings));
    let (ontology, ontology_text) = described.unzip();
    let functions = functions::functions(source, &root, &mut out.findings);
    out.functions = functions.usages();
    let task = Task { source, catalogue, outline, ports, parameters, libraries, functions, ontology };
    let mut fields = Fields { task: &task, view: View::default(), path: String::new(), out };
    fields.keys(&root, &TASK_KEYS);
    let horizon = match root.get("horizon") {
        Some(node) => horizon(&mut fields, node),
        None => DEFAULT_HORIZON,
    };
    let speculation_width = root.get("speculation_width").and_then(|node| fields.count(node, "speculation_width", 1));
    let deadline_s = root.get("deadline").and_then(|node| flow::positive(&mut fields, node, "deadline"));
    let exceptions = root.get("exceptions").and_then(|node| flow::exceptions(&mut fields, node));
    let tolerances = tolerance::tolerances(&mut fields, &root);
    let parameters = read_parameters(&mut fields, &root);
    let mut initial = root.get("world").map(|node| world(&mut fields, node)).unwrap_or_default();
    out.declares_world = root.get("world").is_some();
    if loading.from.is_some() {
        (initial, out.declares_world) = (Vec::new(), false);
    }
    let ids = (0..task.outline.steps.len()).map(|i| crate::id::StateId(i as u64));
    let mut states: Vec<_> = ids.map(|id| state::state(&task, id, out)).collect();
    // The task's outputs are stored in the root.
    let outputs: Vec<TaskOutput> = match &mut states[0].kind {
        StateKind::Sequence { outputs, .. } => std::mem::take(outputs),
        _ => Vec::new(),
    };
    let mut hasher = blake3::Hasher::new();
    hasher.update(source.as_bytes());
    hasher.update(ontology_text.unwrap_or_default().as_bytes());
    hasher.update(loading.from.unwrap_or_default().as_bytes());
    // The digest includes the annotations of used actions, like the texts of libraries.
    for (action, said) in said_by_actions(&states, catalogue) {
        hasher.update(action.as_bytes());
        hasher.update(said.as_bytes());
    }
    for (id, library) in &task.libraries {
        hasher.update(library.digest.as_bytes());
        graft::graft(&mut states, *id, library, &task.in_sight(*id));
        out.libraries.push(task.outline.step(*id).path.clone());
    }
    projected::imply(&mut states);
    let digest = hasher.finalize().to_hex().to_string();
    let mut program = Program {
        name,
        horizon,
        speculation_width: speculation_width.map_or(Program::DEFAULT_SPECULATION_WIDTH, |width| width as usize),
        deadline_s,
        exceptions: exceptions.unwrap_or_default(),
        parameters,
        outputs,
        initial,
        tolerances,
        ontology: task.ontology.clone(),
        kinds: catalogue.kinds.clone(),
        states,
        digest,
    };
    flow::inherit_exceptions(&mut program.states);
    flow::outcomes_exist(&task, &program, out);
    if !out.guards.is_empty() && !out.findings.has_errors() {
        match guard::unfold(&mut program, &out.guards) {
            Ok(places) => out.places.move_to(&places),
            Err(guard::TooManyStates) => {
                let message =
                    "with what `retry`, `while`, `timeout` and `finally` are made of there are more than 20,000 states";
                out.findings.error(
                    "invalid-state",
                    root.at,
                    "",
                    message,
                    "say it of fewer states, or of the state around them",
                );
            }
        }
    }
    Some(program)
}

/// The annotations that states take from their actions, as text, by action. A task that says everything itself has the same digest whatever the
/// catalogue says.
fn said_by_actions(states: &[State], catalogue: &Catalogue) -> BTreeMap<String, String> {
    let relies = |state: &&State| state.annotations.origin.values().any(|origin| *origin != Origin::State);
    let said = |state: &State| {
        let StateKind::Action { provider, action, .. } = &state.kind else { return None };
        let signature = catalogue.action(provider, action)?;
        Some((format!("{provider}/{action}"), toml::to_string(&signature.annotations).unwrap_or_default()))
    };
    states.iter().filter(relies).filter_map(said).collect()
}

fn horizon(fields: &mut Fields<'_, '_>, node: &Node) -> usize {
    match node.content {
        Content::Int(n) if n > 0 => usize::try_from(n).unwrap_or(DEFAULT_HORIZON),
        Content::Int(n) => {
            let message = format!("a horizon of {n} leaves no room for a single state");
            fields.error("horizon-too-small", node.at, message, format!("leave it out for {DEFAULT_HORIZON}"));
            DEFAULT_HORIZON
        }
        _ => {
            fields.error("type-mismatch", node.at, "`horizon` is a whole number of states", "");
            DEFAULT_HORIZON
        }
    }
}

/// The ontology that a task names, with its text.
fn ontology(node: &Node, loading: &Loading<'_>, findings: &mut Findings) -> Option<(Ontology, String)> {
    let mut refuse = |message: String, help: &str| findings.error("invalid-ontology", node.at, "", message, help);
    let Content::Text(path) = &node.content else {
        let message = format!("`ontology` is the name of a file, found {}", node.described());
        refuse(message, "write `ontology: robot.ttl`, relative to this file");
        return None;
    };
    match loading.files.read(loading.file, path) {
        Err(why) => {
            refuse(format!("`{path}` cannot be read: {why}"), "the path is relative to this file");
            None
        }
        Ok((name, text)) => {
            let read = |using: &str, path: &str| loading.files.read(using, path);
            match turtle::imports::read_with(&name, &text, &read) {
                Ok(ontology) => Some(ontology),
                Err(error) => {
                    refuse(format!("{name}: {}", said(&error)), "");
                    None
                }
            }
        }
    }
}

/// An error with the names of the files that lead to it.
fn said(error: &OntologyError) -> String {
    match error {
        OntologyError::Import { file, source } => format!("{file}: {}", said(source)),
        other => other.to_string(),
    }
}

fn world(fields: &mut Fields<'_, '_>, node: &Node) -> Vec<EffectExpr> {
    let mut initial = Vec::new();
    for item in node.items() {
        let effects = effects::list(fields, item);
        if !EffectExpr::fact_expressions(&effects).is_empty() {
            let message = "the initial world cannot look up facts";
            fields.error("invalid-expression", item.at, message, "use constants and parameters");
        }
        let mut parts = Vec::new();
        effects.iter().for_each(|effect| effect.each_expression(&mut |expr| parts.push(expr)));
        if let Some(problem) = parts.into_iter().find_map(check::constants::problem) {
            fields.error(check::constants::RULE, item.at, problem.to_string(), check::constants::HELP);
        }
        for i in initial.len()..initial.len() + effects.len() {
            fields.out.places.note(StateId(0), format!("world.{i}"), item.at);
        }
        initial.extend(effects);
    }
    initial
}

/// `name: {type: int, default: 3}`, or `name: 3` with the value's own type.
fn read_parameters(fields: &mut Fields<'_, '_>, root: &Node) -> Vec<Parameter> {
    let mut parameters = Vec::new();
    for entry in root.get("parameters").map(Node::entries).unwrap_or_default() {
        let long = entry.value.get("type").is_some() || entry.value.get("default").is_some();
        let default = if long {
            fields.keys(&entry.value, &["type", "default", "description"]);
            entry.value.get("default")
        } else {
            Some(&entry.value)
        };
        let declared = entry.value.get("type").filter(|_| long).map(|node| declared_type(fields, node));
        let default = default.and_then(|node| constant(fields, node).map(|value| (node.at, value)));
        let ty = declared.flatten().or_else(|| default.as_ref().map(|(_, value)| check::types::of_value(value)));
        let ty = ty.unwrap_or(Type::Any);
        if let Some((at, value)) = &default {
            of_type(fields, *at, &entry.key, &ty, value);
        }
        parameters.push(Parameter { name: entry.key.clone(), ty, default: default.map(|(_, value)| value) });
    }
    parameters
}

/// Reports a default of another type.
fn of_type(fields: &mut Fields<'_, '_>, at: crate::program::Location, name: &str, ty: &Type, value: &Value) {
    if ty.accepts(value) {
        return;
    }
    let items =
        if let Value::List(items) = value { items.iter().map(ToString::to_string).collect() } else { Vec::new() };
    let help = check::types::called(ty, &items).unwrap_or_default();
    fields.error("type-mismatch", at, format!("the default of `{name}` is {}, not {ty}", value.type_name()), help);
}

fn constant(fields: &mut Fields<'_, '_>, node: &Node) -> Option<Value> {
    match fields.expression(node)?.evaluate(&NothingKnown) {
        Ok(value) => Some(value),
        Err(error) => {
            let rule = if error.is_not_yet_known() { "invalid-expression" } else { check::constants::RULE };
            fields.error(rule, node.at, error.to_string(), "a default is a constant");
            None
        }
    }
}

fn declared_type(fields: &mut Fields<'_, '_>, node: &Node) -> Option<Type> {
    match type_of(node) {
        Ok(ty) => Some(ty),
        Err(message) => {
            fields.error("type-mismatch", node.at, message, "");
            None
        }
    }
}

/// Parses a type: a text, or a mapping of fields to types.
fn type_of(node: &Node) -> Result<Type, String> {
    match &node.content {
        Content::Text(text) => text.parse::<Type>().map_err(|error| error.to_string()),
        Content::Map(entries) => {
            let fields = entries.iter().map(|entry| Ok((entry.key.clone(), type_of(&entry.value)?)));
            Ok(Type::Record(fields.collect::<Result<_, String>>()?))
        }
        _ => Err(format!("expected a type, found {}", node.described())),
    }
}

/// The output ports of every state: those of its action, or only those in `out` if that is given.
fn ports(
    outline: &Outline<'_>,
    catalogue: &Catalogue,
    libraries: &BTreeMap<StateId, Program>,
    findings: &mut Findings,
) -> Vec<Ports> {
    let of_step = |(index, step): (usize, &outline::Step<'_>)| match &step.form {
        Form::Action { action } => {
            let signature = state::action_name(action).and_then(|(p, a)| catalogue.action(&p, &a));
            let Some(node) = step.body.get("out") else {
                let types = signature.map(|s| s.outputs.clone()).unwrap_or_default();
                return Ports { types, open: signature.is_none() };
            };
            let mut ports = Ports { open: signature.is_none(), ..Ports::default() };
            for (name, at, ty) in declared_ports(node, &step.path, findings) {
                let offered = signature.and_then(|s| s.outputs.get(&name));
                if let (Some(signature), None) = (signature, offered) {
                    let message = format!("the action has no output port `{name}`");
                    let help = suggestion(&name, signature.outputs.keys().map(String::as_str), "", "it has no outputs");
                    findings.error("unknown-port", at, &step.path, message, help);
                    continue;
                }
                let fits = |ty: &Type| offered.is_none_or(|offered| ty.accepts_type(offered));
                if let Some(ty) = ty.as_ref().filter(|ty| !fits(ty)) {
                    let offered = offered.map(ToString::to_string).unwrap_or_default();
                    let message = format!("the action's output `{name}` is {offered}, not {ty}");
                    findings.error("type-mismatch", at, &step.path, message, "leave the type out");
                }
                let ty = ty.filter(|ty| *ty != Type::Any).or(offered.cloned()).unwrap_or(Type::Any);
                ports.types.insert(name, ty);
            }
            ports
        }
        Form::Library { .. } => match libraries.get(&StateId(index as u64)) {
            None => Ports { open: true, ..Ports::default() },
            Some(library) => {
                let types = library.outputs.iter().map(|output| (output.name.clone(), output.ty.clone()));
                Ports { types: types.collect(), open: false }
            }
        },
        Form::Sequence { .. }
        | Form::Concurrency { .. }
        | Form::ForEach { .. }
        | Form::While { .. }
        | Form::Condition { .. } => {
            let declared = step.body.get("outputs").map(Node::entries).unwrap_or_default();
            let typed = |entry: &yaml::Entry| entry.value.get("type").and_then(|node| type_of(node).ok());
            let types = declared.iter().map(|entry| (entry.key.clone(), typed(entry).unwrap_or(Type::Any)));
            Ports { types: types.collect(), open: false }
        }
        Form::Wait { node, asks } => Ports { types: wait::ports(node, *asks), open: false },
    };
    outline.steps.iter().enumerate().map(of_step).collect()
}

/// Whether this is `{type: int, default: 0}`, with either or both, and not such a record type.
fn is_port_form(node: &Node) -> bool {
    let entries = node.entries();
    !entries.is_empty()
        && entries.iter().all(|entry| matches!(entry.key.as_str(), "type" | "default"))
        && (node.get("default").is_some() || entries.len() == 1)
}

/// `[a, b]`, `{a, b}`, `{a: type}`, `{a: {type: int, default: 0}}` or `a`.
fn declared_ports(
    node: &Node,
    path: &str,
    findings: &mut Findings,
) -> Vec<(String, crate::program::Location, Option<Type>)> {
    let mut ports = Vec::new();
    for item in node.items() {
        match &item.content {
            Content::Text(name) => ports.push((name.clone(), item.at, None)),
            Content::Map(entries) => {
                for entry in entries {
                    let ty = match &entry.value.content {
                        Content::Null => None,
                        _ if is_port_form(&entry.value) && entry.value.get("type").is_none() => None,
                        _ => match type_of(
                            entry.value.get("type").filter(|_| is_port_form(&entry.value)).unwrap_or(&entry.value),
                        ) {
                            Ok(ty) => Some(ty),
                            Err(message) => {
                                findings.error("type-mismatch", entry.value.at, path, message, "");
                                None
                            }
                        },
                    };
                    ports.push((entry.key.clone(), entry.at, ty));
                }
            }
            _ => {
                let message = format!("expected output ports, found {}", item.described());
                findings.error("invalid-state", item.at, path, message, "write `out: {port}` or `out: {port: type}`");
            }
        }
    }
    ports
}
