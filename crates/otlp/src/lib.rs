//! Spans for OpenTelemetry: what one is, its ids ([`ids`]), its two forms (OTLP/JSON for files, protobuf for `/v1/traces`), and the
//! sender of a process ([`start`], [`sender`]).
//!
//! ```text
//!   record(span) ──bounded queue──▶ thread "otlp": batches ──POST /v1/traces──▶ collector
//! ```
//! Whoever records a span never waits: a span that has no room in the queue, or that the collector does not take, is dropped and counted.
//! There is one sender in a process, as there is one log. Without one ([`sender`] is `None`) nothing is recorded.

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
