//! Conversions to and from the wire: `From<T> for v1::T` never fails, `TryFrom<v1::T> for T` says what is wrong and where.
//!
//! What the schema cannot express is checked here, so that no core ever sees it: a missing choice, a number that is not finite, an invalid pose, a
//! trajectory that runs backwards, names without limit, nesting without end.

mod action;
mod describe;
mod fact;
mod process;
mod resource;
mod scene;
mod value;
mod world;

use crate::MAX_PORTS_BYTES;
use prost::Message as _;
use ratn_model::name::{KIND_RULE, is_kind, is_unseen};
use ratn_model::value::Value;
use std::collections::BTreeMap;
use std::fmt;

use crate::v1;
pub use describe::{MAX_DESCRIPTION_BYTES, check_size};
pub use scene::digest;

/// Maximum nesting depth of lists and maps.
pub const MAX_DEPTH: usize = 16;
/// Maximum number of elements of a value, over all its lists and maps.
pub const MAX_ELEMENTS: usize = 200_000;
/// Maximum number of bytes of ids, kinds, predicates and port names.
pub const MAX_NAME_BYTES: usize = 1024;

/// A message that matches the schema but is invalid.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{path}: {problem}")]
pub struct Malformed {
    /// The path of the field in the message: `goal.inputs[start].joints[2]`.
    pub path: String,
    /// What is wrong with it, and what would be right.
    pub problem: String,
}

impl Malformed {
    /// A problem of the field `field`.
    pub fn new(field: impl fmt::Display, problem: impl Into<String>) -> Malformed {
        Malformed { path: field.to_string(), problem: problem.into() }
    }

    /// The same problem, with the path extended by the enclosing field.
    #[must_use]
    pub fn within(mut self, field: impl fmt::Display) -> Malformed {
        let dot = if self.path.is_empty() || self.path.starts_with('[') { "" } else { "." };
        self.path = format!("{field}{dot}{}", self.path);
        self
    }
}

impl From<Malformed> for tonic::Status {
    fn from(malformed: Malformed) -> tonic::Status {
        tonic::Status::invalid_argument(malformed.to_string())
    }
}

/// Converts a required message field.
///
/// # Errors
/// [`Malformed`] if it is missing or cannot be converted.
pub fn required<W, T>(message: Option<W>, field: &str) -> Result<T, Malformed>
where
    T: TryFrom<W, Error = Malformed>,
{
    let message = message.ok_or_else(|| Malformed::new(field, "is missing"))?;
    T::try_from(message).map_err(|malformed| malformed.within(field))
}

/// Maximum number of selectors in a request: a longer list would cost others more than its length suggests.
pub const MAX_SELECTED: usize = 256;

/// Checks that a list of selectors has at most [`MAX_SELECTED`] elements.
///
/// # Errors
/// [`Malformed`] if it has more.
pub fn few(count: usize, field: &str) -> Result<(), Malformed> {
    if count <= MAX_SELECTED {
        return Ok(());
    }
    Err(Malformed::new(field, format!("has {count} elements: at most {MAX_SELECTED} are allowed, ask more than once")))
}

/// Converts every element of a repeated field.
///
/// # Errors
/// [`Malformed`] for the first element that cannot be converted.
pub fn each<W, T>(messages: Vec<W>, field: &str) -> Result<Vec<T>, Malformed>
where
    T: TryFrom<W, Error = Malformed>,
{
    let convert = |(i, message)| T::try_from(message).map_err(|m: Malformed| m.within(format!("{field}[{i}]")));
    messages.into_iter().enumerate().map(convert).collect()
}

/// Converts items to a repeated field.
pub fn all<T, W: From<T>>(items: impl IntoIterator<Item = T>) -> Vec<W> {
    items.into_iter().map(W::from).collect()
}

/// The size of a value on the wire, in bytes.
pub fn value_bytes(value: &v1::Value) -> usize {
    value.encoded_len()
}

/// The approximate size of ports on the wire, in bytes.
pub fn ports_bytes(fields: &BTreeMap<String, v1::Value>) -> usize {
    fields.iter().map(|(name, value)| name.len() + value.encoded_len()).sum()
}

/// Passes the wire form of ports to `take`, ordered by name, for a fingerprint.
pub fn wire_form(fields: &BTreeMap<String, v1::Value>, mut take: impl FnMut(&[u8])) {
    for (name, value) in fields {
        let value = value.encode_to_vec();
        for part in [name.as_bytes(), &value] {
            take(&(part.len() as u64).to_le_bytes());
            take(part);
        }
    }
}

