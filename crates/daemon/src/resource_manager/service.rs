//! gRPC in front of the actor: checks what the schema cannot say, and undoes what a dropped call was about to get.

use super::actor::{Handle, Message};
use super::providers::Provisions;
use super::stream::CallerService;
use super::watch_filter::WatchFilter;
use super::{Granted, wire};
use crate::access::{Caller, speaker};
use crate::audit::{self, Mutation};
use crate::details::{self, ending, retry_later, status};
use crate::metrics::Metrics;
use crate::paging::{self, Filled, Page};
use crate::quota::Quotas;
use futures::{Stream, StreamExt};
use ratn_model::id::{LeaseId, Revision};
use ratn_model::resource::{Lease, Requirement, ResourceOperation};
use ratn_proto::convert::{all, each, label, name, names, ports, required};
use ratn_proto::types::{Resource, ResourceFilter, WatchPosition};
use ratn_proto::v1;
use ratn_resources::{AcquireRequest, Reply, Request as PoolRequest, ResourceSpec, SessionId};
use ratn_worker::multiplex::SessionCalls;
use ratn_worker::multiplex::server::Answers;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};
use tokio::sync::{mpsc, oneshot};
use tokio_util::sync::CancellationToken;
use tonic::{Code, Request, Response, Status, Streaming};

/// Answers that wait for a slow reader of a keep-alive stream.
const KEEP_ALIVE_BUFFER: usize = 16;
/// What the pool's own answer at a deadline is given to arrive.
const GRACE: Duration = Duration::from_millis(20);
/// Resources that are looked at in one turn for a list.
const LISTED_AT_ONCE: usize = 4_096;
/// Ids that an answer names.
const MOST_IDS: usize = 1_000;
/// Resources that one watch may name.
const MAX_WATCHED: usize = 1_024;
/// What a ping on a stream counts as.
const PING: &str = "/ratn.v1.ResourceService/KeepAlive";
/// When a watcher that was cut off may come back.
const WATCH_AGAIN_AFTER: Duration = Duration::from_millis(50);

/// The service; clones share the actor.
#[derive(Debug, Clone)]
pub(super) struct Service {
    pub(super) actor: Handle,
    shutdown: CancellationToken,
    next_ticket: Arc<AtomicU64>,
    pub(super) metrics: Arc<Metrics>,
}

type Streamed<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

impl Service {
    pub(super) fn new(actor: Handle, shutdown: CancellationToken, metrics: Arc<Metrics>) -> Service {
        Service { actor, shutdown, next_ticket: Arc::default(), metrics }
    }

    /// A refusal is counted by its reason.
    fn counted<T>(&self, operation: &'static str, outcome: Result<T, Status>) -> Result<T, Status> {
        outcome.inspect_err(|status| self.metrics.refused(operation, details::reason(status)))
    }

    async fn perform(&self, caller: &Caller, request_id: String, request: PoolRequest) -> Result<(Reply, u64), Status> {
        label(&request_id, "request_id")?;
        let operation = match &request {
            PoolRequest::Create { .. } => "create",
            PoolRequest::Consume { .. } => "consume",
            PoolRequest::Delete { .. } | PoolRequest::DeleteUnits { .. } => "delete",
            PoolRequest::Release { .. } => "release",
            PoolRequest::EndTask { .. } => "end_task",
            PoolRequest::ConfirmStandstill { .. } => "confirm_standstill",
            _ => "operate",
        };
        let pending = audit::begin(caller, &request_id, || mutation_of(&request));
        let speaker = speaker(caller);
        let performed = self
            .actor
            .ask(|answer| Message::Perform { speaker, request_id, request, answer })
            .await
            .and_then(|done| done);
        pending.ended(&performed);
        let (reply, revision) = self.counted(operation, performed)?;
        Ok((reply, revision.0))
    }

    pub(super) async fn kept_alive(
        &self,
        caller: &Caller,
        ping: v1::KeepAliveRequest,
    ) -> Result<v1::KeepAliveResponse, Status> {
        let session = session(&ping.session_id)?;
        label(&ping.client, "client")?;
        let client = if ping.client.is_empty() { ping.session_id.clone() } else { ping.client };
        let ttl = Duration::from_millis(ping.ttl_ms);
        let (named, id) = (client.clone(), ping.session_id.clone());
        let kept = self.actor.keep_alive(speaker(caller), session, client, ttl).await;
        // Pings that change nothing are not written down.
        if ttl.is_zero() {
            audit::begin(caller, "", || Mutation::CloseSession { session: id }).ended(&kept);
        } else if kept.as_ref().map_or(true, |kept| kept.created) {
            let open = || Mutation::OpenSession { session: id, client: named, ttl_ms: ping.ttl_ms };
            audit::begin(caller, "", open).ended(&kept);
        }
        let kept = self.counted("keep_alive", kept)?;
        Ok(v1::KeepAliveResponse {
            session_id: ping.session_id,
            ttl_ms: u64::try_from(kept.ttl.as_millis()).unwrap_or(u64::MAX),
            created: kept.created,
            revision: kept.revision.0,
        })
    }

