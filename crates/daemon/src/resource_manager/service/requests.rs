//! Calls to the actor: a change is written to the audit log, and a refusal is counted by its reason.

use super::mutation;
use crate::access::{Caller, speaker};
use crate::audit::{self, Pending};
use crate::details::{self, status};
use crate::metrics::Metrics;
use crate::resource_manager::actor::{Answer, Handle, Message};
use ratn_proto::convert::{label, name};
use ratn_resources::{Reply, Request, SessionId, Speaker};
use std::sync::Arc;
use tonic::{Code, Status};

/// Sends requests to the actor; clones share the actor.
#[derive(Debug, Clone)]
pub(super) struct Requests {
    actor: Handle,
    metrics: Arc<Metrics>,
}

impl Requests {
    pub(super) fn new(actor: Handle, metrics: Arc<Metrics>) -> Requests {
        Requests { actor, metrics }
    }

    /// For reads, and for calls that wait.
    pub(super) fn actor(&self) -> &Handle {
        &self.actor
    }

    pub(super) fn metrics(&self) -> &Arc<Metrics> {
        &self.metrics
    }

    /// Counts a refusal by its reason.
    pub(super) fn counted<T>(&self, operation: &'static str, outcome: Result<T, Status>) -> Result<T, Status> {
        outcome.inspect_err(|status| self.metrics.refused(operation, details::reason(status)))
    }

    /// Asks the actor for a change. `pending` is its entry in the audit log.
    pub(super) async fn change<T>(
        &self,
        operation: &'static str,
        pending: Pending,
        caller: &Caller,
        message: impl FnOnce(Speaker, Answer<T>) -> Message,
    ) -> Result<T, Status> {
        let speaker = speaker(caller);
        let changed = self.actor.request(|answer| message(speaker, answer)).await;
        pending.ended(&changed);
        self.counted(operation, changed)
    }

    /// Asks the pool for a change. Returns its reply and the revision of the change.
    pub(super) async fn perform(
        &self,
        caller: &Caller,
        request_id: String,
        request: Request,
    ) -> Result<(Reply, u64), Status> {
        label(&request_id, "request_id")?;
        let operation = match &request {
            Request::Create { .. } => "create",
            Request::Consume { .. } => "consume",
            Request::Delete { .. } | Request::DeleteUnits { .. } => "delete",
            Request::Release { .. } => "release",
            Request::EndTask { .. } => "end_task",
            Request::ConfirmStandstill { .. } => "confirm_standstill",
            _ => "operate",
        };
        let pending = audit::begin(caller, &request_id, || mutation::of(&request));
        let speaker = speaker(caller);
        let changed = loop {
            let (speaker, request_id, request) = (speaker.clone(), request_id.clone(), request.clone());
            let message = |answer| Message::Perform { speaker, request_id, request, answer };
            match self.actor.request(message).await {
                // The call is done in part. It asks for the rest, after those who asked in the meantime.
                Ok((Reply::Unfinished, _)) => {}
                changed => break changed,
            }
        };
        pending.ended(&changed);
        let (reply, revision) = self.counted(operation, changed)?;
        Ok((reply, revision.0))
    }
}

pub(super) fn session(id: &str) -> Result<SessionId, Status> {
    name(id, "session_id")?;
    Ok(SessionId::from(id))
}

/// A call without a session is made as operator.
pub(super) fn optional_session(id: &str) -> Result<Option<SessionId>, Status> {
    (!id.is_empty()).then(|| session(id)).transpose()
}

pub(super) fn odd_reply(reply: &Reply) -> Status {
    status(Code::Internal, "BROKEN", format!("the pool answered with {reply:?}"))
}
