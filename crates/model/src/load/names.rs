//! What names stand for, seen from one state: variables of the loops around it, parameters, outputs of other states.
//!
//! A state's name is looked for among the siblings of this state and of those around it, inside out; then anywhere. That
//! the state found can really have written its port by then is a rule of `check`.

use super::functions::Functions;
use super::outline::{Form, Outline};
use crate::catalogue::{Catalogue, no_states};
use crate::expression::Expr;
use crate::expression::parse::{NameError, Names};
use crate::id::StateId;
use crate::ontology::Ontology;
use crate::program::Program;
use crate::value::Type;
use std::collections::{BTreeMap, BTreeSet};
use std::rc::Rc;

/// The port of a region that says how it ended.
const OUTCOME: &str = "outcome";

/// The output ports of a state.
#[derive(Debug, Clone, Default)]
pub(crate) struct Ports {
    pub(crate) types: BTreeMap<String, Type>,
    /// The action is unknown, so any port may exist.
    pub(crate) open: bool,
}

/// Everything that is known of a task before its expressions are read.
pub(crate) struct Task<'a> {
    pub(crate) source: &'a str,
    pub(crate) catalogue: &'a Catalogue,
    pub(crate) outline: Outline<'a>,
    /// By [`StateId`].
    pub(crate) ports: Vec<Ports>,
    pub(crate) parameters: Vec<String>,
    /// Libraries that states use, loaded, by state.
    pub(crate) libraries: BTreeMap<StateId, Program>,
    /// Its own functions.
    pub(crate) functions: Functions,
    /// What its facts may say; `None`: anything.
    pub(crate) ontology: Option<Ontology>,
}

/// From where an expression sees the task.
#[derive(Debug, Clone, Default)]
pub(crate) struct View {
    /// The state; `None` sees parameters only.
    pub(crate) state: Option<StateId>,
    /// It sees the state's children and its scoped variables (outputs of a hierarchy).
    pub(crate) inside: bool,
    /// A bare word may be an output of the state itself (its effects).
    pub(crate) own_outputs: bool,
    /// Further variables (of quantified effects).
    pub(crate) variables: Vec<String>,
    /// An annotation of the state's action is read: it sees the action's ports alone.
    pub(crate) action: Option<Rc<super::action::Ports>>,
}

/// The names of a task as one expression sees them.
pub(crate) struct NamesFrom<'t, 'a> {
    pub(crate) task: &'t Task<'a>,
    pub(crate) view: &'t View,
}

impl Task<'_> {
    /// The variables that the loops around a state bind, innermost first.
    pub(crate) fn loop_variables(&self, state: StateId) -> impl Iterator<Item = &str> {
        self.outline
            .containers(state)
            .flat_map(|id| match &self.outline.step(id).form {
                Form::ForEach { variable, index, .. } => [Some(variable.as_str()), index.as_deref()],
                Form::While { index, .. } => [index.as_deref(), None],
                _ => [None, None],
            })
            .flatten()
    }

    /// Every variable that is in sight where a state stands.
    pub(crate) fn in_sight(&self, state: StateId) -> BTreeSet<String> {
        let around = self.loop_variables(state).chain(self.scoped_variables(state, false));
        around.chain(self.parameters.iter().map(String::as_str)).map(str::to_owned).collect()
    }

    /// The scoped variables of the states around one, innermost first.
    pub(crate) fn scoped_variables(&self, state: StateId, inside: bool) -> impl Iterator<Item = &str> {
        let around = inside.then_some(state).into_iter().chain(self.outline.containers(state));
        around.flat_map(|id| {
            let declared = self.outline.step(id).body.get("variables");
            declared.into_iter().flat_map(|node| node.entries()).map(|entry| entry.key.as_str())
        })
    }
}

impl NamesFrom<'_, '_> {
    fn find(&self, from: StateId, name: &str) -> Option<StateId> {
        let outline = &self.task.outline;
        let named = |id: &&StateId| outline.step(**id).name == name;
        let children = outline.step(from).form.first_branch();
        if self.view.inside
            && let Some(found) = children.iter().find(named)
        {
            return Some(*found);
        }
        let siblings = outline.around(from).find_map(|id| outline.siblings(id).iter().find(named).copied());
        siblings.or_else(|| {
            let at = outline.steps.iter().skip(1).position(|step| step.name == name)?;
            Some(StateId(at as u64 + 1))
        })
    }
}

impl Names for NamesFrom<'_, '_> {
    fn variable(&mut self, name: &str) -> Result<Expr, NameError> {
        if let Some(action) = &self.view.action {
            return action.input(name);
        }
        let mut known: Vec<&str> = self.view.variables.iter().map(String::as_str).collect();
        known.extend(self.view.state.iter().flat_map(|state| self.task.loop_variables(*state)));
        if let Some(state) = self.view.state {
            if self.view.inside
                && let Form::While { index: Some(index), .. } = &self.task.outline.step(state).form
            {
                known.push(index);
            }
            known.extend(self.task.scoped_variables(state, self.view.inside));
        }
        known.extend(self.task.parameters.iter().map(String::as_str));
        if known.contains(&name) {
            return Ok(Expr::Variable(name.to_owned()));
        }
        Err(NameError {
            rule: "unknown-variable",
            message: format!("there is no variable `${name}` here"),
            help: suggestion(
                name,
                known.into_iter(),
                "$",
                "declare it under `parameters` or `variables`, or bind it in a loop",
            ),
        })
    }

