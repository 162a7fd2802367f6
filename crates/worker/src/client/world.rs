//! The client of the world pool. The frequent calls of a task (commit, project, release) share one stream per client.

use super::{CallError, Channels, snapshot};
use crate::endpoint::Endpoint;
use crate::multiplex::WorldCalls;
use crate::multiplex::client::Multiplexer;
use crate::trace::Traced;
use ratn_model::fact::{Change, FactKey, FactPattern, Footprint};
use ratn_model::id::{FencingToken, LeaseId, ProjectionId, Revision};
use ratn_model::measurement::Evidence;
use ratn_proto::convert::{Malformed, all, each};
use ratn_proto::types::{Contradiction, FactDifference, FactRecord, FactVersion, WorldUpdate};
use ratn_proto::v1;
use ratn_proto::v1::calls_request::Kind as Asked;
use ratn_proto::v1::calls_response::Kind as Answered;
use ratn_proto::v1::world_pool_service_client::WorldPoolServiceClient;
use ratn_proto::{MAX_MESSAGE_BYTES, PAGE_BYTES};
use ratn_world::digest::Digest;
use ratn_world::scene::delta::SceneDelta;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use tonic::{Code, Status, Streaming};
use tonic_types::StatusExt;

/// Bytes that the stream adds to a call: its id and its trace context.
const ENVELOPE_BYTES: usize = 128;

/// A client of one world pool.
#[derive(Debug, Clone)]
pub struct WorldClient {
    endpoint: Endpoint,
    client: WorldPoolServiceClient<Traced>,
    calls: Multiplexer<WorldCalls>,
    /// The pool is of an older version, without the stream of calls.
    alone: Arc<AtomicBool>,
}

/// A projection to be made.
#[derive(Debug, Clone, PartialEq)]
pub struct Projection {
    /// The request id, `run/instance/attempt`: the same request makes one projection.
    pub request: String,
    /// The revision of the root that the projection is based on.
    pub base: Revision,
    /// The changes on top of that revision, in order.
    pub changes: Vec<Change>,
    /// For each change the writer that is expected to commit it, by the path of its instance: the pool compares that commit with the
    /// predicted change. Empty or missing: no writer, and the change stays in effect over every commit.
    pub writers: Vec<Arc<str>>,
    /// The facts of the projection that its reader may see.
    pub reads: Footprint,
    /// The lease that holds the resource for the projection, with its fencing token.
    pub lease: Option<(LeaseId, FencingToken)>,
}

/// For a projection that is referred to before it exists.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Early {
    /// The projection's id, one that an earlier answer has promised; `None`: the pool chooses one.
    pub id: Option<ProjectionId>,
    /// The id of a commit on its way: the projection is based on the revision that this commit makes, or a later one.
    pub after: Option<String>,
    /// Number of ids that the answer is to promise, at most 64.
    pub promise: u32,
}

/// Changes to be committed to the root.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Commit {
    /// The commit's id, `run/instance`: the same id commits once.
    pub id: String,
    /// The changes, in order.
    pub changes: Vec<Change>,
    /// The revision that the root must get by this commit; `None` for any.
    pub revision: Option<Revision>,
    /// The node that writes, by the path of its instance; may be empty.
    pub writer: String,
    /// Which measurement each written fact comes from.
    pub evidence: Evidence,
}

/// A running watch of the root.
#[derive(Debug)]
pub struct WorldWatch {
    endpoint: Endpoint,
    stream: Streaming<v1::WorldPoolServiceWatchResponse>,
}

/// A running watch of a projection.
#[derive(Debug)]
pub struct ProjectionWatch {
    endpoint: Endpoint,
    stream: Streaming<v1::WatchProjectionResponse>,
}

impl ProjectionWatch {
    /// First whether the projection holds, then its first contradiction; `None` when the projection has ended.
    ///
    /// # Errors
    /// [`CallError`] if the watch broke.
    pub async fn next(&mut self) -> Result<Option<Option<Contradiction>>, CallError> {
        let message = self.stream.message().await.map_err(|s| CallError::from_status(&self.endpoint, &s))?;
        let told = message.map(|message| message.contradiction.map(Contradiction::try_from).transpose()).transpose();
        told.map_err(|m| CallError::malformed(&self.endpoint, m))
    }
}

