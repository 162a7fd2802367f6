//! Values, poses, trajectories.

use super::{MAX_DEPTH, MAX_ELEMENTS, Malformed, all_finite, finite, missing_choice, name};
use crate::v1;
use crate::v1::value::Kind;
use ratn_model::pose::Pose;
use ratn_model::value::{Trajectory, TrajectoryPoint, Value};
use std::collections::BTreeMap;

/// Maximum deviation of the length of a pose's quaternion from 1.
const QUATERNION_TOLERANCE: f64 = 0.01;

impl From<Value> for v1::Value {
    fn from(value: Value) -> v1::Value {
        let kind = match value {
            Value::Null => Kind::Null(v1::Null {}),
            Value::Bool(b) => Kind::Boolean(b),
            Value::Int(i) => Kind::Integer(i),
            Value::Float(x) => Kind::Number(x),
            Value::String(text) => Kind::Text(text),
            Value::Pose(pose) => Kind::Pose(pose.into()),
            Value::Joints(positions) => Kind::Joints(v1::Joints { positions }),
            Value::Trajectory(trajectory) => Kind::Trajectory(trajectory.into()),
            Value::List(values) => {
                Kind::List(v1::ValueList { values: values.into_iter().map(v1::Value::from).collect() })
            }
            Value::Map(fields) => Kind::Map(v1::ValueMap { fields: super::wire_ports(fields) }),
            Value::Bytes(bytes) => Kind::Opaque(bytes),
        };
        v1::Value { kind: Some(kind) }
    }
}

impl TryFrom<v1::Value> for Value {
    type Error = Malformed;

    fn try_from(value: v1::Value) -> Result<Value, Malformed> {
        read(value, 0, &mut MAX_ELEMENTS.clone())
    }
}

/// Reads a value at nesting depth `depth`; `budget` is the remaining number of elements.
fn read(value: v1::Value, depth: usize, budget: &mut usize) -> Result<Value, Malformed> {
    let mut room = |elements: usize| {
        if depth == MAX_DEPTH {
            return Err(Malformed::new("", format!("lists and maps nest deeper than {MAX_DEPTH}")));
        }
        *budget = budget
            .checked_sub(elements)
            .ok_or_else(|| Malformed::new("", format!("the value has more than {MAX_ELEMENTS} elements")))?;
        Ok(())
    };
    let kind = value.kind.ok_or_else(|| {
        missing_choice("null, boolean, integer, number, text, pose, joints, trajectory, list, map, opaque")
    })?;
    Ok(match kind {
        Kind::Null(v1::Null {}) => Value::Null,
        Kind::Boolean(b) => Value::Bool(b),
        Kind::Integer(i) => Value::Int(i),
        Kind::Number(x) => Value::Float(finite(x, "number")?),
        Kind::Text(text) => Value::String(text),
        Kind::Pose(pose) => Value::Pose(pose.try_into().map_err(|m: Malformed| m.within("pose"))?),
        Kind::Joints(joints) => {
            all_finite(&joints.positions, "joints")?;
            Value::Joints(joints.positions)
        }
        Kind::Trajectory(path) => Value::Trajectory(path.try_into().map_err(|m: Malformed| m.within("trajectory"))?),
        Kind::List(list) => {
            room(list.values.len())?;
            let mut values = Vec::with_capacity(list.values.len());
            for (i, element) in list.values.into_iter().enumerate() {
                values.push(read(element, depth + 1, budget).map_err(|m| m.within(format!("[{i}]")))?);
            }
            Value::List(values.into())
        }
        Kind::Map(map) => {
            room(map.fields.len())?;
            let mut fields = BTreeMap::new();
            for (key, element) in map.fields {
                name(&key, "name")?;
                let element = read(element, depth + 1, budget).map_err(|m| m.within(format!("[{key}]")))?;
                fields.insert(key, element);
            }
            Value::Map(fields)
        }
        Kind::Opaque(bytes) => Value::Bytes(bytes),
    })
}

impl From<Pose> for v1::Pose {
    fn from(pose: Pose) -> v1::Pose {
        v1::Pose { position_m: pose.position.to_vec(), quaternion_xyzw: pose.quaternion_xyzw.to_vec() }
    }
}

impl TryFrom<v1::Pose> for Pose {
    type Error = Malformed;

    fn try_from(pose: v1::Pose) -> Result<Pose, Malformed> {
        all_finite(&pose.position_m, "position_m")?;
        all_finite(&pose.quaternion_xyzw, "quaternion_xyzw")?;
        let count = |field: &str, have: usize, want: usize| {
            Malformed::new(field, format!("has {have} numbers: exactly {want} are needed"))
        };
        let position = pose.position_m.try_into().map_err(|p: Vec<f64>| count("position_m", p.len(), 3))?;
        let quaternion_xyzw: [f64; 4] =
            pose.quaternion_xyzw.try_into().map_err(|q: Vec<f64>| count("quaternion_xyzw", q.len(), 4))?;
        let length = quaternion_xyzw.iter().map(|c| c * c).sum::<f64>().sqrt();
        if (length - 1.0).abs() > QUATERNION_TOLERANCE {
            return Err(Malformed::new("quaternion_xyzw", format!("has length {length}: it must be 1")));
        }
        Ok(Pose { position, quaternion_xyzw })
    }
}

impl From<Trajectory> for v1::Trajectory {
    fn from(trajectory: Trajectory) -> v1::Trajectory {
        let point = |p: TrajectoryPoint| v1::TrajectoryPoint {
            time_s: p.time_s,
            positions: p.positions,
            velocities: p.velocities,
        };
        v1::Trajectory { joints: trajectory.joints, points: trajectory.points.into_iter().map(point).collect() }
    }
}

impl TryFrom<v1::Trajectory> for Trajectory {
    type Error = Malformed;

    fn try_from(trajectory: v1::Trajectory) -> Result<Trajectory, Malformed> {
        for (i, joint) in trajectory.joints.iter().enumerate() {
            name(joint, &format!("joints[{i}]"))?;
        }
        let joints = trajectory.joints.len();
        if trajectory.points.is_empty() {
            return Err(Malformed::new("points", "is empty: a trajectory has at least one point"));
        }
        let mut points = Vec::with_capacity(trajectory.points.len());
        let mut earliest = f64::NEG_INFINITY;
        for (i, point) in trajectory.points.into_iter().enumerate() {
            check_point(&point, joints, earliest).map_err(|m| m.within(format!("points[{i}]")))?;
            earliest = point.time_s;
            points.push(TrajectoryPoint {
                time_s: point.time_s,
                positions: point.positions,
                velocities: point.velocities,
            });
        }
        Ok(Trajectory { joints: trajectory.joints, points })
    }
}

fn check_point(point: &v1::TrajectoryPoint, joints: usize, after: f64) -> Result<(), Malformed> {
    finite(point.time_s, "time_s")?;
    all_finite(&point.positions, "positions")?;
    all_finite(&point.velocities, "velocities")?;
    if point.time_s < 0.0 || point.time_s <= after {
        return Err(Malformed::new("time_s", format!("is {}: times start at 0 and grow strictly", point.time_s)));
    }
    if point.positions.len() != joints {
        let have = point.positions.len();
        return Err(Malformed::new("positions", format!("has {have} numbers for {joints} joints")));
    }
    if !point.velocities.is_empty() && point.velocities.len() != joints {
        let have = point.velocities.len();
        return Err(Malformed::new("velocities", format!("has {have} numbers for {joints} joints")));
    }
    Ok(())
}