    async fn wait_for_grant(
        &self,
        caller: &Caller,
        request_id: String,
        request: AcquireRequest,
        wait_ms: u64,
    ) -> Result<Lease, Status> {
        let pending = audit::begin(caller, &request_id, || mutation_of_acquire(&request));
        let began = Instant::now();
        let granted = self.granted(caller, request_id, request, wait_ms).await;
        if granted.is_ok() {
            self.metrics.granted(began.elapsed());
        }
        pending.ended_with(&granted, |lease| Some(lease.token));
        self.counted("acquire", granted)
    }

    async fn granted(
        &self,
        caller: &Caller,
        request_id: String,
        request: AcquireRequest,
        wait_ms: u64,
    ) -> Result<Lease, Status> {
        label(&request_id, "request_id")?;
        label(&request.purpose, "holder")?;
        if wait_ms == 0 {
            return Err(status(Code::InvalidArgument, "MALFORMED", "deadline_ms: is 0: it must be at least 1"));
        }
        let ticket = self.next_ticket.fetch_add(1, Ordering::Relaxed);
        let (answer, answered) = oneshot::channel();
        let wait = Duration::from_millis(wait_ms);
        let speaker = speaker(caller);
        self.actor.send(Message::Acquire { speaker, ticket, request_id, request, wait, answer }).await?;
        let mut call = WaitingCall { actor: self.actor.clone(), ticket, answered: Some(answered) };
        let Some(answered) = &mut call.answered else { return Err(ending()) };
        // The pool answers at the deadline, and says what was waited for; a call that joined another of its request id has
        // a deadline of its own, and leaves by being dropped.
        let Ok(granted) = tokio::time::timeout(wait + GRACE, answered).await else {
            return Err(status(Code::DeadlineExceeded, "NOT_GRANTED_IN_TIME", "not granted: the deadline has passed"));
        };
        call.answered = None;
        granted.map_err(|_| ending())?
    }
}

/// An acquire that waits. Dropped before its answer, it leaves the queue, or gives back what it was granted meanwhile.
struct WaitingCall {
    actor: Handle,
    ticket: u64,
    answered: Option<oneshot::Receiver<Granted>>,
}

impl Drop for WaitingCall {
    fn drop(&mut self) {
        let Some(mut answered) = self.answered.take() else { return };
        answered.close();
        match answered.try_recv() {
            Ok(Ok(lease)) => self.actor.send_later(Message::Return { lease: lease.id }),
            Ok(Err(_)) => {}
            Err(_) => self.actor.send_later(Message::Abandon { ticket: self.ticket }),
        }
    }
}

#[tonic::async_trait]
impl v1::resource_service_server::ResourceService for Service {
    type WatchStream = Streamed<v1::ResourceServiceWatchResponse>;
    type WatchDemandStream = Streamed<v1::WatchDemandResponse>;
    type KeepAliveStream = Streamed<v1::KeepAliveResponse>;
    type SessionStream = Answers<SessionCalls, CallerService>;

    async fn create(&self, request: Request<v1::CreateRequest>) -> Result<Response<v1::CreateResponse>, Status> {
        let (caller, request) = (Caller::of(&request), request.into_inner());
        let resource: Resource = required(request.resource, "resource")?;
        if !caller.may_create(resource.class) {
            let message = format!("{caller} may not create resources of the class {}", resource.class);
            return Err(status(Code::PermissionDenied, "ROLE_MISSING", message));
        }
        let spec = ResourceSpec {
            id: Some(resource.id).filter(|id| !id.is_empty()),
            class: resource.class,
            kind: resource.kind,
            attributes: resource.attributes,
            capacity: resource.capacity,
            divisible: resource.divisible,
            renewable: resource.renewable,
            host: resource.host,
        };
        let session = optional_session(&request.session_id)?;
        let (reply, _) = self.perform(&caller, request.request_id, PoolRequest::Create { session, spec }).await?;
        let Reply::Created { id, .. } = reply else { return Err(odd_reply(&reply)) };
        let Some(view) = self.actor.ask(|answer| Message::Get { id: id.clone(), answer }).await? else {
            let message = format!("`{id}` was created by this request and is gone since");
            return Err(status(Code::NotFound, "RESOURCE_UNKNOWN", message));
        };
        Ok(Response::new(v1::CreateResponse { resource: Some(wire::resource(&view).into()) }))
    }

