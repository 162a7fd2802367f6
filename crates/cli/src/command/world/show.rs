//! Facts, differences and histories as tables for people and as JSON for programs.

use super::{dump, task_text};
use crate::columns::{aligned, columns};
use ratn_model::fact::FactKey;
use ratn_model::id::Revision;
use ratn_model::measurement::{Certainty, Measurement};
use ratn_model::value::Value;
use ratn_proto::types::{FactDifference, FactRecord, FactVersion, WorldChange, WorldUpdate};
use ratn_world::query::Rows;
use serde_json::json;

/// One line per fact.
pub(super) fn facts(facts: &[FactRecord]) -> String {
    let rows = facts.iter().map(|fact| {
        [
            task_text::key(&fact.key),
            said(&fact.value),
            fact.revision.0.to_string(),
            fact.writer.as_deref().unwrap_or("-").to_owned(),
            fact.measured.as_deref().map_or_else(String::new, |by| measured(by, &fact.value)),
        ]
    });
    columns(&["FACT", "VALUE", "REVISION", "WRITER", "MEASURED BY"], rows.collect())
}

/// A value as in a task file, where that is possible.
fn said(value: &Value) -> String {
    task_text::value(value).unwrap_or_else(|| value.to_string())
}

/// One line each: the value before, the value after, and the writer; the writer of a deletion is
/// not kept.
pub(super) fn differences(differences: &[FactDifference]) -> String {
    let value = |fact: &Option<FactRecord>| fact.as_ref().map_or_else(|| "-".to_owned(), |fact| said(&fact.value));
    let rows = differences.iter().map(|one| {
        let writer = one.after.as_ref().and_then(|fact| fact.writer.as_deref()).unwrap_or("-").to_owned();
        [task_text::key(&one.key), value(&one.before), value(&one.after), writer]
    });
    columns(&["FACT", "BEFORE", "AFTER", "WRITER"], rows.collect())
}

pub(super) fn differences_json(from: Revision, to: Revision, differences: &[FactDifference]) -> serde_json::Value {
    let differences: Vec<_> = differences
        .iter()
        .map(|one| {
            json!({
                "predicate": one.key.predicate, "arguments": one.key.arguments,
                "before": one.before.as_ref().map(dump::fact), "after": one.after.as_ref().map(dump::fact),
            })
        })
        .collect();
    json!({ "from": from.0, "to": to.0, "differences": differences })
}

/// One line each, newest first, and the revision before which nothing is known.
pub(super) fn versions(key: &FactKey, oldest: Revision, versions: &[FactVersion]) -> String {
    if versions.is_empty() {
        return format!("{key} never was, since revision {}, the oldest that is kept", oldest.0);
    }
    let rows = versions.iter().map(|version| {
        let fact = version.fact.as_ref();
        [
            version.revision.0.to_string(),
            fact.map_or_else(|| "(gone)".to_owned(), |fact| said(&fact.value)),
            version.writer.as_deref().unwrap_or("-").to_owned(),
            if version.commit.is_empty() { "-".to_owned() } else { version.commit.clone() },
        ]
    });
    let table = columns(&["REVISION", "VALUE", "WRITER", "COMMIT"], rows.collect());
    format!("{table}\nkept since revision {}", oldest.0)
}

pub(super) fn versions_json(oldest: Revision, versions: &[FactVersion]) -> serde_json::Value {
    let versions: Vec<_> = versions
        .iter()
        .map(|version| {
            let fact = version.fact.as_ref().map(dump::fact);
            json!({ "revision": version.revision.0, "commit": version.commit, "writer": version.writer, "fact": fact })
        })
        .collect();
    json!({ "oldest": oldest.0, "versions": versions })
}

/// A revision, and below it what was written.
pub(super) fn change(change: &WorldChange) -> String {
    let commit = if change.commit.is_empty() { "too old" } else { &change.commit };
    let by = change.writer.as_deref().map_or_else(String::new, |writer| format!(" by {writer}"));
    let mut lines = vec![format!("revision {}{by} ({commit})", change.revision.0)];
    lines.extend(change.written.iter().map(|fact| format!("  {} = {}", task_text::key(&fact.key), said(&fact.value))));
    lines.extend(change.gone.iter().map(|key| format!("  {} is gone", task_text::key(key))));
    lines.join("\n")
}

