//! Scopes: where the names of an expression get their values.
//!
//! Values are borrowed from the scope where possible: using a field of an element of a long list does not copy the list.

use crate::fact::{FactKey, FactPattern};
use crate::id::StateId;
use crate::value::Value;
use std::borrow::Cow;
use std::cell::Cell;
use std::collections::BTreeMap;

/// Gives names their values. `None` and [`Lookup::Unknown`] mean not known *yet*: a scope never guesses. By default it asks the
/// scope around it.
pub trait Scope {
    /// The scope around this one, if there is one.
    fn outer(&self) -> Option<&dyn Scope> {
        None
    }
    /// `$name`: a loop variable or a task parameter.
    fn variable(&self, name: &str) -> Option<Cow<'_, Value>> {
        self.outer()?.variable(name)
    }
    /// An output of the state itself (only its effects may name it).
    fn output(&self, name: &str) -> Option<Cow<'_, Value>> {
        self.outer()?.output(name)
    }
    /// An output of another state.
    fn port(&self, state: StateId, port: &str) -> Option<Cow<'_, Value>> {
        self.outer()?.port(state, port)
    }
    /// Whether an output of another state exists, and why.
    fn given(&self, state: StateId, port: &str) -> Given {
        self.outer().map_or(Given::NotYetKnown, |outer| outer.given(state, port))
    }
    /// The first fact that matches, in the order of keys.
    fn fact(&self, pattern: &FactPattern) -> Lookup<'_> {
        self.outer().map_or(Lookup::Unknown, |outer| outer.fact(pattern))
    }
    /// Visits the facts that match, in the order of keys, and possibly others, until `visit` returns false. Returns whether they
    /// are known.
    fn each_fact(&self, pattern: &FactPattern, visit: &mut dyn FnMut(&FactKey, &Value) -> bool) -> bool {
        self.outer().is_some_and(|outer| outer.each_fact(pattern, visit))
    }
    /// `?name`: a variable bound by the query around it.
    fn unknown(&self, name: &str) -> Option<Cow<'_, Value>> {
        self.outer()?.unknown(name)
    }
    /// `$name` in the body of a comprehension: the present element.
    fn element(&self, name: &str) -> Option<Cow<'_, Value>> {
        self.outer()?.element(name)
    }
    /// Number of facts that the query around it, with inner queries, may still visit. An element of a comprehension counts as
    /// several.
    fn budget(&self) -> Option<&Cell<u64>> {
        self.outer()?.budget()
    }
}

/// Whether an output exists, or an expression of outputs. An expression has the greatest value among its parts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Given {
    /// It needs no output.
    Always,
    /// A state on the path to this place has written it.
    Written,
    /// No state has written it, and the port has a default.
    Default,
    /// A state on the path to this place may still write it.
    NotYetKnown,
    /// It does not exist and never will.
    Missing,
}

/// The result of looking up a fact.
#[derive(Debug, Clone, PartialEq)]
pub enum Lookup<'a> {
    /// The scope does not know (yet) which facts hold.
    Unknown,
    /// No fact matches.
    Absent,
    /// The value of the first fact that matches.
    Holds(Cow<'a, Value>),
}

/// The scope in which nothing is known.
#[derive(Debug, Clone, Copy, Default)]
pub struct NothingKnown;

impl Scope for NothingKnown {}

/// The scope in which only these variables are known.
impl Scope for BTreeMap<String, Value> {
    fn variable(&self, name: &str) -> Option<Cow<'_, Value>> {
        self.get(name).map(Cow::Borrowed)
    }
}

/// Another scope with one more variable, which hides an outer one of the same name.
pub struct WithVariable<'a> {
    /// The scope around it.
    pub outer: &'a dyn Scope,
    /// The variable.
    pub name: &'a str,
    /// Its value; `None` while it is not known.
    pub value: Option<&'a Value>,
}

impl Scope for WithVariable<'_> {
    fn outer(&self) -> Option<&dyn Scope> {
        Some(self.outer)
    }

    fn variable(&self, name: &str) -> Option<Cow<'_, Value>> {
        if name == self.name { self.value.map(Cow::Borrowed) } else { self.outer.variable(name) }
    }
}

/// Another scope with an element of a comprehension.
pub struct WithElement<'a> {
    /// The scope around it.
    pub outer: &'a dyn Scope,
    /// Its name in the body.
    pub name: &'a str,
    /// Its value.
    pub value: &'a Value,
    /// What remains of the evaluation's budget.
    pub left: &'a Cell<u64>,
}

impl Scope for WithElement<'_> {
    fn outer(&self) -> Option<&dyn Scope> {
        Some(self.outer)
    }

    fn element(&self, name: &str) -> Option<Cow<'_, Value>> {
        if name == self.name { Some(Cow::Borrowed(self.value)) } else { self.outer.element(name) }
    }

    fn budget(&self) -> Option<&Cell<u64>> {
        Some(self.left)
    }
}