    async fn consume(&self, request: Request<v1::ConsumeRequest>) -> Result<Response<v1::ConsumeResponse>, Status> {
        let (caller, request) = (Caller::of(&request), request.into_inner());
        let requirement: Requirement = required(request.requirement, "requirement")?;
        let session = session(&request.session_id)?;
        let (reply, revision) =
            self.perform(&caller, request.request_id, PoolRequest::Consume { session, requirement }).await?;
        let Reply::Touched(resource_ids) = reply else { return Err(odd_reply(&reply)) };
        Ok(Response::new(v1::ConsumeResponse { resource_ids, revision }))
    }

    async fn delete(&self, request: Request<v1::DeleteRequest>) -> Result<Response<v1::DeleteResponse>, Status> {
        use v1::delete_request::Target;
        let (caller, request) = (Caller::of(&request), request.into_inner());
        let target = request.target.ok_or_else(|| {
            status(Code::InvalidArgument, "MALFORMED", "target: resource_id or requirement is missing")
        })?;
        let (resource_ids, revision) = match target {
            Target::ResourceId(id) => {
                name(&id, "resource_id")?;
                let session = optional_session(&request.session_id)?;
                let delete = PoolRequest::Delete { session, id: id.clone() };
                let (_, revision) = self.perform(&caller, request.request_id, delete).await?;
                (vec![id], revision)
            }
            Target::Requirement(requirement) => {
                let requirement = Requirement::try_from(requirement).map_err(|m| m.within("requirement"))?;
                let delete = PoolRequest::DeleteUnits { session: session(&request.session_id)?, requirement };
                let (reply, revision) = self.perform(&caller, request.request_id, delete).await?;
                let Reply::Touched(ids) = reply else { return Err(odd_reply(&reply)) };
                (ids, revision)
            }
        };
        Ok(Response::new(v1::DeleteResponse { resource_ids, revision }))
    }

    async fn block(&self, request: Request<v1::BlockRequest>) -> Result<Response<v1::BlockResponse>, Status> {
        let (caller, request) = (Caller::of(&request), request.into_inner());
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
        let lease = self.wait_for_grant(&caller, request.request_id, acquire, request.deadline_ms).await?;
        Ok(Response::new(v1::BlockResponse { lease: Some(wire::lease(lease, request.session_id)) }))
    }

    async fn acquire(&self, request: Request<v1::AcquireRequest>) -> Result<Response<v1::AcquireResponse>, Status> {
        let (caller, request) = (Caller::of(&request), request.into_inner());
        let requirements = each(request.requirements, "requirements")?;
        let acquire = AcquireRequest {
            priority: request.priority,
            purpose: request.holder,
            ..AcquireRequest::new(session(&request.session_id)?, requirements)
        };
        let lease = self.wait_for_grant(&caller, request.request_id, acquire, request.deadline_ms).await?;
        Ok(Response::new(v1::AcquireResponse { lease: Some(wire::lease(lease, request.session_id)) }))
    }

    async fn withdraw(&self, request: Request<v1::WithdrawRequest>) -> Result<Response<v1::WithdrawResponse>, Status> {
        let caller = Caller::of(&request);
        let v1::WithdrawRequest { request_id, session_id, call } = request.into_inner();
        name(&request_id, "request_id")?;
        let session = session(&session_id)?;
        if call != 0 {
            let message = "call: is of a session's stream: a withdraw of its own names the request id alone";
            return Err(status(Code::InvalidArgument, "MALFORMED", message));
        }
        let withdraw = || Mutation::Withdraw { session: session_id };
        let pending = audit::begin(&caller, &request_id, withdraw);
        let speaker = speaker(&caller);
        let withdrawn = self
            .actor
            .ask(|answer| Message::Withdraw { speaker, session, request_id, answer })
            .await
            .and_then(|done| done);
        pending.ended(&withdrawn);
        let withdrawn = self.counted("withdraw", withdrawn)?;
        Ok(Response::new(v1::WithdrawResponse { withdrawn }))
    }

