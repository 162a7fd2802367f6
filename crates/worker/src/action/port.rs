//! Reading inputs: by name and type, with a message that says which input, what was expected, and what was there.

use ratn_model::pose::Pose;
use ratn_model::value::{Trajectory, Value};

/// An input or a part of one, which may be missing or of another type. The methods read it as a type.
#[derive(Debug, Clone)]
pub struct Port<'a> {
    /// Whose input; may be empty.
    action: &'a str,
    path: String,
    value: Option<&'a Value>,
}

/// An input that is missing or of another type.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum InputError {
    /// The input is missing.
    #[error("input `{port}`{} is missing: expected {expected}", of(action))]
    Missing {
        /// The action; empty where it is not an action's.
        action: String,
        /// The input's path, `region.size`.
        port: String,
        /// The expected type.
        expected: &'static str,
    },
    /// The input is of another type.
    #[error("input `{port}`{} is {found}: expected {expected}", of(action))]
    WrongType {
        /// The action; empty where it is not an action's.
        action: String,
        /// The input's path.
        port: String,
        /// The expected type.
        expected: &'static str,
        /// The type of the value.
        found: String,
    },
}

impl<'a> Port<'a> {
    /// The input `name`. A null value counts as missing.
    pub fn new(name: &str, value: Option<&'a Value>) -> Port<'a> {
        Port::of("", name, value)
    }

    /// The same; errors name the action.
    pub fn of(action: &'a str, name: &str, value: Option<&'a Value>) -> Port<'a> {
        Port { action, path: name.to_owned(), value: value.filter(|v| **v != Value::Null) }
    }

    /// This input; `None` where it is missing.
    pub fn optional(self) -> Option<Port<'a>> {
        self.value.is_some().then_some(self)
    }

    /// A field of this value, which is a map.
    pub fn field(&self, name: &str) -> Port<'a> {
        Port::of(self.action, &format!("{}.{name}", self.path), self.value.and_then(|v| v.field(name)))
    }

    /// The value, of whatever type.
    ///
    /// # Errors
    /// [`InputError`].
    pub fn any(&self) -> Result<&'a Value, InputError> {
        self.read("a value", Some)
    }

    /// A truth value.
    ///
    /// # Errors
    /// [`InputError`].
    pub fn bool(&self) -> Result<bool, InputError> {
        self.read("a bool", |v| if let Value::Bool(b) = v { Some(*b) } else { None })
    }

    /// A whole number.
    ///
    /// # Errors
    /// [`InputError`].
    pub fn int(&self) -> Result<i64, InputError> {
        self.read("an int", |v| if let Value::Int(i) = v { Some(*i) } else { None })
    }

    /// A number.
    ///
    /// # Errors
    /// [`InputError`].
    pub fn float(&self) -> Result<f64, InputError> {
        self.read("a number", Value::as_number)
    }

    /// Text.
    ///
    /// # Errors
    /// [`InputError`].
    pub fn string(&self) -> Result<&'a str, InputError> {
        self.read("a string", |v| if let Value::String(text) = v { Some(text.as_str()) } else { None })
    }

    /// A pose: position in metres, orientation as a unit quaternion (x, y, z, w).
    ///
    /// # Errors
    /// [`InputError`].
    pub fn pose(&self) -> Result<Pose, InputError> {
        self.read("a pose", |v| if let Value::Pose(pose) = v { Some(*pose) } else { None })
    }

    /// Positions of joints, in radians (prismatic joints: metres), in the order of the arm's joints.
    ///
    /// # Errors
    /// [`InputError`].
    pub fn joints(&self) -> Result<&'a [f64], InputError> {
        self.read("joints", |v| if let Value::Joints(joints) = v { Some(joints.as_slice()) } else { None })
    }

    /// A trajectory: joint names, and points with time in seconds, positions and velocities.
    ///
    /// # Errors
    /// [`InputError`].
    pub fn trajectory(&self) -> Result<&'a Trajectory, InputError> {
        self.read("a trajectory", |v| if let Value::Trajectory(t) = v { Some(t) } else { None })
    }

    /// Bytes.
    ///
    /// # Errors
    /// [`InputError`].
    pub fn bytes(&self) -> Result<&'a [u8], InputError> {
        self.read("bytes", |v| if let Value::Bytes(bytes) = v { Some(bytes.as_slice()) } else { None })
    }

    /// The elements of a list.
    ///
    /// # Errors
    /// [`InputError`].
    pub fn list(&self) -> Result<Vec<Port<'a>>, InputError> {
        let values = self.read("a list", |v| if let Value::List(values) = v { Some(values) } else { None })?;
        let element = |(i, v)| Port { action: self.action, path: format!("{}[{i}]", self.path), value: Some(v) };
        Ok(values.iter().enumerate().map(element).collect())
    }

    /// A list of exactly three numbers.
    ///
    /// # Errors
    /// [`InputError`].
    pub fn vector3(&self) -> Result<[f64; 3], InputError> {
        self.read("a list of three numbers", |v| {
            let Value::List(values) = v else { return None };
            let numbers: Option<Vec<f64>> = values.iter().map(Value::as_number).collect();
            numbers?.try_into().ok()
        })
    }

    fn read<T>(&self, expected: &'static str, take: impl FnOnce(&'a Value) -> Option<T>) -> Result<T, InputError> {
        let (action, port) = (|| self.action.to_owned(), || self.path.clone());
        let value = self.value.ok_or_else(|| InputError::Missing { action: action(), port: port(), expected })?;
        let wrong = || InputError::WrongType { action: action(), port: port(), expected, found: summary(value) };
        take(value).ok_or_else(wrong)
    }
}

fn of(action: &str) -> String {
    if action.is_empty() { String::new() } else { format!(" of `{action}`") }
}

fn summary(value: &Value) -> String {
    match value {
        Value::Bool(_) | Value::Int(_) | Value::Float(_) | Value::Pose(_) | Value::Joints(_) => {
            format!("the {} {value}", value.type_name())
        }
        Value::List(values) => format!("a list of {}", values.len()),
        _ => format!("a {}", value.type_name()),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    #[test]
    fn a_wrong_input_is_named_with_what_was_expected_and_found() {
        let region = Value::map([("size", Value::List(vec![Value::Int(1), Value::Float(2.0)].into()))]);
        let port = Port::new("region", Some(&region));
        let message = |error: InputError| error.to_string();
        assert_eq!(
            message(port.field("size").vector3().unwrap_err()),
            "input `region.size` is a list of 2: expected a list of three numbers"
        );
        assert_eq!(message(port.field("pose").pose().unwrap_err()), "input `region.pose` is missing: expected a pose");
        assert_eq!(message(port.pose().unwrap_err()), "input `region` is a map: expected a pose");
        assert_eq!(port.field("size").list().unwrap()[1].float().unwrap(), 2.0);
    }

    #[test]
    fn a_null_input_counts_as_none() {
        assert!(Port::new("budget_s", Some(&Value::Null)).optional().is_none());
    }
}
