//! Values of ports, variables and facts, and their types.

use crate::list::List;
use crate::pose::Pose;
use serde::{Deserialize, Serialize};
use std::cmp::Ordering;
use std::collections::BTreeMap;
use std::fmt;

/// A value of a port, a variable, a parameter or a fact.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Value {
    /// No value.
    Null,
    /// True or false.
    Bool(bool),
    /// A whole number.
    Int(i64),
    /// A number; the port's name tells its unit.
    Float(f64),
    /// Text, or the name of an individual.
    String(String),
    /// A rigid pose.
    Pose(Pose),
    /// Joint positions in radians (metres for sliding joints), in the order of the robot's arm joints.
    Joints(Vec<f64>),
    /// A timed path.
    Trajectory(Trajectory),
    /// A list; elements may differ in type.
    List(List),
    /// Named fields.
    Map(BTreeMap<String, Value>),
    /// Bytes that only their producer and consumer can interpret.
    Bytes(Vec<u8>),
}

/// A timed joint-space path.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Trajectory {
    /// Joint names, the order of every `positions`.
    pub joints: Vec<String>,
    /// At least one point; times increase strictly from 0.
    pub points: Vec<TrajectoryPoint>,
}

/// One point of a [`Trajectory`].
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct TrajectoryPoint {
    /// Seconds from the start of the motion, in the robot's time.
    pub time_s: f64,
    /// Radians.
    pub positions: Vec<f64>,
    /// Radians per second.
    pub velocities: Vec<f64>,
}

impl Trajectory {
    /// Seconds from the first to the last point.
    pub fn duration_s(&self) -> f64 {
        self.points.last().map_or(0.0, |p| p.time_s)
    }
}

/// The type of a port, a parameter or a variable.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(into = "String", try_from = "String")]
pub enum Type {
    /// Accepts every value.
    Any,
    /// [`Value::Bool`].
    Bool,
    /// [`Value::Int`].
    Int,
    /// [`Value::Float`]; an int is accepted too.
    Float,
    /// [`Value::String`].
    String,
    /// [`Value::Pose`].
    Pose,
    /// [`Value::Joints`].
    Joints,
    /// [`Value::Trajectory`].
    Trajectory,
    /// [`Value::Bytes`].
    Bytes,
    /// [`Value::List`] of one element type.
    List(Box<Type>),
    /// [`Value::Map`] of one value type.
    Map(Box<Type>),
    /// [`Value::Map`] with at least these fields.
    Record(BTreeMap<String, Type>),
}

