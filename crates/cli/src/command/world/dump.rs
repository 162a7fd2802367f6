//! Facts in exact JSON: what is read is what was written, to the last bit of every number.
//!
//! `{"revision": 7, "facts": [{"predicate": "at", "arguments": ["box_1"], "value": {"pose": {…}}, "revision": 3, "writer": "place[1]",
//! "measured": {"source": "camera", "certainty": {"confidence": 0.9}}}]}`; a value names its kind. Loading a dump uses predicate,
//! arguments, value and `measured`.

use anyhow::{Context, ensure};
use ratn_model::fact::{FactKey, Term};
use ratn_model::id::Revision;
use ratn_model::measurement::Measurement;
use ratn_model::value::Value;
use ratn_proto::types::FactRecord;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

#[derive(Debug, Deserialize)]
struct Dump {
    facts: Vec<DumpedFact>,
}

#[derive(Debug, Serialize, Deserialize)]
struct DumpedFact {
    predicate: String,
    arguments: Vec<Term>,
    value: Value,
    #[serde(default)]
    revision: u64,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    writer: Option<Arc<str>>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    measured: Option<Arc<Measurement>>,
}

/// The facts of one revision.
pub(super) fn json(revision: Revision, facts: &[FactRecord]) -> serde_json::Value {
    let facts: Vec<serde_json::Value> = facts.iter().map(fact).collect();
    serde_json::json!({ "revision": revision.0, "facts": facts })
}

/// One fact.
pub(super) fn fact(fact: &FactRecord) -> serde_json::Value {
    let dumped = DumpedFact {
        predicate: fact.key.predicate.clone(),
        arguments: fact.key.arguments.clone(),
        value: fact.value.clone(),
        revision: fact.revision.0,
        writer: fact.writer.clone(),
        measured: fact.measured.clone(),
    };
    // This cannot fail: there are no maps with keys that are not strings.
    serde_json::to_value(dumped).unwrap_or_default()
}

/// Reads what [`json`] wrote.
pub(super) fn read(text: &str) -> anyhow::Result<Vec<FactRecord>> {
    let dump: Dump = serde_json::from_str(text).context("not what `ratn world dump` writes")?;
    let fact = |fact: DumpedFact| FactRecord {
        key: FactKey { predicate: fact.predicate, arguments: fact.arguments },
        value: fact.value,
        revision: Revision(fact.revision),
        writer: fact.writer,
        measured: fact.measured,
    };
    let facts: Vec<FactRecord> = dump.facts.into_iter().map(fact).collect();
    once(&facts)?;
    Ok(facts)
}

/// Refuses two values for one fact, because it is unknown which is meant.
pub(super) fn once(facts: &[FactRecord]) -> anyhow::Result<()> {
    let mut seen = std::collections::BTreeSet::new();
    let twice = facts.iter().find(|fact| !seen.insert(&fact.key));
    ensure!(twice.is_none(), "{} is there twice", twice.map_or_else(String::new, |fact| fact.key.to_string()));
    Ok(())
}

#[cfg(test)]
pub(super) mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use crate::command::world::turtle;
    use proptest::collection::{btree_map, vec};
    use proptest::prelude::*;
    use ratn_model::measurement::Certainty;
    use ratn_model::pose::Pose;
    use ratn_model::value::{Trajectory, TrajectoryPoint};

    fn number() -> impl Strategy<Value = f64> {
        prop_oneof![
            any::<f64>().prop_filter("finite", |x| x.is_finite()),
            Just(-0.0),
            Just(0.1 + 0.2),
            Just(5e-324),
            Just(1.0)
        ]
    }

    fn text() -> impl Strategy<Value = String> {
        prop_oneof!["[a-z]{1,6}", any::<String>(), Just("\"\\n\u{1}<é>\\\"".to_owned())]
    }

    fn value() -> impl Strategy<Value = Value> {
        let pose = (prop::array::uniform3(number()), prop::array::uniform4(number()))
            .prop_map(|(position, quaternion_xyzw)| Value::Pose(Pose { position, quaternion_xyzw }));
        let point = (number(), vec(number(), 0..3), vec(number(), 0..3))
            .prop_map(|(time_s, positions, velocities)| TrajectoryPoint { time_s, positions, velocities });
        let trajectory = (vec(text(), 0..3), vec(point, 0..3))
            .prop_map(|(joints, points)| Value::Trajectory(Trajectory { joints, points }));
        let leaf = prop_oneof![
            Just(Value::Null),
            any::<bool>().prop_map(Value::Bool),
            any::<i64>().prop_map(Value::Int),
            number().prop_map(Value::Float),
            text().prop_map(Value::String),
            pose,
            vec(number(), 0..7).prop_map(Value::Joints),
            trajectory,
            vec(any::<u8>(), 0..9).prop_map(Value::Bytes),
        ];
        leaf.prop_recursive(3, 24, 4, |inner| {
            prop_oneof![
                vec(inner.clone(), 0..4).prop_map(|items| Value::List(items.into())),
                btree_map(text(), inner, 0..4).prop_map(Value::Map),
            ]
        })
    }

    fn facts() -> impl Strategy<Value = Vec<FactRecord>> {
        let term = prop_oneof![any::<i64>().prop_map(Term::Int), text().prop_map(Term::Name)];
        let key = (text(), vec(term, 0..4)).prop_map(|(predicate, arguments)| FactKey { predicate, arguments });
        let certainty =
            prop_oneof![number().prop_map(Certainty::Confidence), vec(number(), 4).prop_map(Certainty::Covariance),];
        let measured = (text(), prop::option::of(certainty))
            .prop_map(|(source, certainty)| Arc::new(Measurement { source, certainty }));
        let said = (value(), any::<u64>(), prop::option::of(text()), prop::option::of(measured));
        btree_map(key, said, 0..6).prop_map(|facts| {
            let fact = |(key, (value, revision, writer, measured)): (FactKey, (Value, u64, Option<String>, _))| {
                FactRecord { key, value, revision: Revision(revision), writer: writer.map(Arc::from), measured }
            };
            facts.into_iter().map(fact).collect()
        })
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 256, failure_persistence: None, ..ProptestConfig::default() })]

        #[test]
        fn a_dump_in_either_format_is_read_as_it_was_written(facts in facts()) {
            let text = serde_json::to_string_pretty(&json(Revision(7), &facts)).unwrap();
            // Compared as text, because equal numbers may differ in their sign.
            prop_assert_eq!(format!("{:?}", read(&text).unwrap()), format!("{:?}", &facts), "{}", text);
            let text = turtle::write(&facts).unwrap();
            let told: Vec<FactRecord> = facts
                .iter()
                .map(|fact| FactRecord { revision: Revision(0), writer: None, ..fact.clone() })
                .collect();
            let mut read = turtle::read(&text).unwrap();
            read.sort_by(|a, b| a.key.cmp(&b.key));
            prop_assert_eq!(format!("{read:?}"), format!("{told:?}"), "{}", text);
        }
    }

    #[test]
    fn what_is_no_dump_is_refused() {
        for (text, why) in [
            ("{", "not what"),
            ("[]", "not what"),
            (r#"{"facts": [{"predicate": "at", "arguments": []}]}"#, "not what"),
            (
                r#"{"facts": [{"predicate": "at", "arguments": [], "value": "null"}, {"predicate": "at", "arguments": [], "value": "null"}]}"#,
                "at() is there twice",
            ),
        ] {
            let refused = format!("{:#}", read(text).unwrap_err());
            assert!(refused.contains(why), "{refused}");
        }
    }
}
