//! gRPC in front of the actor.

use super::actor::{Handle, Message, NewProjection};
use super::leases::{Known, LiveLeases};
use ratn_model::fact::FactKey;
use ratn_model::id::{LeaseId, ProjectionId, Revision};
use ratn_proto::convert::{all, each, label, name, required};
use ratn_proto::types::FactRecord;
use ratn_proto::v1;
use ratn_world::world::Fact;
use std::time::Duration;
use tokio::sync::watch;
use tonic::{Request, Response, Status};

/// A grant may reach the client before the watch tells of it: so long a projection waits for that.
const LEASE_PATIENCE: Duration = Duration::from_secs(1);

/// The service; clones share the actor.
#[derive(Debug, Clone)]
pub(super) struct Service {
    pub(super) actor: Handle,
    pub(super) leases: watch::Receiver<LiveLeases>,
}

#[tonic::async_trait]
impl v1::world_pool_service_server::WorldPoolService for Service {
    async fn get_root(&self, _: Request<v1::GetRootRequest>) -> Result<Response<v1::GetRootResponse>, Status> {
        let root = self.actor.ask(|answer| Message::Root { answer }).await?;
        let facts = root.iter().map(|(key, fact)| record((key.clone(), fact.clone())));
        Ok(Response::new(v1::GetRootResponse { revision: root.revision().0, facts: all(facts) }))
    }

    async fn commit(&self, request: Request<v1::CommitRequest>) -> Result<Response<v1::CommitResponse>, Status> {
        let request = request.into_inner();
        name(&request.commit_id, "commit_id")?;
        let id = request.commit_id;
        let changes = each(request.changes, "changes")?;
        let expected = (request.revision != 0).then_some(Revision(request.revision));
        let revision = self.actor.ask(|answer| Message::Commit { id, changes, expected, answer }).await?;
        Ok(Response::new(v1::CommitResponse { revision: revision.0 }))
    }

    async fn project(&self, request: Request<v1::ProjectRequest>) -> Result<Response<v1::ProjectResponse>, Status> {
        let request = request.into_inner();
        label(&request.request_id, "request_id")?;
        let lease = (request.lease_id != 0).then_some(LeaseId(request.lease_id));
        let projection = NewProjection {
            request_id: request.request_id,
            base: Revision(request.base_revision),
            changes: each(request.changes, "changes")?,
            reads: required(request.reads, "reads")?,
            lease,
        };
        if let Some(lease) = lease {
            let mut leases = self.leases.clone();
            let told = leases.wait_for(|leases| leases.known(lease) != Known::NotYet);
            // In vain for a lease that holds nothing: the actor knows what to do with that.
            let _ = tokio::time::timeout(LEASE_PATIENCE, told).await;
        }
        let id = self.actor.ask(|answer| Message::Project { projection, answer }).await?;
        Ok(Response::new(v1::ProjectResponse { projection_id: id.0 }))
    }

    async fn query(&self, request: Request<v1::QueryRequest>) -> Result<Response<v1::QueryResponse>, Status> {
        let request = request.into_inner();
        let projection = request.projection_id.map(ProjectionId);
        let patterns = each(request.patterns, "patterns")?;
        let (facts, revision) = self.actor.ask(|answer| Message::Query { projection, patterns, answer }).await?;
        Ok(Response::new(v1::QueryResponse { facts: all(facts.into_iter().map(record)), revision: revision.0 }))
    }

    async fn release(
        &self,
        request: Request<v1::WorldPoolServiceReleaseRequest>,
    ) -> Result<Response<v1::WorldPoolServiceReleaseResponse>, Status> {
        let projection = ProjectionId(request.into_inner().projection_id);
        let released = self.actor.ask(|answer| Message::Release { projection, answer }).await?;
        Ok(Response::new(v1::WorldPoolServiceReleaseResponse { released }))
    }
}

fn record((key, fact): (FactKey, Fact)) -> FactRecord {
    FactRecord { key, value: fact.value, revision: fact.revision }
}
