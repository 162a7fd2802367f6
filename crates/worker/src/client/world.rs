//! The client of the world pool.

use super::{CallError, Channels};
use crate::endpoint::Endpoint;
use crate::trace::Traced;
use ratn_model::fact::{Change, FactPattern, Footprint};
use ratn_model::id::{FencingToken, LeaseId, ProjectionId, Revision};
use ratn_proto::MAX_MESSAGE_BYTES;
use ratn_proto::convert::{all, each};
use ratn_proto::types::FactRecord;
use ratn_proto::v1;
use ratn_proto::v1::world_pool_service_client::WorldPoolServiceClient;

/// Asks one world pool.
#[derive(Debug, Clone)]
pub struct WorldClient {
    endpoint: Endpoint,
    client: WorldPoolServiceClient<Traced>,
}

/// What a projection shall be.
#[derive(Debug, Clone, PartialEq)]
pub struct Projection {
    /// Unique to what asks, `run/instance/attempt`.
    pub request: String,
    /// The root's revision below it.
    pub base: Revision,
    /// The changes over that, in order.
    pub changes: Vec<Change>,
    /// What of it may be seen.
    pub reads: Footprint,
    /// The lease that holds the room for it, with its token.
    pub lease: Option<(LeaseId, FencingToken)>,
}

impl WorldClient {
    /// The client of the world pool at `endpoint`.
    ///
    /// # Errors
    /// As [`Channels::get`].
    pub fn new(channels: &Channels, endpoint: &Endpoint) -> Result<WorldClient, CallError> {
        let client = WorldPoolServiceClient::new(channels.traced(endpoint)?)
            .max_decoding_message_size(MAX_MESSAGE_BYTES)
            .max_encoding_message_size(MAX_MESSAGE_BYTES);
        Ok(WorldClient { endpoint: endpoint.clone(), client })
    }

    /// Where the world pool is.
    pub fn endpoint(&self) -> &Endpoint {
        &self.endpoint
    }

    /// The root's revision and every fact of it.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn root(&self) -> Result<(Revision, Vec<FactRecord>), CallError> {
        let answer = self.client.clone().get_root(v1::GetRootRequest {}).await;
        let answer = answer.map_err(|status| self.failed(&status))?.into_inner();
        Ok((Revision(answer.revision), self.records(answer.facts)?))
    }

    /// Makes changes real; the root's revision with them. `commit` is unique to what is committed, `run/instance`;
    /// `revision` is what the root's revision must become, where that matters.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn commit(
        &self,
        commit: &str,
        changes: Vec<Change>,
        revision: Option<Revision>,
    ) -> Result<Revision, CallError> {
        let question = v1::CommitRequest {
            commit_id: commit.to_owned(),
            changes: all(changes),
            revision: revision.map_or(0, |r| r.0),
        };
        let answer = self.client.clone().commit(question).await.map_err(|status| self.failed(&status))?;
        Ok(Revision(answer.into_inner().revision))
    }

    /// Makes a projection.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn project(&self, projection: Projection) -> Result<ProjectionId, CallError> {
        let (lease, token) = projection.lease.unwrap_or_default();
        let question = v1::ProjectRequest {
            request_id: projection.request,
            base_revision: projection.base.0,
            changes: all(projection.changes),
            reads: Some(projection.reads.into()),
            lease_id: lease.0,
            token: token.0,
        };
        let answer = self.client.clone().project(question).await.map_err(|status| self.failed(&status))?;
        Ok(ProjectionId(answer.into_inner().projection_id))
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
        let question =
            v1::QueryRequest { projection_id: projection.map(|p| p.0), patterns: all(patterns.iter().cloned()) };
        let answer = self.client.clone().query(question).await.map_err(|status| self.failed(&status))?;
        self.records(answer.into_inner().facts)
    }

    /// Ends a projection; false when it had ended before.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn release(&self, projection: ProjectionId) -> Result<bool, CallError> {
        let question = v1::WorldPoolServiceReleaseRequest { projection_id: projection.0 };
        let answer = self.client.clone().release(question).await.map_err(|status| self.failed(&status))?;
        Ok(answer.into_inner().released)
    }

    fn records(&self, facts: Vec<v1::Fact>) -> Result<Vec<FactRecord>, CallError> {
        each(facts, "facts").map_err(|m| CallError::malformed(&self.endpoint, m))
    }

    fn failed(&self, status: &tonic::Status) -> CallError {
        CallError::from_status(&self.endpoint, status)
    }
}
