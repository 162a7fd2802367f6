//! The calls on a session's stream, each treated as a separate call from the stream's caller. Dropped calls leave the queue as unary calls do; so
//! does a call that its client reports as dropped, also when its answer was under way to the client.

use super::service::Service;
use crate::access::Caller;
use crate::audit::{self, Mutation};
use crate::details::status;
use crate::stream_calls::StreamCaller;
use futures::StreamExt;
use futures::stream::once;
use ratn_model::id::LeaseId;
use ratn_proto::convert::name;
use ratn_proto::v1;
use ratn_proto::v1::resource_service_server::ResourceService;
use ratn_proto::v1::session_request::Kind as Asked;
use ratn_proto::v1::session_response::Kind;
use ratn_worker::multiplex::server::{CallAnswers, Serve};
use ratn_worker::multiplex::{Protocol, SessionCalls};
use ratn_worker::trace::{self, TraceContext};
use std::collections::{BTreeMap, VecDeque};
use std::time::Instant;
use tonic::{Code, Status};
use tracing::Instrument;

/// The method as which a withdraw on a stream counts.
const WITHDRAW: &str = "/ratn.v1.ResourceService/Withdraw";

/// Number of grants of a stream that are remembered by call id: more than can be under way to a client that reads.
const GRANTS: usize = 4_096;

/// Performs the calls of one caller.
#[derive(Debug)]
pub(super) struct CallerService {
    service: Service,
    caller: StreamCaller,
    grants: Grants,
}

/// Which call of the stream was answered with which lease: the newest grants.
#[derive(Debug, Default)]
struct Grants {
    leases: BTreeMap<u64, LeaseId>,
    /// Oldest first.
    order: VecDeque<u64>,
}

impl Grants {
    fn keep(&mut self, call: u64, lease: LeaseId) {
        self.leases.insert(call, lease);
        self.order.push_back(call);
        while self.order.len() > GRANTS {
            if let Some(oldest) = self.order.pop_front() {
                self.leases.remove(&oldest);
            }
        }
    }
}

impl CallerService {
    pub(super) fn new(service: Service, caller: StreamCaller) -> CallerService {
        CallerService { service, caller, grants: Grants::default() }
    }
}

impl Serve<SessionCalls> for CallerService {
    const MAX_CALLS: usize = 4_096;

    fn begin(&mut self, call: Option<Asked>, context: Option<TraceContext>) -> CallAnswers<SessionCalls> {
        let path = call.as_ref().map_or("/ratn.v1.ResourceService/KeepAlive", SessionCalls::path);
        let performed = performed(self.service.clone(), self.caller.caller.clone(), call);
        let counted = self.caller.clone().call(path, performed);
        match context {
            None => once(counted).boxed(),
            Some(context) => once(trace::within(context, counted).instrument(context.entered())).boxed(),
        }
    }

    fn answered(&mut self, id: u64, answer: &Result<Kind, Status>) {
        let lease = match answer {
            Ok(Kind::Block(granted)) => granted.lease.as_ref(),
            Ok(Kind::Acquire(granted)) => granted.lease.as_ref(),
            _ => None,
        };
        if let Some(lease) = lease.filter(|_| id != 0) {
            self.grants.keep(id, LeaseId(lease.id));
        }
    }

    /// The client dropped a call. If its answer was under way, the lease is returned as for a dropped unary call, unless another call with the same
    /// request id got it and the client received that answer.
    fn end(&mut self, ended: u64, by: Asked, end: impl FnOnce() -> bool) -> Option<Result<Kind, Status>> {
        let Asked::Withdraw(v1::WithdrawRequest { request_id, session_id, unheard, .. }) = by else { return None };
        if let Err(malformed) = name(&request_id, "request_id").and_then(|()| name(&session_id, "session_id")) {
            return Some(Err(malformed.into()));
        }
        let mut withdrawn = end();
        if !withdrawn && let Some(lease) = self.grants.leases.remove(&ended) {
            self.service.return_later(lease);
            let withdraw = || Mutation::Withdraw { session: session_id.clone() };
            audit::begin(&self.caller.caller, &request_id, withdraw).ended(&Ok(()));
            withdrawn = true;
        }
        // The end of a call was counted with the call. A withdraw that counts separately may be refused before it causes any work.
        let StreamCaller { caller, quotas, .. } = &self.caller;
        let counts = quotas.as_ref().filter(|_| !withdrawn);
        if let Some(Err(refused)) = counts.map(|quotas| quotas.admit(caller, WITHDRAW, Instant::now())) {
            return Some(Err(refused));
        }
        if unheard {
            self.service.undo_later(caller, &session_id, request_id);
        }
        Some(Ok(Kind::Withdraw(v1::WithdrawResponse { withdrawn })))
    }

    fn too_many(&self) -> Status {
        self.caller.too_many(Self::MAX_CALLS)
    }
}

async fn performed(service: Service, caller: Caller, call: Option<Asked>) -> Result<Kind, Status> {
    Ok(match call {
        Some(Asked::KeepAlive(ping)) => Kind::KeepAlive(service.kept_alive(&caller, ping).await?),
        Some(Asked::Block(block)) => Kind::Block(service.block(caller.request(block)).await?.into_inner()),
        Some(Asked::Acquire(acquire)) => Kind::Acquire(service.acquire(caller.request(acquire)).await?.into_inner()),
        Some(Asked::Release(release)) => Kind::Release(service.release(caller.request(release)).await?.into_inner()),
        Some(Asked::Withdraw(undo)) => Kind::Withdraw(service.withdraw(caller.request(undo)).await?.into_inner()),
        None => return Err(status(Code::InvalidArgument, "MALFORMED", "kind: is missing: set one of the calls")),
    })
}