    async fn release(
        &self,
        request: Request<v1::ResourceServiceReleaseRequest>,
    ) -> Result<Response<v1::ResourceServiceReleaseResponse>, Status> {
        let (caller, request) = (Caller::of(&request), request.into_inner());
        let session = optional_session(&request.session_id)?;
        let release = PoolRequest::Release { session, lease: LeaseId(request.lease_id) };
        let (released, revision) = match self.perform(&caller, request.request_id, release).await {
            Ok((_, revision)) => (true, revision),
            Err(status) if status.code() == Code::NotFound => {
                (false, self.actor.ask(|answer| Message::Revision { answer }).await?.0)
            }
            Err(status) => return Err(status),
        };
        Ok(Response::new(v1::ResourceServiceReleaseResponse { released, revision }))
    }

    async fn confirm_standstill(
        &self,
        request: Request<v1::ConfirmStandstillRequest>,
    ) -> Result<Response<v1::ConfirmStandstillResponse>, Status> {
        let (caller, request) = (Caller::of(&request), request.into_inner());
        name(&request.resource_id, "resource_id")?;
        let session = optional_session(&request.session_id)?;
        let (lease, resource) = (LeaseId(request.lease_id), request.resource_id);
        let confirm = PoolRequest::ConfirmStandstill { session, lease, resource };
        let (reply, revision) = self.perform(&caller, request.request_id, confirm).await?;
        let Reply::Touched(freed) = reply else { return Err(odd_reply(&reply)) };
        Ok(Response::new(v1::ConfirmStandstillResponse { freed: !freed.is_empty(), revision }))
    }

    async fn exists(&self, request: Request<v1::ExistsRequest>) -> Result<Response<v1::ExistsResponse>, Status> {
        let requirement: Requirement = required(request.into_inner().requirement, "requirement")?;
        let wanted = requirement.count;
        let (units, mut resource_ids) = self.actor.ask(|answer| Message::Find { requirement, answer }).await?;
        resource_ids.truncate(MOST_IDS);
        Ok(Response::new(v1::ExistsResponse { exists: units >= wanted, resource_ids }))
    }

    async fn get(
        &self,
        request: Request<v1::ResourceServiceGetRequest>,
    ) -> Result<Response<v1::ResourceServiceGetResponse>, Status> {
        let id = request.into_inner().resource_id;
        name(&id, "resource_id")?;
        let Some(view) = self.actor.ask(|answer| Message::Get { id: id.clone(), answer }).await? else {
            return Err(status(Code::NotFound, "RESOURCE_UNKNOWN", format!("there is no resource `{id}`")));
        };
        Ok(Response::new(v1::ResourceServiceGetResponse { resource: Some(wire::resource(&view).into()) }))
    }

    async fn explain(&self, request: Request<v1::ExplainRequest>) -> Result<Response<v1::ExplainResponse>, Status> {
        let (caller, request_id) = (Caller::of(&request).name, request.into_inner().request_id);
        label(&request_id, "request_id")?;
        let (waiting, total) = self.actor.ask(|answer| Message::Explain { caller, request_id, answer }).await??;
        let total = u32::try_from(total).unwrap_or(u32::MAX);
        Ok(Response::new(v1::ExplainResponse { waiting: paging::first(all(waiting)), total }))
    }

    async fn list_sessions(
        &self,
        request: Request<v1::ListSessionsRequest>,
    ) -> Result<Response<v1::ListSessionsResponse>, Status> {
        let v1::ListSessionsRequest { page_bytes, page_token } = request.into_inner();
        label(&page_token, "page_token")?;
        let sessions = self.actor.ask(|answer| Message::Sessions { answer }).await?;
        // The token is the id of the last on the page before.
        let behind = sessions.into_iter().filter(|session| session.id > page_token).map(v1::SessionStatus::from);
        let mut filled = Filled::default();
        let more = Page::of(page_bytes, &page_token).fill(behind, &mut filled)?;
        let last = filled.items.last().filter(|_| more).map(|session| session.session_id.clone());
        let next_page_token = last.unwrap_or_default();
        Ok(Response::new(v1::ListSessionsResponse { sessions: filled.items, next_page_token }))
    }

    async fn end_task(&self, request: Request<v1::EndTaskRequest>) -> Result<Response<v1::EndTaskResponse>, Status> {
        let (caller, request) = (Caller::of(&request), request.into_inner());
        let end = PoolRequest::EndTask { session: session(&request.session_id)? };
        let (_, revision) = self.perform(&caller, request.request_id, end).await?;
        Ok(Response::new(v1::EndTaskResponse { revision }))
    }