impl Value {
    /// The kind of this value, in the words of the type grammar.
    pub fn type_name(&self) -> &'static str {
        match self {
            Value::Null => "null",
            Value::Bool(_) => "bool",
            Value::Int(_) => "int",
            Value::Float(_) => "float",
            Value::String(_) => "string",
            Value::Pose(_) => "pose",
            Value::Joints(_) => "joints",
            Value::Trajectory(_) => "trajectory",
            Value::List(_) => "list",
            Value::Map(_) => "map",
            Value::Bytes(_) => "bytes",
        }
    }

    /// An int or a float, as a float.
    pub fn as_number(&self) -> Option<f64> {
        match self {
            Value::Int(i) => Some(*i as f64),
            Value::Float(f) => Some(*f),
            _ => None,
        }
    }

    /// A total order of all values: by kind in the order of [`Value`] (ints and floats together as numbers), then by content.
    pub fn total_order(&self, other: &Value) -> Ordering {
        let kind = |value: &Value| match value {
            Value::Null => 0,
            Value::Bool(_) => 1,
            Value::Int(_) | Value::Float(_) => 2,
            Value::String(_) => 3,
            Value::Pose(_) => 4,
            Value::Joints(_) => 5,
            Value::Trajectory(_) => 6,
            Value::List(_) => 7,
            Value::Map(_) => 8,
            Value::Bytes(_) => 9,
        };
        let floats = |a: &[f64], b: &[f64]| {
            let differing = a.iter().zip(b).map(|(x, y)| x.total_cmp(y)).find(|order| order.is_ne());
            differing.unwrap_or(a.len().cmp(&b.len()))
        };
        match (self, other) {
            (Value::Bool(a), Value::Bool(b)) => a.cmp(b),
            (Value::Int(a), Value::Int(b)) => a.cmp(b),
            (Value::String(a), Value::String(b)) => a.cmp(b),
            (Value::Bytes(a), Value::Bytes(b)) => a.cmp(b),
            (Value::Pose(a), Value::Pose(b)) => {
                floats(&a.position, &b.position).then_with(|| floats(&a.quaternion_xyzw, &b.quaternion_xyzw))
            }
            (Value::Joints(a), Value::Joints(b)) => floats(a, b),
            (Value::Trajectory(a), Value::Trajectory(b)) => a.joints.cmp(&b.joints).then_with(|| {
                let points = a.points.iter().zip(&b.points).map(|(p, q)| {
                    let times = p.time_s.total_cmp(&q.time_s);
                    times
                        .then_with(|| floats(&p.positions, &q.positions))
                        .then_with(|| floats(&p.velocities, &q.velocities))
                });
                let mut differing = points.filter(|order| order.is_ne());
                differing.next().unwrap_or(a.points.len().cmp(&b.points.len()))
            }),
            (Value::List(a), Value::List(b)) => {
                let mut differing = a.iter().zip(b).map(|(a, b)| a.total_order(b)).filter(|order| order.is_ne());
                differing.next().unwrap_or(a.len().cmp(&b.len()))
            }
            (Value::Map(a), Value::Map(b)) => {
                let fields = a.iter().zip(b).map(|((n, a), (m, b))| n.cmp(m).then_with(|| a.total_order(b)));
                let mut differing = fields.filter(|order| order.is_ne());
                differing.next().unwrap_or(a.len().cmp(&b.len()))
            }
            (a, b) => match (a.as_number(), b.as_number()) {
                // An int and a float of the same value are still different.
                (Some(x), Some(y)) => {
                    x.total_cmp(&y).then_with(|| matches!(a, Value::Float(_)).cmp(&matches!(b, Value::Float(_))))
                }
                _ => kind(a).cmp(&kind(b)),
            },
        }
    }

    /// A field of a map.
    pub fn field(&self, name: &str) -> Option<&Value> {
        match self {
            Value::Map(fields) => fields.get(name),
            _ => None,
        }
    }

    /// A map from pairs.
    pub fn map<const N: usize>(fields: [(&str, Value); N]) -> Value {
        Value::Map(fields.into_iter().map(|(k, v)| (k.to_owned(), v)).collect())
    }
}

impl Type {
    /// Whether `value` is of this type.
    pub fn accepts(&self, value: &Value) -> bool {
        match (self, value) {
            (Type::Any, _) => true,
            (Type::Bool, Value::Bool(_))
            | (Type::Int, Value::Int(_))
            | (Type::Float, Value::Float(_) | Value::Int(_))
            | (Type::String, Value::String(_))
            | (Type::Pose, Value::Pose(_))
            | (Type::Joints, Value::Joints(_))
            | (Type::Trajectory, Value::Trajectory(_))
            | (Type::Bytes, Value::Bytes(_)) => true,
            (Type::List(element), Value::List(values)) => values.iter().all(|v| element.accepts(v)),
            (Type::Map(element), Value::Map(fields)) => fields.values().all(|v| element.accepts(v)),
            (Type::Record(types), Value::Map(fields)) => {
                types.iter().all(|(name, ty)| fields.get(name).is_some_and(|v| ty.accepts(v)))
            }
            _ => false,
        }
    }

    /// A value that this type accepts, with each int that stands for a float as that float.
    pub fn widened(&self, value: Value) -> Value {
        match (self, value) {
            (Type::Float, Value::Int(int)) => Value::Float(int as f64),
            (Type::List(element), Value::List(values)) => {
                Value::List(values.into_iter().map(|value| element.widened(value)).collect())
            }
            (Type::Map(element), Value::Map(fields)) => {
                Value::Map(fields.into_iter().map(|(name, value)| (name, element.widened(value))).collect())
            }
            (Type::Record(types), Value::Map(fields)) => {
                let of = |name: &String| types.get(name).unwrap_or(&Type::Any);
                Value::Map(fields.into_iter().map(|(name, value)| (name.clone(), of(&name).widened(value))).collect())
            }
            (_, value) => value,
        }
    }

