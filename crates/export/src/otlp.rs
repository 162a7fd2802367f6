//! Spans for OpenTelemetry: one for the run, in it one per instance, and in that one per attempt and per wait for resources.
//!
//! OTLP/JSON, one `ExportTraceServiceRequest` per line: the format of the collector's `otlpjsonfile` receiver; each line can be sent to
//! `/v1/traces` as it is. What an instance waited for is linked. Ids are derived from the run, so the same log gives the same spans, equal
//! to those that a run sends live ([`crate::live`]).

use super::{Writer, unix_ns};
use ratn_executive::protocol::LogLine;
use ratn_model::id::InstanceId;
use ratn_model::program::SUCCESS;
use ratn_otlp::ids::{self, PARTS, ROOT};
use ratn_otlp::{Kind, Link, Span, json_request};
use ratn_report::statistics::mode_name;
use ratn_report::timeline::{Cause, Changed, Ending, Instance, Job, Timeline, Wait};
use std::collections::BTreeMap;
use std::io::{self, Write};

/// Number of spans per request.
const BATCH: usize = 512;

pub(crate) struct Otlp<W> {
    out: W,
    spans: Vec<Span>,
}

/// Converts a moment of a run to nanoseconds since 1970.
pub(crate) type Laid<'a> = &'a dyn Fn(f64) -> u64;

impl<W: Write> Otlp<W> {
    pub(crate) fn new(out: W) -> Otlp<W> {
        Otlp { out, spans: Vec::new() }
    }

    fn add(&mut self, run: &Timeline, left: &[Instance]) -> io::Result<()> {
        for instance in left {
            spans_of(run, &|at_s| unix_ns(run, at_s), instance, &mut self.spans);
            if self.spans.len() >= BATCH {
                self.send(run)?;
            }
        }
        Ok(())
    }

    fn send(&mut self, run: &Timeline) -> io::Result<()> {
        let spans = std::mem::take(&mut self.spans);
        let mut resource = vec![("service.name", "ratn".to_owned())];
        resource.extend(about(run));
        serde_json::to_writer(&mut self.out, &json_request(&resource, "ratn.event-log", &spans))?;
        self.out.write_all(b"\n")
    }
}

impl<W: Write> Writer for Otlp<W> {
    fn line(&mut self, _: &LogLine, run: &Timeline, changed: &Changed) -> io::Result<()> {
        self.add(run, &changed.left)
    }

    fn end(&mut self, run: &Timeline, changed: &Changed) -> io::Result<()> {
        self.add(run, &changed.left)?;
        self.spans.push(root(run, &|at_s| unix_ns(run, at_s)));
        self.send(run)
    }
}

/// Attributes of a run.
pub(crate) fn about(run: &Timeline) -> [(&'static str, String); 3] {
    [("ratn.task", run.task.clone()), ("ratn.mode", mode_name(run.mode).to_owned()), ("ratn.run", run.run.clone())]
}

/// The root span of the run.
pub(crate) fn root(run: &Timeline, laid: Laid<'_>) -> Span {
    let outcome = run.outcome.clone().unwrap_or_else(|| "unfinished".to_owned());
    let error = (outcome != SUCCESS).then(|| run.reason.clone());
    let root = span(run, laid, ROOT, None, &run.task, (0.0, run.end_s), [("ratn.outcome", outcome)]);
    Span { error, ..root }
}

/// The spans of an instance.
pub(crate) fn spans_of(run: &Timeline, laid: Laid<'_>, one: &Instance, spans: &mut Vec<Span>) {
    let id = ids::instance(one.id.0);
    let to_s = if one.has_left() { one.since_s } else { run.end_s };
    let whole = span(
        run,
        laid,
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
    let error = one.outcome.as_deref().filter(|outcome| **outcome != *SUCCESS).map(str::to_owned);
    spans.push(Span { links: links(one), error, ..whole });
    let jobs = one.jobs.iter().map(|job| job_span(run, laid, id, job));
    let waits = one.waits.iter().map(|wait| wait_span(run, laid, id, wait));
    for (part, part_span) in jobs.chain(waits).take(PARTS as usize - 1).enumerate() {
        spans.push(Span { id: id + 1 + part as u64, ..part_span });
    }
}

fn job_span(run: &Timeline, laid: Laid<'_>, of: u64, job: &Job) -> Span {
    let name = format!("{}/{}", job.provider, job.action);
    let (ending, error) = match &job.ending {
        Ending::Outcome(outcome, reason) => (outcome.clone(), (outcome != SUCCESS).then(|| reason.clone())),
        Ending::Crashed(reason) => ("crashed".to_owned(), Some(reason.clone())),
        Ending::Cancelled => ("cancelled".to_owned(), None),
        Ending::Open => ("open".to_owned(), None),
    };
    let span = span(
        run,
        laid,
        of,
        Some(of),
        &name,
        (job.from_s, job.to_s),
        [
            ("ratn.outcome", ending),
            ("ratn.attempt", job.attempt.to_string()),
            ("ratn.resources", job.resources.join(" ")),
            ("ratn.ahead_of_time", job.ahead_of_time.to_string()),
        ],
    );
    Span { error, ..span }
}

fn wait_span(run: &Timeline, laid: Laid<'_>, of: u64, wait: &Wait) -> Span {
    let behind: Vec<String> = wait.behind.iter().map(|one| format!("{} of {}", one.resource, one.holder)).collect();
    let kinds = wait.kinds.join(", ");
    let name = format!("waits for {}", if kinds.is_empty() { "nothing of its own" } else { &kinds });
    let span = span(run, laid, of, Some(of), &name, (wait.from_s, wait.to_s), [("ratn.behind", behind.join(", "))]);
    let links = wait.behind.iter().map(|one| link(one.instance, "resource")).collect();
    Span { links, ..span }
}

/// Links to what the instance waited for: results of others, and effects that its projection shows.
fn links(one: &Instance) -> Vec<Link> {
    let mut by_id: BTreeMap<InstanceId, &'static str> = BTreeMap::new();
    for phase in one.awaited() {
        if let Cause::Result(id, _) = &phase.ended_by
            && *id != one.id
        {
            by_id.insert(*id, "result");
        }
    }
    by_id.into_iter().map(|(id, why)| link(id, why)).collect()
}

fn link(to: InstanceId, waited_for: &'static str) -> Link {
    Link { to: ids::instance(to.0), waited_for }
}

fn span<const N: usize>(
    run: &Timeline,
    laid: Laid<'_>,
    id: u64,
    parent: Option<u64>,
    name: &str,
    (from_s, to_s): (f64, f64),
    said: [(&'static str, String); N],
) -> Span {
    Span {
        trace: ids::trace(&run.run, &run.task, run.seed, run.began_unix_ms),
        id,
        parent,
        name: name.to_owned(),
        kind: Kind::Internal,
        from_unix_ns: laid(from_s),
        to_unix_ns: laid(to_s.max(from_s)),
        attributes: said.into(),
        links: Vec::new(),
        error: None,
    }
}
