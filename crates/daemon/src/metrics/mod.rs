//! Metrics of a daemon for Prometheus: in the OpenMetrics text format, at `/metrics` of a separate listener.
//!
//! Made once per daemon and given to every part that counts something. Serving the metrics is separate ([`listen`]). Labels have few values: methods of this
//! system, gRPC codes, reasons of refusals; never text from a client.

mod listener;

pub use listener::{ListenError, listen};

use prometheus_client::collector::Collector;
use prometheus_client::encoding::text::encode;
use prometheus_client::encoding::{DescriptorEncoder, EncodeLabelSet, EncodeMetric};
use prometheus_client::metrics::counter::{ConstCounter, Counter};
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::metrics::histogram::Histogram;
use prometheus_client::metrics::info::Info;
use prometheus_client::registry::{Registry, Unit};
use ratn_proto::access::method_of;
use std::fmt;
use std::time::Duration;
use tonic::Code;

/// Buckets of the duration of a call in seconds: from a local call to one that is too slow for a user.
const CALL_SECONDS: [f64; 15] =
    [5e-5, 1e-4, 2.5e-4, 5e-4, 1e-3, 2.5e-3, 5e-3, 1e-2, 2.5e-2, 5e-2, 0.1, 0.25, 0.5, 1.0, 5.0];
/// Buckets of the time in the queue in seconds: from no wait to the duration of another task.
const WAIT_SECONDS: [f64; 11] = [1e-4, 1e-3, 1e-2, 0.1, 0.5, 1.0, 5.0, 10.0, 60.0, 300.0, 1800.0];

/// All metrics. Daemons other than the resource manager have only those of calls, and the world pool also those of its journal.
#[derive(Debug)]
pub struct Metrics {
    registry: Registry,
    calls: Family<Call, Histogram, fn() -> Histogram>,
    refusals: Family<Refusal, Counter>,
    grants: Counter,
    queue_wait: Histogram,
    resources: Gauge,
    sessions: Gauge,
    leases: Gauge,
    waiters: Gauge,
    watchers: Gauge,
    pub(crate) journal: JournalMetrics,
}

/// Metrics of durable state. Clones share their counters.
#[derive(Debug, Clone, Default)]
pub(crate) struct JournalMetrics {
    pub(crate) entries: Counter,
    pub(crate) bytes: Counter,
    pub(crate) commits: Counter,
    pub(crate) failed: Gauge,
}

/// Current amounts.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Amounts {
    pub(crate) resources: usize,
    pub(crate) sessions: usize,
    pub(crate) leases: usize,
    pub(crate) waiters: usize,
    pub(crate) watchers: usize,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct Call {
    service: &'static str,
    method: &'static str,
    code: &'static str,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct Refusal {
    operation: &'static str,
    reason: String,
}

/// Counts of the spans that this process sent and dropped.
#[derive(Debug)]
struct Spans(ratn_otlp::Counts);

impl Collector for Spans {
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> fmt::Result {
        let Spans(counts) = self;
        for (name, help, count) in [
            ("otlp_spans_sent", "Spans that the OTLP collector has taken", counts.sent()),
            ("otlp_spans_dropped", "Spans that no OTLP collector has taken", counts.dropped()),
        ] {
            let counter = ConstCounter::new(count);
            counter.encode(encoder.encode_descriptor(name, help, None, counter.metric_type())?)?;
        }
        Ok(())
    }
}

impl JournalMetrics {
    fn register(&self, registry: &mut Registry) {
        let JournalMetrics { entries, bytes, commits, failed } = self;
        registry.register("journal_entries", "Entries appended to the journal", entries.clone());
        registry.register_with_unit("journal_appended", "Bytes appended to the journal", Unit::Bytes, bytes.clone());
        let help = "Times that more of the journal was seen to be on the disk; many entries may share one";
        registry.register("journal_commits", help, commits.clone());
        let help = "1 when the journal cannot be written and every change is refused";
        registry.register("journal_failed", help, failed.clone());
    }
}

impl Metrics {
    /// The metrics of a daemon of this role, all zero.
    pub fn new(role: &str) -> Metrics {
        let metrics = Metrics {
            registry: Registry::with_prefix("ratn"),
            calls: Family::new_with_constructor(|| Histogram::new(CALL_SECONDS)),
            refusals: Family::default(),
            grants: Counter::default(),
            queue_wait: Histogram::new(WAIT_SECONDS),
            resources: Gauge::default(),
            sessions: Gauge::default(),
            leases: Gauge::default(),
            waiters: Gauge::default(),
            watchers: Gauge::default(),
            journal: JournalMetrics::default(),
        };
        metrics.registered(role)
    }

    /// Adds the counts of spans, where this process sends any.
    #[must_use]
    pub fn with_spans(mut self) -> Metrics {
        if let Some(sender) = ratn_otlp::sender() {
            self.registry.register_collector(Box::new(Spans(sender.counts().clone())));
        }
        self
    }

