//! What an action says of itself: its ports with their types and defaults, its outcomes, and what states that perform it may say.

use ratn_model::catalogue::{ActionSignature, DescriptionError};
use ratn_model::value::{Type, Value};
use ratn_proto::types::GoalOutcome;
use std::collections::BTreeMap;

/// The ports of an action, built from code: `Signature::new().input("from", Type::Pose).output("object", Type::String)`.
///
/// A goal whose inputs do not fit it ends `aborted` before the action sees it, with the action and the port in the reason; so does a goal of
/// which the action writes other outputs with success. An optional input with a default is always there.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Signature {
    said: ActionSignature,
    defaults: BTreeMap<String, Value>,
}

/// A goal that does not fit what its action says of itself.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SignatureError {
    /// A required input is not there.
    #[error("input `{port}` of `{action}` is missing: expected {expected}")]
    MissingInput {
        /// The action.
        action: String,
        /// The input.
        port: String,
        /// Its type.
        expected: Type,
    },
    /// An input is something else.
    #[error("input `{port}` of `{action}` is a {found}: expected {expected}")]
    InputType {
        /// The action.
        action: String,
        /// The input.
        port: String,
        /// Its type.
        expected: Type,
        /// What it is.
        found: &'static str,
    },
    /// An input that the action does not have.
    #[error("`{action}` has no input `{port}`; it has {known}")]
    UnknownInput {
        /// The action.
        action: String,
        /// The input.
        port: String,
        /// Those that it has.
        known: String,
    },
    /// An output was not written, or as something else.
    #[error("`{action}` ended with success, and its output `{port}` is {found}: expected {expected}")]
    Output {
        /// The action.
        action: String,
        /// The output.
        port: String,
        /// Its type.
        expected: Type,
        /// What it is.
        found: &'static str,
    },
}

impl Signature {
    /// Without ports.
    pub fn new() -> Signature {
        Signature::default()
    }

    /// With an input that every goal has.
    #[must_use]
    pub fn input(mut self, name: &str, of_type: Type) -> Signature {
        self.said.inputs.insert(name.to_owned(), of_type);
        self
    }

    /// With an input that a goal may have.
    #[must_use]
    pub fn optional(mut self, name: &str, of_type: Type) -> Signature {
        self.said.optional.insert(name.to_owned(), of_type);
        self
    }

    /// With an input that is this where a goal does not have it.
    #[must_use]
    pub fn with_default(mut self, name: &str, of_type: Type, value: Value) -> Signature {
        self.said.defaults.insert(name.to_owned(), value.to_string());
        self.defaults.insert(name.to_owned(), value);
        self.optional(name, of_type)
    }

    /// With an output that is written with success.
    #[must_use]
    pub fn output(mut self, name: &str, of_type: Type) -> Signature {
        self.said.outputs.insert(name.to_owned(), of_type);
        self
    }

    /// With an outcome besides `success`, `aborted` and `preempted`.
    #[must_use]
    pub fn outcome(mut self, name: &str) -> Signature {
        self.said.outcomes.push(name.to_owned());
        self
    }

    /// A state that performs it may say `computes: true`: it reads its projection and changes nothing.
    #[must_use]
    pub fn computes(mut self) -> Signature {
        self.said.annotations.computes = true;
        self
    }

    /// A state that performs it reads facts of this pattern, `at(?)`.
    #[must_use]
    pub fn reads(mut self, pattern: &str) -> Signature {
        self.said.annotations.reads.push(pattern.to_owned());
        self
    }

    /// A state that performs it senses facts of this pattern.
    #[must_use]
    pub fn senses(mut self, pattern: &str) -> Signature {
        self.said.annotations.senses.push(pattern.to_owned());
        self
    }

    /// A state that performs it requires this.
    #[must_use]
    pub fn requires(mut self, condition: &str) -> Signature {
        self.said.annotations.requires.push(condition.to_owned());
        self
    }

    /// A state that performs it makes this true.
    #[must_use]
    pub fn effect(mut self, effect: &str) -> Signature {
        self.said.annotations.effects.push(effect.to_owned());
        self
    }

    /// Whether every default is of its port's type.
    ///
    /// # Errors
    /// [`DescriptionError::Default`] of the first that is not.
    pub fn check_defaults(&self, action: &str) -> Result<(), DescriptionError> {
        let wrong = |(port, value): (&String, &Value)| {
            let expected = self.said.optional.get(port)?;
            let fits = *value == Value::Null || expected.accepts(value);
            (!fits).then(|| DescriptionError::default_of(action, port, &value.to_string(), expected))
        };
        self.defaults.iter().find_map(wrong).map_or(Ok(()), Err)
    }

    /// What it says, for a catalogue.
    pub fn said(&self) -> &ActionSignature {
        &self.said
    }

    /// Puts in what the inputs of a goal lack and have a default, and looks whether they fit.
    ///
    /// # Errors
    /// [`SignatureError`] of the first that does not.
    pub fn complete(&self, action: &str, inputs: &mut BTreeMap<String, Value>) -> Result<(), SignatureError> {
        let (action, ActionSignature { inputs: required, optional, .. }) = (|| action.to_owned(), &self.said);
        for (port, value) in &*inputs {
            let Some(expected) = required.get(port).or_else(|| optional.get(port)) else {
                let known = required.keys().chain(optional.keys()).map(String::as_str).collect::<Vec<_>>();
                let known = if known.is_empty() { "none".to_owned() } else { known.join(", ") };
                return Err(SignatureError::UnknownInput { action: action(), port: port.clone(), known });
            };
            if *value != Value::Null && !expected.accepts(value) {
                let (expected, found) = (expected.clone(), value.type_name());
                return Err(SignatureError::InputType { action: action(), port: port.clone(), expected, found });
            }
        }
        let lacks = |(port, expected): &(&String, &Type)| match inputs.get(*port) {
            Some(Value::Null) => **expected != Type::Any,
            given => given.is_none(),
        };
        let lacking = required.iter().find(lacks);
        if let Some((port, expected)) = lacking {
            let (port, expected) = (port.clone(), expected.clone());
            return Err(SignatureError::MissingInput { action: action(), port, expected });
        }
        for (port, value) in &self.defaults {
            let given = inputs.entry(port.clone()).or_insert(Value::Null);
            if *given == Value::Null {
                given.clone_from(value);
            }
        }
        Ok(())
    }

    /// Whether what came of a goal is what the action says.
    ///
    /// # Errors
    /// [`SignatureError`] of the first output that is not.
    pub fn check(&self, action: &str, outcome: &GoalOutcome) -> Result<(), SignatureError> {
        let wrong = |(port, expected): (&String, &Type)| {
            let written = outcome.outputs.get(port);
            let found = match written {
                Some(value) if expected.accepts(value) => return None,
                Some(value) => value.type_name(),
                None => "missing",
            };
            let (action, port, expected) = (action.to_owned(), port.clone(), expected.clone());
            Some(SignatureError::Output { action, port, expected, found })
        };
        let wrong = if outcome.is_success() { self.said.outputs.iter().find_map(wrong) } else { None };
        wrong.map_or(Ok(()), Err)
    }
}
