//! Calls for a lease: acquire and block wait in the queue, withdraw leaves it, and explain says why a call waits.

use super::mutation;
use super::notes::Notes;
use super::requests::{Requests, session};
use super::waiting_call::{Tickets, WaitingCall};
use crate::access::{Caller, speaker};
use crate::audit::{self, Mutation};
use crate::details::status;
use crate::paging;
use crate::resource_manager::actor::Message;
use crate::resource_manager::{Granted, wire};
use ratn_model::resource::{Requirement, ResourceOperation};
use ratn_proto::convert::{all, each, label, name, required};
use ratn_proto::v1;
use ratn_resources::AcquireRequest;
use std::time::{Duration, Instant};
use tonic::{Code, Status};

pub(super) async fn block(
    requests: &Requests,
    tickets: &Tickets,
    caller: &Caller,
    request: v1::BlockRequest,
) -> Result<v1::BlockResponse, Status> {
    let requirement: Requirement = required(request.requirement, "requirement")?;
    if requirement.operation != ResourceOperation::Block {
        let message = format!("requirement.operation: is {}, not block", requirement.operation);
        return Err(status(Code::InvalidArgument, "MALFORMED", message));
    }
    let acquire = AcquireRequest {
        priority: request.priority,
        purpose: request.holder,
        ..AcquireRequest::new(session(&request.session_id)?, vec![requirement])
    };
    let lease = wait_for_grant(requests, tickets, caller, request.request_id, acquire, request.deadline_ms).await?;
    Ok(v1::BlockResponse { lease: Some(wire::lease(lease, request.session_id)) })
}

pub(super) async fn acquire(
    requests: &Requests,
    tickets: &Tickets,
    notes: &Notes,
    caller: &Caller,
    request: v1::AcquireRequest,
) -> Result<v1::AcquireResponse, Status> {
    let requirements = each(request.requirements, "requirements")?;
    let acquire = AcquireRequest {
        priority: request.priority,
        purpose: request.holder,
        speculative: request.speculative,
        instead_of: request.instead_of,
        ..AcquireRequest::new(session(&request.session_id)?, requirements)
    };
    let lease = wait_for_grant(requests, tickets, caller, request.request_id, acquire, request.deadline_ms).await?;
    let notes = notes.of(&lease, &request.session_id, &caller.name, Instant::now());
    Ok(v1::AcquireResponse { lease: Some(wire::lease(lease, request.session_id)), notes })
}

async fn wait_for_grant(
    requests: &Requests,
    tickets: &Tickets,
    caller: &Caller,
    request_id: String,
    request: AcquireRequest,
    wait_ms: u64,
) -> Granted {
    let pending = audit::begin(caller, &request_id, || mutation::of_acquire(&request));
    let began = Instant::now();
    let granted = granted(requests, tickets, caller, request_id, request, wait_ms).await;
    if granted.is_ok() {
        requests.metrics().granted(began.elapsed());
    }
    pending.ended_with(&granted, |lease| Some(lease.token));
    requests.counted("acquire", granted)
}

async fn granted(
    requests: &Requests,
    tickets: &Tickets,
    caller: &Caller,
    request_id: String,
    request: AcquireRequest,
    wait_ms: u64,
) -> Granted {
    label(&request_id, "request_id")?;
    label(&request.purpose, "holder")?;
    label(&request.instead_of, "instead_of")?;
    if wait_ms == 0 {
        return Err(status(Code::InvalidArgument, "MALFORMED", "deadline_ms: is 0: it must be at least 1"));
    }
    let wait = Duration::from_millis(wait_ms);
    let speaker = speaker(caller);
    WaitingCall::begin(requests.actor(), tickets, speaker, request_id, request, wait).await?.granted(wait).await
}

pub(super) async fn withdraw(
    requests: &Requests,
    caller: &Caller,
    request: v1::WithdrawRequest,
) -> Result<v1::WithdrawResponse, Status> {
    let v1::WithdrawRequest { request_id, session_id, call, .. } = request;
    name(&request_id, "request_id")?;
    let session = session(&session_id)?;
    let pending = audit::begin(caller, &request_id, || Mutation::Withdraw { session: session_id });
    if call != 0 {
        let message = "call: is of a session's stream: a withdraw of its own names the request id alone";
        let refused = Err(status(Code::InvalidArgument, "MALFORMED", message));
        pending.ended(&refused);
        return refused;
    }
    let message = |speaker, answer| Message::Withdraw { speaker, session, request_id, answer };
    let withdrawn = requests.change("withdraw", pending, caller, message).await?;
    Ok(v1::WithdrawResponse { withdrawn })
}

pub(super) async fn explain(
    requests: &Requests,
    caller: Caller,
    request: v1::ExplainRequest,
) -> Result<v1::ExplainResponse, Status> {
    let (caller, request_id) = (caller.name, request.request_id);
    label(&request_id, "request_id")?;
    let asked = |answer| Message::Waiters { caller, request_id, answer };
    let (mut waiters, total) = requests.actor().request(asked).await?;
    let mut waiting = Vec::new();
    while !waiters.is_empty() {
        let rest = waiters.clone();
        let explain = |answer| Message::Explain { waiters: rest, answer };
        let (explained, done) = requests.actor().ask(explain).await?;
        waiting.extend(explained);
        waiters.drain(..done.clamp(1, waiters.len()));
    }
    let total = u32::try_from(total).unwrap_or(u32::MAX);
    Ok(v1::ExplainResponse { waiting: paging::first(all(waiting)), total })
}
