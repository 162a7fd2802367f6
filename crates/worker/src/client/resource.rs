//! The client of the resource manager. The frequent calls of a task (acquire, block, release) share one stream per session.

use super::unheard::{Ended, Unheard};
use super::{CallError, Channels, fresh_id, snapshot};
use crate::endpoint::Endpoint;
use crate::multiplex::SessionCalls;
use crate::multiplex::client::Multiplexer;
use crate::trace::Traced;
use ratn_model::id::LeaseId;
use ratn_model::resource::{Lease, OperatedUnits, Requirement};
use ratn_model::value::Value;
use ratn_proto::convert::{Malformed, all, each, required, wire_ports};
use ratn_proto::types::{
    Demand, Provision, Recalled, Resource, ResourceFilter, ResourceUpdate, SessionStatus, WaitingAcquire, WatchPosition,
};
use ratn_proto::v1;
use ratn_proto::v1::resource_service_client::ResourceServiceClient;
use ratn_proto::v1::session_request::Kind as Asked;
use ratn_proto::v1::session_response::Kind as Answered;
use ratn_proto::{MAX_MESSAGE_BYTES, PAGE_BYTES};
use std::collections::BTreeMap;
use std::time::Duration;
use tonic::Streaming;

/// Maximum number of requests in one recall call.
const RECALLED_AT_ONCE: usize = 1_000;

/// A client of one resource manager, in the name of one session. Every mutation gets a fresh request id.
#[derive(Debug, Clone)]
pub struct ResourceClient {
    endpoint: Endpoint,
    session: String,
    client: ResourceServiceClient<Traced>,
    calls: Multiplexer<SessionCalls>,
    unheard: Unheard,
}

/// How an acquire waits in the queue.
#[derive(Debug, Clone, PartialEq)]
pub struct AcquireOptions {
    /// The request id, which makes the request idempotent, for example `run/instance/attempt`. If empty, a fresh one is used.
    pub request: String,
    /// Among requests made within the same ten seconds, larger priorities are served first; equal priorities in order of arrival.
    pub priority: i64,
    /// The resources may turn out not to be needed: requests that are certainly needed come first.
    pub speculative: bool,
    /// The request id of an earlier acquire of the same session for the same resources, whose place in the queue this one takes; empty for
    /// none.
    pub instead_of: String,
    /// Maximum time to wait.
    pub deadline: Duration,
    /// A name of the holder for people: `sort_boxes: place[2]/plan`.
    pub holder: String,
}

impl Default for AcquireOptions {
    fn default() -> AcquireOptions {
        AcquireOptions {
            request: String::new(),
            priority: 0,
            speculative: false,
            instead_of: String::new(),
            deadline: Duration::from_secs(600),
            holder: String::new(),
        }
    }
}

/// A running watch of demand: the resources that are missing.
#[derive(Debug)]
pub struct DemandWatch {
    endpoint: Endpoint,
    stream: Streaming<v1::WatchDemandResponse>,
}

/// A watch of the resources: first a snapshot, then every change.
#[derive(Debug)]
pub struct ResourceWatch {
    endpoint: Endpoint,
    stream: Streaming<v1::ResourceServiceWatchResponse>,
}

impl ResourceClient {
    /// The client of the resource manager at `endpoint`. `session` is the id of a [`crate::session::Session`]; it may be empty for a client
    /// that only lists and watches.
    ///
    /// # Errors
    /// As [`Channels::get`].
    pub fn new(channels: &Channels, endpoint: &Endpoint, session: &str) -> Result<ResourceClient, CallError> {
        let client = ResourceServiceClient::new(channels.get(endpoint)?)
            .max_decoding_message_size(MAX_MESSAGE_BYTES)
            .max_encoding_message_size(MAX_MESSAGE_BYTES);
        let (endpoint, session) = (endpoint.clone(), session.to_owned());
        Ok(ResourceClient { endpoint, session, client, calls: Multiplexer::default(), unheard: Unheard::default() })
    }

    /// The resource manager's endpoint.
    pub fn endpoint(&self) -> &Endpoint {
        &self.endpoint
    }