    fn registered(mut self, role: &str) -> Metrics {
        let registry = &mut self.registry;
        let build = Info::new([("version", env!("CARGO_PKG_VERSION").to_owned()), ("role", role.to_owned())]);
        registry.register("build", "What runs", build);
        let help = "Time from a call's arrival to its answer, or to the beginning of a stream of answers";
        registry.register_with_unit("rpc_duration", help, Unit::Seconds, self.calls.clone());
        let (resource_manager, world_pool) = (crate::resource_manager::ROLE, crate::world_pool::ROLE);
        if role == resource_manager || role == world_pool {
            self.journal.register(&mut self.registry);
        }
        let registry = &mut self.registry;
        registry.register("refusals", "What was asked for and refused", self.refusals.clone());
        if role != resource_manager {
            return self;
        }
        registry.register("grants", "Leases that were granted", self.grants.clone());
        let help = "Time from an acquire's arrival to its grant";
        registry.register_with_unit("queue_wait", help, Unit::Seconds, self.queue_wait.clone());
        registry.register("resources", "Resources that are there", self.resources.clone());
        registry.register("sessions", "Sessions that live", self.sessions.clone());
        registry.register("leases", "Leases that are held", self.leases.clone());
        registry.register("waiters", "Acquires in the queue", self.waiters.clone());
        registry.register("watchers", "Clients that watch", self.watchers.clone());
        self
    }

    /// Counts a call that was answered. Calls of services that are not part of this system are not counted.
    pub(crate) fn call(&self, path: &str, code: Code, took: Duration) {
        if let Some(method) = method_of(path) {
            let (service, method) = (method.service, method.name);
            self.calls.get_or_create(&Call { service, method, code: name_of(code) }).observe(took.as_secs_f64());
        }
    }

    pub(crate) fn granted(&self, waited: Duration) {
        self.grants.inc();
        self.queue_wait.observe(waited.as_secs_f64());
    }

    /// Counts a refusal for one of this system's reasons.
    pub(crate) fn refused(&self, operation: &'static str, reason: String) {
        self.refusals.get_or_create(&Refusal { operation, reason }).inc();
    }

    pub(crate) fn set(&self, amounts: Amounts) {
        let Amounts { resources, sessions, leases, waiters, watchers } = amounts;
        let gauges = [&self.resources, &self.sessions, &self.leases, &self.waiters, &self.watchers];
        for (gauge, amount) in gauges.into_iter().zip([resources, sessions, leases, waiters, watchers]) {
            gauge.set(i64::try_from(amount).unwrap_or(i64::MAX));
        }
    }

    /// All metrics as text.
    fn text(&self) -> String {
        let mut text = String::new();
        // Writing to a string cannot fail.
        let _ = encode(&mut text, &self.registry);
        text
    }
}

/// A code as gRPC spells it.
pub(crate) fn name_of(code: Code) -> &'static str {
    match code {
        Code::Ok => "OK",
        Code::Cancelled => "CANCELLED",
        Code::Unknown => "UNKNOWN",
        Code::InvalidArgument => "INVALID_ARGUMENT",
        Code::DeadlineExceeded => "DEADLINE_EXCEEDED",
        Code::NotFound => "NOT_FOUND",
        Code::AlreadyExists => "ALREADY_EXISTS",
        Code::PermissionDenied => "PERMISSION_DENIED",
        Code::ResourceExhausted => "RESOURCE_EXHAUSTED",
        Code::FailedPrecondition => "FAILED_PRECONDITION",
        Code::Aborted => "ABORTED",
        Code::OutOfRange => "OUT_OF_RANGE",
        Code::Unimplemented => "UNIMPLEMENTED",
        Code::Internal => "INTERNAL",
        Code::Unavailable => "UNAVAILABLE",
        Code::DataLoss => "DATA_LOSS",
        Code::Unauthenticated => "UNAUTHENTICATED",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_measured_has_a_unit_and_what_a_client_sends_is_no_label() {
        let metrics = Metrics::new(crate::resource_manager::ROLE);
        metrics.call("/ratn.v1.ResourceService/Acquire", Code::Ok, Duration::from_micros(70));
        metrics.call("/ratn.v1.ResourceService/Acquire", Code::DeadlineExceeded, Duration::from_secs(7));
        metrics.call("/ratn.v1.ResourceService/\u{7}made up", Code::Unimplemented, Duration::ZERO);
        metrics.granted(Duration::from_millis(2));
        metrics.refused("release", "LEASE_UNKNOWN".to_owned());
        metrics.set(Amounts { sessions: 3, waiters: 2, ..Amounts::default() });
        let text = metrics.text();
        let labels = "service=\"ratn.v1.ResourceService\",method=\"Acquire\"";
        for line in [
            &format!("ratn_rpc_duration_seconds_count{{{labels},code=\"OK\"}} 1"),
            &format!("ratn_rpc_duration_seconds_bucket{{le=\"0.0001\",{labels},code=\"OK\"}} 1"),
            &format!("ratn_rpc_duration_seconds_count{{{labels},code=\"DEADLINE_EXCEEDED\"}} 1"),
            "ratn_grants_total 1",
            "ratn_queue_wait_seconds_sum 0.002",
            "ratn_refusals_total{operation=\"release\",reason=\"LEASE_UNKNOWN\"} 1",
            "ratn_sessions 3",
            "ratn_waiters 2",
            "ratn_journal_failed 0",
            "ratn_journal_appended_bytes_total 0",
            "# EOF",
        ] {
            assert!(text.lines().any(|there| there == line), "{line} is not in\n{text}");
        }
        assert!(!text.contains("made up"), "{text}");
    }

    #[test]
    fn a_daemon_that_grants_nothing_says_nothing_of_grants() {
        let text = Metrics::new("cell").text();
        assert!(text.contains("role=\"cell\"") && !text.contains("grants"), "{text}");
    }
}
