//! The gRPC service in front of the actor.

use super::actor::{Handle, Message, NewProjection, Update, WATCH_AGAIN_AFTER};
use super::history::{Commit, Kept};
use super::leases::{Known, LiveLeases};
use super::query::{Found, View};
use super::stream::CallerService;
use crate::access::Caller;
use crate::audit::{self, Mutation};
use crate::details::{retry_later, status};
use crate::metrics::Metrics;
use crate::paging::{self, Filled, Page};
use crate::stream_calls::StreamCaller;
use crate::watch_stream;
use futures::StreamExt;
use futures::stream::BoxStream;
use prost::Message as _;
use ratn_model::fact::{FactKey, FactPattern};
use ratn_model::id::{LeaseId, ProjectionId, Revision};
use ratn_proto::MAX_PAGE_BYTES;
use ratn_proto::convert::{Malformed, all, digest, each, few, label, name, required};
use ratn_proto::types::{FactDifference, FactRecord, FactVersion, WorldChange, WorldUpdate};
use ratn_proto::v1;
use ratn_worker::multiplex::WorldCalls;
use ratn_worker::multiplex::server::Answers;
use ratn_world::digest::Digest;
use ratn_world::world::Fact;
use std::collections::BTreeSet;
use std::sync::{Arc, Weak};
use std::time::Duration;
use tokio::sync::{Semaphore, watch};
use tokio_util::sync::CancellationToken;
use tonic::{Code, Request, Response, Status, Streaming};

/// A grant may reach the client before the watch reports the lease: a projection waits up to this long for it.
const LEASE_PATIENCE: Duration = Duration::from_secs(1);

/// Maximum number of scenes that a client may name as known.
const MOST_BASES: usize = 16;

/// A query that looks at no more than this many facts runs in the call's own task; a longer one goes to a separate thread.
const AT_ONCE: usize = 4_096;

/// Maximum number of versions of a fact in an answer.
const MOST_VERSIONS: usize = 1_000;

/// The service; clones share the actor.
#[derive(Debug, Clone)]
pub(super) struct Service {
    pub(super) actor: Handle,
    pub(super) leases: watch::Receiver<LiveLeases>,
    pub(super) shutdown: CancellationToken,
    pub(super) sizes: Sizes,
    pub(super) long_reads: LongReads,
    pub(super) metrics: Arc<Metrics>,
}

/// Long reads run in separate threads, a few at a time, which leaves the other threads to everybody else.
#[derive(Debug, Clone)]
pub(super) struct LongReads(Arc<Semaphore>);

impl Default for LongReads {
    fn default() -> LongReads {
        let threads = std::thread::available_parallelism().map_or(1, usize::from);
        LongReads(Arc::new(Semaphore::new((threads / 2).max(1))))
    }
}

impl LongReads {
    async fn read<T: Send + 'static>(
        &self,
        read: impl FnOnce() -> Result<T, Status> + Send + 'static,
    ) -> Result<T, Status> {
        // A call that is dropped leaves the queue.
        let permit = self.0.clone().acquire_owned().await;
        let reading = tokio::task::spawn_blocking(move || {
            let _permit = permit;
            read()
        });
        reading.await.map_err(|error| status(Code::Internal, "BROKEN", format!("reading the world: {error}")))?
    }
}

/// A page of the facts that a query finds after those already seen, and whether there are more; `None` where that would look at more than
/// `most` facts.
fn page_of(
    view: &View,
    patterns: &[FactPattern],
    seen: usize,
    page: Page,
    most: usize,
) -> Result<Option<(Vec<v1::Fact>, bool)>, Status> {
    let (mut filled, mut skipped, mut full) = (Filled::default(), 0, Ok(false));
    let found = view.find(patterns, most, &mut |key, fact| {
        if skipped < seen {
            skipped += 1;
            return true;
        }
        full = page.fill([v1::Fact::from(record((key.clone(), fact.clone())))], &mut filled);
        matches!(full, Ok(false))
    });
    let more = full?;
    Ok((found == Found::All).then_some((filled.items, more)))
}

/// Maximum number of different writers in the changes of a projection: each is compared with the others.
const MOST_WRITERS: usize = 4_096;

/// Maximum sizes of requests, in bytes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sizes {
    /// One change, or one piece of evidence.
    pub(super) fact: usize,
    /// All of them together.
    pub(super) commit: usize,
}

