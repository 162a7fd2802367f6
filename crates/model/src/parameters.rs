//! The values of a task's parameters in one run: those that are set, else the defaults.

use crate::expression::Expr;
use crate::expression::parse::{NameError, Names, parse_expression};
use crate::expression::scope::NothingKnown;
use crate::load::suggestion;
use crate::program::{Parameter, Program};
use crate::value::{Type, Value};
use std::collections::BTreeMap;

/// Error: parameters cannot be bound. Its rule is `invalid-parameter`.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ParameterError {
    /// The task declares no such parameter.
    #[error("task `{task}` has no parameter `{name}`: {help}")]
    Unknown {
        /// The task.
        task: String,
        /// The unknown name.
        name: String,
        /// The parameters that exist.
        help: String,
    },
    /// The text is no value of the parameter's type.
    #[error("parameter `{name}` is {ty}; `{text}` is none")]
    NotOfItsType {
        /// The parameter.
        name: String,
        /// Its type.
        ty: Type,
        /// The text.
        text: String,
    },
    /// The parameter was set twice.
    #[error("parameter `{name}` is set twice")]
    Twice {
        /// The parameter.
        name: String,
    },
    /// The parameter is neither set nor has it a default.
    #[error("task `{task}` needs parameter `{name}` ({ty}): set it with `--set {name}=…`")]
    Missing {
        /// The task.
        task: String,
        /// The parameter.
        name: String,
        /// Its type.
        ty: Type,
    },
}

impl Program {
    /// Every parameter's value, from `--set name=text` pairs and defaults. Strings are taken as they are; everything else
    /// is written as in a task file: `3`, `true`, `pose(0, 0, 1)`, `[1, 2]`.
    ///
    /// # Errors
    /// [`ParameterError`] with the parameter and the expected value.
    pub fn bind_parameters(&self, set: &[(String, String)]) -> Result<BTreeMap<String, Value>, ParameterError> {
        let mut values = BTreeMap::new();
        for (name, text) in set {
            let Some(parameter) = self.parameters.iter().find(|p| p.name == *name) else {
                let known = self.parameters.iter().map(|p| p.name.as_str());
                let help = suggestion(name, known, "", "it has none of that name");
                return Err(ParameterError::Unknown { task: self.name.clone(), name: name.clone(), help });
            };
            let value = read(text, parameter)?;
            if values.insert(name.clone(), value).is_some() {
                return Err(ParameterError::Twice { name: name.clone() });
            }
        }
        for Parameter { name, ty, default } in &self.parameters {
            if values.contains_key(name) {
                continue;
            }
            let missing = || ParameterError::Missing { task: self.name.clone(), name: name.clone(), ty: ty.clone() };
            values.insert(name.clone(), default.clone().ok_or_else(missing)?);
        }
        Ok(values)
    }
}

/// Parses a constant written as in a task file: `3`, `true`, `left`, `pose(0, 0, 1)`, `[1, 2]`.
///
/// # Errors
/// Why the text is no constant.
pub fn constant(text: &str) -> Result<Value, String> {
    let expression = parse_expression(text, &mut NoNames).map_err(|error| error.message)?;
    expression.evaluate(&NothingKnown).map_err(|error| error.to_string())
}

fn read(text: &str, parameter: &Parameter) -> Result<Value, ParameterError> {
    let wrong = || ParameterError::NotOfItsType {
        name: parameter.name.clone(),
        ty: parameter.ty.clone(),
        text: text.to_owned(),
    };
    if parameter.ty == Type::String {
        return Ok(Value::String(text.to_owned()));
    }
    let expr = parse_expression(text, &mut NoNames).map_err(|_| wrong())?;
    let value = expr.evaluate(&NothingKnown).map_err(|_| wrong())?;
    let value = match (&parameter.ty, value) {
        (Type::Float, Value::Int(i)) => Value::Float(i as f64),
        (_, value) => value,
    };
    if parameter.ty.accepts(&value) { Ok(value) } else { Err(wrong()) }
}

/// Names in a constant: a word is the individual of that name; all other names are unknown.
pub(crate) struct NoNames;

impl Names for NoNames {
    fn variable(&mut self, name: &str) -> Result<Expr, NameError> {
        Err(no_constant(format!("${name}")))
    }

    fn word(&mut self, _: &str) -> Option<Expr> {
        None
    }

    fn port(&mut self, state: &str, port: &str) -> Result<Expr, NameError> {
        Err(no_constant(format!("{state}.{port}")))
    }
}

fn no_constant(what: String) -> NameError {
    NameError { rule: "invalid-parameter", message: format!("`{what}` is no constant"), help: String::new() }
}
