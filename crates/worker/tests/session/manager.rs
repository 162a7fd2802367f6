//! A resource manager reduced to what sessions and providers need of it: sessions that die with their time to live, and resources that die
//! with their session.

use super::LONG;
use futures::stream::{BoxStream, StreamExt};
use ratn_proto::v1::resource_service_server::{ResourceService, ResourceServiceServer};
use ratn_proto::v1::*;
use ratn_worker::endpoint::Endpoint;
use ratn_worker::protocol::HEADER;
use ratn_worker::server::{Services, bind};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex};
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;
use tonic::{Code, Request, Response, Status, Streaming};
use tonic_types::{ErrorDetails, StatusExt};

#[derive(Default)]
pub(crate) struct Pool {
    /// Which of all sessions each is.
    pub(crate) sessions: BTreeMap<String, u64>,
    /// Sessions that were made.
    pub(crate) made: u64,
    /// So many creations are never answered, and change nothing.
    pub(crate) unanswered: usize,
    /// How often each was to be created.
    pub(crate) creations: BTreeMap<String, usize>,
    /// The caller has no role any more that may create anything.
    pub(crate) forbids: bool,
    /// Creations are done, their answers are held back, and then lost.
    pub(crate) loses_answers: bool,
    /// Pings that arrived.
    pub(crate) pings: usize,
    /// So many pings break their stream.
    pub(crate) broken: usize,
    /// So many answers that say that a session was made are lost with their stream.
    pub(crate) lost_answers: usize,
    pub(crate) resources: BTreeMap<String, ratn_proto::v1::Resource>,
    /// Ids of resources that another session has.
    pub(crate) taken: BTreeSet<String>,
    /// Ids of sessions that another caller has.
    pub(crate) anothers: BTreeSet<String>,
    /// So many creations end with their session before they are answered.
    pub(crate) short_lived: usize,
    /// Resources are watched, from now on or once more is known.
    pub(crate) shows: Option<bool>,
    /// Watches that have begun.
    pub(crate) watches: usize,
    /// Questions for one resource are refused so often: the manager is busy.
    pub(crate) busy: usize,
    /// The youngest lease.
    pub(crate) youngest: u64,
    /// So many confirmations of standstill are never answered.
    pub(crate) swallowed: usize,
    /// Confirmations of standstill that arrived.
    pub(crate) confirmations: usize,
    /// What streams of pings said of their protocol, in order.
    pub(crate) protocols: Vec<Option<String>>,
}

#[derive(Clone)]
pub(crate) struct Manager {
    pub(crate) pool: Arc<Mutex<Pool>>,
    pub(crate) changed: watch::Sender<()>,
}

#[tonic::async_trait]
impl ResourceService for Manager {
    async fn create(&self, request: Request<CreateRequest>) -> Result<Response<CreateResponse>, Status> {
        let request = request.into_inner();
        let is_unanswered = {
            let mut pool = self.pool.lock().unwrap();
            let is_unanswered = pool.unanswered > 0;
            pool.unanswered -= usize::from(is_unanswered);
            is_unanswered
        };
        if is_unanswered {
            return std::future::pending().await;
        }
        let (resource, is_lost) = {
            let mut pool = self.pool.lock().unwrap();
            if !pool.sessions.contains_key(&request.session_id) {
                return Err(Status::failed_precondition("no such session"));
            }
            let resource = request.resource.unwrap();
            *pool.creations.entry(resource.id.clone()).or_default() += 1;
            if resource.kind == "Forbidden" || pool.forbids {
                drop(pool);
                self.changed.send_replace(());
                return Err(Status::permission_denied("not here"));
            }
            if pool.taken.contains(&resource.id) {
                return Err(Status::already_exists("another session has it"));
            }
            if let Some(left) = pool.short_lived.checked_sub(1) {
                pool.short_lived = left;
                return Err(Status::not_found("created by this request and gone since"));
            }
            let resource = ratn_proto::v1::Resource { session_id: request.session_id, ..resource };
            pool.resources.insert(resource.id.clone(), resource.clone());
            (resource, pool.loses_answers)
        };
        self.changed.send_replace(());
        if is_lost {
            self.until(|pool| !pool.loses_answers).await;
            return Err(Status::unavailable("the connection broke"));
        }
        Ok(Response::new(CreateResponse { resource: Some(resource) }))
    }

