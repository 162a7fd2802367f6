//! Facts in the syntax of a task file, so that the output can be pasted there.
//!
//! Numbers are rounded to a micrometre or microradian; JSON and dumps are exact. Orientations are given as roll, pitch
//! and yaw.

use ratn_model::fact::{FactKey, Term};
use ratn_model::pose::Pose;
use ratn_model::value::Value;
use ratn_proto::types::FactRecord;
use std::f64::consts::FRAC_PI_2;

/// A smaller number (from 1e-6 on) is written with nine decimals.
const SMALL: f64 = 1e-3;
/// A larger number is an integer, and is written with an exponent.
const LARGE: f64 = 1e16;
/// At a pitch this close to a right angle, roll and yaw turn about the same axis.
const UPRIGHT: f64 = 1.0 - 1e-9;
/// Words that an expression does not read as text.
const KEYWORDS: [&str; 9] = ["true", "false", "null", "and", "or", "not", "in", "exists", "by"];

/// The `world` section of a task with these facts; facts that a task cannot express are comments.
pub(super) fn world(facts: &[FactRecord]) -> String {
    let line = |fact: &FactRecord| match value(&fact.value) {
        Some(said) => format!("  - '{}'", format!("{} = {said}", key(&fact.key)).replace('\'', "''")),
        None => format!("  # {} is {}, which no task can say", fact.key, fact.value),
    };
    std::iter::once("world:".to_owned()).chain(facts.iter().map(line)).collect::<Vec<_>>().join("\n")
}

/// A fact without its value.
pub(super) fn key(key: &FactKey) -> String {
    let arguments: Vec<String> = key
        .arguments
        .iter()
        .map(|argument| match argument {
            Term::Name(name) => text(name),
            Term::Int(number) => number.to_string(),
        })
        .collect();
    format!("{}({})", key.predicate, arguments.join(", "))
}

/// A value as an expression; `None` for values without one.
pub(super) fn value(value: &Value) -> Option<String> {
    Some(match value {
        Value::Null => "null".to_owned(),
        Value::Bool(yes) => yes.to_string(),
        Value::Int(number) => number.to_string(),
        Value::Float(number) => {
            let written = rounded(*number);
            if written.contains(['.', 'e']) { written } else { format!("{written}.0") }
        }
        Value::String(said) => text(said),
        Value::Pose(pose) => self::pose(pose),
        Value::Joints(positions) => {
            format!("joints({})", positions.iter().map(|one| rounded(*one)).collect::<Vec<_>>().join(", "))
        }
        Value::List(items) => format!("[{}]", items.iter().map(self::value).collect::<Option<Vec<_>>>()?.join(", ")),
        Value::Map(fields) => {
            let said = fields.iter().map(|(name, one)| Some(format!("{}: {}", text(name), self::value(one)?)));
            format!("{{{}}}", said.collect::<Option<Vec<_>>>()?.join(", "))
        }
        Value::Trajectory(_) | Value::Bytes(_) => return None,
    })
}

fn pose(pose: &Pose) -> String {
    let [x, y, z, w] = pose.quaternion_xyzw;
    let sine = (2.0 * (w * y - z * x)).clamp(-1.0, 1.0);
    let [roll, pitch, yaw] = if sine.abs() > UPRIGHT {
        [0.0, FRAC_PI_2.copysign(sine), 2.0 * z.atan2(w)]
    } else {
        let roll = (2.0 * (w * x + y * z)).atan2(1.0 - 2.0 * (x * x + y * y));
        let yaw = (2.0 * (w * z + x * y)).atan2(1.0 - 2.0 * (y * y + z * z));
        [roll, sine.asin(), yaw]
    };
    let turned = [roll, pitch, yaw].map(rounded);
    let mut numbers: Vec<String> = pose.position.iter().map(|one| rounded(*one)).collect();
    if turned.iter().any(|angle| angle != "0") {
        numbers.extend(turned);
    }
    format!("pose({})", numbers.join(", "))
}

/// Without trailing zeros.
fn rounded(number: f64) -> String {
    if number != 0.0 && number.abs() < SMALL && number.abs() >= 1e-6 {
        return format!("{number:.9}").trim_end_matches('0').trim_end_matches('.').to_owned();
    }
    if number.abs() >= LARGE {
        return format!("{number:?}");
    }
    let fixed = format!("{number:.6}");
    let short = fixed.trim_end_matches('0').trim_end_matches('.');
    if short == "-0" { "0".to_owned() } else { short.to_owned() }
}

