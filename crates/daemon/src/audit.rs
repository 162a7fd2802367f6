//! The audit log: one event of the tracing target `audit` per mutation, with who, what, the session, the fencing token, how it
//! ended and which trace it was a part of. Off unless the config names a file or the filter says `audit=info`: then it costs a comparison.

use crate::access::Caller;
use crate::{details, metrics};
use ratn_model::id::FencingToken;
use ratn_worker::trace;
use tonic::{Code, Status};

/// The tracing target.
pub const TARGET: &str = "audit";

/// One mutation, as far as it is known before it is tried.
#[derive(Debug)]
pub(crate) struct Mutation<'a> {
    pub(crate) caller: &'a Caller,
    /// `create`, `acquire`, `release` …
    pub(crate) operation: &'static str,
    /// The request's id, where it has one.
    pub(crate) request: &'a str,
    /// What is changed, and in the name of which session, for people.
    pub(crate) what: String,
}

/// Whether anybody writes it down.
pub(crate) fn enabled() -> bool {
    tracing::enabled!(target: TARGET, tracing::Level::INFO)
}

impl Mutation<'_> {
    /// It has ended.
    pub(crate) fn ended(&self, outcome: Result<Option<FencingToken>, &Status>) {
        if let (Err(status), Some(metrics)) = (outcome, metrics::get()) {
            metrics.refused(self.operation, details::reason(status));
        }
        let (code, reason, token) = match outcome {
            Ok(token) => (Code::Ok, "", token.map_or(0, |token| token.0)),
            Err(status) => (status.code(), status.message(), 0),
        };
        let Mutation { caller, operation, request, what } = self;
        let trace = trace::current().map(|context| context.trace_id().to_string()).unwrap_or_default();
        tracing::info!(target: TARGET, who = %caller, operation, request, what, token, ?code, reason, trace);
    }
}
