//! A span, and its form as OTLP/JSON.

use serde_json::{Value, json};

const ERROR: u32 = 2;
/// Maximum length of a text in bytes; a longer one is truncated: a reason may be as long as a message on the wire.
const MAX_TEXT: usize = 4_096;
/// Maximum number of links; further ones are dropped, as the SDKs of OpenTelemetry do.
const MAX_LINKS: usize = 128;
/// Maximum size of a span or a link on the wire, without its texts.
const FRAME: usize = 128;

/// A span: a part of a trace that has ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Span {
    /// The trace, never 0.
    pub trace: u128,
    /// The span id, never 0.
    pub id: u64,
    /// The parent span.
    pub parent: Option<u64>,
    /// The operation.
    pub name: String,
    /// The kind of the span.
    pub kind: Kind,
    /// Nanoseconds since 1970.
    pub from_unix_ns: u64,
    /// Nanoseconds since 1970, not before `from_unix_ns`.
    pub to_unix_ns: u64,
    /// Attributes; those with an empty value are omitted.
    pub attributes: Vec<(&'static str, String)>,
    /// What it waited for, in the same trace: the span, and the reason.
    pub links: Vec<Link>,
    /// The error, if any.
    pub error: Option<String>,
}

/// A link to another span in the same trace.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Link {
    /// The other span.
    pub to: u64,
    /// The value of `ratn.waited_for`.
    pub waited_for: &'static str,
}

/// The relation of a span to its parent, with OTLP's numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// Work of the same process.
    Internal = 1,
    /// The answer to a call.
    Server = 2,
}

/// The name and value of an attribute of a link.
pub(crate) const WAITED_FOR: &str = "ratn.waited_for";

/// An OTLP/JSON request with these spans.
pub fn json_request<'a>(
    resource: &[(&'static str, String)],
    scope: &str,
    spans: impl IntoIterator<Item = &'a Span>,
) -> Value {
    let spans: Vec<Value> = spans.into_iter().map(Span::json).collect();
    json!({"resourceSpans": [{
        "resource": {"attributes": attributes(resource)},
        "scopeSpans": [{"scope": {"name": scope}, "spans": spans}],
    }]})
}

impl Span {
    fn json(&self) -> Value {
        let trace = format!("{:032x}", self.trace);
        // 64-bit numbers are strings in OTLP/JSON.
        let mut json = json!({
            "traceId": trace,
            "spanId": hex(self.id),
            "parentSpanId": self.parent.map(hex).unwrap_or_default(),
            "name": self.name,
            "kind": self.kind as u32,
            "startTimeUnixNano": self.from_unix_ns.to_string(),
            "endTimeUnixNano": self.to_unix_ns.to_string(),
            "attributes": attributes(&self.attributes),
        });
        if !self.links.is_empty() {
            let link = |link: &Link| {
                let why = attributes(&[(WAITED_FOR, link.waited_for.to_owned())]);
                json!({"traceId": trace, "spanId": hex(link.to), "attributes": why})
            };
            json["links"] = self.links.iter().map(link).collect();
        }
        if let Some(message) = &self.error {
            json["status"] = json!({"code": ERROR, "message": message});
        }
        json
    }

    /// Truncates texts and links to their limits.
    pub(crate) fn cut(mut self) -> Span {
        let values = self.attributes.iter_mut().map(|(_, value)| value);
        values.chain([&mut self.name]).chain(&mut self.error).for_each(cut);
        self.links.truncate(MAX_LINKS);
        self
    }

    /// Approximate size on the wire, in bytes.
    pub(crate) fn bytes(&self) -> usize {
        let attributes = self.attributes.iter().map(|(key, value)| key.len() + value.len() + FRAME / 4);
        let texts = self.name.len() + self.error.as_ref().map_or(0, String::len) + attributes.sum::<usize>();
        texts + FRAME * (1 + self.links.len())
    }

    pub(crate) fn said(&self) -> impl Iterator<Item = (&'static str, &str)> {
        said(&self.attributes)
    }
}

fn cut(text: &mut String) {
    if text.len() > MAX_TEXT {
        text.truncate(text.floor_char_boundary(MAX_TEXT));
        text.push('…');
        // Release the unused capacity: the queue's limits do not count it.
        text.shrink_to_fit();
    }
}

/// The attributes with a value.
pub(crate) fn said<'a>(attributes: &'a [(&'static str, String)]) -> impl Iterator<Item = (&'static str, &'a str)> {
    attributes.iter().filter(|(_, value)| !value.is_empty()).map(|(key, value)| (*key, value.as_str()))
}

fn attributes(all: &[(&'static str, String)]) -> Value {
    said(all).map(|(key, value)| json!({"key": key, "value": {"stringValue": value}})).collect()
}

fn hex(id: u64) -> String {
    format!("{id:016x}")
}