fn text(said: &str) -> String {
    let is_word = said.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
        && said.starts_with(|c: char| c.is_ascii_alphabetic() || c == '_');
    if is_word && !KEYWORDS.contains(&said) {
        return said.to_owned();
    }
    let escaped = said.replace('\\', "\\\\").replace('"', "\\\"").replace('\n', "\\n").replace('\t', "\\t");
    format!("\"{escaped}\"")
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use ratn_model::catalogue::Catalogue;
    use ratn_model::expression::EffectExpr;
    use ratn_model::expression::scope::NothingKnown;
    use ratn_model::id::Revision;
    use std::collections::BTreeMap;

    fn fact(name: &str, value: Value) -> FactRecord {
        let key = FactKey { predicate: "fact".to_owned(), arguments: vec![Term::Name(name.to_owned()), Term::Int(-3)] };
        FactRecord { key, value, revision: Revision(1), writer: None, measured: None }
    }

    /// The initial values of a task, in the order of its file.
    fn pasted(world: &str) -> Vec<Value> {
        let source = format!("task: pasted\n{world}\nstates: []\n");
        let loaded = ratn_model::load::load(&source, "pasted.yaml", &Catalogue::standard());
        let loaded = loaded.unwrap_or_else(|findings| panic!("{}\n{source}", findings[0]));
        let value = |effect: &EffectExpr| match effect {
            EffectExpr::Set(_, expression) => expression.evaluate(&NothingKnown).unwrap(),
            other => panic!("{other}"),
        };
        loaded.program.initial.iter().map(value).collect()
    }

    #[test]
    fn what_is_shown_can_be_pasted_into_a_task() {
        let size = Value::List(vec![Value::Float(0.078846), Value::Float(-2.0), Value::Float(1e-4)].into());
        let values = [
            Value::Null,
            Value::Bool(true),
            Value::Int(-7),
            Value::Float(2.0),
            Value::Float(1e300),
            Value::Float(-1.5e16),
            Value::Joints(vec![1e300, 0.5]),
            Value::String("box_1".to_owned()),
            Value::String("true".to_owned()),
            Value::String("it's: a \"left\" hand # 2\\".to_owned()),
            Value::Joints(vec![0.9, -1.2, 0.0]),
            Value::Map(BTreeMap::from([
                ("type".to_owned(), Value::String("box".to_owned())),
                ("size".to_owned(), size.clone()),
            ])),
            Value::List(vec![size].into()),
        ];
        let facts: Vec<FactRecord> = values.iter().map(|value| fact("left hand", value.clone())).collect();
        assert_eq!(pasted(&world(&facts)), values);
    }

    #[test]
    fn a_pose_that_is_pasted_is_the_same_pose() {
        let angles = [-3.1, -FRAC_PI_2, -0.4, 0.0, 0.7, FRAC_PI_2, 2.9];
        let poses: Vec<Pose> = angles
            .iter()
            .flat_map(|roll| angles.iter().map(move |pitch| (*roll, *pitch)))
            .flat_map(|(roll, pitch)| {
                angles.iter().map(move |yaw| Pose::from_rpy([0.1, -0.25, 1.5], roll, pitch, *yaw))
            })
            .collect();
        let facts: Vec<FactRecord> = poses.iter().map(|pose| fact("x", Value::Pose(*pose))).collect();
        for (pose, value) in poses.iter().zip(pasted(&world(&facts))) {
            let Value::Pose(again) = value else { panic!("{value}") };
            assert!(pose.distance(&again) < 1e-5 && pose.angle(&again) < 1e-4, "{pose:?} {again:?}");
        }
    }

    #[test]
    fn what_no_task_can_say_is_a_comment() {
        let text = world(&[fact("x", Value::Bytes(vec![1, 2])), fact("x", Value::Int(1))]);
        assert!(text.contains("  # fact(x, -3) is 2 bytes, which no task can say"), "{text}");
        assert_eq!(pasted(&text), [Value::Int(1)]);
    }
}
