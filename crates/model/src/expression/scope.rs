//! Where the names of an expression get their values.
//!
//! Values are borrowed where the scope has them: a field of an element of a long list costs no copy of the list.

use crate::fact::{FactKey, FactPattern};
use crate::id::StateId;
use crate::value::Value;
use std::borrow::Cow;
use std::cell::Cell;
use std::collections::BTreeMap;

/// Gives names their values. `None` and [`Lookup::Unknown`] mean not known *yet*: a scope never guesses. What a scope does not say
/// itself is what the scope around it says.
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
    /// Whether an output of another state is there, and why.
    fn given(&self, state: StateId, port: &str) -> Given {
        self.outer().map_or(Given::NotYetKnown, |outer| outer.given(state, port))
    }
    /// The first fact that matches, in the order of keys.
    fn fact(&self, pattern: &FactPattern) -> Lookup<'_> {
        self.outer().map_or(Lookup::Unknown, |outer| outer.fact(pattern))
    }
    /// Visits the facts that match, in the order of keys, until told to stop; others may be among them. Whether they are known.
    fn each_fact(&self, pattern: &FactPattern, visit: &mut dyn FnMut(&FactKey, &Value) -> bool) -> bool {
        self.outer().is_some_and(|outer| outer.each_fact(pattern, visit))
    }
    /// `?name`: what a query around has bound.
    fn unknown(&self, name: &str) -> Option<Cow<'_, Value>> {
        self.outer()?.unknown(name)
    }
    /// `$name` in the body of a comprehension: the element that it is evaluated for.
    fn element(&self, name: &str) -> Option<Cow<'_, Value>> {
        self.outer()?.element(name)
    }
    /// How many facts the query around may still look at, with those within it. An element of a comprehension counts as several.
    fn budget(&self) -> Option<&Cell<u64>> {
        self.outer()?.budget()
    }
}

/// Whether an output, or what is made of outputs, is there. What is made of several is as the greatest of them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Given {
    /// It needs no output.
    Always,
    /// A state on the way to here has written it.
    Written,
    /// No state has, and the port has a default.
    Default,
    /// A state on the way to here may still write it.
    NotYetKnown,
    /// It is not there, and never will be.
    Missing,
}

/// What a scope knows of a fact.
#[derive(Debug, Clone, PartialEq)]
pub enum Lookup<'a> {
    /// The scope does not know (yet) which facts hold.
    Unknown,
    /// No fact matches.
    Absent,
    /// The value of the first that matches.
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

/// Another scope with one variable more, which hides one of the same name.
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
    /// What the evaluation may still look at.
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
