//! Approximate memory of facts and changes in bytes: themselves, the data that they own, and their entries in tables. Shared data (names
//! of writers) is not counted.

use ratn_model::fact::{Change, FactKey, FactPattern, Footprint, Term};
use ratn_model::measurement::{Certainty, Measurement};
use ratn_model::value::{Trajectory, TrajectoryPoint, Value};
use ratn_world::world::{Fact, Written};

/// Bytes of a fact in the tables and indexes of a world, besides its key and its value.
const PLACE: usize = 256;

/// Bytes of a written fact: its key, its value and its table entries.
pub(super) fn of_fact(key: &FactKey, fact: &Fact) -> usize {
    let measured = fact.measured.as_deref().map_or(0, of_measurement);
    of_key(key) + size_of::<Fact>() + of_value(&fact.value) + measured
}

/// Bytes of a key with its table entries.
pub(super) fn of_key(key: &FactKey) -> usize {
    PLACE + size_of::<FactKey>() + key.predicate.len() + key.arguments.iter().map(of_term).sum::<usize>()
}

pub(super) fn of_written(written: &Written) -> usize {
    written.iter().map(|(key, fact)| fact.as_deref().map_or_else(|| of_key(key), |fact| of_fact(key, fact))).sum()
}

pub(super) fn of_changes(changes: &[Change]) -> usize {
    let one = |change: &Change| match change {
        Change::Set { fact, value } => of_key(fact) + of_value(value),
        Change::Increase { fact, .. } => of_key(fact),
        Change::Delete { pattern } => of_pattern(pattern),
    };
    changes.iter().map(one).sum()
}

pub(super) fn of_footprint(footprint: &Footprint) -> usize {
    match footprint {
        Footprint::Everything => 0,
        Footprint::Patterns(patterns) => of_patterns(patterns),
    }
}

pub(super) fn of_patterns(patterns: &[FactPattern]) -> usize {
    patterns.iter().map(of_pattern).sum()
}

fn of_pattern(pattern: &FactPattern) -> usize {
    let arguments = pattern.arguments.iter().map(|term| term.as_ref().map_or(size_of::<Term>(), of_term));
    PLACE + size_of::<FactPattern>() + pattern.predicate.len() + arguments.sum::<usize>()
}

fn of_term(term: &Term) -> usize {
    size_of::<Term>() + if let Term::Name(name) = term { name.len() } else { 0 }
}

fn of_measurement(measured: &Measurement) -> usize {
    let numbers = if let Some(Certainty::Covariance(numbers)) = &measured.certainty { numbers.len() } else { 0 };
    size_of::<Measurement>() + measured.source.len() + numbers * size_of::<f64>()
}

/// Bytes that a value owns; the value itself is counted by its owner.
fn of_value(value: &Value) -> usize {
    match value {
        Value::Null | Value::Bool(_) | Value::Int(_) | Value::Float(_) | Value::Pose(_) => 0,
        Value::String(text) => text.len(),
        Value::Bytes(bytes) => bytes.len(),
        Value::Joints(positions) => positions.len() * size_of::<f64>(),
        Value::Trajectory(trajectory) => of_trajectory(trajectory),
        Value::List(items) => items.iter().map(|item| size_of::<Value>() + of_value(item)).sum(),
        Value::Map(fields) => {
            let field = |(name, value): (&String, &Value)| size_of::<(String, Value)>() + name.len() + of_value(value);
            fields.iter().map(field).sum()
        }
    }
}

fn of_trajectory(trajectory: &Trajectory) -> usize {
    let joints = trajectory.joints.iter().map(|joint| size_of::<String>() + joint.len());
    let numbers = |point: &TrajectoryPoint| (point.positions.len() + point.velocities.len()) * size_of::<f64>();
    let points = trajectory.points.iter().map(|point| size_of::<TrajectoryPoint>() + numbers(point));
    joints.sum::<usize>() + points.sum::<usize>()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_list_takes_its_items_and_not_only_the_bytes_that_they_have_on_the_wire() {
        let thousand = Value::List(vec![Value::Int(0); 1_000].into());
        assert_eq!(of_value(&thousand), 1_000 * size_of::<Value>());
        assert_eq!(
            of_value(&Value::List(vec![thousand, Value::String("abc".to_owned())].into())),
            1_002 * size_of::<Value>() + 3
        );
        let field = [("key".to_owned(), Value::Bytes(vec![0; 50]))];
        assert_eq!(of_value(&Value::Map(field.into())), size_of::<(String, Value)>() + 53);
    }
}