    async fn watch_demand(
        &self,
        request: Request<v1::WatchDemandRequest>,
    ) -> Result<Response<Self::WatchDemandStream>, Status> {
        let (caller, request) = (Caller::of(&request), request.into_inner());
        let session = session(&request.session_id)?;
        for (index, provision) in request.provisions.iter().enumerate() {
            name(&provision.kind, &format!("provisions[{index}].kind"))?;
        }
        let provisions = Provisions {
            kinds: request.provisions.into_iter().map(|provision| (provision.kind, provision.most)).collect(),
            attributes: ports(request.attributes, "attributes")?,
        };
        let speaker = speaker(&caller);
        let demand = self.actor.ask(|answer| Message::WatchDemand { speaker, session, provisions, answer }).await;
        let mut demand = self.counted("watch_demand", demand.and_then(|watch| watch))?;
        demand.mark_changed();
        let stream = futures::stream::unfold(demand, async |mut demand| {
            demand.changed().await.ok()?;
            let demands = all(demand.borrow_and_update().iter().cloned());
            Some((Ok(v1::WatchDemandResponse { demands }), demand))
        });
        Ok(Response::new(Box::pin(stream.take_until(self.shutdown.clone().cancelled_owned()))))
    }

    async fn report_shortage(
        &self,
        request: Request<v1::ReportShortageRequest>,
    ) -> Result<Response<v1::ReportShortageResponse>, Status> {
        let caller = Caller::of(&request);
        let v1::ReportShortageRequest { session_id, kind, reason, most } = request.into_inner();
        name(&kind, "kind")?;
        label(&reason, "reason")?;
        let session = session(&session_id)?;
        let shortage = || Mutation::ReportShortage {
            session: session_id.clone(),
            kind: kind.clone(),
            most,
            reason: reason.clone(),
        };
        let pending = audit::begin(&caller, "", shortage);
        let speaker = speaker(&caller);
        let report = |answer| Message::ReportShortage { speaker, session, kind, most, reason, answer };
        let reported = self.actor.ask(report).await.and_then(|done| done);
        pending.ended(&reported);
        self.counted("report_shortage", reported)?;
        Ok(Response::new(v1::ReportShortageResponse {}))
    }

    async fn list(&self, request: Request<v1::ListRequest>) -> Result<Response<v1::ListResponse>, Status> {
        let request = request.into_inner();
        label(&request.page_token, "page_token")?;
        let page = Page::of(request.page_bytes, &request.page_token);
        // The token is the id of the last on the page before.
        let mut after = request.page_token.clone();
        let filter = ResourceFilter::try_from(request)?;
        let (mut filled, mut first) = (Filled::default(), None);
        loop {
            let from = after.clone();
            let listed = self.actor.ask(|answer| Message::List { after: from, most: LISTED_AT_ONCE, answer });
            let (views, revision) = listed.await?;
            let revision = *first.get_or_insert(revision);
            let passing = views.iter().filter(|view| wire::passes(view, &filter));
            let more = page.fill(passing.map(|view| wire::resource(view).into()), &mut filled)?;
            let full = filled.items.last().filter(|_| more).map(|last: &v1::Resource| last.id.clone());
            match views.last().filter(|_| views.len() == LISTED_AT_ONCE) {
                Some(last) if !more => after.clone_from(&last.id),
                _ => {
                    let (resources, next_page_token) = (filled.items, full.unwrap_or_default());
                    return Ok(Response::new(v1::ListResponse { resources, revision: revision.0, next_page_token }));
                }
            }
        }
    }

