//! gRPC in front of the actor: checks what the schema cannot express, and undoes grants to dropped calls.
//!
//! ```text
//!   Service ──one file for each kind of call──▶ resources, acquires, leases, sessions, demand, watches
//!                                                   └──▶ requests: audit log, counted refusals ──▶ actor
//! ```

mod acquires;
mod demand;
mod leases;
mod mutation;
mod notes;
mod requests;
mod resources;
mod sessions;
#[cfg(test)]
mod test_actor;
mod waiting_call;
mod watches;

use super::actor::{Handle, Message};
use super::stream::CallerService;
use crate::access::{Caller, speaker};
use crate::metrics::Metrics;
use crate::quota::Quotas;
use crate::stream_calls::StreamCaller;
use futures::stream::BoxStream;
use notes::Notes;
use ratn_model::id::LeaseId;
use ratn_proto::v1;
use ratn_resources::SessionId;
use ratn_worker::multiplex::SessionCalls;
use ratn_worker::multiplex::server::Answers;
use requests::Requests;
use std::sync::Arc;
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status, Streaming};
use waiting_call::Tickets;

/// The service; clones share the actor.
#[derive(Debug, Clone)]
pub(super) struct Service {
    requests: Requests,
    tickets: Tickets,
    notes: Notes,
    shutdown: CancellationToken,
}

type Streamed<T> = BoxStream<'static, Result<T, Status>>;

impl Service {
    pub(super) fn new(actor: Handle, shutdown: CancellationToken, metrics: Arc<Metrics>) -> Service {
        let (tickets, notes) = Default::default();
        Service { requests: Requests::new(actor, metrics), tickets, notes, shutdown }
    }

    pub(super) fn metrics(&self) -> &Arc<Metrics> {
        self.requests.metrics()
    }

    pub(super) async fn kept_alive(
        &self,
        caller: &Caller,
        ping: v1::KeepAliveRequest,
    ) -> Result<v1::KeepAliveResponse, Status> {
        sessions::kept_alive(&self.requests, caller, ping).await
    }

    /// Gives back a lease whose grant the caller did not read.
    pub(super) fn return_later(&self, lease: LeaseId) {
        self.requests.actor().send_later(Message::Return { lease });
    }

    /// Gives back what a request was granted, whichever calls were answered with it: the caller has read no answer.
    pub(super) fn undo_later(&self, caller: &Caller, session: &str, request_id: String) {
        let (speaker, session) = (speaker(caller), SessionId::from(session));
        self.requests.actor().send_later(Message::Undo { speaker, session, request_id });
    }
}

/// The caller of a request, and its message.
fn parts<T>(request: Request<T>) -> (Caller, T) {
    (Caller::of(&request), request.into_inner())
}

#[tonic::async_trait]
impl v1::resource_service_server::ResourceService for Service {
    type WatchStream = Streamed<v1::ResourceServiceWatchResponse>;
    type WatchDemandStream = Streamed<v1::WatchDemandResponse>;
    type KeepAliveStream = Streamed<v1::KeepAliveResponse>;
    type SessionStream = Answers<SessionCalls, CallerService>;

    async fn create(&self, request: Request<v1::CreateRequest>) -> Result<Response<v1::CreateResponse>, Status> {
        let (caller, request) = parts(request);
        resources::create(&self.requests, &caller, request).await.map(Response::new)
    }

    async fn consume(&self, request: Request<v1::ConsumeRequest>) -> Result<Response<v1::ConsumeResponse>, Status> {
        let (caller, request) = parts(request);
        resources::consume(&self.requests, &caller, request).await.map(Response::new)
    }

    async fn delete(&self, request: Request<v1::DeleteRequest>) -> Result<Response<v1::DeleteResponse>, Status> {
        let (caller, request) = parts(request);
        resources::delete(&self.requests, &caller, request).await.map(Response::new)
    }

    async fn recall(&self, request: Request<v1::RecallRequest>) -> Result<Response<v1::RecallResponse>, Status> {
        let (caller, request) = parts(request);
        resources::recall(&self.requests, &caller, request).await.map(Response::new)
    }

    async fn exists(&self, request: Request<v1::ExistsRequest>) -> Result<Response<v1::ExistsResponse>, Status> {
        resources::exists(&self.requests, request.into_inner()).await.map(Response::new)
    }

