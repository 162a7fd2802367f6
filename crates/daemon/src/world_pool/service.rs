//! gRPC in front of the actor.

use super::actor::{Handle, Message, NewProjection, Update, WATCH_AGAIN_AFTER};
use super::history::Commit;
use super::leases::{Known, LiveLeases};
use crate::details::{ending, retry_later};
use futures::StreamExt;
use futures::stream::BoxStream;
use ratn_model::fact::{FactKey, FactPattern};
use ratn_model::id::{LeaseId, ProjectionId, Revision};
use ratn_proto::convert::{Malformed, all, digest, each, label, name, required};
use ratn_proto::types::{FactDifference, FactRecord, FactVersion, WorldChange, WorldUpdate};
use ratn_proto::v1;
use ratn_world::digest::Digest;
use ratn_world::world::Fact;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;
use tonic::{Code, Request, Response, Status};

/// A grant may reach the client before the watch tells of it: so long a projection waits for that.
const LEASE_PATIENCE: Duration = Duration::from_secs(1);

/// Scenes that a client may say that it has.
const MOST_BASES: usize = 16;

/// Of a fact's history.
const MOST_VERSIONS: usize = 1_000;

/// The service; clones share the actor.
#[derive(Debug, Clone)]
pub(super) struct Service {
    pub(super) actor: Handle,
    pub(super) leases: watch::Receiver<LiveLeases>,
    pub(super) shutdown: CancellationToken,
}

#[tonic::async_trait]
impl v1::world_pool_service_server::WorldPoolService for Service {
    async fn get_root(&self, _: Request<v1::GetRootRequest>) -> Result<Response<v1::GetRootResponse>, Status> {
        let root = self.actor.request(|answer| Message::Root { answer }).await?;
        let facts = root.iter().map(|(key, fact)| record((key.clone(), fact.clone())));
        Ok(Response::new(v1::GetRootResponse { revision: root.revision().0, facts: all(facts) }))
    }

    async fn commit(&self, request: Request<v1::CommitRequest>) -> Result<Response<v1::CommitResponse>, Status> {
        let request = request.into_inner();
        name(&request.commit_id, "commit_id")?;
        label(&request.writer, "writer")?;
        let commit = Commit {
            id: request.commit_id,
            changes: each(request.changes, "changes")?,
            expected: (request.revision != 0).then_some(Revision(request.revision)),
            writer: Some(request.writer).filter(|writer| !writer.is_empty()),
            evidence: each(request.evidence, "evidence")?,
        };
        let (revision, contradictions) = self.actor.request(|answer| Message::Commit { commit, answer }).await?;
        Ok(Response::new(v1::CommitResponse { revision: revision.0, contradictions: all(contradictions) }))
    }

    async fn project(&self, request: Request<v1::ProjectRequest>) -> Result<Response<v1::ProjectResponse>, Status> {
        let request = request.into_inner();
        label(&request.request_id, "request_id")?;
        request.writers.iter().try_for_each(|writer| label(writer, "writers"))?;
        let lease = (request.lease_id != 0).then_some(LeaseId(request.lease_id));
        let projection = NewProjection {
            request_id: request.request_id,
            base: Revision(request.base_revision),
            changes: each(request.changes, "changes")?,
            writers: request.writers.into_iter().map(Arc::from).collect(),
            reads: required(request.reads, "reads")?,
            lease,
        };
        if let Some(lease) = lease {
            let mut leases = self.leases.clone();
            let told = leases.wait_for(|leases| leases.known(lease) != Known::NotYet);
            // In vain for a lease that holds nothing: the actor knows what to do with that.
            let _ = tokio::time::timeout(LEASE_PATIENCE, told).await;
        }
        let id = self.actor.request(|answer| Message::Project { projection, answer }).await?;
        Ok(Response::new(v1::ProjectResponse { projection_id: id.0 }))
    }

    async fn query(&self, request: Request<v1::QueryRequest>) -> Result<Response<v1::QueryResponse>, Status> {
        let request = request.into_inner();
        let projection = request.projection_id.map(ProjectionId);
        let patterns = each(request.patterns, "patterns")?;
        let at = request.at_revision.map(Revision);
        if projection.is_some() && at.is_some() {
            return Err(Malformed::new("at_revision", "is of the root: not together with projection_id").into());
        }
        let (facts, revision) =
            self.actor.request(|answer| Message::Query { projection, at, patterns, answer }).await?;
        Ok(Response::new(v1::QueryResponse { facts: all(facts.into_iter().map(record)), revision: revision.0 }))
    }

    type WatchStream = BoxStream<'static, Result<v1::WorldPoolServiceWatchResponse, Status>>;

    async fn watch(
        &self,
        request: Request<v1::WorldPoolServiceWatchRequest>,
    ) -> Result<Response<Self::WatchStream>, Status> {
        let request = request.into_inner();
        let patterns: Vec<FactPattern> = each(request.patterns, "patterns")?;
        let after = request.after_revision.map(Revision);
        let updates = self.actor.request(|answer| Message::Watch { after, answer }).await?;
        let updates = tokio_stream::wrappers::ReceiverStream::new(updates)
            .filter_map(move |update| futures::future::ready(told(&update, &patterns)))
            .map(|update| Ok(update.into()));
        let shutdown = self.shutdown.clone();
        let last = futures::stream::once(async move {
            if shutdown.is_cancelled() {
                return Err(ending());
            }
            let message = "the watch has ended, for it was too slow or the disk failed: watch again";
            Err(retry_later(Code::Unavailable, "WATCH_AGAIN", message, WATCH_AGAIN_AFTER))
        });
        let stream = updates.take_until(self.shutdown.clone().cancelled_owned()).chain(last);
        Ok(Response::new(Box::pin(stream)))
    }