impl Sizes {
    fn check(self, field: &str, changes: &[impl prost::Message]) -> Result<usize, Status> {
        for (index, change) in changes.iter().enumerate() {
            let (bytes, most) = (change.encoded_len(), self.fact);
            if bytes > most {
                let rule = format!("has {bytes} bytes: at most {most} are accepted (fact_bytes)");
                return Err(Malformed::new(format!("{field}[{index}]"), rule).into());
            }
        }
        let (bytes, most): (usize, usize) = (changes.iter().map(prost::Message::encoded_len).sum(), self.commit);
        if bytes > most {
            let rule = format!("have {bytes} bytes: at most {most} are accepted at once (commit_bytes)");
            return Err(Malformed::new(field, rule).into());
        }
        Ok(bytes)
    }
}

#[tonic::async_trait]
impl v1::world_pool_service_server::WorldPoolService for Service {
    async fn get_root(&self, request: Request<v1::GetRootRequest>) -> Result<Response<v1::GetRootResponse>, Status> {
        let v1::GetRootRequest { page_bytes, page_token } = request.into_inner();
        let query = v1::QueryRequest { page_bytes, page_token, ..Default::default() };
        let v1::QueryResponse { facts, revision, next_page_token } =
            self.query(Request::new(query)).await?.into_inner();
        Ok(Response::new(v1::GetRootResponse { revision, facts, next_page_token }))
    }

    async fn commit(&self, request: Request<v1::CommitRequest>) -> Result<Response<v1::CommitResponse>, Status> {
        let (caller, request) = (Caller::of(&request), request.into_inner());
        name(&request.commit_id, "commit_id")?;
        label(&request.writer, "writer")?;
        self.sizes.check("changes", &request.changes)?;
        self.sizes.check("evidence", &request.evidence)?;
        let commit = Commit {
            by: caller.clone(),
            id: request.commit_id,
            changes: each(request.changes, "changes")?,
            expected: (request.revision != 0).then_some(Revision(request.revision)),
            writer: Some(request.writer).filter(|writer| !writer.is_empty()),
            evidence: each(request.evidence, "evidence")?,
        };
        let pending = audit::begin(&caller, &commit.id, || Mutation::Commit {
            revision: commit.expected.map_or(0, |revision| revision.0),
            changes: commit.changes.len(),
            writer: commit.writer.clone().unwrap_or_default(),
        });
        let committed = self.actor.request(|answer| Message::Commit { commit, answer }).await;
        pending.ended(&committed);
        let (revision, contradictions) = committed?;
        let contradictions = paging::first(all(contradictions));
        Ok(Response::new(v1::CommitResponse { revision: revision.0, contradictions }))
    }

    async fn project(&self, request: Request<v1::ProjectRequest>) -> Result<Response<v1::ProjectResponse>, Status> {
        let (caller, request) = (Caller::of(&request), request.into_inner());
        label(&request.request_id, "request_id")?;
        label(&request.after_commit_id, "after_commit_id")?;
        self.sizes.check("changes", &request.changes)?;
        request.writers.iter().try_for_each(|writer| label(writer, "writers"))?;
        let writers = request.writers.iter().collect::<BTreeSet<_>>().len();
        if writers > MOST_WRITERS {
            let rule = format!("are {writers} different ones: at most {MOST_WRITERS} are accepted");
            return Err(Malformed::new("writers", rule).into());
        }
        let lease = (request.lease_id != 0).then_some(LeaseId(request.lease_id));
        let projection = NewProjection {
            by: caller.clone(),
            request_id: request.request_id,
            id: (request.projection_id != 0).then_some(ProjectionId(request.projection_id)),
            after: Some(request.after_commit_id).filter(|id| !id.is_empty()),
            base: Revision(request.base_revision),
            changes: each(request.changes, "changes")?,
            writers: request.writers.into_iter().map(Arc::from).collect(),
            reads: required(request.reads, "reads")?,
            lease,
        };
        let pending = audit::begin(&caller, &projection.request_id, || Mutation::Project {
            base_revision: projection.base.0,
            changes: projection.changes.len(),
            lease: request.lease_id,
        });
        if let Some(lease) = lease {
            let mut leases = self.leases.clone();
            let told = leases.wait_for(|leases| leases.known(lease) != Known::NotYet);
            // For a lease that does not exist this waits in vain, and the actor refuses the request.
            let _ = tokio::time::timeout(LEASE_PATIENCE, told).await;
        }
        let promise = request.promise;
        let made = self.actor.request(|answer| Message::Project { projection, promise, answer }).await;
        pending.ended(&made);
        let (id, promised) = made?;
        let promised = promised.into_iter().map(|id| id.0).collect();
        Ok(Response::new(v1::ProjectResponse { projection_id: id.0, promised }))
    }

