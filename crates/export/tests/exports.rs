//! A small log in every form. `scripts/check-exports` has exports read by programs of others, and exports a million lines in constant
//! memory.

use ratn_event_log::Lines;
use ratn_export::{Drawing, ExportError, Format, export};
use std::path::{Path, PathBuf};

/// A wait, a crash and its second attempt, a discarded plan and an aborted motion.
fn two_boxes() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../report/src/fixtures/two_boxes.jsonl")
}

fn exported(format: Format) -> Vec<u8> {
    let mut out = Vec::new();
    export(format, Lines::of(&two_boxes()).expect("the fixture opens"), &mut out).expect("it is exported");
    out
}

fn text(format: Format) -> String {
    String::from_utf8(exported(format)).expect("it is text")
}

#[test]
fn a_table_has_a_row_for_each_instance() {
    insta::assert_snapshot!(text(Format::Csv).replace('\r', ""));
}

#[test]
fn the_network_for_graphviz() {
    insta::assert_snapshot!(text(Format::Dot(Drawing::Network)));
}

#[test]
fn the_task_for_graphviz() {
    insta::assert_snapshot!(text(Format::Dot(Drawing::Task)));
}

#[test]
fn the_network_for_mermaid() {
    insta::assert_snapshot!(text(Format::Mermaid(Drawing::Network)));
}

#[test]
fn the_task_for_mermaid() {
    insta::assert_snapshot!(text(Format::Mermaid(Drawing::Task)));
}

#[test]
fn spans_are_one_request_a_line() {
    let text = text(Format::Otlp);
    let lines: Vec<serde_json::Value> = text.lines().map(|line| serde_json::from_str(line).expect("JSON")).collect();
    assert_eq!(lines.len(), 1);
    let spans = lines[0]["resourceSpans"][0]["scopeSpans"][0]["spans"].as_array().expect("spans").clone();
    let said = |span: &serde_json::Value| {
        format!(
            "{} {} in {:?}: {} s, {} links, status {}",
            span["spanId"].as_str().unwrap_or_default(),
            span["name"].as_str().unwrap_or_default(),
            span["parentSpanId"].as_str().unwrap_or_default(),
            seconds(span),
            span["links"].as_array().map_or(0, Vec::len),
            span["status"],
        )
    };
    insta::assert_snapshot!(spans.iter().map(said).collect::<Vec<_>>().join("\n"));
}

fn seconds(span: &serde_json::Value) -> f64 {
    let moment = |key: &str| span[key].as_str().and_then(|ns| ns.parse::<f64>().ok()).expect("a moment");
    (moment("endTimeUnixNano") - moment("startTimeUnixNano")) / 1e9
}

#[test]
fn the_same_log_gives_the_same_bytes() {
    for format in [Format::Perfetto, Format::Otlp, Format::Mcap, Format::Csv] {
        assert_eq!(exported(format), exported(format));
        assert!(!exported(format).is_empty());
    }
}

#[test]
fn a_log_that_does_not_read_on_is_named_and_a_full_target_is_told_from_it() {
    let foreign = std::iter::once(Err("line 1 is none"));
    let error = export(Format::Csv, foreign, Vec::new()).expect_err("refused");
    assert!(matches!(error, ExportError::Log("line 1 is none")));
    let full: &mut [u8] = &mut [];
    let error = export(Format::Mcap, Lines::of(&two_boxes()).expect("it opens"), full).expect_err("refused");
    assert!(matches!(error, ExportError::Write(_)));
}
