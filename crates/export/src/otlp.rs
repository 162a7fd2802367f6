//! Spans for OpenTelemetry: one for the run, one for each instance in it, one for each attempt and each wait for resources in that.
//!
//! OTLP/JSON, one `ExportTraceServiceRequest` a line: the form of the collector's `otlpjsonfile` receiver, and each line can be sent to
//! `/v1/traces` as it is. What an instance waited for is linked. Ids follow from the run, so the same log gives the same spans.

use super::{Writer, number_of, unix_ns};
use ratn_executive::protocol::LogLine;
use ratn_model::id::InstanceId;
use ratn_model::program::SUCCESS;
use ratn_report::statistics::mode_name;
use ratn_report::timeline::{Cause, Changed, Ending, Instance, Job, Timeline, Wait};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::io::{self, Write};

/// As many spans are one request.
const BATCH: usize = 512;
/// The run's own span; those of instances are behind it.
const ROOT: u64 = 1;
const ERROR: u32 = 2;

pub(crate) struct Otlp<W> {
    out: W,
    spans: Vec<Value>,
}

impl<W: Write> Otlp<W> {
    pub(crate) fn new(out: W) -> Otlp<W> {
        Otlp { out, spans: Vec::new() }
    }

    fn add(&mut self, run: &Timeline, left: &[Instance]) -> io::Result<()> {
        for instance in left {
            spans_of(run, instance, &mut self.spans);
            if self.spans.len() >= BATCH {
                self.send(run)?;
            }
        }
        Ok(())
    }

    fn send(&mut self, run: &Timeline) -> io::Result<()> {
        let spans = std::mem::take(&mut self.spans);
        let resource = attributes([
            ("service.name", "ratn".to_owned()),
            ("ratn.task", run.task.clone()),
            ("ratn.mode", mode_name(run.mode).to_owned()),
            ("ratn.run", run.run.clone()),
        ]);
        let request = json!({"resourceSpans": [{
            "resource": {"attributes": resource},
            "scopeSpans": [{"scope": {"name": "ratn.event-log"}, "spans": spans}],
        }]});
        serde_json::to_writer(&mut self.out, &request)?;
        self.out.write_all(b"\n")
    }
}

impl<W: Write> Writer for Otlp<W> {
    fn line(&mut self, _: &LogLine, run: &Timeline, changed: &Changed) -> io::Result<()> {
        self.add(run, &changed.left)
    }

    fn end(&mut self, run: &Timeline, changed: &Changed) -> io::Result<()> {
        self.add(run, &changed.left)?;
        let outcome = run.outcome.clone().unwrap_or_else(|| "unfinished".to_owned());
        let mut root = span(run, ROOT, None, &run.task, (0.0, run.end_s), [("ratn.outcome", outcome.clone())]);
        if outcome != SUCCESS {
            root["status"] = json!({"code": ERROR, "message": run.reason});
        }
        self.spans.push(root);
        self.send(run)
    }
}

/// Jobs and waits have ids of their own: of one instance there are at most so many.
const PARTS: u64 = 1 << 16;

fn id_of(instance: InstanceId) -> u64 {
    (instance.0 + 1) * PARTS
}

fn spans_of(run: &Timeline, one: &Instance, spans: &mut Vec<Value>) {
    let id = id_of(one.id);
    let to_s = if one.has_left() { one.since_s } else { run.end_s };
    let mut whole = span(
        run,
        id,
        Some(ROOT),
        &one.path,
        (one.expanded_s, to_s),
        [
            ("ratn.stage", one.stage.name().to_owned()),
            ("ratn.outcome", one.outcome.as_deref().unwrap_or_default().to_owned()),
            ("ratn.speculative", one.speculative.to_string()),
            ("ratn.invalidated", one.invalidations.join("; ")),
        ],
    );
    whole["links"] = links(run, one);
    if one.outcome.as_deref().is_some_and(|outcome| *outcome != *SUCCESS) {
        whole["status"] = json!({"code": ERROR, "message": one.outcome.as_deref()});
    }
    spans.push(whole);
    let jobs = one.jobs.iter().map(|job| job_span(run, id, job));
    let waits = one.waits.iter().map(|wait| wait_span(run, wait));
    for (part, mut part_span) in jobs.chain(waits).take(PARTS as usize - 1).enumerate() {
        part_span["spanId"] = hex(id + 1 + part as u64).into();
        part_span["parentSpanId"] = hex(id).into();
        spans.push(part_span);
    }
}