    async fn delete(&self, request: Request<DeleteRequest>) -> Result<Response<DeleteResponse>, Status> {
        let Some(delete_request::Target::ResourceId(id)) = request.into_inner().target else { unreachable!() };
        self.pool.lock().unwrap().resources.remove(&id).ok_or_else(|| Status::not_found(id.clone()))?;
        self.changed.send_replace(());
        Ok(Response::new(DeleteResponse { resource_ids: vec![id], revision: 1, deleted: Vec::new() }))
    }

    type KeepAliveStream = BoxStream<'static, Result<KeepAliveResponse, Status>>;

    async fn keep_alive(
        &self,
        request: Request<Streaming<KeepAliveRequest>>,
    ) -> Result<Response<Self::KeepAliveStream>, Status> {
        let manager = self.clone();
        let protocol = request.metadata().get(HEADER).map(|said| said.to_str().unwrap().to_owned());
        manager.pool.lock().unwrap().protocols.push(protocol);
        let answers = request.into_inner().map(move |ping| {
            let ping = ping?;
            let mut pool = manager.pool.lock().unwrap();
            if pool.anothers.contains(&ping.session_id) {
                let details = ErrorDetails::with_error_info("NOT_YOURS", "ratn", []);
                return Err(Status::with_error_details(Code::PermissionDenied, "another's", details));
            }
            let created = ping.ttl_ms > 0 && !pool.sessions.contains_key(&ping.session_id);
            if ping.ttl_ms == 0 {
                pool.sessions.remove(&ping.session_id);
            } else if created {
                pool.made += 1;
                let number = pool.made;
                pool.sessions.insert(ping.session_id.clone(), number);
            }
            let number = pool.sessions.get(&ping.session_id).copied().unwrap_or(0);
            pool.pings += 1;
            let is_lost = created && pool.lost_answers > 0;
            pool.lost_answers -= usize::from(is_lost);
            let breaks = pool.broken > 0;
            pool.broken -= usize::from(breaks);
            drop(pool);
            manager.changed.send_replace(());
            if is_lost || breaks {
                return Err(Status::unavailable("the connection broke"));
            }
            Ok(KeepAliveResponse { session_id: ping.session_id, ttl_ms: ping.ttl_ms, created, revision: 1, number })
        });
        Ok(Response::new(answers.boxed()))
    }

    async fn recall(&self, _: Request<RecallRequest>) -> Result<Response<RecallResponse>, Status> {
        Err(Status::unimplemented("not under test"))
    }

    async fn consume(&self, _: Request<ConsumeRequest>) -> Result<Response<ConsumeResponse>, Status> {
        Err(Status::unimplemented("not under test"))
    }

    async fn block(&self, _: Request<BlockRequest>) -> Result<Response<BlockResponse>, Status> {
        Err(Status::unimplemented("not under test"))
    }

    async fn release(
        &self,
        _: Request<ResourceServiceReleaseRequest>,
    ) -> Result<Response<ResourceServiceReleaseResponse>, Status> {
        Err(Status::unimplemented("not under test"))
    }

    async fn withdraw(&self, _: Request<WithdrawRequest>) -> Result<Response<WithdrawResponse>, Status> {
        Err(Status::unimplemented("not under test"))
    }

    async fn exists(&self, _: Request<ExistsRequest>) -> Result<Response<ExistsResponse>, Status> {
        Err(Status::unimplemented("not under test"))
    }

    async fn acquire(&self, _: Request<AcquireRequest>) -> Result<Response<AcquireResponse>, Status> {
        Err(Status::unimplemented("not under test"))
    }

    async fn list(&self, _: Request<ListRequest>) -> Result<Response<ListResponse>, Status> {
        Err(Status::unimplemented("not under test"))
    }

    type SessionStream = BoxStream<'static, Result<ratn_proto::v1::SessionResponse, Status>>;

    async fn session(
        &self,
        _: Request<Streaming<ratn_proto::v1::SessionRequest>>,
    ) -> Result<Response<Self::SessionStream>, Status> {
        Err(Status::unimplemented("not under test"))
    }

    async fn get(
        &self,
        request: Request<ratn_proto::v1::ResourceServiceGetRequest>,
    ) -> Result<Response<ratn_proto::v1::ResourceServiceGetResponse>, Status> {
        let mut pool = self.pool.lock().unwrap();
        if let Some(left) = pool.busy.checked_sub(1) {
            pool.busy = left;
            return Err(Status::resource_exhausted("busy"));
        }
        let found = pool.resources.get(&request.into_inner().resource_id).cloned();
        let resource = Some(found.ok_or_else(|| Status::not_found("no such resource"))?);
        Ok(Response::new(ratn_proto::v1::ResourceServiceGetResponse { resource }))
    }

