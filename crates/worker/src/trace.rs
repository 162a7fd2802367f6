//! W3C trace context (www.w3.org/TR/trace-context, level 1): taken from the metadata of a call, and added to the calls made for it.
//!
//! ```text
//!   traceparent: 00-<trace id, 32 hex digits>-<span id of the caller, 16>-<flags, 2>
//! ```
//! A task's context ([`within`]) goes into every call that the task makes over [`crate::client::Channels`]; the span of the answering side
//! is a child of it. The ids are in the logs. If the process exports spans ([`ratn_otlp::sender`]), each answer is one ([`answering`]).

use crate::protocol;
use rand::RngExt;
use ratn_otlp::{Kind, Sender, Span};
use std::fmt;
use std::future::Future;
use std::str::FromStr;
use std::task::{Context, Poll};
use std::time::{Instant, SystemTime, UNIX_EPOCH};
use tonic::Code;
use tonic::body::Body;
use tonic::codegen::{Service, http};
use tonic::transport::Channel;

/// The header and metadata key.
pub const HEADER: &str = "traceparent";

/// The flag with which the originator of the trace asks for its spans to be recorded.
const SAMPLED: u8 = 1;

/// A position in a trace: trace id, span id and flags.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TraceContext {
    trace: u128,
    span: u64,
    flags: u8,
}

/// Text that is no trace context.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("is no traceparent: expected 00-<32 hex digits>-<16 hex digits>-<2 hex digits>, neither id zero")]
pub struct TraceContextError;

tokio::task_local! {
    static CURRENT: TraceContext;
}

impl TraceContext {
    /// A new trace.
    pub fn fresh() -> TraceContext {
        let mut random = rand::rng();
        TraceContext { trace: random.random::<u128>().max(1), span: random.random::<u64>().max(1), flags: SAMPLED }
    }

    /// A context with these ids; neither may be 0.
    pub fn of(trace: u128, span: u64) -> TraceContext {
        TraceContext { trace: trace.max(1), span: span.max(1), flags: SAMPLED }
    }

    /// A context of the same trace with this span id.
    #[must_use]
    pub fn at(self, span: u64) -> TraceContext {
        TraceContext { span: span.max(1), ..self }
    }

    /// A new span of the same trace.
    #[must_use]
    pub fn child(self) -> TraceContext {
        TraceContext { span: rand::rng().random::<u64>().max(1), ..self }
    }

    /// The context in a request's headers, if any; a malformed one counts as absent, as the standard demands.
    pub fn from_headers(headers: &http::HeaderMap) -> Option<TraceContext> {
        headers.get(HEADER)?.to_str().ok()?.parse().ok()
    }

    /// A tracing span that adds the ids to the log lines of what is done for a call.
    pub fn entered(self) -> tracing::Span {
        tracing::info_span!("call", trace = %self.trace_id(), span = %self.span_id())
    }

    /// The trace id: 32 hex digits.
    pub fn trace_id(self) -> impl fmt::Display {
        Hex(self.trace, 32)
    }

    /// The span id: 16 hex digits.
    pub fn span_id(self) -> impl fmt::Display {
        Hex(self.span.into(), 16)
    }
}

impl fmt::Display for TraceContext {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "00-{:032x}-{:016x}-{:02x}", self.trace, self.span, self.flags)
    }
}

impl FromStr for TraceContext {
    type Err = TraceContextError;

    fn from_str(text: &str) -> Result<TraceContext, TraceContextError> {
        let lower_hex = |part: &str| part.bytes().all(|b| matches!(b, b'0'..=b'9' | b'a'..=b'f'));
        let mut parts = text.split('-');
        let mut part = |length: usize| {
            parts.next().filter(|part| part.len() == length && lower_hex(part)).ok_or(TraceContextError)
        };
        let (version, trace, span, flags) = (part(2)?, part(32)?, part(16)?, part(2)?);
        // Later versions of the format may append parts; version 00 may not.
        if version == "ff" || (version == "00" && parts.next().is_some()) {
            return Err(TraceContextError);
        }
        let context = TraceContext {
            trace: u128::from_str_radix(trace, 16).map_err(|_| TraceContextError)?,
            span: u64::from_str_radix(span, 16).map_err(|_| TraceContextError)?,
            flags: u8::from_str_radix(flags, 16).map_err(|_| TraceContextError)?,
        };
        if context.trace == 0 || context.span == 0 { Err(TraceContextError) } else { Ok(context) }
    }
}

struct Hex(u128, usize);

impl fmt::Display for Hex {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:0width$x}", self.0, width = self.1)
    }
}

/// A channel whose calls carry the trace context of the task that makes them, and the protocol version of this program.
#[derive(Debug, Clone)]
pub struct Traced(Channel);

impl Traced {
    /// Wraps this channel.
    pub fn new(channel: Channel) -> Traced {
        Traced(channel)
    }

    /// The channel itself, for servers of other programs.
    pub fn into_channel(self) -> Channel {
        self.0
    }
}