    async fn watch(
        &self,
        request: Request<v1::ResourceServiceWatchRequest>,
    ) -> Result<Response<Self::WatchStream>, Status> {
        let request = request.into_inner();
        names(&request.kinds, "kinds")?;
        names(&request.resource_ids, "resource_ids")?;
        if request.resource_ids.len() > MAX_WATCHED {
            let there = request.resource_ids.len();
            let message = format!("resource_ids: has {there} ids, at most {MAX_WATCHED}: watch without any, or twice");
            return Err(status(Code::InvalidArgument, "MALFORMED", message));
        }
        let (part, in_parts) = (request.after_part, request.in_parts);
        let after = request.after_revision.map(|revision| WatchPosition { revision: Revision(revision), part });
        let filter = Arc::new(WatchFilter {
            kinds: request.kinds.into_iter().collect(),
            resources: request.resource_ids.into_iter().collect(),
        });
        let watch = |answer| Message::Watch { after, filter: filter.clone(), answer };
        let updates = self.counted("watch", self.actor.ask(watch).await.and_then(|watch| watch))?;
        let updates = tokio_stream::wrappers::ReceiverStream::new(updates)
            .flat_map(move |told| futures::stream::iter(told.updates(&filter, after)))
            .flat_map(move |update| futures::stream::iter(messages(update.into(), in_parts)))
            // After a snapshot that does not fit nothing follows.
            .scan(false, |over, message| {
                let before = std::mem::replace(over, message.is_err());
                futures::future::ready((!before).then_some(message))
            });
        let shutdown = self.shutdown.clone();
        let last = futures::stream::once(async move {
            if shutdown.is_cancelled() {
                return Err(ending());
            }
            let message = "the watch has ended, for it was too slow: watch again";
            Err(retry_later(Code::Unavailable, "WATCH_AGAIN", message, WATCH_AGAIN_AFTER))
        });
        let stream = updates.take_until(self.shutdown.clone().cancelled_owned()).chain(last);
        Ok(Response::new(Box::pin(stream)))
    }

    async fn keep_alive(
        &self,
        request: Request<Streaming<v1::KeepAliveRequest>>,
    ) -> Result<Response<Self::KeepAliveStream>, Status> {
        let (caller, quotas) = (Caller::of(&request), request.extensions().get::<Quotas>().cloned());
        let mut pings = request.into_inner();
        let (sender, answers) = mpsc::channel(KEEP_ALIVE_BUFFER);
        let (service, shutdown) = (self.clone(), self.shutdown.clone());
        tokio::spawn(async move {
            loop {
                let ping = tokio::select! {
                    ping = pings.message() => ping,
                    () = shutdown.cancelled() => return,
                };
                let Ok(Some(ping)) = ping else { return };
                let permit = quotas.as_ref().map(|quotas| quotas.admit(&caller, PING, Instant::now())).transpose();
                let answer = match permit {
                    Ok(_permit) => service.kept_alive(&caller, ping).await,
                    Err(refused) => Err(refused),
                };
                let failed = answer.is_err();
                if sender.send(answer).await.is_err() || failed {
                    return;
                }
            }
        });
        Ok(Response::new(Box::pin(tokio_stream::wrappers::ReceiverStream::new(answers))))
    }

    async fn session(
        &self,
        request: Request<Streaming<v1::SessionRequest>>,
    ) -> Result<Response<Self::SessionStream>, Status> {
        let quotas = request.extensions().get::<Quotas>().cloned();
        let calls = CallerService::new(self.clone(), Caller::of(&request), quotas);
        Ok(Response::new(Answers::new(calls, request.into_inner(), Some(self.shutdown.clone()))))
    }
}

/// A snapshot in messages that are not too large; anything else as it is.
fn messages(
    message: v1::ResourceServiceWatchResponse,
    in_parts: bool,
) -> Vec<Result<v1::ResourceServiceWatchResponse, Status>> {
    use v1::resource_service_watch_response::Kind;
    let Some(Kind::Snapshot(mut snapshot)) = message.kind else { return vec![Ok(message)] };
    let mut parts = paging::parts(std::mem::take(&mut snapshot.resources));
    if parts.len() > 1 && !in_parts {
        // What is no more than a message is sent as one.
        let mut filled = Filled::default();
        if let Err(too_large) = Page::of(0, "").fill(parts.into_iter().flatten(), &mut filled) {
            return vec![Err(too_large)];
        }
        parts = vec![filled.items];
    }
    let last = parts.len() - 1;
    let part = |(index, resources)| {
        let snapshot = v1::ResourceSnapshot { resources, more: index < last, ..snapshot.clone() };
        Ok(v1::ResourceServiceWatchResponse { kind: Some(Kind::Snapshot(snapshot)) })
    };
    parts.into_iter().enumerate().map(part).collect()
}

fn session(id: &str) -> Result<SessionId, Status> {
    name(id, "session_id")?;
    Ok(SessionId::from(id))
}

/// Without a session a call speaks for the operator.
fn optional_session(id: &str) -> Result<Option<SessionId>, Status> {
    (!id.is_empty()).then(|| session(id)).transpose()
}

