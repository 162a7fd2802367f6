//! A worker's description of itself: its provider's name, its resource kind, and its actions with their ports. It comes from outside and is
//! accepted only within these bounds.

use super::{ActionSignature, Annotations, Catalogue, InvalidAnnotation, Provider, ResourceOffer};
use crate::expression::parse::parse_expression;
use crate::expression::scope::NothingKnown;
use crate::expression::{Expr, Function};
use crate::parameters::NoNames;
use crate::resource::{Quantity, ResourceClass};
use crate::value::{Type, Value};
use std::collections::BTreeMap;

/// Limit of the actions of one worker.
const ACTIONS: usize = 128;
/// Limit of the inputs, outputs, outcomes and annotations of one action, together.
const PORTS: usize = 128;
/// Limit of a name, in bytes.
const NAME_BYTES: usize = 64;
/// Limit of a type, a default or an annotation, in bytes.
const TEXT_BYTES: usize = 512;
/// Limit of a description for people, in bytes.
const DESCRIPTION_BYTES: usize = 2_048;

/// The description; see the module.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct WorkerDescription {
    /// The name that tasks use, `inspector` in `inspector/nearest`; empty if not given.
    pub provider: String,
    /// Its resource kind; empty if not given.
    pub kind: String,
    /// Its actions by name; without a signature if its ports are not given.
    pub actions: BTreeMap<String, Option<ActionSignature>>,
}

/// Error: the description is not accepted.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DescriptionError {
    /// There are too many of something.
    #[error("it says {count} {what}{of}: at most {most} are taken")]
    TooMany {
        /// Of what, `actions`.
        what: &'static str,
        /// The action; may be empty.
        of: String,
        /// Their number.
        count: usize,
        /// The limit.
        most: usize,
    },
    /// A name is not allowed in tasks.
    #[error("its {what} `{name}`{of} is no name: {rule}")]
    Name {
        /// What is named.
        what: &'static str,
        /// The action; may be empty.
        of: String,
        /// The name, shortened.
        name: String,
        /// The rule for names.
        rule: &'static str,
    },
    /// A text is too long.
    #[error("its {what}{of} is too long, or not one line of text: at most {most} bytes without control characters")]
    Text {
        /// Which text.
        what: &'static str,
        /// The action; may be empty.
        of: String,
        /// The limit, in bytes.
        most: usize,
    },
    /// A port appears twice, or a port that is not optional has a default.
    #[error("action `{action}` says port `{port}` twice, or a default of it that is required")]
    Port {
        /// The action.
        action: String,
        /// The port.
        port: String,
    },
    /// A default does not have the port's type.
    #[error("action `{action}`: the default of port `{port}` is `{default}`, which is no {expected}")]
    Default {
        /// The action.
        action: String,
        /// The port.
        port: String,
        /// The default, shortened.
        default: String,
        /// The port's type.
        expected: Type,
    },
    /// An annotation cannot be parsed.
    #[error("action `{action}`: `{key}: {text}`: {why}")]
    Annotation {
        /// The action.
        action: String,
        /// Its key.
        key: &'static str,
        /// Its text, shortened.
        text: String,
        /// What is wrong, shortened.
        why: String,
    },
    /// The message is too large.
    #[error("it has {bytes} bytes: at most {most} are taken")]
    TooLarge {
        /// Its size on the wire.
        bytes: usize,
        /// The limit.
        most: usize,
    },
    /// The type grammar does not know a type.
    #[error("action `{action}`: port `{port}`: {why}")]
    Type {
        /// The action.
        action: String,
        /// The port.
        port: String,
        /// What is wrong.
        why: String,
    },
    /// The message cannot be decoded.
    #[error("it cannot be read: {why}")]
    Malformed {
        /// Why.
        why: String,
    },
}

impl DescriptionError {
    /// The error for a default that does not have its port's type.
    pub fn default_of(action: &str, port: &str, default: &str, expected: &Type) -> DescriptionError {
        DescriptionError::Default {
            action: shown(action),
            port: shown(port),
            default: shown(default),
            expected: expected.clone(),
        }
    }
}

impl WorkerDescription {
    /// Checks the description against these bounds.
    ///
    /// # Errors
    /// [`DescriptionError`] for the first violation.
    pub fn check(&self) -> Result<(), DescriptionError> {
        bound("actions", "", self.actions.len(), ACTIONS)?;
        for (what, said) in [("provider", &self.provider), ("kind", &self.kind)] {
            if !said.is_empty() {
                name(what, "", said)?;
            }
        }
        for (action, signature) in &self.actions {
            action_name(action)?;
            signature.as_ref().map_or(Ok(()), |signature| check(action, signature))?;
        }
        Ok(())
    }

    /// The actions with signatures, which tasks can use.
    pub fn signatures(&self) -> impl Iterator<Item = (&String, &ActionSignature)> {
        self.actions.iter().filter_map(|(name, signature)| Some((name, signature.as_ref()?)))
    }
}