    async fn query(&self, request: Request<v1::QueryRequest>) -> Result<Response<v1::QueryResponse>, Status> {
        let (by, request) = (Caller::of(&request).name, request.into_inner());
        let projection = request.projection_id.map(ProjectionId);
        few(request.patterns.len(), "patterns")?;
        let same = v1::QueryRequest { page_bytes: 0, page_token: String::new(), at_revision: None, ..request.clone() };
        let patterns = each(request.patterns, "patterns")?;
        let place = paging::place(&request.page_token, &same)?;
        let page = Page::of(request.page_bytes, &request.page_token);
        let at = match place {
            // The next page is of the same revision; a projection has only one revision.
            Some((revision, _)) => Some(Revision(revision)).filter(|_| projection.is_none()),
            None => request.at_revision.map(Revision),
        };
        if projection.is_some() && at.is_some() {
            return Err(Malformed::new("at_revision", "is of the root: not together with projection_id").into());
        }
        let asked = patterns.clone();
        let view = self.actor.request(|answer| Message::Query { by, projection, at, patterns: asked, answer }).await?;
        let (revision, seen) = (view.revision, place.map_or(0, |(_, seen)| seen));
        // Without a pattern a query looks at all facts.
        let few = !patterns.is_empty() || view.world.len() <= AT_ONCE;
        let at_once = if few { page_of(&view, &patterns, seen, page, AT_ONCE)? } else { None };
        let (facts, more) = match at_once {
            Some(found) => found,
            None => {
                let read = move || {
                    let found = page_of(&view, &patterns, seen, page, view.most())?;
                    found.ok_or_else(|| super::status::of_too_much(&view.too_much()))
                };
                self.long_reads.read(read).await?
            }
        };
        let next_page_token = paging::token(more, revision.0, seen + facts.len(), &same);
        Ok(Response::new(v1::QueryResponse { facts, revision: revision.0, next_page_token }))
    }

    type WatchStream = BoxStream<'static, Result<v1::WorldPoolServiceWatchResponse, Status>>;

    async fn watch(
        &self,
        request: Request<v1::WorldPoolServiceWatchRequest>,
    ) -> Result<Response<Self::WatchStream>, Status> {
        let request = request.into_inner();
        few(request.patterns.len(), "patterns")?;
        let patterns: Vec<FactPattern> = each(request.patterns, "patterns")?;
        let (patterns, after): (Arc<[FactPattern]>, _) = (patterns.into(), request.after_revision.map(Revision));
        let updates = self.actor.request(|answer| Message::Watch { after, answer }).await?;
        let updates = tokio_stream::wrappers::ReceiverStream::new(updates)
            .flat_map(move |update| futures::stream::iter(messages(update, patterns.clone(), request.in_parts)));
        Ok(Response::new(watch_stream::ended(updates, self.shutdown.clone(), cut_off())))
    }

    type WatchProjectionStream = BoxStream<'static, Result<v1::WatchProjectionResponse, Status>>;

    async fn watch_projection(
        &self,
        request: Request<v1::WatchProjectionRequest>,
    ) -> Result<Response<Self::WatchProjectionStream>, Status> {
        let (by, projection) = (Caller::of(&request).name, ProjectionId(request.into_inner().projection_id));
        let validity = self.actor.request(|answer| Message::WatchProjection { by, projection, answer }).await?;
        let told = tokio_stream::wrappers::WatchStream::new(validity).map(|contradiction| {
            let told = v1::WatchProjectionResponse { contradiction: contradiction.map(v1::Contradiction::from) };
            paging::whole(told, "the contradiction", "query the fact in the projection and in the root")
        });
        Ok(Response::new(Box::pin(told.take_until(self.shutdown.clone().cancelled_owned()))))
    }