impl WorldWatch {
    /// The snapshot, then every revision; `None` when the pool ends the watch.
    ///
    /// # Errors
    /// [`CallError`] if the watch broke.
    pub async fn next(&mut self) -> Result<Option<WorldUpdate>, CallError> {
        let message = snapshot::next(&self.endpoint, &mut self.stream).await?;
        let update = message.map(WorldUpdate::try_from).transpose();
        update.map_err(|m| CallError::malformed(&self.endpoint, m))
    }
}

impl WorldClient {
    /// The client of the world pool at `endpoint`.
    ///
    /// # Errors
    /// As [`Channels::get`].
    pub fn new(channels: &Channels, endpoint: &Endpoint) -> Result<WorldClient, CallError> {
        let client = WorldPoolServiceClient::new(channels.get(endpoint)?)
            .max_decoding_message_size(MAX_MESSAGE_BYTES)
            .max_encoding_message_size(MAX_MESSAGE_BYTES);
        Ok(WorldClient { endpoint: endpoint.clone(), client, calls: Multiplexer::default(), alone: Arc::default() })
    }

    /// The world pool's endpoint.
    pub fn endpoint(&self) -> &Endpoint {
        &self.endpoint
    }

    /// The root's revision and all its facts.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn root(&self) -> Result<(Revision, Vec<FactRecord>), CallError> {
        self.all_pages(v1::QueryRequest::default()).await
    }

    /// Commits changes, and returns the resulting revision of the root. `commit` is the commit's id, `run/instance`: the same id commits
    /// once. `revision`, if given, is the revision that the root must get.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn commit(
        &self,
        commit: &str,
        changes: Vec<Change>,
        revision: Option<Revision>,
    ) -> Result<Revision, CallError> {
        let commit = Commit { id: commit.to_owned(), changes, revision, ..Commit::default() };
        self.commit_as(commit).await.map(|(revision, _)| revision)
    }

    /// As [`WorldClient::commit`], with the writer and the evidence. Returns also the projections that the commit contradicts, sorted by id
    /// (none if the same id was committed before).
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn commit_as(&self, commit: Commit) -> Result<(Revision, Vec<Contradiction>), CallError> {
        let question = v1::CommitRequest {
            commit_id: commit.id,
            changes: all(commit.changes),
            revision: commit.revision.map_or(0, |r| r.0),
            writer: commit.writer,
            evidence: all(commit.evidence),
        };
        let Answered::Commit(answer) = self.ask(Asked::Commit(question)).await? else {
            return Err(self.another("a commit"));
        };
        let contradictions = each(answer.contradictions, "contradictions");
        Ok((Revision(answer.revision), contradictions.map_err(|m| CallError::malformed(&self.endpoint, m))?))
    }

    /// Makes a projection.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn project(&self, projection: Projection) -> Result<ProjectionId, CallError> {
        self.project_early(projection, Early::default()).await.map(|(id, _)| id)
    }

    /// As [`WorldClient::project`], for a projection whose id others may know already. Returns also the ids that are promised for the next
    /// projections.
    ///
    /// # Errors
    /// [`CallError`]; FAILED_PRECONDITION if the id was not promised, or the commit does not come within a second.
    pub async fn project_early(
        &self,
        projection: Projection,
        early: Early,
    ) -> Result<(ProjectionId, Vec<ProjectionId>), CallError> {
        let (lease, token) = projection.lease.unwrap_or_default();
        let question = v1::ProjectRequest {
            request_id: projection.request,
            base_revision: projection.base.0,
            changes: all(projection.changes),
            reads: Some(projection.reads.into()),
            lease_id: lease.0,
            token: token.0,
            writers: projection.writers.iter().map(ToString::to_string).collect(),
            projection_id: early.id.unwrap_or_default().0,
            promise: early.promise,
            after_commit_id: early.after.unwrap_or_default(),
        };
        let Answered::Project(answer) = self.ask(Asked::Project(question)).await? else {
            return Err(self.another("a projection"));
        };
        Ok((ProjectionId(answer.projection_id), answer.promised.into_iter().map(ProjectionId).collect()))
    }

    /// The facts of a projection, or of the root, that match any of the patterns.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn query(
        &self,
        projection: Option<ProjectionId>,
        patterns: &[FactPattern],
    ) -> Result<Vec<FactRecord>, CallError> {
        let projection_id = projection.map(|p| p.0);
        let question =
            v1::QueryRequest { projection_id, patterns: all(patterns.iter().cloned()), ..Default::default() };
        self.all_pages(question).await.map(|(_, facts)| facts)
    }

    /// The facts of the root at a revision (by default: the present one) that match any of the patterns (without patterns: all), and that
    /// revision.
    ///
    /// # Errors
    /// [`CallError`], also if the revision is not kept any more.
    pub async fn root_at(
        &self,
        revision: Option<Revision>,
        patterns: &[FactPattern],
    ) -> Result<(Revision, Vec<FactRecord>), CallError> {
        let at_revision = revision.map(|revision| revision.0);
        let patterns = all(patterns.iter().cloned());
        self.all_pages(v1::QueryRequest { at_revision, patterns, ..Default::default() }).await
    }

    /// Watches the revisions of the root, a snapshot first; with `after`, every revision after that one and no snapshot. With patterns,
    /// only the facts that match one.
    ///
    /// # Errors
    /// [`CallError`], also if not all revisions after `after` are kept any more.
    pub async fn watch(&self, after: Option<Revision>, patterns: &[FactPattern]) -> Result<WorldWatch, CallError> {
        let after_revision = after.map(|after| after.0);
        let patterns = all(patterns.iter().cloned());
        let question = v1::WorldPoolServiceWatchRequest { patterns, after_revision, in_parts: true };
        let answer = self.client.clone().watch(question).await.map_err(|status| self.failed(&status))?;
        Ok(WorldWatch { endpoint: self.endpoint.clone(), stream: answer.into_inner() })
    }

    /// The facts that differ between two revisions of the root, and the number of the second revision; `None` is the present root.
    ///
    /// # Errors
    /// [`CallError`], also if one of them is not kept any more.
    pub async fn diff(
        &self,
        from: Revision,
        to: Option<Revision>,
        patterns: &[FactPattern],
    ) -> Result<(Vec<FactDifference>, Revision), CallError> {
        let (from_revision, to_revision) = (from.0, to.map(|to| to.0));
        let (patterns, page_token) = (all(patterns.iter().cloned()), String::new());
        let mut question = v1::DiffRequest { from_revision, to_revision, patterns, page_bytes: PAGE_BYTES, page_token };
        let mut differences = Vec::new();
        loop {
            let answer = self.client.clone().diff(question.clone()).await;
            let answer = answer.map_err(|status| self.failed(&status))?.into_inner();
            differences.extend(answer.differences);
            if answer.next_page_token.is_empty() {
                let differences = each(differences, "differences");
                let differences = differences.map_err(|m| CallError::malformed(&self.endpoint, m))?;
                return Ok((differences, Revision(answer.to_revision)));
            }
            question.page_token = answer.next_page_token;
        }
    }

    /// The versions of a fact, the newest first, and the oldest revision that is kept: earlier versions are unknown.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn history(&self, fact: FactKey) -> Result<(Vec<FactVersion>, Revision), CallError> {
        let question = v1::GetFactHistoryRequest { key: Some(fact.into()) };
        let answer = self.client.clone().get_fact_history(question).await;
        let answer = answer.map_err(|status| self.failed(&status))?.into_inner();
        let versions = each(answer.versions, "versions").map_err(|m| CallError::malformed(&self.endpoint, m))?;
        Ok((versions, Revision(answer.oldest_revision)))
    }

    /// Watches whether a projection holds: first its present state, then the first contradiction by the root.
    ///
    /// # Errors
    /// [`CallError`], also if the projection has ended.
    pub async fn watch_projection(&self, projection: ProjectionId) -> Result<ProjectionWatch, CallError> {
        let question = v1::WatchProjectionRequest { projection_id: projection.0 };
        let answer = self.client.clone().watch_projection(question).await.map_err(|status| self.failed(&status))?;
        Ok(ProjectionWatch { endpoint: self.endpoint.clone(), stream: answer.into_inner() })
    }

    /// The scene of a projection, or of the root: the difference from one of the bases (scenes that the caller has, the likeliest first, at
    /// most 16), or the whole scene.
    ///
    /// # Errors
    /// [`CallError`], also if a geometric fact yields no geometry.
    pub async fn scene(&self, projection: Option<ProjectionId>, bases: &[Digest]) -> Result<SceneDelta, CallError> {
        let bases = bases.iter().map(|base| base.as_bytes().to_vec()).collect();
        let question = v1::GetSceneRequest { projection_id: projection.map(|projection| projection.0), bases };
        let answer = self.client.clone().get_scene(question).await.map_err(|status| self.failed(&status))?;
        SceneDelta::try_from(answer.into_inner()).map_err(|m| CallError::malformed(&self.endpoint, m))
    }

    /// Ends a projection; false if it had ended before.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn release(&self, projection: ProjectionId) -> Result<bool, CallError> {
        let question = v1::WorldPoolServiceReleaseRequest { projection_id: projection.0 };
        match self.ask(Asked::Release(question)).await? {
            Answered::Release(ended) => Ok(ended.released),
            _ => Err(self.another("a release")),
        }
    }

    /// Asks over the stream of calls; with a pool that has no such stream, by a call of its own.
    async fn ask(&self, call: Asked) -> Result<Answered, CallError> {
        self.fits(&call)?;
        if !self.alone.load(Ordering::Relaxed) {
            let mut client = self.client.clone();
            let open = |questions| async move { client.calls(questions).await };
            match self.calls.call(open, call.clone()).await {
                Err(status) if has_no_calls(&status) => self.alone.store(true, Ordering::Relaxed),
                answer => return answer.map_err(|status| self.failed(&status)),
            }
        }
        Box::pin(self.ask_alone(call)).await.map_err(|status| self.failed(&status))
    }

    async fn ask_alone(&self, call: Asked) -> Result<Answered, Status> {
        let mut client = self.client.clone();
        match call {
            Asked::Commit(commit) => client.commit(commit).await.map(|answer| Answered::Commit(answer.into_inner())),
            Asked::Project(project) => {
                client.project(project).await.map(|answer| Answered::Project(answer.into_inner()))
            }
            Asked::Release(release) => {
                client.release(release).await.map(|answer| Answered::Release(answer.into_inner()))
            }
        }
    }

    /// Checks the size: a message that is too large would end the stream, and every other call on it.
    fn fits(&self, call: &Asked) -> Result<(), CallError> {
        let bytes = call.encoded_len();
        if bytes <= MAX_MESSAGE_BYTES - ENVELOPE_BYTES {
            return Ok(());
        }
        let most = MAX_MESSAGE_BYTES;
        let message =
            format!("the request has {bytes} bytes: more than a message may have ({most} bytes); ask for less at once");
        Err(CallError::from_status(&self.endpoint, &Status::out_of_range(message)))
    }

    fn another(&self, what: &str) -> CallError {
        CallError::malformed(&self.endpoint, Malformed::new("kind", format!("is not that of an answer to {what}")))
    }

    /// All pages of an answer; they belong to one revision.
    async fn all_pages(&self, mut question: v1::QueryRequest) -> Result<(Revision, Vec<FactRecord>), CallError> {
        question.page_bytes = PAGE_BYTES;
        let mut facts = Vec::new();
        loop {
            let answer = self.client.clone().query(question.clone()).await;
            let answer = answer.map_err(|status| self.failed(&status))?.into_inner();
            facts.extend(answer.facts);
            if answer.next_page_token.is_empty() {
                return Ok((Revision(answer.revision), self.records(facts)?));
            }
            question.page_token = answer.next_page_token;
        }
    }

    fn records(&self, facts: Vec<v1::Fact>) -> Result<Vec<FactRecord>, CallError> {
        each(facts, "facts").map_err(|m| CallError::malformed(&self.endpoint, m))
    }

    fn failed(&self, status: &tonic::Status) -> CallError {
        CallError::from_status(&self.endpoint, status)
    }
}

/// Whether a pool is of an older version that does not know the stream of calls.
fn has_no_calls(status: &Status) -> bool {
    let closed = || status.get_details_error_info().is_some_and(|info| info.reason == "METHOD_CLOSED");
    status.code() == Code::Unimplemented || (status.code() == Code::PermissionDenied && closed())
}
