//! The audit log: one event of the tracing target `audit` per mutation of a server, with caller, mutation, outcome and trace. Off unless a
//! subscriber listens to the target (a daemon's `audit_file`, a filter with `audit=info`): then it costs a comparison.
//!
//! ```text
//!   begin(caller, request, || Mutation) ─▶ Pending ─ ended(outcome) ─▶ a record
//!                                             └─ dropped: the caller left before the answer ─▶ a record with CANCELLED
//! ```
//! Each kind of change is a variant of [`Mutation`]; only this module turns it into text.

use crate::access::Caller;
use crate::trace;
use ratn_model::id::FencingToken;
use serde::Serialize;
use tonic::{Code, Status};

/// The tracing target.
pub const TARGET: &str = "audit";
/// Maximum length of a text from a caller, in characters; a longer one is truncated.
const LONGEST: usize = 1_000;

/// A change of a server's state. Its name in the log is the variant's name in snake case: `emergency_stop`.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "operation", rename_all = "snake_case")]
#[expect(missing_docs, reason = "the fields are those of the requests of the same name in the proto")]
pub enum Mutation {
    // ----- resource manager -----
    OpenSession { session: String, client: String, ttl_ms: u64 },
    CloseSession { session: String },
    Create { session: String, resource: String, kind: String, class: String },
    Consume { session: String, requirement: String },
    Delete { session: String, target: String },
    Acquire { session: String, requirements: Vec<String>, holder: String, priority: i64 },
    Withdraw { session: String },
    Release { session: String, lease: u64, at_rest: bool },
    ConfirmStandstill { session: String, lease: u64, resource: String },
    EndTask { session: String },
    ReportShortage { session: String, kind: String, most: u32, reason: String },
    // ----- world pool -----
    Commit { revision: u64, changes: usize, writer: String },
    Project { base_revision: u64, changes: usize, lease: u64 },
    ReleaseProjection { projection: u64 },
    // ----- process manager -----
    Spawn { template: String, count: u32 },
    Stop { worker: String },
    Restart { target: String },
    Scale { template: String, min: Option<u32>, max: Option<u32>, spares: Option<u32> },
    Drain { undo: bool },
    // ----- providers -----
    Goal { goal: String, action: String, lease: u64, known_only: bool },
    Cancel { goal: String },
    EmergencyStop { reason: String },
    ClearEmergencyStop,
    Hold { reason: String },
    GoOn,
    // ----- a run -----
    Signal { signal: String },
    Answer { state: String, choice: String },
    SetBreakpoint { state: String },
    ClearBreakpoint { state: String },
    // ----- the cell -----
    Reset { seed: u64 },
    InjectFault { fault: String },
    PutBack,
}

/// A mutation under way. If it is dropped before [`Pending::ended`], the record says that the caller left.
#[derive(Debug)]
pub struct Pending(Option<Box<Record>>);

#[derive(Debug)]
struct Record {
    who: Caller,
    request: String,
    mutation: Mutation,
}

/// Whether any subscriber records audit events.
pub fn enabled() -> bool {
    tracing::enabled!(target: TARGET, tracing::Level::INFO)
}

/// Begins a mutation; the request id may be empty.
pub fn begin(caller: &Caller, request: &str, mutation: impl FnOnce() -> Mutation) -> Pending {
    let record = || Record { who: caller.clone(), request: cut(request), mutation: mutation() };
    Pending(enabled().then(|| Box::new(record())))
}

impl Pending {
    /// Records how the mutation ended.
    pub fn ended<T>(self, outcome: &Result<T, Status>) {
        self.ended_with(outcome, |_| None);
    }

    /// As [`Pending::ended`], with the fencing token of the result.
    pub fn ended_with<T>(mut self, outcome: &Result<T, Status>, token: impl FnOnce(&T) -> Option<FencingToken>) {
        let Some(record) = self.0.take() else { return };
        match outcome {
            Ok(done) => record.write(Code::Ok, "", token(done)),
            Err(status) => record.write(status.code(), status.message(), None),
        }
    }
}

impl Drop for Pending {
    fn drop(&mut self) {
        if let Some(record) = self.0.take() {
            record.write(Code::Cancelled, "the caller left before the answer; it may have happened", None);
        }
    }
}

impl Record {
    fn write(&self, code: Code, reason: &str, token: Option<FencingToken>) {
        let mut what = serde_json::to_value(&self.mutation).unwrap_or_default();
        let operation = what.as_object_mut().and_then(|fields| fields.remove("operation")).unwrap_or_default();
        let operation = operation.as_str().unwrap_or_default();
        let trace = trace::current().map(|context| context.trace_id().to_string()).unwrap_or_default();
        let (who, request, token) = (&self.who, &self.request, token.map_or(0, |token| token.0));
        tracing::info!(target: TARGET, %who, operation, request, %what, token, ?code, reason, trace);
    }
}

/// A caller's text, truncated to the maximum length.
pub fn cut(text: &str) -> String {
    text.chars().take(LONGEST).collect()
}
