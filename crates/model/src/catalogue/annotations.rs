//! Annotations of an action: they hold for every state that performs it, so that they need not be repeated in every state.
//!
//! Each text is an expression as in task files. `$port` is the expression that the state gives to an input; a bare word is an output of the action.
//! A state's own annotation under the same key takes precedence. How a state gets these annotations: `load/action.rs`.

use super::ActionSignature;
use crate::expression::Expr;
use crate::expression::parse::{NameError, Names, ParseError, parse_effect, parse_expression, parse_fact};
use crate::load::suggestion;
use serde::{Deserialize, Deserializer, Serialize};
use std::collections::BTreeMap;

/// The annotations; see the module. What is missing has the same default as in a task file: the state may read and change everything.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Annotations {
    /// Whether it works on a projection and changes nothing.
    pub computes: bool,
    /// Patterns of the facts that it reads, `scene` for those of the geometry; an empty list: none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reads: Option<Vec<String>>,
    /// Patterns of the facts that it senses; an empty list: it is no sensing action.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub senses: Vec<String>,
    /// Its preconditions.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub requires: Vec<String>,
    /// Its effects with `success`; an empty list: none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub effects: Option<Vec<String>>,
    /// Predicates whose facts are unknown after any other outcome: the facts that `success` would set are deleted then.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub unknown_after_failure: Vec<String>,
    /// The resource kinds of which it blocks one each, including its provider's; `world_model` is room for a projection.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub resources: Vec<String>,
    /// Its usual duration, in seconds.
    #[serde(skip_serializing_if = "Option::is_none", deserialize_with = "number_or_text")]
    pub duration: Option<String>,
    /// Whether it is anytime: it gives a usable result first, and better ones until it is cancelled; any of them is acceptable. Only for actions
    /// that compute or sense.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub anytime: bool,
    /// By optional input: annotations that replace those above, key by key, if a state gives this input.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub given: BTreeMap<String, Annotations>,
}

/// Error: an annotation cannot be parsed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("`{key}: {text}`: {message}{}{help}", if help.is_empty() { "" } else { "; " })]
pub struct InvalidAnnotation {
    /// Its key.
    pub key: &'static str,
    /// Its text.
    pub text: String,
    /// What is wrong.
    pub message: String,
    /// What to do; may be empty.
    pub help: String,
}

impl Annotations {
    /// Whether there are no annotations.
    pub fn is_empty(&self) -> bool {
        *self == Annotations::default()
    }