    /// Adds a resource, or updates one that this session added. Returns the resource as the manager has it now.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn create(&self, resource: Resource) -> Result<Resource, CallError> {
        self.create_once("", resource).await
    }

    /// As [`ResourceClient::create`], idempotent by this request id.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn create_once(&self, request: &str, resource: Resource) -> Result<Resource, CallError> {
        let (request_id, session_id) = self.mutation(request);
        let question = v1::CreateRequest { request_id, session_id, resource: Some(resource.into()) };
        let answer = self.client.clone().create(question).await.map_err(|status| self.failed(&status))?;
        self.field(answer.into_inner().resource, "resource")
    }

    /// Consumes capacity. Returns the ids of the resources from which it was taken.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn consume(&self, requirement: Requirement) -> Result<Vec<String>, CallError> {
        self.consume_once("", requirement).await
    }

    /// As [`ResourceClient::consume`], idempotent by this request id.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn consume_once(&self, request: &str, requirement: Requirement) -> Result<Vec<String>, CallError> {
        Ok(self.consume_target(request, requirement, "").await?.resource_ids)
    }

    /// As [`ResourceClient::consume_once`], from only one resource if one is named. Returns the amount for each resource, if the manager reports it.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn consume_units_once(
        &self,
        request: &str,
        requirement: Requirement,
        resource: &str,
    ) -> Result<Option<Vec<OperatedUnits>>, CallError> {
        let answer = self.consume_target(request, requirement, resource).await?;
        self.units(&answer.resource_ids, answer.consumed)
    }

    async fn consume_target(
        &self,
        request: &str,
        requirement: Requirement,
        resource: &str,
    ) -> Result<v1::ConsumeResponse, CallError> {
        let (request_id, session_id) = self.mutation(request);
        let (requirement, resource_id) = (Some(requirement.into()), resource.to_owned());
        let question = v1::ConsumeRequest { request_id, session_id, requirement, resource_id };
        let answer = self.client.clone().consume(question).await.map_err(|status| self.failed(&status))?;
        Ok(answer.into_inner())
    }

    /// The reported units, if they are reported for every resource.
    fn units(&self, ids: &[String], units: Vec<v1::OperatedUnits>) -> Result<Option<Vec<OperatedUnits>>, CallError> {
        let is_said = units.len() == ids.len();
        let units = each(units, "units").map_err(|m| self.malformed(m))?;
        Ok(is_said.then_some(units))
    }

    /// The results of earlier requests, in the order of these ids; `None` if a result is not known.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn recall(&self, requests: &[String]) -> Result<Vec<Option<Recalled>>, CallError> {
        let mut recalled = Vec::with_capacity(requests.len());
        // A long answer is only about the first requests.
        while let Some(rest) = requests.get(recalled.len()..).filter(|rest| !rest.is_empty()) {
            let some = &rest[..rest.len().min(RECALLED_AT_ONCE)];
            let question = v1::RecallRequest { session_id: self.session.clone(), request_ids: some.to_vec() };
            let answer = self.client.clone().recall(question).await.map_err(|status| self.failed(&status))?;
            let answer: Vec<Option<Recalled>> =
                each(answer.into_inner().requests, "requests").map_err(|m| self.malformed(m))?;
            if answer.is_empty() || answer.len() > some.len() {
                return Err(self.malformed(Malformed::new("requests", "are none, or more than were asked for")));
            }
            recalled.extend(answer);
        }
        Ok(recalled)
    }

    /// Removes one resource by its id.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn delete(&self, resource: &str) -> Result<(), CallError> {
        self.delete_target("", v1::delete_request::Target::ResourceId(resource.to_owned())).await.map(|_| ())
    }

    /// Removes as many resources as the requirement demands. Returns their ids.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn delete_matching(&self, requirement: Requirement) -> Result<Vec<String>, CallError> {
        self.delete_matching_once("", requirement).await
    }

    /// As [`ResourceClient::delete_matching`], idempotent by this request id.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn delete_matching_once(
        &self,
        request: &str,
        requirement: Requirement,
    ) -> Result<Vec<String>, CallError> {
        let target = v1::delete_request::Target::Requirement(requirement.into());
        Ok(self.delete_target(request, target).await?.resource_ids)
    }

    /// The same; returns the amount for each resource, if the manager reports it.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn delete_units_once(
        &self,
        request: &str,
        requirement: Requirement,
    ) -> Result<Option<Vec<OperatedUnits>>, CallError> {
        let target = v1::delete_request::Target::Requirement(requirement.into());
        let answer = self.delete_target(request, target).await?;
        self.units(&answer.resource_ids, answer.deleted)
    }

    async fn delete_target(
        &self,
        request: &str,
        target: v1::delete_request::Target,
    ) -> Result<v1::DeleteResponse, CallError> {
        let (request_id, session_id) = self.mutation(request);
        let question = v1::DeleteRequest { request_id, session_id, target: Some(target) };
        let answer = self.client.clone().delete(question).await.map_err(|status| self.failed(&status))?;
        Ok(answer.into_inner())
    }

    /// Waits for resources of one kind and blocks them.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn block(&self, requirement: Requirement, options: AcquireOptions) -> Result<Lease, CallError> {
        let (request_id, session_id) = self.mutation(&options.request);
        let question = v1::BlockRequest {
            request_id,
            session_id,
            requirement: Some(requirement.into()),
            priority: options.priority,
            deadline_ms: milliseconds(options.deadline),
            holder: options.holder,
        };
        match self.ask_for_lease(&question.request_id.clone(), Asked::Block(question)).await? {
            Answered::Block(granted) => self.field(granted.lease, "lease"),
            _ => Err(self.another("a block")),
        }
    }

    /// Waits until all requirements can be met at once, and takes the resources under one lease. Dropping the future leaves the queue; a
    /// lease that is granted at that moment is given back, unless another call of the same request id waits for it or has got it.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn acquire(&self, requirements: Vec<Requirement>, options: AcquireOptions) -> Result<Lease, CallError> {
        Ok(self.acquire_with_notes(requirements, options).await?.0)
    }

    /// As [`ResourceClient::acquire`], with the notes that the last holders left when they released the resources.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn acquire_with_notes(
        &self,
        requirements: Vec<Requirement>,
        options: AcquireOptions,
    ) -> Result<(Lease, Vec<v1::HolderNote>), CallError> {
        let (request_id, session_id) = self.mutation(&options.request);
        let question = v1::AcquireRequest {
            request_id,
            session_id,
            requirements: all(requirements),
            priority: options.priority,
            deadline_ms: milliseconds(options.deadline),
            holder: options.holder,
            speculative: options.speculative,
            instead_of: options.instead_of,
        };
        match self.ask_for_lease(&question.request_id.clone(), Asked::Acquire(question)).await? {
            Answered::Acquire(granted) => Ok((self.field(granted.lease, "lease")?, granted.notes)),
            _ => Err(self.another("an acquire")),
        }
    }

    /// Withdraws an acquire or a block by its request id, for every call that made it: the request leaves the queue, or its lease is given
    /// back. Then the same request id may be used for another acquire. False if there was nothing to withdraw.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn withdraw(&self, request: &str) -> Result<bool, CallError> {
        let (request_id, session_id) = (request.to_owned(), self.session.clone());
        let question = v1::WithdrawRequest { request_id, session_id, ..Default::default() };
        match self.ask(Asked::Withdraw(question)).await? {
            Answered::Withdraw(undone) => {
                self.unheard.withdrawn(request);
                Ok(undone.withdrawn)
            }
            _ => Err(self.another("a withdraw")),
        }
    }

    /// Releases a lease. False if it had ended before.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn release(&self, lease: LeaseId) -> Result<bool, CallError> {
        self.release_with_note(lease, String::new(), true).await
    }

    /// As [`ResourceClient::release`], with a note of at most 256 bytes for the next holder of the resources. `at_rest` says that the holder
    /// knows that nothing moves any more for the lease; if not, it ends as a revoked one does: what moves is granted again when its provider has
    /// confirmed standstill, or its bound has passed.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn release_with_note(&self, lease: LeaseId, note: String, at_rest: bool) -> Result<bool, CallError> {
        let (request_id, session_id) = self.mutation("");
        let question = v1::ResourceServiceReleaseRequest { request_id, session_id, lease_id: lease.0, note, at_rest };
        match self.ask(Asked::Release(question)).await? {
            Answered::Release(ended) => Ok(ended.released),
            _ => Err(self.another("a release")),
        }
    }

    /// Confirms, as the provider of a resource, that nothing moves any more for a lease that has ended. False if no confirmation was
    /// pending for that lease.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn confirm_standstill(&self, lease: LeaseId, resource: &str) -> Result<bool, CallError> {
        let question = v1::ConfirmStandstillRequest {
            // A repeated confirmation changes nothing.
            request_id: String::new(),
            session_id: self.session.clone(),
            lease_id: lease.0,
            resource_id: resource.to_owned(),
        };
        let answer = self.client.clone().confirm_standstill(question).await.map_err(|status| self.failed(&status))?;
        Ok(answer.into_inner().freed)
    }

    /// Whether resources that meet the requirement exist, blocked or not.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn exists(&self, requirement: Requirement) -> Result<bool, CallError> {
        let question = v1::ExistsRequest { requirement: Some(requirement.into()) };
        let answer = self.client.clone().exists(question).await.map_err(|status| self.failed(&status))?;
        Ok(answer.into_inner().exists)
    }

    /// The resources of these kinds (without kinds: of every kind), sorted by id.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn list(&self, kinds: &[&str]) -> Result<Vec<Resource>, CallError> {
        self.list_where(ResourceFilter { kinds: owned(kinds), ..ResourceFilter::default() }).await
    }

    /// The resources that pass a filter, sorted by id.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn list_where(&self, filter: ResourceFilter) -> Result<Vec<Resource>, CallError> {
        let mut question = v1::ListRequest { page_bytes: PAGE_BYTES, ..filter.into() };
        let mut resources = Vec::new();
        loop {
            let answer = self.client.clone().list(question.clone()).await.map_err(|status| self.failed(&status))?;
            let answer = answer.into_inner();
            resources.extend(answer.resources);
            if answer.next_page_token.is_empty() {
                return each(resources, "resources").map_err(|m| self.malformed(m));
            }
            question.page_token = answer.next_page_token;
        }
    }

    /// One resource.
    ///
    /// # Errors
    /// [`CallError`], also if it does not exist.
    pub async fn get(&self, resource: &str) -> Result<Resource, CallError> {
        let question = v1::ResourceServiceGetRequest { resource_id: resource.to_owned() };
        let answer = self.client.clone().get(question).await.map_err(|status| self.failed(&status))?;
        self.field(answer.into_inner().resource, "resource")
    }

    /// Why the acquire of a request id waits. With an empty id: why the first hundred acquires of the queue wait.
    ///
    /// # Errors
    /// [`CallError`], also if the given request does not wait.
    pub async fn explain(&self, request: &str) -> Result<Vec<WaitingAcquire>, CallError> {
        let question = v1::ExplainRequest { request_id: request.to_owned() };
        let answer = self.client.clone().explain(question).await.map_err(|status| self.failed(&status))?;
        each(answer.into_inner().waiting, "waiting").map_err(|m| self.malformed(m))
    }

    /// Every session, sorted by id.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn sessions(&self) -> Result<Vec<SessionStatus>, CallError> {
        let mut question = v1::ListSessionsRequest { page_bytes: PAGE_BYTES, ..Default::default() };
        let mut sessions = Vec::new();
        loop {
            let answer = self.client.clone().list_sessions(question.clone()).await;
            let answer = answer.map_err(|status| self.failed(&status))?.into_inner();
            sessions.extend(answer.sessions);
            if answer.next_page_token.is_empty() {
                return each(sessions, "sessions").map_err(|m| self.malformed(m));
            }
            question.page_token = answer.next_page_token;
        }
    }

    /// Ends the session's task: renewable capacity that it consumed is returned.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn end_task(&self) -> Result<(), CallError> {
        let (request_id, session_id) = self.mutation("");
        let question = v1::EndTaskRequest { request_id, session_id };
        self.client.clone().end_task(question).await.map(drop).map_err(|status| self.failed(&status))
    }

    /// Watches the resources of these kinds (without kinds: of every kind): a snapshot, then every change.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn watch(&self, kinds: &[&str]) -> Result<ResourceWatch, CallError> {
        self.watch_from(kinds, None).await
    }

    /// Watches every change after a revision or an event ([`ratn_proto::types::ResourceEvent::position`]), without a snapshot; if no
    /// position is given, with one.
    ///
    /// # Errors
    /// [`CallError`], also if not all changes after the position are kept any more.
    pub async fn watch_from(&self, kinds: &[&str], after: Option<WatchPosition>) -> Result<ResourceWatch, CallError> {
        let after_revision = after.map(|after| after.revision.0);
        let after_part = after.and_then(|after| after.part);
        let kinds = owned(kinds);
        let question = v1::ResourceServiceWatchRequest { kinds, after_revision, after_part, ..Default::default() };
        self.watched(question).await
    }

    /// Watches the resources of these ids; at least one id must be given.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn watch_resources(&self, ids: impl IntoIterator<Item = String>) -> Result<ResourceWatch, CallError> {
        let resource_ids = ids.into_iter().collect();
        self.watched(v1::ResourceServiceWatchRequest { resource_ids, ..Default::default() }).await
    }

    async fn watched(&self, question: v1::ResourceServiceWatchRequest) -> Result<ResourceWatch, CallError> {
        let question = v1::ResourceServiceWatchRequest { in_parts: true, ..question };
        let answer = self.client.clone().watch(question).await.map_err(|status| self.failed(&status))?;
        Ok(ResourceWatch { endpoint: self.endpoint.clone(), stream: answer.into_inner() })
    }

    /// Watches the demand, for a provider of these kinds whose resources of a kind all have these attributes: the resources that are
    /// missing, first now, then after every change.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn watch_demand(
        &self,
        kinds: &BTreeMap<String, Provision>,
        attributes: &BTreeMap<String, Value>,
    ) -> Result<DemandWatch, CallError> {
        let provision = |(kind, provision): (&String, &Provision)| v1::Provision {
            kind: kind.clone(),
            most: provision.most,
            grows: provision.grows,
        };
        let provisions = kinds.iter().map(provision).collect();
        let question = v1::WatchDemandRequest {
            session_id: self.session.clone(),
            provisions,
            attributes: wire_ports(attributes.clone()),
        };
        let answer = self.client.clone().watch_demand(question).await.map_err(|status| self.failed(&status))?;
        Ok(DemandWatch { endpoint: self.endpoint.clone(), stream: answer.into_inner() })
    }

    /// Reports, to everybody who waits for a kind, why there are at most `most` of it for now; an empty reason takes the report back. The
    /// manager asks this provider for no more than that.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn report_shortage(&self, kind: &str, most: u32, reason: &str) -> Result<(), CallError> {
        let (session_id, kind, reason) = (self.session.clone(), kind.to_owned(), reason.to_owned());
        let question = v1::ReportShortageRequest { session_id, kind, reason, most };
        self.client.clone().report_shortage(question).await.map(drop).map_err(|status| self.failed(&status))
    }

    /// Asks over the session's stream.
    async fn ask(&self, question: Asked) -> Result<Answered, CallError> {
        let mut client = self.client.clone();
        let open = |questions| async move { client.session(questions).await };
        self.calls.call(open, question).await.map_err(|status| self.failed(&status))
    }

    /// As `ask`, for a question that is answered with a lease. If the future is dropped after the answer to an earlier question of the same
    /// request was lost, the lease of that answer is given back.
    async fn ask_for_lease(&self, request: &str, question: Asked) -> Result<Answered, CallError> {
        let mut client = self.client.clone();
        let open = |questions| async move { client.session(questions).await };
        let asking = self.unheard.ask(request);
        let when_dropped = |told: &mut Asked| {
            if let Asked::Withdraw(withdraw) = told {
                withdraw.unheard = asking.dropped();
            }
        };
        let answer = self.calls.call_dropped_with(open, question, when_dropped).await;
        let answer = answer.map_err(|status| self.failed(&status));
        asking.ended(match &answer {
            Ok(_) => Ended::Granted,
            Err(error) if error.is_crash() => Ended::Lost,
            Err(_) => Ended::Refused,
        });
        answer
    }

    /// The error for an answer that belongs to another kind of call.
    fn another(&self, asked: &str) -> CallError {
        self.malformed(Malformed::new("kind", format!("is not that of an answer to {asked}")))
    }

    /// The request id (a fresh one if empty) and the session's id.
    fn mutation(&self, request: &str) -> (String, String) {
        let id = if request.is_empty() { fresh_id("request") } else { request.to_owned() };
        (id, self.session.clone())
    }

    fn field<W, T: TryFrom<W, Error = Malformed>>(&self, message: Option<W>, field: &str) -> Result<T, CallError> {
        required(message, field).map_err(|m| self.malformed(m))
    }

    fn malformed(&self, malformed: Malformed) -> CallError {
        CallError::malformed(&self.endpoint, malformed)
    }

    fn failed(&self, status: &tonic::Status) -> CallError {
        CallError::from_status(&self.endpoint, status)
    }
}

