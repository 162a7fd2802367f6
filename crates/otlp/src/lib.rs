//! Spans for OpenTelemetry: their data, their ids ([`ids`]), the two formats (OTLP/JSON for files, protobuf for `/v1/traces`), and the
//! sender of a process ([`start`], [`sender`]).
//!
//! ```text
//!   record(span) ──bounded queue──▶ thread "otlp": batches ──POST /v1/traces──▶ collector
//! ```
//! Recording a span never waits: a span that finds no room in the queue, or that the collector does not accept, is dropped and counted. A
//! process has one sender, as it has one log. Without one ([`sender`] is `None`) nothing is recorded.

mod config;
pub mod ids;
mod post;
mod sender;
mod span;
mod wire;

pub use config::{Fault, OtlpConfig};
pub use sender::{Counts, END_OF_RUN, END_OF_SERVER, Sender, sender, start};
pub use span::{Kind, Link, Span, json_request};
pub use wire::{Decoded, decode};