    async fn diff(&self, request: Request<v1::DiffRequest>) -> Result<Response<v1::DiffResponse>, Status> {
        let request = request.into_inner();
        few(request.patterns.len(), "patterns")?;
        let same = v1::DiffRequest { page_bytes: 0, page_token: String::new(), to_revision: None, ..request.clone() };
        let patterns: Vec<FactPattern> = each(request.patterns, "patterns")?;
        let from = Revision(request.from_revision);
        let place = paging::place(&request.page_token, &same)?;
        let page = Page::of(request.page_bytes, &request.page_token);
        let to = place.map(|(to, _)| Revision(to)).or(request.to_revision.map(Revision));
        let (between, to) = self.actor.request(|answer| Message::Diff { from, to, answer }).await?;
        let seen = place.map_or(0, |(_, seen)| seen);
        let read = move || {
            let differences = between.differences().filter(|(key, ..)| wanted(key, &patterns));
            let differences = differences.map(|(key, before, after)| FactDifference {
                before: before.map(|fact| record((key.as_ref().clone(), fact.as_ref().clone()))),
                after: after.map(|fact| record((key.as_ref().clone(), fact.as_ref().clone()))),
                key: key.as_ref().clone(),
            });
            let mut filled = Filled::default();
            let more = page.fill(differences.skip(seen).map(v1::FactDifference::from), &mut filled)?;
            Ok((filled.items, more))
        };
        let (differences, more) = self.long_reads.read(read).await?;
        let next_page_token = paging::token(more, to.0, seen + differences.len(), &same);
        Ok(Response::new(v1::DiffResponse { differences, to_revision: to.0, next_page_token }))
    }

    async fn get_fact_history(
        &self,
        request: Request<v1::GetFactHistoryRequest>,
    ) -> Result<Response<v1::GetFactHistoryResponse>, Status> {
        let key: FactKey = required(request.into_inner().key, "key")?;
        let asked = key.clone();
        let message = |answer| Message::Versions { key: asked, limit: MOST_VERSIONS, answer };
        let (versions, oldest) = self.actor.request(message).await?;
        let versions = versions.into_iter().map(|version| FactVersion {
            revision: version.revision,
            commit: version.commit.to_string(),
            fact: version.fact.map(|fact| record((key.clone(), fact.as_ref().clone()))),
            writer: version.writer,
        });
        Ok(Response::new(v1::GetFactHistoryResponse {
            versions: paging::first(all(versions)),
            oldest_revision: oldest.0,
        }))
    }

    async fn get_scene(&self, request: Request<v1::GetSceneRequest>) -> Result<Response<v1::GetSceneResponse>, Status> {
        let (by, request) = (Caller::of(&request).name, request.into_inner());
        let projection = request.projection_id.map(ProjectionId);
        if request.bases.len() > MOST_BASES {
            return Err(Malformed::new("bases", format!("at most {MOST_BASES} are looked at")).into());
        }
        let bases: Result<Vec<Digest>, Malformed> = request.bases.iter().map(|base| digest(base, "bases")).collect();
        let bases = bases?;
        let scene = self.actor.request(|answer| Message::Scene { by, projection, bases, answer }).await?;
        Ok(Response::new(paging::whole(scene.into(), "the scene", "make a projection that reads less of it")?))
    }

    async fn release(
        &self,
        request: Request<v1::WorldPoolServiceReleaseRequest>,
    ) -> Result<Response<v1::WorldPoolServiceReleaseResponse>, Status> {
        let (caller, projection) = (Caller::of(&request), ProjectionId(request.into_inner().projection_id));
        let pending = audit::begin(&caller, "", || Mutation::ReleaseProjection { projection: projection.0 });
        let by = caller;
        let released = self.actor.request(|answer| Message::Release { by, projection, answer }).await;
        pending.ended(&released);
        let released = released?;
        Ok(Response::new(v1::WorldPoolServiceReleaseResponse { released }))
    }

    type CallsStream = Answers<WorldCalls, CallerService>;

    async fn calls(
        &self,
        request: Request<Streaming<v1::CallsRequest>>,
    ) -> Result<Response<Self::CallsStream>, Status> {
        let caller = StreamCaller::of(&request, self.metrics.clone());
        let calls = CallerService::new(self.clone(), caller);
        Ok(Response::new(Answers::new(calls, request.into_inner(), Some(self.shutdown.clone()))))
    }
}

