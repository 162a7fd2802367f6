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

/// A plan whose result `move` waits for, which is discarded before it begins; `turn` begins on another result, and the log ends before `rest` does.
const DISCARDED: &str = r#"{"at":0,"event":"started","task":"t","digest":"d","mode":"cdtn","parameters":{},"seed":7,"world":[],"revision":1}
{"at":0,"command":"note","note":"expanded","instance":1,"state":1,"path":"plan","speculative":false}
{"at":0,"command":"note","note":"expanded","instance":2,"state":2,"path":"move","speculative":true}
{"at":0,"command":"note","note":"expanded","instance":3,"state":3,"path":"turn","speculative":false}
{"at":0,"command":"note","note":"expanded","instance":4,"state":4,"path":"rest","speculative":false}
{"at":0,"command":"start","instance":1,"attempt":1,"goal":{"provider":"brain","action":"think","inputs":{},"seed":1,"lease":null,"projection":null,"expected_s":null}}
{"at":1000000000,"event":"finished","instance":1,"attempt":1,"outcome":"success","outputs":{},"measured":[],"reason":""}
{"at":1000000000,"command":"note","note":"finished","instance":1,"outcome":"success"}
{"at":1000000000,"command":"acquire","instance":2,"requirements":[],"priority":1}
{"at":1000000000,"command":"acquire","instance":4,"requirements":[],"priority":1}
{"at":1000000000,"command":"start","instance":3,"attempt":1,"goal":{"provider":"arm","action":"turn","inputs":{},"seed":1,"lease":null,"projection":null,"expected_s":null}}
{"at":2000000000,"event":"woken"}
{"at":2000000000,"command":"note","note":"squashed","instance":2}
"#;

#[test]
fn every_flow_of_a_trace_ends_also_where_it_leads_to_nothing() {
    let lines = DISCARDED.lines().map(serde_json::from_str);
    let mut trace = Vec::new();
    export(Format::Perfetto, lines, &mut trace).expect("it is exported");
    let (mut begun, mut ended) = (Vec::new(), Vec::new());
    for (_, packet) in fields(&trace) {
        for (_, event) in fields(packet).into_iter().filter(|(number, _)| *number == 11) {
            begun.extend(fields(event).into_iter().filter(|(number, _)| *number == 47).map(|(_, id)| id.to_vec()));
            ended.extend(fields(event).into_iter().filter(|(number, _)| *number == 48).map(|(_, id)| id.to_vec()));
        }
    }
    ended.sort();
    assert_eq!((begun.len(), begun), (3, ended));
}

/// The fields of a protobuf message: their numbers, and the bytes of their values.
fn fields(message: &[u8]) -> Vec<(u64, &[u8])> {
    let (mut all, mut rest) = (Vec::new(), message);
    while !rest.is_empty() {
        let (key, behind) = varint(rest);
        let (skipped, length) = match key & 7 {
            0 => (0, behind.len() - varint(behind).1.len()),
            1 => (0, 8),
            5 => (0, 4),
            _ => (behind.len() - varint(behind).1.len(), varint(behind).0 as usize),
        };
        all.push((key >> 3, &behind[skipped..skipped + length]));
        rest = &behind[skipped + length..];
    }
    all
}

fn varint(bytes: &[u8]) -> (u64, &[u8]) {
    let length = 1 + bytes.iter().take_while(|byte| **byte >= 0x80).count();
    let value = bytes[..length].iter().rev().fold(0, |value, byte| (value << 7) | u64::from(byte & 0x7f));
    (value, &bytes[length..])
}
