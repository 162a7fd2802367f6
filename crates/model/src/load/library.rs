//! Libraries: a task file that is used as a state of another one.
//!
//! A library is loaded and checked separately, with its own name in messages. Then its states are inserted below the state
//! that uses it. Its parameters become scoped variables, its outputs output ports, its outcomes outcomes.

use super::fields::Fields;
use super::outline::{Form, Outline};
use super::yaml::{Content, Node};
use super::{Loading, names::suggestion};
use crate::diagnostic::{Diagnostic, Findings};
use crate::expression::Expr;
use crate::expression::scope::NothingKnown;
use crate::id::StateId;
use crate::program::Program;
use std::cell::RefCell;
use std::collections::BTreeMap;

/// Limit of nested libraries.
const MAX_DEPTH: usize = 8;
/// Limit of the libraries of a task.
const MAX_LIBRARIES: usize = 64;
/// Limit of the states of a task, including those of its libraries.
const MAX_STATES: usize = 20_000;

/// Gives the texts of libraries.
pub trait Files {
    /// The name (for messages and to identify the file) and the text of the file that `using` refers to as `path`.
    ///
    /// # Errors
    /// The reason why it cannot be read.
    fn read(&self, using: &str, path: &str) -> Result<(String, String), String>;
}

/// No libraries.
pub(crate) struct NoFiles;

impl Files for NoFiles {
    fn read(&self, _: &str, _: &str) -> Result<(String, String), String> {
        Err("libraries cannot be read here".to_owned())
    }
}

/// Libraries by name, each loaded once; `None` if it was refused.
pub(crate) type Known = RefCell<BTreeMap<String, Option<Program>>>;

/// Loads the libraries that the steps of an outline use. The findings of a refused library are reported, too.
pub(crate) fn load_all(
    outline: &Outline<'_>,
    loading: &Loading<'_>,
    findings: &mut Findings,
    inner: &mut Vec<Diagnostic>,
) -> BTreeMap<StateId, Program> {
    let mut libraries = BTreeMap::new();
    let mut states = 0;
    for (index, step) in outline.steps.iter().enumerate() {
        let Form::Library { file } = &step.form else { continue };
        let Content::Text(path) = &file.content else {
            let help = "write `library: part.yaml`, relative to this file";
            findings.error("invalid-state", file.at, &step.path, "`library` is the name of a task file", help);
            continue;
        };
        match library(path, loading, inner) {
            Ok(library) => {
                states += library.states.len();
                if states > MAX_STATES {
                    let message = format!("a task has at most {MAX_STATES} states of libraries");
                    findings.error("unknown-library", file.at, &step.path, message, "use it from a loop");
                    break;
                }
                let ignored = [("world", !library.initial.is_empty()), ("deadline", library.deadline_s.is_some())];
                for (key, _) in ignored.into_iter().filter(|(_, declared)| *declared) {
                    let message = format!("the `{key}` of `{path}` counts only where that is run by itself");
                    let help = format!("say it in the `{key}` of this task, if it is not said there already");
                    findings.warning("ignored-in-library", file.at, &step.path, message, help);
                }
                libraries.insert(StateId(index as u64), library);
            }
            Err((message, help)) => findings.error("unknown-library", file.at, &step.path, message, help),
        }
    }
    libraries
}

/// A library, or the reason why it cannot be used and what to do.
fn library(path: &str, loading: &Loading<'_>, inner: &mut Vec<Diagnostic>) -> Result<Program, (String, &'static str)> {
    if loading.around.len() >= MAX_DEPTH {
        return Err((format!("libraries use libraries at most {MAX_DEPTH} deep"), ""));
    }
    let read = loading.files.read(loading.file, path);
    let (name, text) = read.map_err(|why| {
        let message = format!("`{path}` cannot be read: {why}");
        (message, "the path is relative to this file")
    })?;
    if loading.around.contains(&name) || name == loading.file {
        return Err((format!("`{path}` uses itself, directly or over others"), "break the circle"));
    }
    let refused = || (format!("the library `{path}` is refused"), "see what is said of it");
    if let Some(known) = loading.known.borrow().get(&name) {
        return known.clone().ok_or_else(refused);
    }
    if loading.known.borrow().len() >= MAX_LIBRARIES {
        return Err((format!("a task has at most {MAX_LIBRARIES} libraries"), ""));
    }
    let mut around = loading.around.clone();
    around.push(loading.file.to_owned());
    let loaded = match super::load_within(&text, &Loading { file: &name, around, from: None, ..*loading }) {
        Ok(loaded) => {
            // What holds before the library begins depends on its use.
            inner.extend(loaded.warnings.into_iter().filter(|warning| !depends_on_use(&warning.rule)));
            Some(loaded.program)
        }
        Err(diagnostics) => {
            inner.extend(diagnostics);
            None
        }
    };
    loading.known.borrow_mut().insert(name, loaded.clone());
    loaded.ok_or_else(refused)
}

/// Whether the result of a rule depends on where a library is used.
pub(crate) fn depends_on_use(rule: &str) -> bool {
    rule == "unestablished-precondition"
}

/// The parameters of a library as scoped variables: the values in `with`, else their defaults.
pub(crate) fn parameters(fields: &mut Fields<'_, '_>, id: StateId, body: &Node) -> Vec<(String, Expr)> {
    let Some(library) = fields.task.libraries.get(&id) else { return Vec::new() };
    let given = fields.mapping(body, "with", "{ boxes: 2 }");
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
                let value = fields.expression(&entry.value);
                let constant = value.as_ref().and_then(|value| value.evaluate(&NothingKnown).ok());
                if let Some(constant) = constant.filter(|constant| !parameter.ty.accepts(constant)) {
                    let (name, ty) = (&parameter.name, &parameter.ty);
                    let message = format!("the library's parameter `{name}` is {ty}, not {}", constant.type_name());
                    fields.error("type-mismatch", entry.value.at, message, "");
                }
                value
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
    // The library's own variables may use its parameters; all are evaluated outside of the state.
    let own = library.states[0].variables.iter().map(|(name, value)| {
        let mut value = value.clone();
        value.rewrite(&mut |part| give(&bound, part));
        (name.clone(), value)
    });
    let own: Vec<_> = own.collect();
    bound.extend(own);
    bound
}

/// Replaces a variable by its expression.
fn give(bound: &[(String, Expr)], expr: &mut Expr) {
    if let Expr::Variable(name) = expr
        && let Some((_, value)) = bound.iter().find(|(given, _)| given == name)
    {
        *expr = value.clone();
    }
}
