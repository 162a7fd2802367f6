//! A span, and its form as OTLP/JSON.

use serde_json::{Value, json};

const ERROR: u32 = 2;
/// Of a longer text the beginning is sent: a reason may be as long as a message of the wire.
const MAX_TEXT: usize = 4_096;
/// Of more links the first are sent, as the SDKs of OpenTelemetry do it.
const MAX_LINKS: usize = 128;
/// What a span or a link takes on the wire beside its texts, at the most.
const FRAME: usize = 128;

/// A part of a trace that has ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Span {
    /// The trace, never 0.
    pub trace: u128,
    /// The span in it, never 0.
    pub id: u64,
    /// The span that it is a part of.
    pub parent: Option<u64>,
    /// What was done.
    pub name: String,
    /// Where it was done.
    pub kind: Kind,
    /// Nanoseconds since 1970.
    pub from_unix_ns: u64,
    /// Nanoseconds since 1970, not before `from_unix_ns`.
    pub to_unix_ns: u64,
    /// What is known of it; an empty value says nothing, and is left out.
    pub attributes: Vec<(&'static str, String)>,
    /// What it waited for, in the same trace: which span, and why.
    pub links: Vec<Link>,
    /// What went wrong, if anything did.
    pub error: Option<String>,
}

/// Another span, in the same trace.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Link {
    /// Which.
    pub to: u64,
    /// The value of `ratn.waited_for`.
    pub waited_for: &'static str,
}

/// What a span is to its parent, with OTLP's numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// Work of the same process.
    Internal = 1,
    /// The answer to a call.
    Server = 2,
}

/// The name and value of an attribute of a link.
pub(crate) const WAITED_FOR: &str = "ratn.waited_for";

/// A request with spans as OTLP/JSON.
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
        // Numbers of 64 bits are strings in OTLP/JSON.
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

    /// With texts and links of bounded length.
    pub(crate) fn cut(mut self) -> Span {
        let values = self.attributes.iter_mut().map(|(_, value)| value);
        values.chain([&mut self.name]).chain(&mut self.error).for_each(cut);
        self.links.truncate(MAX_LINKS);
        self
    }

    /// About how many bytes it takes on the wire.
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
        // The queue is bounded in spans.
        text.shrink_to_fit();
    }
}

/// Those that say something.
pub(crate) fn said<'a>(attributes: &'a [(&'static str, String)]) -> impl Iterator<Item = (&'static str, &'a str)> {
    attributes.iter().filter(|(_, value)| !value.is_empty()).map(|(key, value)| (*key, value.as_str()))
}

fn attributes(all: &[(&'static str, String)]) -> Value {
    said(all).map(|(key, value)| json!({"key": key, "value": {"stringValue": value}})).collect()
}

fn hex(id: u64) -> String {
    format!("{id:016x}")
}
