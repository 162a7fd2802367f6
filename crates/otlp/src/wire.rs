//! The protobuf format: the required part of `opentelemetry/proto/collector/trace/v1/trace_service.proto` (1.x), written by hand.

use super::span::{Span, WAITED_FOR, said};
use prost::Message;

#[derive(Clone, PartialEq, Message)]
struct Request {
    #[prost(message, repeated, tag = "1")]
    resource_spans: Vec<ResourceSpans>,
}

#[derive(Clone, PartialEq, Message)]
struct ResourceSpans {
    #[prost(message, optional, tag = "1")]
    resource: Option<Resource>,
    #[prost(message, repeated, tag = "2")]
    scope_spans: Vec<ScopeSpans>,
}

#[derive(Clone, PartialEq, Message)]
struct Resource {
    #[prost(message, repeated, tag = "1")]
    attributes: Vec<KeyValue>,
}

#[derive(Clone, PartialEq, Message)]
struct ScopeSpans {
    #[prost(message, optional, tag = "1")]
    scope: Option<Scope>,
    #[prost(message, repeated, tag = "2")]
    spans: Vec<WireSpan>,
}

#[derive(Clone, PartialEq, Message)]
struct Scope {
    #[prost(string, tag = "1")]
    name: String,
}

#[derive(Clone, PartialEq, Message)]
struct WireSpan {
    #[prost(bytes = "vec", tag = "1")]
    trace_id: Vec<u8>,
    #[prost(bytes = "vec", tag = "2")]
    span_id: Vec<u8>,
    #[prost(bytes = "vec", tag = "4")]
    parent_span_id: Vec<u8>,
    #[prost(string, tag = "5")]
    name: String,
    #[prost(int32, tag = "6")]
    kind: i32,
    #[prost(fixed64, tag = "7")]
    start_time_unix_nano: u64,
    #[prost(fixed64, tag = "8")]
    end_time_unix_nano: u64,
    #[prost(message, repeated, tag = "9")]
    attributes: Vec<KeyValue>,
    #[prost(message, repeated, tag = "13")]
    links: Vec<WireLink>,
    #[prost(message, optional, tag = "15")]
    status: Option<Status>,
}

#[derive(Clone, PartialEq, Message)]
struct WireLink {
    #[prost(bytes = "vec", tag = "1")]
    trace_id: Vec<u8>,
    #[prost(bytes = "vec", tag = "2")]
    span_id: Vec<u8>,
    #[prost(message, repeated, tag = "4")]
    attributes: Vec<KeyValue>,
}

#[derive(Clone, PartialEq, Message)]
struct Status {
    #[prost(string, tag = "2")]
    message: String,
    #[prost(int32, tag = "3")]
    code: i32,
}

#[derive(Clone, PartialEq, Message)]
struct KeyValue {
    #[prost(string, tag = "1")]
    key: String,
    #[prost(message, optional, tag = "2")]
    value: Option<AnyValue>,
}

#[derive(Clone, PartialEq, Message)]
struct AnyValue {
    #[prost(string, optional, tag = "1")]
    string_value: Option<String>,
}

const ERROR: i32 = 2;

/// Encodes an `ExportTraceServiceRequest`.
pub(crate) fn request(resource: &[(&'static str, String)], scope: &str, spans: &[Span]) -> Vec<u8> {
    let scope_spans =
        ScopeSpans { scope: Some(Scope { name: scope.to_owned() }), spans: spans.iter().map(span).collect() };
    let resource = Resource { attributes: said(resource).map(key_value).collect() };
    let spans = ResourceSpans { resource: Some(resource), scope_spans: vec![scope_spans] };
    Request { resource_spans: vec![spans] }.encode_to_vec()
}

fn span(span: &Span) -> WireSpan {
    let trace = span.trace.to_be_bytes().to_vec();
    let link = |link: &super::Link| WireLink {
        trace_id: trace.clone(),
        span_id: link.to.to_be_bytes().to_vec(),
        attributes: vec![key_value((WAITED_FOR, link.waited_for))],
    };
    WireSpan {
        span_id: span.id.to_be_bytes().to_vec(),
        parent_span_id: span.parent.map(|parent| parent.to_be_bytes().to_vec()).unwrap_or_default(),
        name: span.name.clone(),
        kind: span.kind as i32,
        start_time_unix_nano: span.from_unix_ns,
        end_time_unix_nano: span.to_unix_ns,
        attributes: span.said().map(key_value).collect(),
        links: span.links.iter().map(link).collect(),
        status: span.error.clone().map(|message| Status { message, code: ERROR }),
        trace_id: trace,
    }
}

fn key_value((key, value): (&'static str, &str)) -> KeyValue {
    KeyValue { key: key.to_owned(), value: Some(AnyValue { string_value: Some(value.to_owned()) }) }
}

/// A span as decoded by a collector, for tests.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Decoded {
    /// `service.name` of the resource.
    pub service: String,
    /// The trace id: 32 hex digits.
    pub trace: String,
    /// The span id: 16 hex digits.
    pub id: String,
    /// The parent's span id: 16 hex digits, or empty.
    pub parent: String,
    /// The operation.
    pub name: String,
    /// Start and end, in nanoseconds since 1970.
    pub time_unix_ns: (u64, u64),
    /// The attributes.
    pub attributes: Vec<(String, String)>,
    /// The span ids that it waited for.
    pub links: Vec<String>,
    /// The error.
    pub error: Option<String>,
}

/// Decodes the body of a request, as a collector does.
///
/// # Errors
/// The body is not a valid request.
pub fn decode(body: &[u8]) -> Result<Vec<Decoded>, prost::DecodeError> {
    let request = Request::decode(body)?;
    let mut spans = Vec::new();
    for of_resource in request.resource_spans {
        let resource = of_resource.resource.map(|resource| resource.attributes).unwrap_or_default();
        let service = pairs(resource).into_iter().find(|(key, _)| key == "service.name");
        let service = service.map(|(_, value)| value).unwrap_or_default();
        for span in of_resource.scope_spans.into_iter().flat_map(|scope| scope.spans) {
            spans.push(Decoded {
                service: service.clone(),
                trace: hex(&span.trace_id),
                id: hex(&span.span_id),
                parent: hex(&span.parent_span_id),
                name: span.name,
                time_unix_ns: (span.start_time_unix_nano, span.end_time_unix_nano),
                attributes: pairs(span.attributes),
                links: span.links.iter().map(|link| hex(&link.span_id)).collect(),
                error: span.status.filter(|status| status.code == ERROR).map(|status| status.message),
            });
        }
    }
    Ok(spans)
}

fn pairs(attributes: Vec<KeyValue>) -> Vec<(String, String)> {
    let value = |value: Option<AnyValue>| value.and_then(|value| value.string_value).unwrap_or_default();
    attributes.into_iter().map(|pair| (pair.key, value(pair.value))).collect()
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}