    type WatchProjectionStream = BoxStream<'static, Result<v1::WatchProjectionResponse, Status>>;

    async fn watch_projection(
        &self,
        request: Request<v1::WatchProjectionRequest>,
    ) -> Result<Response<Self::WatchProjectionStream>, Status> {
        let projection = ProjectionId(request.into_inner().projection_id);
        let validity = self.actor.request(|answer| Message::WatchProjection { projection, answer }).await?;
        let told = tokio_stream::wrappers::WatchStream::new(validity).map(|contradiction| {
            Ok(v1::WatchProjectionResponse { contradiction: contradiction.map(v1::Contradiction::from) })
        });
        Ok(Response::new(Box::pin(told.take_until(self.shutdown.clone().cancelled_owned()))))
    }

    async fn diff(&self, request: Request<v1::DiffRequest>) -> Result<Response<v1::DiffResponse>, Status> {
        let request = request.into_inner();
        let patterns: Vec<FactPattern> = each(request.patterns, "patterns")?;
        let from = Revision(request.from_revision);
        let to = request.to_revision.map(Revision);
        let (differences, to) = self.actor.request(|answer| Message::Diff { from, to, answer }).await?;
        let differences = differences.into_iter().filter(|(key, ..)| wanted(key, &patterns));
        let differences = differences.map(|(key, before, after)| FactDifference {
            before: before.map(|fact| record((key.as_ref().clone(), fact.as_ref().clone()))),
            after: after.map(|fact| record((key.as_ref().clone(), fact.as_ref().clone()))),
            key: key.as_ref().clone(),
        });
        Ok(Response::new(v1::DiffResponse { differences: all(differences), to_revision: to.0 }))
    }

    async fn get_fact_history(
        &self,
        request: Request<v1::GetFactHistoryRequest>,
    ) -> Result<Response<v1::GetFactHistoryResponse>, Status> {
        let key: FactKey = required(request.into_inner().key, "key")?;
        let asked = key.clone();
        let message = |answer| Message::Versions { key: asked, limit: MOST_VERSIONS, answer };
        let (versions, oldest) = self.actor.request(message).await?;
        let versions = versions.into_iter().map(|(revision, commit, fact)| FactVersion {
            revision,
            commit: commit.to_string(),
            fact: fact.map(|fact| record((key.clone(), fact.as_ref().clone()))),
        });
        Ok(Response::new(v1::GetFactHistoryResponse { versions: all(versions), oldest_revision: oldest.0 }))
    }

    async fn get_scene(&self, request: Request<v1::GetSceneRequest>) -> Result<Response<v1::GetSceneResponse>, Status> {
        let request = request.into_inner();
        let projection = request.projection_id.map(ProjectionId);
        if request.bases.len() > MOST_BASES {
            return Err(Malformed::new("bases", format!("at most {MOST_BASES} are looked at")).into());
        }
        let bases: Result<Vec<Digest>, Malformed> = request.bases.iter().map(|base| digest(base, "bases")).collect();
        let bases = bases?;
        let scene = self.actor.request(|answer| Message::Scene { projection, bases, answer }).await?;
        Ok(Response::new(scene.into()))
    }

    async fn release(
        &self,
        request: Request<v1::WorldPoolServiceReleaseRequest>,
    ) -> Result<Response<v1::WorldPoolServiceReleaseResponse>, Status> {
        let projection = ProjectionId(request.into_inner().projection_id);
        let released = self.actor.request(|answer| Message::Release { projection, answer }).await?;
        Ok(Response::new(v1::WorldPoolServiceReleaseResponse { released }))
    }
}

/// What of an update a watcher of these patterns is told; nothing, when none of it.
fn told(update: &Update, patterns: &[FactPattern]) -> Option<WorldUpdate> {
    match update {
        Update::Snapshot(world) => {
            let facts = world.iter().filter(|(key, _)| wanted(key, patterns));
            let facts = facts.map(|(key, fact)| record((key.clone(), fact.clone()))).collect();
            Some(WorldUpdate::Snapshot { revision: world.revision(), facts })
        }
        Update::Revision(kept) => {
            let (mut written, mut gone) = (Vec::new(), Vec::new());
            for (key, fact) in kept.written.iter().filter(|(key, _)| wanted(key, patterns)) {
                match fact {
                    Some(fact) => written.push(record((key.as_ref().clone(), fact.as_ref().clone()))),
                    None => gone.push(key.as_ref().clone()),
                }
            }
            let nothing = written.is_empty() && gone.is_empty() && !patterns.is_empty();
            let (revision, commit) = (kept.world.revision(), kept.commit.to_string());
            (!nothing).then_some(WorldUpdate::Changed(WorldChange { revision, commit, written, gone }))
        }
    }
}

fn wanted(key: &FactKey, patterns: &[FactPattern]) -> bool {
    patterns.is_empty() || patterns.iter().any(|pattern| pattern.matches(key))
}

fn record((key, fact): (FactKey, Fact)) -> FactRecord {
    FactRecord { key, value: fact.value, revision: fact.revision, writer: fact.writer, measured: fact.measured }
}
