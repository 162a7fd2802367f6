//! The client of a process manager.

use super::{CallError, Channels};
use crate::endpoint::Endpoint;
use crate::trace::Traced;
use ratn_proto::convert::required;
use ratn_proto::types::{HostPools, PoolStatus, Scale, WorkerStatus};
use ratn_proto::v1;
use ratn_proto::v1::process_service_client::ProcessServiceClient;
use tonic::Streaming;

/// A client of one process manager.
#[derive(Debug, Clone)]
pub struct ProcessClient {
    endpoint: Endpoint,
    client: ProcessServiceClient<Traced>,
}

/// A watch of the workers: first the status of every worker, then every change.
#[derive(Debug)]
pub struct WorkerWatch {
    endpoint: Endpoint,
    stream: Streaming<v1::ProcessServiceWatchResponse>,
}

/// A worker's log, chunk by chunk.
#[derive(Debug)]
pub struct LogPieces {
    endpoint: Endpoint,
    stream: Streaming<v1::ReadLogResponse>,
}

impl ProcessClient {
    /// The client of the process manager at `endpoint`.
    ///
    /// # Errors
    /// As [`Channels::get`].
    pub fn new(channels: &Channels, endpoint: &Endpoint) -> Result<ProcessClient, CallError> {
        let client = ProcessServiceClient::new(channels.get(endpoint)?);
        Ok(ProcessClient { endpoint: endpoint.clone(), client })
    }

    /// The host with its pools.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn pools(&self) -> Result<HostPools, CallError> {
        let answer = self.client.clone().list_pools(v1::ListPoolsRequest {}).await;
        let answer = answer.map_err(|status| self.failed(&status))?.into_inner();
        answer.try_into().map_err(|m| CallError::malformed(&self.endpoint, m))
    }

    /// Starts `count` workers of a template; returns their ids.
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

    /// Replaces the workers of a template, each once its successor is ready; returns the ids of the workers to be replaced.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn restart_template(&self, template: &str) -> Result<Vec<String>, CallError> {
        self.restart(v1::restart_request::Target::Template(template.to_owned())).await
    }

    /// Replaces a worker once its successor is ready; returns the ids of the workers to be replaced.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn restart_worker(&self, worker: &str) -> Result<Vec<String>, CallError> {
        self.restart(v1::restart_request::Target::WorkerId(worker.to_owned())).await
    }

    async fn restart(&self, target: v1::restart_request::Target) -> Result<Vec<String>, CallError> {
        let question = v1::RestartRequest { target: Some(target) };
        let answer = self.client.clone().restart(question).await.map_err(|status| self.failed(&status))?;
        Ok(answer.into_inner().worker_ids)
    }

    /// Changes the number of workers of a template; returns the pool's new status.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn scale(&self, template: &str, scale: Scale) -> Result<PoolStatus, CallError> {
        let Scale { min, max, spares } = scale;
        let question = v1::ScaleRequest { template: template.to_owned(), min, max, spares };
        let answer = self.client.clone().scale(question).await.map_err(|status| self.failed(&status))?;
        required(answer.into_inner().pool, "pool").map_err(|m| CallError::malformed(&self.endpoint, m))
    }

    /// Starts draining the host (it takes no new work), or ends that; returns the ids of the workers that are still there.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn drain(&self, draining: bool) -> Result<Vec<String>, CallError> {
        let question = v1::DrainRequest { undo: !draining };
        let answer = self.client.clone().drain(question).await.map_err(|status| self.failed(&status))?;
        Ok(answer.into_inner().worker_ids)
    }

    /// The output of a worker so far; with `follow` also later output until the worker ends.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn log(&self, worker: &str, follow: bool) -> Result<LogPieces, CallError> {
        let question = v1::ReadLogRequest { worker_id: worker.to_owned(), follow };
        let answer = self.client.clone().read_log(question).await;
        let stream = answer.map_err(|status| self.failed(&status))?.into_inner();
        Ok(LogPieces { endpoint: self.endpoint.clone(), stream })
    }

    /// Watches every worker.
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
    /// [`CallError`] if the watch broke.
    pub async fn next(&mut self) -> Result<Option<WorkerStatus>, CallError> {
        let message = self.stream.message().await.map_err(|s| CallError::from_status(&self.endpoint, &s))?;
        let Some(message) = message else { return Ok(None) };
        let worker = required(message.worker, "worker").map_err(|m| CallError::malformed(&self.endpoint, m))?;
        Ok(Some(worker))
    }
}

impl LogPieces {
    /// The next chunk; `None` at the end of the log.
    ///
    /// # Errors
    /// [`CallError`] if the stream broke.
    pub async fn next(&mut self) -> Result<Option<Vec<u8>>, CallError> {
        let message = self.stream.message().await.map_err(|s| CallError::from_status(&self.endpoint, &s))?;
        Ok(message.map(|message| message.chunk))
    }
}
