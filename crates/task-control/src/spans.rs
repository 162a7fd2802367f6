//! The spans that a run sends while it goes on, where its process has a sender ([`ratn_otlp::start`]).

use ratn_executive::protocol::{Command, Event};
use ratn_export::live::Live;
use ratn_model::time::Timestamp;
use ratn_otlp::{END_OF_RUN, Sender, ids};
use ratn_worker::trace::TraceContext;
use std::time::{SystemTime, UNIX_EPOCH};

/// A run's place in its trace, of which the export of its log is, too.
pub(super) fn trace_of(run: &str, task: &str, seed: u64, began_unix_ms: u64) -> TraceContext {
    TraceContext::of(ids::trace(run, task, seed, began_unix_ms), ids::ROOT)
}

/// The spans of a run under way.
#[derive(Debug)]
pub(super) struct Spans {
    sender: &'static Sender,
    live: Box<Live>,
}

impl Spans {
    /// Of a run whose clock begins now; `None` where nobody wants them.
    #[allow(
        clippy::disallowed_methods,
        reason = "a span is at a moment of the wall clock; how long it took is measured otherwise"
    )]
    pub(super) fn of_a_run_that_begins(speed: f64) -> Option<Spans> {
        let sender = ratn_otlp::sender()?;
        let since_1970 = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        let now_unix_ns = u64::try_from(since_1970.as_nanos()).unwrap_or(u64::MAX);
        Some(Spans { sender, live: Box::new(Live::new(now_unix_ns, speed)) })
    }

    pub(super) fn follow(&mut self, at: Timestamp, event: &Event, commands: &[Command]) {
        self.live.follow(at, event, commands).into_iter().for_each(|span| self.sender.record(span));
    }

    /// Sends what is left, and the run's own span; waits for that no longer than [`END_OF_RUN`].
    pub(super) async fn end(spans: Option<Spans>) {
        if let Some(Spans { sender, mut live }) = spans {
            live.end().into_iter().for_each(|span| sender.record(span));
            sender.flush(END_OF_RUN).await;
        }
    }
}