    fn word(&mut self, word: &str) -> Option<Expr> {
        if let Some(action) = self.view.action.as_ref().filter(|_| self.view.own_outputs) {
            return action.output(word);
        }
        let own = &self.task.ports[self.view.state?.0 as usize];
        (self.view.own_outputs && own.types.contains_key(word)).then(|| Expr::Output(word.to_owned()))
    }

    fn port(&mut self, state: &str, port: &str) -> Result<Expr, NameError> {
        if self.view.action.is_some() {
            return Err(no_states(state, port));
        }
        let Some(from) = self.view.state else {
            return Err(NameError {
                rule: "unknown-state",
                message: format!("`{state}.{port}` is the output of a state, and none has run yet"),
                help: "only constants and parameters can be used here; quote a text that contains a point".to_owned(),
            });
        };
        let Some(id) = self.find(from, state) else {
            let names = self.task.outline.steps.iter().skip(1).map(|step| step.name.as_str());
            return Err(NameError {
                rule: "unknown-state",
                message: format!("there is no state `{state}`"),
                help: suggestion(state, names, "", "name a state of this task, or quote a text that contains a point"),
            });
        };
        let ports = &self.task.ports[id.0 as usize];
        if port == OUTCOME && self.task.outline.is_region(id) {
            return Ok(Expr::Port { state: id, port: port.to_owned() });
        }
        if !ports.open && !ports.types.contains_key(port) {
            let none = match self.task.outline.step(id).form {
                Form::Action { .. } => "its action has no outputs",
                Form::Wait { .. } => "a wait for a signal has the output `value`, a question `answer`",
                Form::Sequence { .. } | Form::Concurrency { .. } => "declare it under the state's `outputs`",
                Form::Library { .. } => "declare it under the `outputs` of the library",
                _ => "loops and conditions have no outputs",
            };
            return Err(NameError {
                rule: "unknown-port",
                message: format!("state `{state}` has no output port `{port}`"),
                help: suggestion(port, ports.types.keys().map(String::as_str), "", none),
            });
        }
        if self.view.own_outputs && id == from {
            return Ok(Expr::Output(port.to_owned()));
        }
        Ok(Expr::Port { state: id, port: port.to_owned() })
    }

    fn has_function(&self, name: &str) -> bool {
        self.view.action.is_none() && self.task.functions.has(name)
    }

    fn call(&mut self, name: &str, arguments: Vec<Expr>) -> Result<Expr, NameError> {
        self.task.functions.call(name, &arguments)
    }
}

/// For a name that is none of those that are known: "did you mean" the nearest, or what there is, or `otherwise`. `prefix` stands before
/// each name.
pub fn suggestion<'n>(name: &str, known: impl Iterator<Item = &'n str>, prefix: &str, otherwise: &str) -> String {
    /// More names than this are not listed.
    const MAX_LISTED: usize = 15;
    let mut known: Vec<&str> = known.collect();
    known.sort_unstable();
    known.dedup();
    let near = known.iter().map(|other| (distance(name, other), other)).min();
    if let Some((d, other)) = near
        && d <= 1 + name.len() / 4
    {
        return format!("did you mean `{prefix}{other}`?");
    }
    if known.is_empty() || known.len() > MAX_LISTED {
        return otherwise.to_owned();
    }
    let listed: Vec<String> = known.iter().map(|other| format!("`{prefix}{other}`")).collect();
    format!("there is {}", listed.join(", "))
}

/// Edits (insert, delete, replace) from one name to the other; names beyond a sane length count as far apart.
pub(crate) fn distance(a: &str, b: &str) -> usize {
    const MAX_LENGTH: usize = 64;
    if a.len().max(b.len()) > MAX_LENGTH {
        return MAX_LENGTH;
    }
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, x) in a.bytes().enumerate() {
        let mut diagonal = row[0];
        row[0] = i + 1;
        for (j, y) in b.bytes().enumerate() {
            let replaced = diagonal + usize::from(x != y);
            diagonal = row[j + 1];
            row[j + 1] = replaced.min(row[j] + 1).min(row[j + 1] + 1);
        }
    }
    row[b.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_near_miss_is_suggested() {
        let known = ["trajectory", "end", "end_pose"];
        assert_eq!(suggestion("trajektory", known.into_iter(), "", ""), "did you mean `trajectory`?");
        assert_eq!(suggestion("x", known.into_iter(), "", ""), "there is `end`, `end_pose`, `trajectory`");
        assert_eq!(suggestion("x", [].into_iter(), "", "declare it"), "declare it");
        assert_eq!(distance("kitten", "sitting"), 3);
    }
}