    /// Whether a value of type `from` may flow into a port of this type; `any` fits both ways and is checked at run time.
    pub fn accepts_type(&self, from: &Type) -> bool {
        match (self, from) {
            (Type::Any, _) | (_, Type::Any) | (Type::Float, Type::Int) => true,
            (Type::List(a), Type::List(b)) | (Type::Map(a), Type::Map(b)) => a.accepts_type(b),
            (Type::Map(a), Type::Record(fields)) => fields.values().all(|b| a.accepts_type(b)),
            (Type::Record(want), Type::Record(have)) => {
                want.iter().all(|(name, ty)| have.get(name).is_some_and(|h| ty.accepts_type(h)))
            }
            (a, b) => a == b,
        }
    }
}

impl fmt::Display for Type {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Type::Any => f.write_str("any"),
            Type::Bool => f.write_str("bool"),
            Type::Int => f.write_str("int"),
            Type::Float => f.write_str("float"),
            Type::String => f.write_str("string"),
            Type::Pose => f.write_str("pose"),
            Type::Joints => f.write_str("joints"),
            Type::Trajectory => f.write_str("trajectory"),
            Type::Bytes => f.write_str("bytes"),
            Type::List(element) => write!(f, "list<{element}>"),
            Type::Map(element) => write!(f, "map<{element}>"),
            Type::Record(fields) => {
                f.write_str("{")?;
                for (i, (name, ty)) in fields.iter().enumerate() {
                    write!(f, "{}{name}: {ty}", if i == 0 { "" } else { ", " })?;
                }
                f.write_str("}")
            }
        }
    }
}

impl From<Type> for String {
    fn from(ty: Type) -> String {
        ty.to_string()
    }
}

/// A type that the type grammar does not know.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "`{text}` is not a type: expected any, bool, int, float, string, pose, joints, trajectory, bytes, list<T>, map<T> or {{field: T}}"
)]
pub struct UnknownType {
    /// The text.
    pub text: String,
}

/// Limit of the nesting of types.
const MAX_TYPE_DEPTH: usize = 16;

impl TryFrom<String> for Type {
    type Error = UnknownType;

    fn try_from(text: String) -> Result<Type, UnknownType> {
        text.parse()
    }
}

impl std::str::FromStr for Type {
    type Err = UnknownType;

    fn from_str(text: &str) -> Result<Type, UnknownType> {
        parse_type(text.trim(), 0).ok_or_else(|| UnknownType { text: text.to_owned() })
    }
}

fn parse_type(text: &str, depth: usize) -> Option<Type> {
    if depth > MAX_TYPE_DEPTH {
        return None;
    }
    let inner = |open: &str| text.strip_prefix(open)?.strip_suffix('>').map(str::trim);
    Some(match text {
        "any" => Type::Any,
        "bool" => Type::Bool,
        "int" => Type::Int,
        "float" => Type::Float,
        "string" => Type::String,
        "pose" => Type::Pose,
        "joints" => Type::Joints,
        "trajectory" => Type::Trajectory,
        "bytes" => Type::Bytes,
        "list" => Type::List(Box::new(Type::Any)),
        "map" => Type::Map(Box::new(Type::Any)),
        _ if text.starts_with("list<") => Type::List(Box::new(parse_type(inner("list<")?, depth + 1)?)),
        _ if text.starts_with("map<") => Type::Map(Box::new(parse_type(inner("map<")?, depth + 1)?)),
        _ => {
            let fields = text.strip_prefix('{')?.strip_suffix('}')?;
            let mut record = BTreeMap::new();
            for field in split_top_level(fields) {
                let (name, ty) = field.split_once(':')?;
                record.insert(name.trim().to_owned(), parse_type(ty.trim(), depth + 1)?);
            }
            Type::Record(record)
        }
    })
}

/// Splits at commas outside brackets.
fn split_top_level(text: &str) -> Vec<&str> {
    let (mut depth, mut start, mut parts) = (0_i32, 0, Vec::new());
    for (i, c) in text.char_indices() {
        match c {
            '<' | '{' => depth += 1,
            '>' | '}' => depth -= 1,
            ',' if depth == 0 => {
                parts.push(text[start..i].trim());
                start = i + 1;
            }
            _ => {}
        }
    }
    if !text[start..].trim().is_empty() {
        parts.push(text[start..].trim());
    }
    parts
}