    /// The texts, by the key of a task file.
    pub fn lists(&self) -> [(&'static str, &[String]); 7] {
        [
            ("reads", self.reads.as_deref().unwrap_or_default()),
            ("senses", &self.senses),
            ("requires", &self.requires),
            ("effects", self.effects.as_deref().unwrap_or_default()),
            ("unknown_after_failure", &self.unknown_after_failure),
            ("resources", &self.resources),
            ("duration", self.duration.as_slice()),
        ]
    }

    /// These annotations, and those for given inputs.
    pub fn all(&self) -> impl Iterator<Item = &Annotations> {
        std::iter::once(self).chain(self.given.values())
    }

    /// The annotations for a state that gives these inputs.
    pub fn of_inputs(&self, is_given: impl Fn(&str) -> bool) -> Annotations {
        let mut said = Annotations { given: BTreeMap::new(), ..self.clone() };
        for (_, other) in self.given.iter().filter(|(input, _)| is_given(input)) {
            let other = other.clone();
            said.computes |= other.computes;
            said.anytime |= other.anytime;
            said.reads = other.reads.or(said.reads);
            said.effects = other.effects.or(said.effects);
            said.duration = other.duration.or(said.duration);
            for (own, other) in [
                (&mut said.senses, other.senses),
                (&mut said.requires, other.requires),
                (&mut said.unknown_after_failure, other.unknown_after_failure),
                (&mut said.resources, other.resources),
            ] {
                if !other.is_empty() {
                    *own = other;
                }
            }
        }
        said
    }

    /// Checks that every text can be parsed, with the ports of its action.
    ///
    /// # Errors
    /// [`InvalidAnnotation`] for the first text that cannot.
    pub fn check(&self, signature: &ActionSignature) -> Result<(), InvalidAnnotation> {
        let wrong = |key, text: &str, message: &str, help: &str| {
            Err(InvalidAnnotation { key, text: text.to_owned(), message: message.to_owned(), help: help.to_owned() })
        };
        if self.computes && !self.senses.is_empty() {
            return wrong(
                "computes",
                "true",
                "an action computes or senses, and this one says both",
                "keep one of them",
            );
        }
        if self.computes && self.effects.as_ref().is_some_and(|effects| !effects.is_empty()) {
            return wrong("computes", "true", "what only computes has no effects", "leave one of them out");
        }
        if self.anytime && !self.computes && self.senses.is_empty() {
            let message = "only an action that computes or senses can give a better result later: one that moves is real when it ends";
            return wrong("anytime", "true", message, "say `computes` or `senses` too, or leave `anytime` out");
        }
        for (input, other) in &self.given {
            if !signature.optional.contains_key(input) {
                return wrong(
                    "given",
                    input,
                    "the action has no optional input of this name",
                    "name one of its optional inputs",
                );
            }
            if !other.given.is_empty() {
                return wrong("given", input, "a `given` stands within another one", "say it of each input by itself");
            }
            self.of_inputs(|name| name == input).check(signature)?;
        }
        for (key, texts) in self.lists() {
            for text in texts {
                let names = &mut Ports { signature, has_outputs: key == "effects" };
                let read = match key {
                    "reads" if text == "scene" => Ok(()),
                    "reads" | "senses" => parse_fact(text, names).map(drop),
                    "effects" => parse_effect(text, names).map(drop),
                    "resources" if !crate::expression::display::is_word(text) => {
                        return wrong(key, text, "this is no kind of a resource", "write a name such as PathPlanner");
                    }
                    "resources" => Ok(()),
                    "unknown_after_failure" if !crate::expression::display::is_word(text) => {
                        return wrong(key, text, "this is no predicate", "write its name alone, such as arm_at");
                    }
                    "unknown_after_failure" => Ok(()),
                    _ => parse_expression(text, names).map(drop),
                };
                if let Err(ParseError { message, help, .. }) = read {
                    return wrong(key, text, &message, &help);
                }
            }
        }
        Ok(())
    }
}

/// Deserializes a number, or an expression as text.
fn number_or_text<'de, D: Deserializer<'de>>(from: D) -> Result<Option<String>, D::Error> {
    #[derive(Deserialize)]
    #[serde(untagged)]
    enum Said {
        Whole(i64),
        Number(f64),
        Text(String),
    }
    Ok(Some(match Said::deserialize(from)? {
        Said::Whole(seconds) => seconds.to_string(),
        Said::Number(seconds) => format!("{seconds:?}"),
        Said::Text(text) => text,
    }))
}

/// The names in an annotation of an action: its ports.
struct Ports<'s> {
    signature: &'s ActionSignature,
    has_outputs: bool,
}

impl Names for Ports<'_> {
    fn variable(&mut self, name: &str) -> Result<Expr, NameError> {
        match unknown_input(self.signature, name) {
            None => Ok(Expr::Variable(name.to_owned())),
            Some(error) => Err(error),
        }
    }

    fn word(&mut self, word: &str) -> Option<Expr> {
        (self.has_outputs && self.signature.outputs.contains_key(word)).then(|| Expr::Output(word.to_owned()))
    }

    fn port(&mut self, state: &str, port: &str) -> Result<Expr, NameError> {
        Err(no_states(state, port))
    }
}

/// The error for `$name` if the action has no such input; else `None`.
pub(crate) fn unknown_input(signature: &ActionSignature, name: &str) -> Option<NameError> {
    let known = || signature.inputs.keys().chain(signature.optional.keys()).map(String::as_str);
    (!known().any(|input| input == name)).then(|| NameError {
        rule: "unknown-port",
        message: format!("the action has no input `{name}`"),
        help: suggestion(name, known(), "$", "an action's annotations speak of its own ports"),
    })
}

/// The error for an output of a state, which an action's annotation cannot name.
pub(crate) fn no_states(state: &str, port: &str) -> NameError {
    NameError {
        rule: "unknown-state",
        message: format!("an action knows no states, and `{state}.{port}` is the output of one"),
        help: "speak of the action's own ports; quote a text that contains a point".to_owned(),
    }
}
