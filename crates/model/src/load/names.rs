//! Resolves names from the point of view of one state: variables of the loops around it, parameters, outputs of other states.
//!
//! A state's name is looked up among the siblings of this state and of those around it, from inside out; then anywhere. Whether the
//! state found can have written its port by then is a rule of `check`.

use super::functions::Functions;
use super::outline::{Form, Outline};
use crate::catalogue::{Catalogue, no_states};
use crate::expression::parse::{NameError, Names};
use crate::expression::{Expr, Function};
use crate::id::StateId;
use crate::ontology::Ontology;
use crate::program::Program;
use crate::value::Type;
use std::collections::{BTreeMap, BTreeSet};
use std::rc::Rc;

/// The port of a region with its outcome.
const OUTCOME: &str = "outcome";

/// The output ports of a state.
#[derive(Debug, Clone, Default)]
pub(crate) struct Ports {
    pub(crate) types: BTreeMap<String, Type>,
    /// Whether the action is unknown, so that any port may exist.
    pub(crate) open: bool,
}

/// Everything known of a task before its expressions are read.
pub(crate) struct Task<'a> {
    pub(crate) source: &'a str,
    pub(crate) catalogue: &'a Catalogue,
    pub(crate) outline: Outline<'a>,
    /// By [`StateId`].
    pub(crate) ports: Vec<Ports>,
    pub(crate) parameters: Vec<String>,
    /// The loaded libraries, by the state that uses them.
    pub(crate) libraries: BTreeMap<StateId, Program>,
    /// The file's own functions.
    pub(crate) functions: Functions,
    /// The ontology of its facts; `None` allows all facts.
    pub(crate) ontology: Option<Ontology>,
}

/// Determines the names that an expression sees.
#[derive(Debug, Clone, Default)]
pub(crate) struct View {
    /// The state; with `None` only parameters are visible.
    pub(crate) state: Option<StateId>,
    /// Whether the state's children and its scoped variables are visible (outputs of a hierarchy).
    pub(crate) inside: bool,
    /// Which of a loop's own variables are visible, inside of the loop.
    pub(crate) of_loop: OfLoop,
    /// Whether a bare word may be an output of the state itself (in its effects).
    pub(crate) own_outputs: bool,
    /// Further variables, of quantified effects.
    pub(crate) variables: Vec<String>,
    /// Set while an annotation of the state's action is read: only the action's ports are visible.
    pub(crate) action: Option<Rc<super::action::Ports>>,
}

/// Which variables of a loop an expression of the loop sees.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) enum OfLoop {
    /// The iteration number, between two iterations.
    #[default]
    Number,
    /// All of them, at the end of an iteration.
    All,
    /// None, at the end of the loop.
    Nothing,
}

/// The names that one expression of a task sees.
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

    /// Every variable in scope at a state.
    pub(crate) fn in_sight(&self, state: StateId) -> BTreeSet<String> {
        let around = self.loop_variables(state).chain(self.scoped_variables(state, false));
        around.chain(self.parameters.iter().map(String::as_str)).map(str::to_owned).collect()
    }

    /// The scoped variables of the states around a state, innermost first.
    pub(crate) fn scoped_variables(&self, state: StateId, inside: bool) -> impl Iterator<Item = &str> {
        let around = inside.then_some(state).into_iter().chain(self.outline.containers(state));
        around.flat_map(|id| {
            let declared = self.outline.step(id).body.get("variables");
            declared.into_iter().flat_map(|node| node.entries()).map(|entry| entry.key.as_str())
        })
    }
}

impl NamesFrom<'_, '_> {
    /// The states with a name inside of a state: in a condition one per branch, and per case of a `switch`.
    fn inside(&self, around: StateId, name: &str) -> Vec<StateId> {
        let outline = &self.task.outline;
        let named = |id: &&StateId| outline.step(**id).name == name;
        let form = &outline.step(around).form;
        let mut found: Vec<StateId> = form.first_branch().iter().find(named).copied().into_iter().collect();
        if let Form::Condition { otherwise, .. } = form {
            found.extend(otherwise.iter().find(named));
            let next = otherwise.iter().filter(|id| outline.step(**id).is_next_case(otherwise));
            found.extend(next.flat_map(|id| self.inside(*id, name)));
        }
        found
    }

    fn find(&self, from: StateId, name: &str) -> Option<StateId> {
        let outline = &self.task.outline;
        let named = |id: &&StateId| outline.step(**id).name == name;
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
            if self.view.inside {
                let all = self.view.of_loop == OfLoop::All;
                let bound = match &self.task.outline.step(state).form {
                    Form::While { index, .. } if self.view.of_loop != OfLoop::Nothing => [index.as_deref(), None],
                    Form::ForEach { variable, index, .. } if all => [Some(variable.as_str()), index.as_deref()],
                    _ => [None, None],
                };
                known.extend(bound.into_iter().flatten());
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
        let inside = if self.view.inside { self.inside(from, state) } else { Vec::new() };
        if let [_, _, ..] = inside.as_slice() {
            let ways = inside.iter().map(|id| self.port_of(from, *id, port)).collect::<Result<Vec<_>, _>>()?;
            return Ok(Expr::Call(Function::Either, ways));
        }
        let Some(id) = inside.first().copied().or_else(|| self.find(from, state)) else {
            let names = self.task.outline.steps.iter().skip(1).map(|step| step.name.as_str());
            return Err(NameError {
                rule: "unknown-state",
                message: format!("there is no state `{state}`"),
                help: suggestion(state, names, "", "name a state of this task, or quote a text that contains a point"),
            });
        };
        self.port_of(from, id, port)
    }

    fn has_function(&self, name: &str) -> bool {
        self.view.action.is_none() && self.task.functions.has(name)
    }

    fn call(&mut self, name: &str, arguments: Vec<Expr>) -> Result<Expr, NameError> {
        self.task.functions.call(name, &arguments)
    }
}

impl NamesFrom<'_, '_> {
    /// A port of the state that was found.
    fn port_of(&self, from: StateId, id: StateId, port: &str) -> Result<Expr, NameError> {
        let ports = &self.task.ports[id.0 as usize];
        let state = &self.task.outline.step(id).name;
        if port == OUTCOME && self.task.outline.is_region(id) {
            return Ok(Expr::Port { state: id, port: port.to_owned() });
        }
        if !ports.open && !ports.types.contains_key(port) {
            let none = match self.task.outline.step(id).form {
                Form::Action { .. } => "its action has no outputs",
                Form::Wait { .. } => "a wait for a signal has the output `value`, a question `answer`",
                Form::Library { .. } => "declare it under the `outputs` of the library",
                _ => "declare it under the state's `outputs`",
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
}

/// Advice for an unknown name: "did you mean" the nearest known name, or a list of the known ones, or `otherwise`. `prefix` is put
/// before each name.
pub fn suggestion<'n>(name: &str, known: impl Iterator<Item = &'n str>, prefix: &str, otherwise: &str) -> String {
    /// Limit of listed names.
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

/// Edit distance (insert, delete, replace) of two names; very long names count as far apart.
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