impl fmt::Display for Value {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Value::Null => f.write_str("null"),
            Value::Bool(b) => write!(f, "{b}"),
            Value::Int(i) => write!(f, "{i}"),
            Value::Float(x) => float(f, *x, None),
            Value::String(s) => f.write_str(s),
            Value::Pose(p) => {
                let ([x, y, z], [i, j, k, w]) = (p.position, p.quaternion_xyzw);
                for (number, before) in [(x, "pose("), (y, ", "), (z, ", "), (i, "; "), (j, ", "), (k, ", "), (w, ", ")]
                {
                    f.write_str(before)?;
                    float(f, number, Some(3))?;
                }
                f.write_str(")")
            }
            Value::Joints(j) => {
                f.write_str("joints(")?;
                for (i, x) in j.iter().enumerate() {
                    f.write_str(if i == 0 { "" } else { ", " })?;
                    float(f, *x, Some(3))?;
                }
                f.write_str(")")
            }
            Value::Trajectory(t) => write!(f, "trajectory({} points, {:.2} s)", t.points.len(), t.duration_s()),
            Value::List(values) => {
                f.write_str("[")?;
                for (i, v) in values.iter().enumerate() {
                    write!(f, "{}{v}", if i == 0 { "" } else { ", " })?;
                }
                f.write_str("]")
            }
            Value::Map(fields) => {
                f.write_str("{")?;
                for (i, (name, v)) in fields.iter().enumerate() {
                    write!(f, "{}{name}: {v}", if i == 0 { "" } else { ", " })?;
                }
                f.write_str("}")
            }
            Value::Bytes(bytes) => write!(f, "{} bytes", bytes.len()),
        }
    }
}

/// A number with this many decimals, or with all that it has. Above sixteen digits before the point, or with many zeros behind it, it has
/// an exponent.
fn float(f: &mut fmt::Formatter<'_>, number: f64, digits: Option<usize>) -> fmt::Result {
    match digits {
        _ if number.is_finite() && number.abs() >= 1e16 => write!(f, "{number:e}"),
        Some(digits) => write!(f, "{number:.digits$}"),
        None if number != 0.0 && number.abs() < 1e-9 => write!(f, "{number:e}"),
        None => write!(f, "{number}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_short_however_large_or_small_they_are() {
        let said = |value: Value| value.to_string();
        assert_eq!(
            [1e300, -1.5e16, 1e15, 0.25, 1e-6, 5e-324].map(|x| said(Value::Float(x))),
            ["1e300", "-1.5e16", "1000000000000000", "0.25", "0.000001", "5e-324"]
        );
        assert_eq!(said(Value::Joints(vec![1e300, 0.5])), "joints(1e300, 0.500)");
        let pose = said(Value::Pose(Pose::at(1e300, 0.5, 0.0)));
        assert_eq!(pose, "pose(1e300, 0.500, 0.000; 0.000, 0.000, 0.000, 1.000)");
    }

    #[test]
    fn types_read_back_as_written() {
        for text in ["int", "list<pose>", "list<{id: string, pose: pose}>", "map<list<float>>"] {
            assert_eq!(text.parse::<Type>().map(|t| t.to_string()), Ok(text.to_owned()));
        }
        assert!("list<poze>".parse::<Type>().is_err());
        assert!("list<".repeat(100).parse::<Type>().is_err());
    }

    #[test]
    fn an_int_flows_into_a_float_but_not_back() {
        assert!(Type::Float.accepts_type(&Type::Int));
        assert!(!Type::Int.accepts_type(&Type::Float));
    }

    #[test]
    fn an_int_in_the_place_of_a_float_is_widened_also_within_lists_and_records() {
        let value = |number: fn(i64) -> Value| {
            let times = Value::List(vec![number(1), Value::Float(0.5)].into());
            Value::map([("shots", Value::Int(3)), ("times", times), ("more", Value::map([("a", number(-2))]))])
        };
        let ty = "{shots: int, times: list<float>, more: map<float>}".parse::<Type>();
        assert_eq!(ty.map(|ty| ty.widened(value(Value::Int))), Ok(value(|int| Value::Float(int as f64))));
        assert_eq!(Type::Any.widened(Value::Int(1)), Value::Int(1));
    }
}
