//! The parameters of a template: typed, with a range, and substituted where arguments and variables name them as `{name}`.

use crate::config::{ConfigError, rule};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Names that are always substituted; `speed` and `robot` are substituted by the command that starts a process manager.
const BUILT_IN: [&str; 7] = ["id", "kind", "host", "runtime_dir", "endpoint_file", "speed", "robot"];
/// Maximum bytes of a text.
const MAX_TEXT_BYTES: usize = 4_096;

/// A typed value with its range.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "type", rename_all = "snake_case", deny_unknown_fields)]
pub enum Parameter {
    /// A whole number.
    Int {
        /// The value.
        value: i64,
        /// At least this.
        #[serde(default)]
        min: Option<i64>,
        /// At most this.
        #[serde(default)]
        max: Option<i64>,
    },
    /// A number.
    Float {
        /// The value.
        value: f64,
        /// At least this.
        #[serde(default)]
        min: Option<f64>,
        /// At most this.
        #[serde(default)]
        max: Option<f64>,
    },
    /// `true` or `false`.
    Bool {
        /// The value.
        value: bool,
    },
    /// A text.
    Text {
        /// The value.
        value: String,
        /// Allowed values; any value where the list is empty.
        #[serde(default)]
        one_of: Vec<String>,
    },
}

impl Parameter {
    /// Reports what is wrong with it; `at` is its place in the config.
    pub(super) fn check(&self, at: &str, name: &str) -> Result<(), ConfigError> {
        rule(at, is_name(name), "a name is of small letters, digits and `_`")?;
        rule(at, !BUILT_IN.contains(&name), format!("`{{{name}}}` is filled in already"))?;
        match self {
            Parameter::Int { value, min, max } => {
                let holds = min.is_none_or(|min| *value >= min) && max.is_none_or(|max| *value <= max);
                rule(at, holds, format!("{value} is not in its range"))
            }
            Parameter::Float { value, min, max } => {
                let holds = min.is_none_or(|min| *value >= min) && max.is_none_or(|max| *value <= max);
                rule(at, value.is_finite() && holds, format!("{value} is not in its range"))
            }
            Parameter::Bool { .. } => Ok(()),
            Parameter::Text { value, one_of } => {
                rule(at, value.len() <= MAX_TEXT_BYTES, format!("at most {MAX_TEXT_BYTES} bytes"))?;
                rule(at, !value.contains(char::is_control), "has control characters")?;
                let known = one_of.is_empty() || one_of.contains(value);
                rule(at, known, format!("`{value}` is none of {}", one_of.join(", ")))
            }
        }
    }

    fn text(&self) -> String {
        match self {
            Parameter::Int { value, .. } => value.to_string(),
            Parameter::Float { value, .. } => value.to_string(),
            Parameter::Bool { value } => value.to_string(),
            Parameter::Text { value, .. } => value.clone(),
        }
    }
}

/// Replaces every `{name}` that `builtin` or a parameter knows, once: inserted text is not searched again.
pub(super) fn fill(
    text: &str,
    builtin: &dyn Fn(&str) -> Option<String>,
    parameters: &BTreeMap<String, Parameter>,
) -> String {
    let mut filled = String::new();
    let mut rest = text;
    while let Some((before, name, after)) = next(rest) {
        filled.push_str(before);
        match builtin(name).or_else(|| parameters.get(name).map(Parameter::text)) {
            Some(value) => filled.push_str(&value),
            None => filled.extend(["{", name, "}"]),
        }
        rest = after;
    }
    filled.push_str(rest);
    filled
}

/// The first `{name}` that is unknown.
pub(super) fn unknown<'t>(text: &'t str, parameters: &BTreeMap<String, Parameter>) -> Option<&'t str> {
    let mut rest = text;
    while let Some((_, name, after)) = next(rest) {
        if !BUILT_IN.contains(&name) && !parameters.contains_key(name) {
            return Some(name);
        }
        rest = after;
    }
    None
}

/// The text before the first `{name}`, the name, and the rest. Other braces are ordinary text.
fn next(text: &str) -> Option<(&str, &str, &str)> {
    text.match_indices('{').find_map(|(at, _)| {
        let (name, after) = text[at + 1..].split_once('}')?;
        is_name(name).then_some((&text[..at], name, after))
    })
}

fn is_name(name: &str) -> bool {
    !name.is_empty() && name.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_')
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    fn parameters(toml: &str) -> BTreeMap<String, Parameter> {
        toml::from_str(toml).unwrap()
    }

    #[test]
    fn values_are_of_their_type_and_in_their_range() {
        let good = [
            "a = { type = 'int', value = 3, min = 1, max = 3 }",
            "a = { type = 'float', value = 1, min = 0.01 }",
            "a = { type = 'bool', value = true }",
            "a = { type = 'text', value = 'fast', one_of = ['fast', 'good'] }",
        ];
        for toml in good {
            assert!(parameters(toml)["a"].check("p.a", "a").is_ok(), "{toml}");
        }
        let bad = [
            ("a = { type = 'int', value = 4, max = 3 }", "`p.a`: 4 is not in its range"),
            ("a = { type = 'float', value = nan }", "`p.a`: NaN is not in its range"),
            ("a = { type = 'text', value = 'slow', one_of = ['fast'] }", "`p.a`: `slow` is none of fast"),
            ("a = { type = 'text', value = \"x\\ny\" }", "`p.a`: has control characters"),
        ];
        for (toml, problem) in bad {
            assert_eq!(parameters(toml)["a"].check("p.a", "a").unwrap_err().to_string(), problem);
        }
        for toml in
            ["a = { type = 'int', value = 1.5 }", "a = { type = 'bool', value = 'yes' }", "a = { type = 'int' }"]
        {
            assert!(toml::from_str::<BTreeMap<String, Parameter>>(toml).is_err(), "{toml}");
        }
        let any = Parameter::Bool { value: true };
        assert!(any.check("p", "id").is_err() && any.check("p", "Speed").is_err());
    }

    #[test]
    fn what_is_known_is_filled_in_once_and_other_braces_are_text() {
        let parameters = parameters("seed = { type = 'int', value = 7 }\nodd = { type = 'text', value = '{seed}' }");
        let builtin = |name: &str| (name == "id").then(|| "planner-1".to_owned());
        let filled = fill("--id={id} {\"a\": {seed}} {odd} {} {A}", &builtin, &parameters);
        assert_eq!(filled, "--id=planner-1 {\"a\": 7} {seed} {} {A}");
        assert_eq!(unknown("{id}{seed} {sead}", &parameters), Some("sead"));
        assert_eq!(unknown("{\"a\": {seed}}", &parameters), None);
    }
}