/// What the audit log says of a request.
fn mutation_of(request: &PoolRequest) -> Mutation {
    let session = request.session().map(|session| session.as_str().to_owned()).unwrap_or_default();
    match request {
        PoolRequest::Create { spec, .. } => Mutation::Create {
            session,
            resource: spec.id.clone().unwrap_or_default(),
            kind: spec.kind.clone(),
            class: spec.class.to_string(),
        },
        PoolRequest::Consume { requirement, .. } => Mutation::Consume { session, requirement: requirement.to_string() },
        PoolRequest::Delete { id, .. } => Mutation::Delete { session, target: id.clone() },
        PoolRequest::DeleteUnits { requirement, .. } => Mutation::Delete { session, target: requirement.to_string() },
        PoolRequest::Release { lease, .. } => Mutation::Release { session, lease: lease.0 },
        PoolRequest::ConfirmStandstill { lease, resource, .. } => {
            Mutation::ConfirmStandstill { session, lease: lease.0, resource: resource.clone() }
        }
        PoolRequest::EndTask { .. } => Mutation::EndTask { session },
        PoolRequest::Acquire(acquire) => mutation_of_acquire(acquire),
    }
}

fn mutation_of_acquire(acquire: &AcquireRequest) -> Mutation {
    Mutation::Acquire {
        session: acquire.session.as_str().to_owned(),
        requirements: acquire.requirements.iter().map(|requirement| audit::cut(&requirement.to_string())).collect(),
        holder: acquire.purpose.clone(),
        priority: acquire.priority,
    }
}