impl Service<http::Request<Body>> for Traced {
    type Response = <Channel as Service<http::Request<Body>>>::Response;
    type Error = <Channel as Service<http::Request<Body>>>::Error;
    type Future = <Channel as Service<http::Request<Body>>>::Future;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Self::Error>> {
        self.0.poll_ready(context)
    }

    fn call(&mut self, mut request: http::Request<Body>) -> Self::Future {
        let header = current().map(|context| http::HeaderValue::try_from(context.to_string()));
        if let Some(Ok(header)) = header {
            request.headers_mut().insert(HEADER, header);
        }
        protocol::say(request.headers_mut());
        self.0.call(request)
    }
}

/// An answer under way; its span is recorded when this is dropped.
#[derive(Debug)]
pub struct Answering {
    sender: &'static Sender,
    path: String,
    caller: TraceContext,
    own: TraceContext,
    began: (SystemTime, Instant),
    code: Option<Code>,
}

/// Begins the span of an answer to a call of this path; `own` is the answer's context, `caller` the call's. `None` if the span is not to be
/// recorded.
#[allow(
    clippy::disallowed_methods,
    reason = "a span is at a moment of the wall clock; how long it took is measured by Instant"
)]
pub fn answering(path: &str, caller: TraceContext, own: TraceContext) -> Option<Answering> {
    let sender = ratn_otlp::sender().filter(|_| caller.flags & SAMPLED != 0)?;
    let (path, began) = (path.trim_start_matches('/').to_owned(), (SystemTime::now(), Instant::now()));
    Some(Answering { sender, path, caller, own, began, code: None })
}

impl Answering {
    /// Sets the status code of the answer.
    pub fn ended(&mut self, code: Code) {
        self.code = Some(code);
    }
}

impl Drop for Answering {
    fn drop(&mut self) {
        let (since, began) = self.began;
        let since_1970 = since.duration_since(UNIX_EPOCH).unwrap_or_default();
        let from_unix_ns = u64::try_from(since_1970.as_nanos()).unwrap_or(u64::MAX);
        let took_ns = u64::try_from(began.elapsed().as_nanos()).unwrap_or(u64::MAX);
        // An answer that is dropped without a status was abandoned by its caller.
        let code = self.code.unwrap_or(Code::Cancelled);
        let (service, method) = self.path.rsplit_once('/').unwrap_or(("", &self.path));
        self.sender.record(Span {
            trace: self.own.trace,
            id: self.own.span,
            parent: Some(self.caller.span),
            name: self.path.clone(),
            kind: Kind::Server,
            from_unix_ns,
            to_unix_ns: from_unix_ns.saturating_add(took_ns),
            attributes: vec![
                ("rpc.system", "grpc".to_owned()),
                ("rpc.service", service.to_owned()),
                ("rpc.method", method.to_owned()),
                ("ratn.code", format!("{code:?}")),
            ],
            links: Vec::new(),
            error: (!matches!(code, Code::Ok | Code::Cancelled)).then(|| code.description().to_owned()),
        });
    }
}

/// As [`within`], if there is a context.
pub async fn within_any<F: Future>(context: Option<TraceContext>, future: F) -> F::Output {
    match context {
        Some(context) => within(context, future).await,
        None => future.await,
    }
}

/// Runs a future as part of a trace.
pub fn within<F: Future>(context: TraceContext, future: F) -> impl Future<Output = F::Output> {
    CURRENT.scope(context, future)
}

/// The context of the running task, if any.
pub fn current() -> Option<TraceContext> {
    CURRENT.try_with(|context| *context).ok()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    #[test]
    fn a_context_reads_back_as_written_and_a_child_stays_in_its_trace() {
        let text = "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01";
        let context: TraceContext = text.parse().unwrap();
        assert_eq!(context.to_string(), text);
        let child = context.child();
        assert_eq!(child.trace_id().to_string(), context.trace_id().to_string());
        assert_ne!(child.span_id().to_string(), context.span_id().to_string());
        assert_eq!(TraceContext::fresh().to_string().parse::<TraceContext>().unwrap().to_string().len(), text.len());
    }

    #[test]
    fn what_is_no_context_is_none() {
        for text in [
            "",
            "00",
            "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331",
            "00-00000000000000000000000000000000-b7ad6b7169203331-01",
            "00-0af7651916cd43dd8448eb211c80319c-0000000000000000-01",
            "00-0AF7651916CD43DD8448EB211C80319C-b7ad6b7169203331-01",
            "ff-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01",
            "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01-more",
        ] {
            assert_eq!(text.parse::<TraceContext>(), Err(TraceContextError), "{text}");
        }
    }

    #[tokio::test]
    async fn a_task_has_the_context_that_it_is_within() {
        let context = TraceContext::fresh();
        assert_eq!(current(), None);
        assert_eq!(within(context, async { current() }).await, Some(context));
    }
}
