//! The client of a process manager.

use super::{CallError, Channels};
use crate::endpoint::Endpoint;
use crate::trace::Traced;
use ratn_proto::convert::{each, required};
use ratn_proto::types::{PoolStatus, WorkerStatus};
use ratn_proto::v1;
use ratn_proto::v1::process_service_client::ProcessServiceClient;
use tonic::Streaming;

/// Asks one process manager.
#[derive(Debug, Clone)]
pub struct ProcessClient {
    endpoint: Endpoint,
    client: ProcessServiceClient<Traced>,
}

/// Every worker as it is, then every change.
#[derive(Debug)]
pub struct WorkerWatch {
    endpoint: Endpoint,
    stream: Streaming<v1::ProcessServiceWatchResponse>,
}

impl ProcessClient {
    /// The client of the process manager at `endpoint`.
    ///
    /// # Errors
    /// As [`Channels::get`].
    pub fn new(channels: &Channels, endpoint: &Endpoint) -> Result<ProcessClient, CallError> {
        let client = ProcessServiceClient::new(channels.traced(endpoint)?);
        Ok(ProcessClient { endpoint: endpoint.clone(), client })
    }

    /// The host's name and its pools.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn pools(&self) -> Result<(String, Vec<PoolStatus>), CallError> {
        let answer = self.client.clone().list_pools(v1::ListPoolsRequest {}).await;
        let answer = answer.map_err(|status| self.failed(&status))?.into_inner();
        let pools = each(answer.pools, "pools").map_err(|m| CallError::malformed(&self.endpoint, m))?;
        Ok((answer.host, pools))
    }

    /// Starts `count` workers of a template; their ids.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn spawn(&self, template: &str, count: u32) -> Result<Vec<String>, CallError> {
        let question = v1::SpawnRequest { template: template.to_owned(), count };
        let answer = self.client.clone().spawn(question).await.map_err(|status| self.failed(&status))?;
        Ok(answer.into_inner().worker_ids)
    }

    /// Ends a worker.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn stop(&self, worker: &str) -> Result<(), CallError> {
        let question = v1::StopRequest { worker_id: worker.to_owned() };
        self.client.clone().stop(question).await.map_err(|status| self.failed(&status))?;
        Ok(())
    }

    /// Tells of every worker and every change.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn watch(&self) -> Result<WorkerWatch, CallError> {
        let answer = self.client.clone().watch(v1::ProcessServiceWatchRequest {}).await;
        let stream = answer.map_err(|status| self.failed(&status))?.into_inner();
        Ok(WorkerWatch { endpoint: self.endpoint.clone(), stream })
    }

    fn failed(&self, status: &tonic::Status) -> CallError {
        CallError::from_status(&self.endpoint, status)
    }
}

impl WorkerWatch {
    /// The next change; `None` when the manager ends the watch.
    ///
    /// # Errors
    /// [`CallError`] when it broke.
    pub async fn next(&mut self) -> Result<Option<WorkerStatus>, CallError> {
        let message = self.stream.message().await.map_err(|s| CallError::from_status(&self.endpoint, &s))?;
        let Some(message) = message else { return Ok(None) };
        let worker = required(message.worker, "worker").map_err(|m| CallError::malformed(&self.endpoint, m))?;
        Ok(Some(worker))
    }
}
