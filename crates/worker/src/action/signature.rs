//! The signature of an action: its ports with types and defaults, its outcomes, and the annotations that a state which performs it may have.

use ratn_model::catalogue::{ActionSignature, Catalogue, DescriptionError};
use ratn_model::value::{Type, Value};
use ratn_proto::types::GoalOutcome;
use std::collections::BTreeMap;
use std::sync::LazyLock;

/// The ports of an action, built from code: `Signature::new().input("from", Type::Pose).output("object", Type::String)`.
///
/// A goal whose inputs do not fit the signature ends `aborted` before the action is called; the reason names action and port. A goal whose
/// action succeeds with other outputs than the signature has ends `aborted`, too. An optional input with a default is always there.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Signature {
    said: ActionSignature,
    defaults: BTreeMap<String, Value>,
}

/// Why a goal does not fit the signature of its action.
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
    /// An input is of another type.
    #[error("input `{port}` of `{action}` is a {found}: expected {expected}")]
    InputType {
        /// The action.
        action: String,
        /// The input.
        port: String,
        /// Its type.
        expected: Type,
        /// The type of the value.
        found: &'static str,
    },
    /// An input that the action does not have.
    #[error("`{action}` has no input `{port}`; it has {known}")]
    UnknownInput {
        /// The action.
        action: String,
        /// The input.
        port: String,
        /// The inputs that it has.
        known: String,
    },
    /// An output was not written, or is of another type.
    #[error("`{action}` ended with success, and its output `{port}` is {found}: expected {expected}")]
    Output {
        /// The action.
        action: String,
        /// The output.
        port: String,
        /// Its type.
        expected: Type,
        /// The type of the value.
        found: &'static str,
    },
}

impl Signature {
    /// Without ports.
    pub fn new() -> Signature {
        Signature::default()
    }

    /// The signature of an action that resources of this kind perform in the bundled system, from its catalogue (`deploy/catalogue.toml`);
    /// `None` if the catalogue has no such action.
    pub fn bundled(kind: &str, action: &str) -> Option<Signature> {
        static STANDARD: LazyLock<Catalogue> = LazyLock::new(Catalogue::standard);
        let provider = STANDARD.providers.values().find(|provider| provider.resource == kind)?;
        let said = provider.actions.get(action)?.clone();
        Some(Signature { said, defaults: BTreeMap::new() })
    }

    /// Adds an input that every goal must have.
    #[must_use]
    pub fn input(mut self, name: &str, of_type: Type) -> Signature {
        self.said.inputs.insert(name.to_owned(), of_type);
        self
    }

    /// Adds an input that a goal may leave out.
    #[must_use]
    pub fn optional(mut self, name: &str, of_type: Type) -> Signature {
        self.said.optional.insert(name.to_owned(), of_type);
        self
    }

    /// Adds an input with a default: `value` where a goal leaves it out.
    #[must_use]
    pub fn with_default(mut self, name: &str, of_type: Type, value: Value) -> Signature {
        self.said.defaults.insert(name.to_owned(), value.to_string());
        self.defaults.insert(name.to_owned(), value);
        self.optional(name, of_type)
    }

    /// Adds an output, which the action writes with `success`.
    #[must_use]
    pub fn output(mut self, name: &str, of_type: Type) -> Signature {
        self.said.outputs.insert(name.to_owned(), of_type);
        self
    }

    /// Adds an outcome beside `success`, `aborted` and `preempted`.
    #[must_use]
    pub fn outcome(mut self, name: &str) -> Signature {
        self.said.outcomes.push(name.to_owned());
        self
    }

    /// The action reads its projection and changes nothing. This annotation and the following ones hold for every state with this action,
    /// unless the state itself says otherwise. Texts are expressions of task files: `$port` is the value that the state gives an input, a
    /// bare word in an effect is an output.
    #[must_use]
    pub fn computes(mut self) -> Signature {
        self.said.annotations.computes = true;
        self
    }

    /// The action reads the facts of this pattern, for example `at(?)`, and no facts beyond the patterns named this way.
    #[must_use]
    pub fn reads(mut self, pattern: &str) -> Signature {
        self.said.annotations.reads.get_or_insert_default().push(pattern.to_owned());
        self
    }

    /// The action reads no facts.
    #[must_use]
    pub fn reads_nothing(mut self) -> Signature {
        self.said.annotations.reads = Some(Vec::new());
        self
    }

    /// The action senses the facts of this pattern.
    #[must_use]
    pub fn senses(mut self, pattern: &str) -> Signature {
        self.said.annotations.senses.push(pattern.to_owned());
        self
    }

    /// The action requires this condition, for example `hand_empty(gripper)`.
    #[must_use]
    pub fn requires(mut self, condition: &str) -> Signature {
        self.said.annotations.requires.push(condition.to_owned());
        self
    }

    /// The action has this effect on success, for example `not hand_empty(gripper)`, and no effects beyond those named this way.
    #[must_use]
    pub fn effect(mut self, effect: &str) -> Signature {
        self.said.annotations.effects.get_or_insert_default().push(effect.to_owned());
        self
    }

    /// The action changes no facts.
    #[must_use]
    pub fn changes_nothing(mut self) -> Signature {
        self.said.annotations.effects = Some(Vec::new());
        self
    }

    /// The action blocks one resource of this kind; the worker's own kind has to be named, too.
    #[must_use]
    pub fn blocks(mut self, kind: &str) -> Signature {
        self.said.annotations.resources.push(kind.to_owned());
        self
    }

    /// How long the action usually takes, in seconds: an expression of its inputs.
    #[must_use]
    pub fn takes(mut self, duration: &str) -> Signature {
        self.said.annotations.duration = Some(duration.to_owned());
        self
    }

    /// The action is an anytime algorithm: it gives a first result and better ones later, if its goal allows that
    /// ([`super::GoalContext::improved`]). A task must have the same meaning with any of the results. Only for actions that compute or
    /// sense.
    #[must_use]
    pub fn anytime(mut self) -> Signature {
        self.said.annotations.anytime = true;
        self
    }

    /// Checks that every default is of its port's type.
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

    /// The signature in the form of a catalogue.
    pub fn said(&self) -> &ActionSignature {
        &self.said
    }

    /// Adds the defaults of inputs that a goal leaves out, and checks all inputs.
    ///
    /// # Errors
    /// [`SignatureError`] of the first input that does not fit.
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

    /// Checks the outputs of a goal that ended with success.
    ///
    /// # Errors
    /// [`SignatureError`] of the first output that does not fit.
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