/// The final status of a watch that was cut off.
fn cut_off() -> Status {
    let message = "the watch has ended, for it was too slow or the disk failed: watch again";
    retry_later(Code::Unavailable, "WATCH_AGAIN", message, WATCH_AGAIN_AFTER)
}

type Messages = Box<dyn Iterator<Item = Result<v1::WorldPoolServiceWatchResponse, Status>> + Send>;

/// The messages of an update for a watcher with these patterns, each made when it is needed. A watcher that still needs a revision which the
/// history has dropped was too slow.
fn messages(update: Update, patterns: Arc<[FactPattern]>, in_parts: bool) -> Messages {
    match update {
        Update::Snapshot(root) => Box::new(snapshot(root, patterns, in_parts)),
        Update::Revision(kept) => match kept.upgrade() {
            Some(kept) => Box::new(change(&kept, &patterns).into_iter()),
            None => Box::new(std::iter::once(Err(cut_off()))),
        },
    }
}

/// The current facts, in messages that are not too large.
fn snapshot(
    root: Weak<Kept>,
    patterns: Arc<[FactPattern]>,
    in_parts: bool,
) -> impl Iterator<Item = Result<v1::WorldPoolServiceWatchResponse, Status>> {
    let revision = root.upgrade().map_or(0, |root| root.world.revision().0);
    let mut behind: Option<FactKey> = None;
    let parts = paging::snapshot_parts(in_parts, move |page, part| {
        let root = root.upgrade().ok_or_else(cut_off)?;
        let facts: Box<dyn Iterator<Item = (&FactKey, &Fact)>> = match &behind {
            Some(key) => Box::new(root.world.iter_behind(key)),
            None => Box::new(root.world.iter()),
        };
        let (mut before, mut last) = (None, None);
        let facts = facts.filter(|(key, _)| wanted(key, &patterns)).map(|(key, fact)| {
            (before, last) = (last, Some(key));
            v1::Fact::from(record((key.clone(), fact.clone())))
        });
        let more = page.fill(facts, part)?;
        let last = before.cloned();
        // The last fact had no room on this page.
        behind = if more { last } else { None };
        Ok(more)
    });
    parts.map(move |part| {
        let (facts, more) = part?;
        let snapshot = v1::WorldSnapshot { facts, more, revision };
        let kind = v1::world_pool_service_watch_response::Kind::Snapshot(snapshot);
        Ok(v1::WorldPoolServiceWatchResponse { kind: Some(kind) })
    })
}

/// The message of a revision, where any of it is wanted. A revision that is too large for a message is sent as a refusal, so that the client
/// begins anew.
fn change(kept: &Kept, patterns: &[FactPattern]) -> Option<Result<v1::WorldPoolServiceWatchResponse, Status>> {
    let (mut written, mut gone) = (Vec::new(), Vec::new());
    for (key, fact) in kept.written.iter().filter(|(key, _)| wanted(key, patterns)) {
        match fact {
            Some(fact) => written.push(record((key.as_ref().clone(), fact.as_ref().clone()))),
            None => gone.push(key.as_ref().clone()),
        }
    }
    if written.is_empty() && gone.is_empty() && !patterns.is_empty() {
        return None;
    }
    let (revision, commit, writer) = (kept.world.revision(), kept.commit.to_string(), kept.writer.clone());
    let change = WorldUpdate::Changed(WorldChange { revision, commit, written, gone, writer });
    let message = v1::WorldPoolServiceWatchResponse::from(change);
    if message.encoded_len() > MAX_PAGE_BYTES + MAX_PAGE_BYTES / 2 {
        let message = "the revision changed more than a message has room for: watch again without a revision";
        return Some(Err(status(Code::OutOfRange, "REVISION_TOO_LARGE", message)));
    }
    Some(Ok(message))
}

fn wanted(key: &FactKey, patterns: &[FactPattern]) -> bool {
    patterns.is_empty() || patterns.iter().any(|pattern| pattern.matches(key))
}

fn record((key, fact): (FactKey, Fact)) -> FactRecord {
    FactRecord { key, value: fact.value, revision: fact.revision, writer: fact.writer, measured: fact.measured }
}