    async fn get(
        &self,
        request: Request<v1::ResourceServiceGetRequest>,
    ) -> Result<Response<v1::ResourceServiceGetResponse>, Status> {
        resources::get(&self.requests, request.into_inner()).await.map(Response::new)
    }

    async fn list(&self, request: Request<v1::ListRequest>) -> Result<Response<v1::ListResponse>, Status> {
        resources::list(&self.requests, request.into_inner()).await.map(Response::new)
    }

    async fn block(&self, request: Request<v1::BlockRequest>) -> Result<Response<v1::BlockResponse>, Status> {
        let (caller, request) = parts(request);
        acquires::block(&self.requests, &self.tickets, &caller, request).await.map(Response::new)
    }

    async fn acquire(&self, request: Request<v1::AcquireRequest>) -> Result<Response<v1::AcquireResponse>, Status> {
        let (caller, request) = parts(request);
        acquires::acquire(&self.requests, &self.tickets, &self.notes, &caller, request).await.map(Response::new)
    }

    async fn withdraw(&self, request: Request<v1::WithdrawRequest>) -> Result<Response<v1::WithdrawResponse>, Status> {
        let (caller, request) = parts(request);
        acquires::withdraw(&self.requests, &caller, request).await.map(Response::new)
    }

    async fn explain(&self, request: Request<v1::ExplainRequest>) -> Result<Response<v1::ExplainResponse>, Status> {
        let (caller, request) = parts(request);
        acquires::explain(&self.requests, caller, request).await.map(Response::new)
    }

    async fn release(
        &self,
        request: Request<v1::ResourceServiceReleaseRequest>,
    ) -> Result<Response<v1::ResourceServiceReleaseResponse>, Status> {
        let (caller, request) = parts(request);
        leases::release(&self.requests, &self.notes, &caller, request).await.map(Response::new)
    }

    async fn confirm_standstill(
        &self,
        request: Request<v1::ConfirmStandstillRequest>,
    ) -> Result<Response<v1::ConfirmStandstillResponse>, Status> {
        let (caller, request) = parts(request);
        leases::confirm_standstill(&self.requests, &caller, request).await.map(Response::new)
    }

    async fn list_sessions(
        &self,
        request: Request<v1::ListSessionsRequest>,
    ) -> Result<Response<v1::ListSessionsResponse>, Status> {
        sessions::list(&self.requests, request.into_inner()).await.map(Response::new)
    }

    async fn end_task(&self, request: Request<v1::EndTaskRequest>) -> Result<Response<v1::EndTaskResponse>, Status> {
        let (caller, request) = parts(request);
        sessions::end_task(&self.requests, &caller, request).await.map(Response::new)
    }

    async fn keep_alive(
        &self,
        request: Request<Streaming<v1::KeepAliveRequest>>,
    ) -> Result<Response<Self::KeepAliveStream>, Status> {
        let quotas = request.extensions().get::<Quotas>().cloned();
        let (caller, pings) = parts(request);
        let answers = sessions::keep_alive(self.requests.clone(), caller, quotas, pings, self.shutdown.clone());
        Ok(Response::new(answers))
    }

    async fn session(
        &self,
        request: Request<Streaming<v1::SessionRequest>>,
    ) -> Result<Response<Self::SessionStream>, Status> {
        let caller = StreamCaller::of(&request, self.metrics().clone());
        let calls = CallerService::new(self.clone(), caller);
        Ok(Response::new(Answers::new(calls, request.into_inner(), Some(self.shutdown.clone()))))
    }

    async fn watch_demand(
        &self,
        request: Request<v1::WatchDemandRequest>,
    ) -> Result<Response<Self::WatchDemandStream>, Status> {
        let (caller, request) = parts(request);
        demand::watch(&self.requests, &caller, request, self.shutdown.clone()).await.map(Response::new)
    }

    async fn report_shortage(
        &self,
        request: Request<v1::ReportShortageRequest>,
    ) -> Result<Response<v1::ReportShortageResponse>, Status> {
        let (caller, request) = parts(request);
        demand::report_shortage(&self.requests, &caller, request).await.map(Response::new)
    }

    async fn watch(
        &self,
        request: Request<v1::ResourceServiceWatchRequest>,
    ) -> Result<Response<Self::WatchStream>, Status> {
        let reader =
            watches::Reader { caller: Caller::of(&request), quotas: request.extensions().get::<Quotas>().cloned() };
        watches::watch(&self.requests, reader, request.into_inner(), self.shutdown.clone()).await.map(Response::new)
    }
}