fn job_span(run: &Timeline, parent: u64, job: &Job) -> Value {
    let name = format!("{}/{}", job.provider, job.action);
    let (ending, error) = match &job.ending {
        Ending::Outcome(outcome, reason) => (outcome.clone(), (outcome != SUCCESS).then(|| reason.clone())),
        Ending::Crashed(reason) => ("crashed".to_owned(), Some(reason.clone())),
        Ending::Cancelled => ("cancelled".to_owned(), None),
        Ending::Open => ("open".to_owned(), None),
    };
    let mut span = span(
        run,
        parent,
        Some(parent),
        &name,
        (job.from_s, job.to_s),
        [
            ("ratn.outcome", ending),
            ("ratn.attempt", job.attempt.to_string()),
            ("ratn.resources", job.resources.join(" ")),
            ("ratn.ahead_of_time", job.ahead_of_time.to_string()),
        ],
    );
    if let Some(message) = error {
        span["status"] = json!({"code": ERROR, "message": message});
    }
    span
}

fn wait_span(run: &Timeline, wait: &Wait) -> Value {
    let behind: Vec<String> = wait.behind.iter().map(|one| format!("{} of {}", one.resource, one.holder)).collect();
    let kinds = wait.kinds.join(", ");
    let name = format!("waits for {}", if kinds.is_empty() { "nothing of its own" } else { &kinds });
    let mut span = span(run, ROOT, Some(ROOT), &name, (wait.from_s, wait.to_s), [("ratn.behind", behind.join(", "))]);
    let linked: Vec<Value> = wait.behind.iter().map(|one| link(run, one.instance, "resource")).collect();
    span["links"] = linked.into();
    span
}

/// What it waited for: results of others, and what its projection shows of them.
fn links(run: &Timeline, one: &Instance) -> Value {
    let mut by_id: BTreeMap<InstanceId, &str> = BTreeMap::new();
    for phase in one.awaited() {
        if let Cause::Result(id, _) = &phase.ended_by
            && *id != one.id
        {
            by_id.insert(*id, "result");
        }
    }
    by_id.into_iter().map(|(id, why)| link(run, id, why)).collect()
}

fn link(run: &Timeline, to: InstanceId, why: &str) -> Value {
    json!({"traceId": trace(run), "spanId": hex(id_of(to)), "attributes": attributes([("ratn.waited_for", why.to_owned())])})
}

fn span<const N: usize>(
    run: &Timeline,
    id: u64,
    parent: Option<u64>,
    name: &str,
    (from_s, to_s): (f64, f64),
    said: [(&str, String); N],
) -> Value {
    // Numbers of 64 bits are strings in OTLP/JSON.
    json!({
        "traceId": trace(run),
        "spanId": hex(id),
        "parentSpanId": parent.map(hex).unwrap_or_default(),
        "name": name,
        "kind": 1,
        "startTimeUnixNano": unix_ns(run, from_s).to_string(),
        "endTimeUnixNano": unix_ns(run, to_s.max(from_s)).to_string(),
        "attributes": attributes(said),
    })
}

/// Those that say something.
fn attributes<const N: usize>(said: [(&str, String); N]) -> Value {
    let said = said.into_iter().filter(|(_, value)| !value.is_empty());
    said.map(|(key, value)| json!({"key": key, "value": {"stringValue": value}})).collect()
}

fn trace(run: &Timeline) -> String {
    let named = format!("{} {} {}", run.run, run.task, run.seed);
    format!("{:016x}{:016x}", number_of(&named), run.began_unix_ms)
}

fn hex(id: u64) -> String {
    format!("{id:016x}")
}