fn odd_reply(reply: &Reply) -> Status {
    status(Code::Internal, "BROKEN", format!("the pool answered with {reply:?}"))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::super::{ResourceManagerConfig, actor, journal};
    use super::*;
    use crate::durable_actor::Journal;
    use crate::durable_actor::slow_disk::SlowDisk;
    use ratn_model::resource::ResourceClass;
    use ratn_resources::Speaker;
    use tokio::sync::watch;

    fn metrics() -> Arc<Metrics> {
        Arc::new(Metrics::new(super::super::ROLE))
    }

    #[tokio::test]
    async fn a_lease_that_two_calls_of_one_request_got_goes_back_when_both_are_dropped() {
        let (config, directory) = (ResourceManagerConfig::default(), tempfile::tempdir().unwrap());
        let log = Journal::log(&config.storage, directory.path());
        let kept = journal::open(&config.storage, Arc::new(log), config.limits.clone()).unwrap();
        let (actor, _) = actor::start(
            watch::Sender::new(config).subscribe(),
            kept,
            Default::default(),
            Default::default(),
            metrics(),
            Default::default(),
        )
        .unwrap();
        let session = SessionId::from("s");
        actor.keep_alive(Speaker::trusted(), session.clone(), "s".to_owned(), Duration::from_secs(60)).await.unwrap();
        let requirement = Requirement::new(ResourceOperation::Block, "Arm");
        let mut calls = Vec::new();
        for ticket in [1, 2] {
            let (answer, answered) = oneshot::channel();
            let request = AcquireRequest::new(session.clone(), vec![requirement.clone()]);
            let (request_id, wait) = ("run/i1".to_owned(), Duration::from_secs(60));
            let speaker = Speaker::trusted();
            actor.send(Message::Acquire { speaker, ticket, request_id, request, wait, answer }).await.unwrap();
            calls.push(WaitingCall { actor: actor.clone(), ticket, answered: Some(answered) });
        }
        let create = PoolRequest::Create { session: None, spec: ResourceSpec::new(ResourceClass::Module, "Arm") };
        let request_id = String::new();
        let speaker = Speaker::trusted();
        actor.ask(|answer| Message::Perform { speaker, request_id, request: create, answer }).await.unwrap().unwrap();
        for free in [0, 0, 1] {
            let list = |answer| Message::List { after: String::new(), most: 1, answer };
            let (views, _) = actor.ask(list).await.unwrap();
            assert_eq!(views[0].free, free);
            calls.pop();
        }
    }

    /// An actor with one arm that is free, and a session.
    async fn with_an_arm() -> (Handle, SessionId, tempfile::TempDir) {
        let (config, directory) = (ResourceManagerConfig::default(), tempfile::tempdir().unwrap());
        let log = Journal::log(&config.storage, directory.path());
        let kept = journal::open(&config.storage, Arc::new(log), config.limits.clone()).unwrap();
        let signals = watch::Sender::new(config).subscribe();
        let (actor, _) =
            actor::start(signals, kept, Default::default(), Default::default(), metrics(), Default::default()).unwrap();
        let session = SessionId::from("s");
        actor.keep_alive(Speaker::trusted(), session.clone(), "s".to_owned(), Duration::from_secs(60)).await.unwrap();
        let create = PoolRequest::Create { session: None, spec: ResourceSpec::new(ResourceClass::Module, "Arm") };
        let request_id = String::new();
        actor
            .ask(|answer| Message::Perform { speaker: Speaker::trusted(), request_id, request: create, answer })
            .await
            .unwrap()
            .unwrap();
        (actor, session, directory)
    }

    /// Always the same request. One that does not wait is dropped before it is answered.
    async fn call(actor: &Handle, session: &SessionId, ticket: u64, waits: bool) -> WaitingCall {
        let (answer, answered) = oneshot::channel();
        let answered = waits.then_some(answered);
        let requirement = Requirement::new(ResourceOperation::Block, "Arm");
        let request = AcquireRequest::new(session.clone(), vec![requirement]);
        let (request_id, wait) = ("run/i1".to_owned(), Duration::from_secs(60));
        actor
            .send(Message::Acquire { speaker: Speaker::trusted(), ticket, request_id, request, wait, answer })
            .await
            .unwrap();
        WaitingCall { actor: actor.clone(), ticket, answered }
    }

    async fn is_free(actor: &Handle) -> bool {
        let id = "Arm-1".to_owned();
        actor.ask(|answer| Message::Get { id, answer }).await.unwrap().unwrap().free == 1
    }

    #[tokio::test]
    async fn a_lease_that_a_repeated_request_was_told_stays_when_the_first_call_of_it_is_dropped() {
        let (actor, session, _directory) = with_an_arm().await;
        let first = call(&actor, &session, 1, true).await;
        let mut second = call(&actor, &session, 2, true).await;
        let third = call(&actor, &session, 3, true).await;
        // Read by its client, as the service does it.
        second.answered.take().unwrap().await.unwrap().unwrap();
        for unread in [first, third] {
            drop(unread);
            assert!(!is_free(&actor).await, "the client of the second call holds it");
        }
        call(&actor, &session, 4, false).await;
        assert!(!is_free(&actor).await, "the client of the second call holds it");
    }

    #[tokio::test]
    async fn a_lease_goes_back_when_the_first_call_and_those_that_repeated_it_are_all_dropped() {
        let (actor, session, _directory) = with_an_arm().await;
        let mut calls = Vec::new();
        for (ticket, waits) in [(1, true), (2, true), (3, false)] {
            calls.push(call(&actor, &session, ticket, waits).await);
            assert!(!is_free(&actor).await);
        }
        calls.pop();
        calls.pop();
        assert!(!is_free(&actor).await);
        calls.pop();
        assert!(is_free(&actor).await);
    }

    #[tokio::test]
    async fn a_ping_that_changes_nothing_is_answered_while_the_disk_hangs() {
        let (config, directory) = (ResourceManagerConfig::default(), tempfile::tempdir().unwrap());
        let disk = SlowDisk::default();
        let log = Journal::log(&config.storage, directory.path()).on(disk.files());
        let kept = journal::open(&config.storage, Arc::new(log), config.limits.clone()).unwrap();
        let signals = watch::Sender::new(config).subscribe();
        let (actor, _) =
            actor::start(signals, kept, Default::default(), Default::default(), metrics(), Default::default()).unwrap();
        let speaker = || Speaker::trusted();
        let ping = async |session: &str, ttl_s| {
            let ttl = Duration::from_secs(ttl_s);
            actor.keep_alive(speaker(), SessionId::from(session), "a".to_owned(), ttl).await.unwrap()
        };
        assert!(ping("a", 60).await.created && ping("c", 60).await.created);
        let hangs = disk.hang();
        let answered = ping("a", 60).await;
        assert!(!answered.created, "at once, however long the disk takes");
        let mut opened = Box::pin(ping("b", 60));
        let mut changed = Box::pin(ping("a", 30));
        for waits in [&mut opened, &mut changed] {
            assert!(futures::poll!(&mut *waits).is_pending());
        }
        // Behind the two: it waits for the disk as they do, for the session is not on it as it is now.
        let mut behind = Box::pin(ping("a", 30));
        assert!(futures::poll!(&mut behind).is_pending());
        assert!(!ping("c", 60).await.created, "the actor has taken all of them by now");
        for waits in [&mut opened, &mut changed, &mut behind] {
            assert!(futures::poll!(&mut *waits).is_pending());
        }
        drop(hangs);
        assert!(opened.await.created);
        assert!(!changed.await.created && !behind.await.created);
    }
}