/// Converts ports or attributes.
///
/// # Errors
/// [`Malformed`] for the first invalid one, or if all together exceed [`MAX_PORTS_BYTES`].
pub fn ports(fields: BTreeMap<String, v1::Value>, field: &str) -> Result<BTreeMap<String, Value>, Malformed> {
    let bytes = ports_bytes(&fields);
    if bytes > MAX_PORTS_BYTES {
        let largest = fields.iter().max_by_key(|(_, value)| value.encoded_len()).map_or("", |(name, _)| name);
        let largest: String = largest.chars().filter(|c| !c.is_control()).take(MAX_NAME_BYTES).collect();
        let rule = format!("have {bytes} bytes, most of them `{largest}`: at most {MAX_PORTS_BYTES} are allowed");
        return Err(Malformed::new(field, rule));
    }
    let convert = |(port, value): (String, v1::Value)| {
        name(&port, "name").map_err(|m| m.within(field))?;
        let value = Value::try_from(value).map_err(|m| m.within(format!("{field}[{port}]")))?;
        Ok((port, value))
    };
    fields.into_iter().map(convert).collect()
}

/// Converts ports or attributes to the wire.
pub fn wire_ports(fields: BTreeMap<String, Value>) -> BTreeMap<String, v1::Value> {
    fields.into_iter().map(|(name, value)| (name, value.into())).collect()
}

/// Checks a required name: not empty, not too long, and without characters that terminals interpret.
///
/// # Errors
/// [`Malformed`] otherwise.
pub fn name(text: &str, field: &str) -> Result<(), Malformed> {
    if text.is_empty() {
        return Err(Malformed::new(field, "is empty"));
    }
    label(text, field)
}

/// Like [`name`], but may be empty.
///
/// # Errors
/// [`Malformed`] if it is too long or has invisible characters.
pub fn label(text: &str, field: &str) -> Result<(), Malformed> {
    if text.len() > MAX_NAME_BYTES {
        return Err(Malformed::new(field, format!("has {} bytes: at most {MAX_NAME_BYTES} are allowed", text.len())));
    }
    if text.chars().any(char::is_control) {
        return Err(Malformed::new(field, "holds control characters"));
    }
    if let Some(unseen) = text.chars().find(|character| is_unseen(*character)) {
        let rule =
            format!("holds U+{:04X}, which is not seen: only characters that are, and plain spaces", u32::from(unseen));
        return Err(Malformed::new(field, rule));
    }
    Ok(())
}

/// Checks a list of names.
///
/// # Errors
/// [`Malformed`] for the first invalid one.
pub fn names(texts: &[String], field: &str) -> Result<(), Malformed> {
    texts.iter().enumerate().try_for_each(|(i, text)| name(text, &format!("{field}[{i}]")))
}

/// Checks that texts are valid kinds of resources.
///
/// # Errors
/// [`Malformed`] for the first invalid one.
pub fn kinds(texts: &[String], field: &str) -> Result<(), Malformed> {
    texts.iter().enumerate().try_for_each(|(i, text)| kind(text, &format!("{field}[{i}]")))
}

/// Checks that a text is a valid kind of a resource.
///
/// # Errors
/// [`Malformed`] if it is not.
pub fn kind(text: &str, field: &str) -> Result<(), Malformed> {
    name(text, field)?;
    if is_kind(text) { Ok(()) } else { Err(Malformed::new(field, format!("is `{text}`: it must be {KIND_RULE}"))) }
}

fn finite(number: f64, field: impl fmt::Display) -> Result<f64, Malformed> {
    if number.is_finite() { Ok(number) } else { Err(Malformed::new(field, format!("is {number}: it must be finite"))) }
}

fn all_finite(numbers: &[f64], field: &str) -> Result<(), Malformed> {
    for (i, number) in numbers.iter().enumerate() {
        if !number.is_finite() {
            return Err(Malformed::new(format!("{field}[{i}]"), format!("is {number}: it must be finite")));
        }
    }
    Ok(())
}

fn missing_choice(choices: &str) -> Malformed {
    Malformed::new("kind", format!("is not set: one of {choices} is needed"))
}

#[cfg(test)]
mod tests;