    async fn explain(
        &self,
        _: Request<ratn_proto::v1::ExplainRequest>,
    ) -> Result<Response<ratn_proto::v1::ExplainResponse>, Status> {
        Err(Status::unimplemented("not under test"))
    }

    async fn list_sessions(
        &self,
        _: Request<ratn_proto::v1::ListSessionsRequest>,
    ) -> Result<Response<ratn_proto::v1::ListSessionsResponse>, Status> {
        Err(Status::unimplemented("not under test"))
    }

    type WatchDemandStream = BoxStream<'static, Result<ratn_proto::v1::WatchDemandResponse, Status>>;

    async fn watch_demand(
        &self,
        _: Request<ratn_proto::v1::WatchDemandRequest>,
    ) -> Result<Response<Self::WatchDemandStream>, Status> {
        Err(Status::unimplemented("not under test"))
    }

    async fn confirm_standstill(
        &self,
        _: Request<ratn_proto::v1::ConfirmStandstillRequest>,
    ) -> Result<Response<ratn_proto::v1::ConfirmStandstillResponse>, Status> {
        let is_swallowed = {
            let mut pool = self.pool.lock().unwrap();
            pool.confirmations += 1;
            pool.confirmations <= pool.swallowed
        };
        self.changed.send_replace(());
        if is_swallowed {
            std::future::pending::<()>().await;
        }
        Ok(Response::new(ratn_proto::v1::ConfirmStandstillResponse::default()))
    }

    async fn report_shortage(
        &self,
        _: Request<ratn_proto::v1::ReportShortageRequest>,
    ) -> Result<Response<ratn_proto::v1::ReportShortageResponse>, Status> {
        Err(Status::unimplemented("not under test"))
    }

    async fn end_task(
        &self,
        _: Request<ratn_proto::v1::EndTaskRequest>,
    ) -> Result<Response<ratn_proto::v1::EndTaskResponse>, Status> {
        Err(Status::unimplemented("not under test"))
    }

    type WatchStream = BoxStream<'static, Result<ResourceServiceWatchResponse, Status>>;

    async fn watch(&self, _: Request<ResourceServiceWatchRequest>) -> Result<Response<Self::WatchStream>, Status> {
        let manager = self.clone();
        {
            let mut pool = manager.pool.lock().unwrap();
            if pool.shows.is_none() {
                return Err(Status::unimplemented("not under test"));
            }
            pool.watches += 1;
        }
        manager.changed.send_replace(());
        let snapshot = async move {
            manager.until(|pool| pool.shows == Some(true)).await;
            let pool = manager.pool.lock().unwrap();
            let (resources, youngest_lease_id) = (pool.resources.values().cloned().collect(), pool.youngest);
            let snapshot =
                ResourceSnapshot { revision: 1, resources, youngest_lease_id, ..ResourceSnapshot::default() };
            Ok(ResourceServiceWatchResponse { kind: Some(resource_service_watch_response::Kind::Snapshot(snapshot)) })
        };
        Ok(Response::new(futures::stream::once(snapshot).chain(futures::stream::pending()).boxed()))
    }
}

impl Manager {
    pub(crate) fn new() -> Manager {
        Manager { pool: Arc::default(), changed: watch::channel(()).0 }
    }

    pub(crate) async fn serve(&self, endpoint: &Endpoint) -> (CancellationToken, tokio::task::JoinHandle<()>) {
        let bound = bind(endpoint).await.unwrap();
        let stop = CancellationToken::new();
        let serving = bound.serve(Services::new().with(ResourceServiceServer::new(self.clone())), stop.clone());
        (stop, tokio::spawn(async move { serving.await.unwrap() }))
    }

    /// Waits until the pool is as `wanted` says.
    pub(crate) async fn until(&self, wanted: impl Fn(&Pool) -> bool) {
        let mut changes = self.changed.subscribe();
        let seen = changes.wait_for(|()| wanted(&self.pool.lock().unwrap()));
        tokio::time::timeout(LONG, seen).await.expect("the pool never became so").unwrap();
    }

    pub(crate) fn forget_everything(&self) {
        let mut pool = self.pool.lock().unwrap();
        *pool = Pool { made: pool.made, ..Pool::default() };
    }
}