impl DemandWatch {
    /// The present demand; `None` when the manager ends the watch.
    ///
    /// # Errors
    /// [`CallError`] if the watch broke.
    pub async fn next(&mut self) -> Result<Option<Vec<Demand>>, CallError> {
        let message = self.stream.message().await.map_err(|s| CallError::from_status(&self.endpoint, &s))?;
        let demands = message.map(|message| each(message.demands, "demands")).transpose();
        demands.map_err(|m| CallError::malformed(&self.endpoint, m))
    }
}

impl ResourceWatch {
    /// The snapshot, then every change; `None` when the manager ends the watch.
    ///
    /// # Errors
    /// [`CallError`] if the watch broke.
    pub async fn next(&mut self) -> Result<Option<ResourceUpdate>, CallError> {
        let message = snapshot::next(&self.endpoint, &mut self.stream).await?;
        let update = message.map(ResourceUpdate::try_from).transpose();
        update.map_err(|m| CallError::malformed(&self.endpoint, m))
    }
}

fn owned(kinds: &[&str]) -> Vec<String> {
    kinds.iter().map(|&kind| kind.to_owned()).collect()
}

fn milliseconds(duration: Duration) -> u64 {
    u64::try_from(duration.as_millis()).unwrap_or(u64::MAX).max(1)
}