pub(super) fn update_json(update: &WorldUpdate) -> serde_json::Value {
    match update {
        WorldUpdate::Snapshot { revision, facts } => dump::json(*revision, facts),
        WorldUpdate::Changed(change) => {
            let written: Vec<_> = change.written.iter().map(dump::fact).collect();
            let gone: Vec<_> = change
                .gone
                .iter()
                .map(|key| json!({ "predicate": key.predicate, "arguments": key.arguments }))
                .collect();
            json!({
                "revision": change.revision.0,
                "commit": change.commit,
                "writer": change.writer,
                "written": written,
                "gone": gone,
            })
        }
    }
}

/// One line per answer; a query without variables is answered yes or no.
pub(super) fn rows(rows: &Rows) -> String {
    if rows.variables.is_empty() {
        return if rows.rows.is_empty() { "no" } else { "yes" }.to_owned();
    }
    let cells = rows.rows.iter().map(|row| row.iter().map(said).collect());
    table(&rows.variables, cells.collect(), rows.more)
}

/// The values of variables in each row; `more` says that there are more rows.
pub(super) fn table(variables: &[String], rows: Vec<Vec<String>>, more: bool) -> String {
    let head: Vec<String> = variables.iter().map(|name| format!("?{name}")).collect();
    let mut lines = aligned(&[vec![head], rows].concat());
    if more {
        lines.push("(there are more: --limit)".to_owned());
    }
    lines.join("\n")
}

pub(super) fn rows_json(revision: Revision, rows: &Rows) -> serde_json::Value {
    json!({ "revision": revision.0, "variables": rows.variables, "rows": rows.rows, "more": rows.more })
}

fn measured(measured: &Measurement, value: &Value) -> String {
    match &measured.certainty {
        None => measured.source.clone(),
        Some(Certainty::Confidence(confidence)) => format!("{} (confidence {})", measured.source, short(*confidence)),
        Some(Certainty::Covariance(entries)) => format!("{} ({})", measured.source, deviation(entries, value)),
    }
}

/// The greatest standard deviation; for a pose that of its position and of its rotation.
fn deviation(entries: &[f64], value: &Value) -> String {
    let rows = entries.len().isqrt();
    let greatest = |from: usize, to: usize| {
        (from..to).filter_map(|i| entries.get(i * (rows + 1))).fold(0.0_f64, |most, v| most.max(*v)).sqrt()
    };
    match value {
        Value::Pose(_) => format!("σ {:.1} mm, {:.1}°", greatest(0, 3) * 1e3, greatest(3, 6).to_degrees()),
        _ => format!("σ {}", short(greatest(0, rows))),
    }
}

/// Four decimals at most.
fn short(number: f64) -> f64 {
    (number * 1e4).round() / 1e4
}

#[cfg(test)]
mod tests {
    use super::*;
    use insta::assert_snapshot;
    use ratn_model::fact::Term;
    use ratn_model::pose::Pose;
    use std::sync::Arc;

    fn fact(name: &str, value: i64) -> FactRecord {
        let measured = Measurement { source: "camera".to_owned(), certainty: Some(Certainty::Confidence(0.9)) };
        FactRecord {
            key: FactKey { predicate: "full".to_owned(), arguments: vec![Term::Name(name.to_owned())] },
            value: Value::Int(value),
            revision: Revision(3),
            writer: Some(Arc::from("fill[2]")),
            measured: (name == "box").then(|| Arc::new(measured)),
        }
    }

