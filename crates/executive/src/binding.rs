//! Evaluating a state's expressions in a scope: inputs, requirements, preconditions.

use ratn_model::expression::{EvaluateError, Expr, Given, Lookup, Scope};
use ratn_model::fact::{FactKey, FactPattern, Footprint};
use ratn_model::id::StateId;
use ratn_model::program::{ResourceExpr, State};
use ratn_model::resource::Requirement;
use ratn_model::value::Value;
use ratn_world::world::World;
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fmt;

/// Output ports of one instance.
pub(crate) type Outputs = BTreeMap<String, Value>;

/// Where an instance's variables and other states' outputs are found.
pub(crate) trait Names {
    /// `$name`
    fn variable(&self, name: &str) -> Option<Cow<'_, Value>>;
    /// `state.port`
    fn port(&self, state: StateId, port: &str) -> Option<Cow<'_, Value>>;
    /// Whether `state.port` has a value.
    fn given(&self, state: StateId, port: &str) -> Given;
}

/// The scope of one instance at its place in the program.
pub(crate) struct Bindings<'a> {
    /// Variables and ports.
    pub(crate) names: &'a dyn Names,
    /// The instance's own outputs, once finished.
    pub(crate) outputs: Option<&'a Outputs>,
    /// The world at its place.
    pub(crate) world: &'a World,
    /// The facts of that world that are not known yet.
    pub(crate) unknown: &'a Footprint,
}

impl Scope for Bindings<'_> {
    fn variable(&self, name: &str) -> Option<Cow<'_, Value>> {
        self.names.variable(name)
    }

    fn output(&self, name: &str) -> Option<Cow<'_, Value>> {
        self.outputs?.get(name).map(Cow::Borrowed)
    }

    fn port(&self, state: StateId, port: &str) -> Option<Cow<'_, Value>> {
        self.names.port(state, port)
    }

    fn given(&self, state: StateId, port: &str) -> Given {
        self.names.given(state, port)
    }

    fn fact(&self, pattern: &FactPattern) -> Lookup<'_> {
        if self.unknown.overlaps(&Footprint::Patterns(vec![pattern.clone()])) {
            return Lookup::Unknown;
        }
        match self.world.matching(pattern).next() {
            Some((_, fact)) => Lookup::Holds(Cow::Owned(fact.value.clone())),
            None => Lookup::Absent,
        }
    }

    fn each_fact(&self, pattern: &FactPattern, visit: &mut dyn FnMut(&FactKey, &Value) -> bool) -> bool {
        if self.unknown.overlaps(&Footprint::Patterns(vec![pattern.clone()])) {
            return false;
        }
        self.world.each_fact(pattern, visit);
        true
    }
}

/// Error: an expression of a state has no value. It names the part of the state.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{part} of {path}")]
pub(crate) struct BindError {
    part: String,
    path: String,
    /// The expression's own error.
    #[source]
    pub(crate) source: EvaluateError,
}

impl BindError {
    /// Names the part of the state.
    pub(crate) fn at(part: impl fmt::Display, state: &State) -> impl FnOnce(EvaluateError) -> BindError {
        move |source| BindError { part: part.to_string(), path: state.path.clone(), source }
    }

    /// The error and its cause on one line, as an outcome's reason.
    pub(crate) fn reason(&self) -> String {
        format!("{self}: {}", self.source)
    }
}

/// The input ports of an action. An input that is null is left out: an optional port not given.
pub(crate) fn inputs(state: &State, inputs: &[(String, Expr)], scope: &dyn Scope) -> Result<Outputs, BindError> {
    let mut bound = BTreeMap::new();
    for (port, expression) in inputs {
        match expression.evaluate(scope).map_err(BindError::at(format_args!("input `{port}`"), state))? {
            Value::Null => {}
            value => {
                bound.insert(port.clone(), value);
            }
        }
    }
    Ok(bound)
}

/// The requirements of a state, evaluated.
pub(crate) fn requirements(
    state: &State,
    wanted: &[ResourceExpr],
    scope: &dyn Scope,
) -> Result<Vec<Requirement>, BindError> {
    wanted.iter().map(|r| r.bind(scope).map_err(BindError::at(format_args!("resource `{}`", r.kind), state))).collect()
}

/// The first precondition (`requires`) that does not hold, as a reason; `Ok(None)` when all hold.
pub(crate) fn unmet(state: &State, scope: &dyn Scope) -> Result<Option<String>, BindError> {
    for requirement in &state.annotations.requires {
        if !requirement.holds(scope).map_err(BindError::at("`requires`", state))? {
            return Ok(Some(format!("the precondition `{requirement}` of {} does not hold", state.path)));
        }
    }
    Ok(None)
}

/// The first `while` condition that does not hold, as a reason; `Ok(None)` when all hold.
pub(crate) fn violated(state: &State, scope: &dyn Scope) -> Result<Option<String>, BindError> {
    not_holding(&state.annotations.holds, scope).map_err(BindError::at("`while`", state))
}

/// The first condition that does not hold, as a sentence.
pub(crate) fn not_holding<'e>(
    conditions: impl IntoIterator<Item = &'e Expr>,
    scope: &dyn Scope,
) -> Result<Option<String>, EvaluateError> {
    for condition in conditions {
        if !condition.holds(scope)? {
            return Ok(Some(format!("`{condition}` does not hold")));
        }
    }
    Ok(None)
}

/// The first declared output port that is missing, or has a value of another type, as a reason.
pub(crate) fn missing_output(
    declared: &BTreeMap<String, ratn_model::value::Type>,
    outputs: &Outputs,
) -> Option<String> {
    declared.iter().find_map(|(port, ty)| match outputs.get(port) {
        None => Some(format!("it did not write its output `{port}`")),
        Some(value) if !ty.accepts(value) => {
            Some(format!("its output `{port}` is of type {}, not {ty}", value.type_name()))
        }
        Some(_) => None,
    })
}

/// The declared estimate of a state's duration, in seconds; `None` if there is none, or its value is not known yet.
pub(crate) fn expected_s(state: &State, scope: &dyn Scope) -> Option<f64> {
    let seconds = state.annotations.duration_s.as_ref()?.evaluate(scope).ok()?.as_number()?;
    (seconds.is_finite() && seconds >= 0.0).then_some(seconds)
}

/// A random seed for one try of one visit, the same in every mode and on every host: FNV-1a over the run's seed, the parts
/// of the path, and, from the second try on, the number of the try.
pub(crate) struct Seed(u64);

impl Seed {
    pub(crate) fn of(run: u64) -> Seed {
        let mut seed = Seed(0xcbf2_9ce4_8422_2325);
        seed.add(&run.to_le_bytes());
        seed
    }

    /// Adds the next part of the visit's path.
    pub(crate) fn add(&mut self, bytes: &[u8]) {
        for byte in bytes {
            self.0 = (self.0 ^ u64::from(*byte)).wrapping_mul(0x0000_0100_0000_01b3);
        }
    }

    /// The seed of one try, counted from 1.
    pub(crate) fn of_try(mut self, number: u32) -> u64 {
        if number > 1 {
            self.add(&number.to_le_bytes());
        }
        self.0
    }
}

/// The path of a child below its parent's.
pub(crate) fn child_path(parent: &str, name: &str) -> String {
    if parent.is_empty() { name.to_owned() } else { format!("{parent}/{name}") }
}