impl Catalogue {
    /// Extends the catalogue by the description of a worker of `kind`, of which there can be `count`. Existing entries do not change.
    pub fn extend_by(&mut self, kind: &str, count: Quantity, worker: &WorkerDescription) {
        if worker.provider.is_empty() || worker.signatures().next().is_none() {
            return;
        }
        let provider = self.providers.entry(worker.provider.clone()).or_insert_with(|| Provider {
            resource: kind.to_owned(),
            joints: None,
            chain: None,
            actions: BTreeMap::new(),
        });
        if provider.resource != kind {
            return;
        }
        for (name, signature) in worker.signatures() {
            provider.actions.entry(name.clone()).or_insert_with(|| signature.clone());
        }
        let offer = || ResourceOffer::new(ResourceClass::Process, count);
        self.resources.entry(kind.to_owned()).or_insert_with(offer);
    }
}

fn check(action: &str, signature: &ActionSignature) -> Result<(), DescriptionError> {
    let of = format!(" of action `{action}`");
    let ActionSignature { inputs, optional, outputs, outcomes, description, defaults, annotations } = signature;
    let lists = || annotations.all().flat_map(Annotations::lists);
    let said: usize = lists().map(|(_, list)| list.len()).sum::<usize>() + annotations.given.len();
    let ports = inputs.len() + optional.len() + outputs.len() + outcomes.len() + defaults.len() + said;
    bound("ports, outcomes and annotations", &of, ports, PORTS)?;
    text("description", &of, description, DESCRIPTION_BYTES)?;
    for (port, of_type) in inputs.iter().chain(optional).chain(outputs) {
        name("port", &of, port)?;
        if *of_type != Type::Any {
            text("type", &of, &of_type.to_string(), TEXT_BYTES)?;
        }
    }
    let twice = inputs.keys().find(|port| optional.contains_key(*port));
    if let Some(port) = twice.or_else(|| defaults.keys().find(|port| !optional.contains_key(*port))) {
        return Err(DescriptionError::Port { action: action.to_owned(), port: shown(port) });
    }
    outcomes.iter().try_for_each(|outcome| name("outcome", &of, outcome))?;
    for (port, default) in defaults {
        text("default", &of, default, TEXT_BYTES)?;
        if let Some(expected) = optional.get(port).filter(|expected| !may_be(default, expected)) {
            return Err(DescriptionError::default_of(action, port, default, expected));
        }
    }
    lists().try_for_each(|(key, list)| list.iter().try_for_each(|said| text(key, &of, said, TEXT_BYTES)))?;
    annotations.check(signature).map_err(|InvalidAnnotation { key, text, message, .. }| DescriptionError::Annotation {
        action: shown(action),
        key,
        text: shown(&text),
        why: shown(&message),
    })
}

/// Whether a default, as people write it, may have this type. Only plain constants are checked. Others (a trajectory, a pose with a
/// quaternion) are accepted and not evaluated: a few characters from outside could make a list of a million elements.
fn may_be(default: &str, expected: &Type) -> bool {
    if matches!(expected, Type::Any | Type::String) {
        return true;
    }
    let plain = parse_expression(default, &mut NoNames).ok().filter(is_plain);
    match plain.and_then(|expr| expr.evaluate(&NothingKnown).ok()) {
        None | Some(Value::Null) => true,
        Some(value) => expected.accepts(&value),
    }
}

fn is_plain(expr: &Expr) -> bool {
    match expr {
        Expr::Literal(_) => true,
        Expr::Unary(_, of) => is_plain(of),
        Expr::List(items) | Expr::Call(Function::Pose | Function::Joints, items) => items.iter().all(is_plain),
        Expr::Map(fields) => fields.iter().all(|(_, item)| is_plain(item)),
        _ => false,
    }
}

fn bound(what: &'static str, of: &str, count: usize, most: usize) -> Result<(), DescriptionError> {
    if count <= most { Ok(()) } else { Err(DescriptionError::TooMany { what, of: of.to_owned(), count, most }) }
}

fn name(what: &'static str, of: &str, said: &str) -> Result<(), DescriptionError> {
    let good = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
    let begins = said.chars().next().is_some_and(|c| c.is_ascii_alphabetic());
    if begins && said.len() <= NAME_BYTES && said.chars().all(good) {
        return Ok(());
    }
    let rule = "1 to 64 ASCII letters, digits, `_` and `-`, the first one a letter";
    Err(DescriptionError::Name { what, of: of.to_owned(), name: shown(said), rule })
}

/// Checks the name of an action. It stands behind a slash and in no expression, so it may be any word that programming languages allow.
fn action_name(said: &str) -> Result<(), DescriptionError> {
    let good = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-' | '.');
    let begins = said.chars().next().is_some_and(|c| c.is_ascii_alphanumeric() || c == '_');
    if begins && said.len() <= NAME_BYTES && said.chars().all(good) {
        return Ok(());
    }
    let rule = "1 to 64 ASCII letters, digits, `_`, `-` and `.`, the first one a letter, a digit or `_`";
    Err(DescriptionError::Name { what: "action", of: String::new(), name: shown(said), rule })
}

fn text(what: &'static str, of: &str, said: &str, most: usize) -> Result<(), DescriptionError> {
    let good = said.len() <= most && !said.contains(char::is_control);
    if good { Ok(()) } else { Err(DescriptionError::Text { what, of: of.to_owned(), most }) }
}

/// A text from outside, shortened for a message.
fn shown(said: &str) -> String {
    said.chars().take(NAME_BYTES).map(|c| if c.is_control() { '?' } else { c }).collect()
}