    #[test]
    fn facts_say_who_wrote_them_when_and_what_measured_them() {
        let unsaid = FactRecord { writer: None, ..fact("base", 1) };
        assert_snapshot!(facts(&[fact("box", 12), unsaid]), @r"
        FACT        VALUE  REVISION  WRITER   MEASURED BY
        full(box)   12     3         fill[2]  camera (confidence 0.9)
        full(base)  1      3         -
        ");
    }

    #[test]
    fn a_pose_says_how_far_off_its_place_and_its_turn_may_be() {
        let mut entries = vec![0.0; 36];
        for (i, deviation) in [0.0005, 0.0002, 0.0001, 0.001, 0.001, 0.005].into_iter().enumerate() {
            entries[7 * i] = deviation * deviation;
        }
        let measured = Measurement { source: "camera".to_owned(), certainty: Some(Certainty::Covariance(entries)) };
        assert_eq!(super::measured(&measured, &Value::Pose(Pose::IDENTITY)), "camera (σ 0.5 mm, 0.3°)");
        let measured = Measurement { certainty: Some(Certainty::Covariance(vec![0.04])), ..measured };
        assert_eq!(super::measured(&measured, &Value::Float(2.0)), "camera (σ 0.2)");
    }

    #[test]
    fn differences_and_versions_say_what_was() {
        let key = fact("box", 1).key;
        let one = FactDifference { key: key.clone(), before: Some(fact("box", 1)), after: None };
        assert_snapshot!(differences(&[one]), @r"
        FACT       BEFORE  AFTER  WRITER
        full(box)  1       -      -
        ");
        let pose = FactRecord { value: Value::Pose(Pose::at(0.5, 0.0, 1.25)), ..fact("box", 1) };
        let one = FactDifference { key: key.clone(), before: None, after: Some(pose) };
        assert_snapshot!(differences(&[one]), @r"
        FACT       BEFORE  AFTER               WRITER
        full(box)  -       pose(0.5, 0, 1.25)  fill[2]
        ");
        let gone = FactVersion {
            revision: Revision(9),
            commit: "run/i4".to_owned(),
            fact: None,
            writer: Some("empty[4]".into()),
        };
        let was = FactVersion {
            revision: Revision(3),
            commit: "run/i1".to_owned(),
            fact: Some(fact("box", 1)),
            writer: Some("fill[2]".into()),
        };
        assert_snapshot!(versions(&key, Revision(2), &[gone, was]), @r"
        REVISION  VALUE   WRITER    COMMIT
        9         (gone)  empty[4]  run/i4
        3         1       fill[2]   run/i1
        kept since revision 2
        ");
    }

    #[test]
    fn a_revision_says_which_state_made_it_and_values_as_a_task_file_does() {
        let written = vec![FactRecord { value: Value::Pose(Pose::at(0.5, 0.0, 1.25)), ..fact("box", 1) }];
        let made = WorldChange {
            revision: Revision(3),
            commit: "run/i1".to_owned(),
            written,
            gone: Vec::new(),
            writer: Some("fill[2]".into()),
        };
        assert_snapshot!(change(&made), @r"
        revision 3 by fill[2] (run/i1)
          full(box) = pose(0.5, 0, 1.25)
        ");
        let gone = vec![FactKey { predicate: "full".to_owned(), arguments: vec![Term::Name("box 2".to_owned())] }];
        let made = WorldChange {
            revision: Revision(4),
            commit: "run/i2".to_owned(),
            written: Vec::new(),
            gone: gone.clone(),
            writer: Some("empty[3]".into()),
        };
        assert_snapshot!(change(&made), @r#"
        revision 4 by empty[3] (run/i2)
          full("box 2") is gone
        "#);
        let made =
            WorldChange { revision: Revision(5), commit: String::new(), written: Vec::new(), gone, writer: None };
        assert_snapshot!(change(&made), @r#"
        revision 5 (too old)
          full("box 2") is gone
        "#);
    }

    #[test]
    fn answers_are_a_table_or_yes_or_no() {
        let rows = |variables: &[&str], rows: Vec<Vec<Value>>| Rows {
            variables: variables.iter().map(|&name| name.to_owned()).collect(),
            rows,
            more: false,
        };
        assert_snapshot!(super::rows(&rows(&["box", "n"], vec![vec![Value::String("box_1".into()), Value::Int(2)]])), @r"
        ?box   ?n
        box_1  2
        ");
        let pose = Value::Pose(Pose::at(0.5, 0.0, 1.25));
        assert!(super::rows(&rows(&["at"], vec![vec![pose]])).ends_with("pose(0.5, 0, 1.25)"));
        assert_eq!(super::rows(&rows(&[], vec![Vec::new()])), "yes");
        assert_eq!(super::rows(&rows(&[], Vec::new())), "no");
    }
}
