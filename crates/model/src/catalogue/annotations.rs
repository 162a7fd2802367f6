//! What an action says of every state that performs it: in a catalogue once, in place of in every state.
//!
//! Each text is an expression as task files have it. `$port` stands for what the state gives an input, a bare word for an output that the action
//! writes. A state that says something under the same key is believed in its place. See `load/action.rs` for how a state comes to it.

use super::ActionSignature;
use crate::expression::Expr;
use crate::expression::parse::{NameError, Names, ParseError, parse_effect, parse_expression, parse_fact};
use crate::load::suggestion;
use serde::{Deserialize, Deserializer, Serialize};
use std::collections::BTreeMap;

/// See the module. What is not said is as if no action had said it: the state then may read and change everything.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Annotations {
    /// It reads its projection and changes nothing.
    pub computes: bool,
    /// Patterns of the facts that it reads, `scene` for those of the geometry; empty for none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reads: Option<Vec<String>>,
    /// Patterns of the facts that it senses; where there are none, it does not only look.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub senses: Vec<String>,
    /// What has to be true when it begins.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub requires: Vec<String>,
    /// What it changes with `success`; empty for nothing.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub effects: Option<Vec<String>>,
    /// Predicates of facts of which nothing is known after any other outcome: those that success sets are deleted then.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub unknown_after_failure: Vec<String>,
    /// Kinds of resources that it blocks one of, its provider's among them; `world_model` is room for a projection.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub resources: Vec<String>,
    /// How long it usually takes, in seconds.
    #[serde(skip_serializing_if = "Option::is_none", deserialize_with = "number_or_text")]
    pub duration: Option<String>,
    /// It gives a result that can be used, and better ones later, until it is stopped: any of them will do. Only what computes or senses can be so.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub anytime: bool,
    /// What is said otherwise where a state gives an optional input, by the input: each key that stands there, in place of the one above.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub given: BTreeMap<String, Annotations>,
}

/// An annotation that does not read.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("`{key}: {text}`: {message}{}{help}", if help.is_empty() { "" } else { "; " })]
pub struct InvalidAnnotation {
    /// Under which key.
    pub key: &'static str,
    /// As it is said.
    pub text: String,
    /// What is wrong with it.
    pub message: String,
    /// What to do; may be empty.
    pub help: String,
}

impl Annotations {
    /// Whether it says nothing.
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

    /// Itself, and what it says where an input is given.
    pub fn all(&self) -> impl Iterator<Item = &Annotations> {
        std::iter::once(self).chain(self.given.values())
    }

    /// What is said of a state that gives these inputs.
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

    /// Whether every text reads, in terms of the ports of its action.
    ///
    /// # Errors
    /// [`InvalidAnnotation`] of the first that does not.
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

/// A number, or an expression as text.
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

/// What names stand for in an annotation of an action.
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

/// Why `$name` means nothing to an action; `None` where it is an input.
pub(crate) fn unknown_input(signature: &ActionSignature, name: &str) -> Option<NameError> {
    let known = || signature.inputs.keys().chain(signature.optional.keys()).map(String::as_str);
    (!known().any(|input| input == name)).then(|| NameError {
        rule: "unknown-port",
        message: format!("the action has no input `{name}`"),
        help: suggestion(name, known(), "$", "an action's annotations speak of its own ports"),
    })
}

/// Why an action cannot name the output of a state.
pub(crate) fn no_states(state: &str, port: &str) -> NameError {
    NameError {
        rule: "unknown-state",
        message: format!("an action knows no states, and `{state}.{port}` is the output of one"),
        help: "speak of the action's own ports; quote a text that contains a point".to_owned(),
    }
}
