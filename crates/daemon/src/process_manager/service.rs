//! gRPC in front of the actor.

use super::actor::{Handle, Message};
use super::status;
use crate::details::{ending, retry_later};
use futures::{Stream, StreamExt};
use ratn_proto::convert::{all, name};
use ratn_proto::v1;
use std::pin::Pin;
use std::time::Duration;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::{Code, Request, Response, Status};

/// The service; clones share the actor.
#[derive(Debug, Clone)]
pub(super) struct Service {
    pub(super) actor: Handle,
    pub(super) host: String,
    pub(super) shutdown: CancellationToken,
}

#[tonic::async_trait]
impl v1::process_service_server::ProcessService for Service {
    type WatchStream = Pin<Box<dyn Stream<Item = Result<v1::ProcessServiceWatchResponse, Status>> + Send>>;

    async fn list_pools(&self, _: Request<v1::ListPoolsRequest>) -> Result<Response<v1::ListPoolsResponse>, Status> {
        let pools = self.actor.ask(|answer| Message::List { answer }).await?;
        Ok(Response::new(v1::ListPoolsResponse { host: self.host.clone(), pools: all(pools) }))
    }

    async fn spawn(&self, request: Request<v1::SpawnRequest>) -> Result<Response<v1::SpawnResponse>, Status> {
        let v1::SpawnRequest { template, count } = request.into_inner();
        name(&template, "template")?;
        if count == 0 {
            return Err(crate::details::status(
                Code::InvalidArgument,
                "MALFORMED",
                "count: is 0: it must be at least 1",
            ));
        }
        let spawned = self.actor.ask(|answer| Message::Spawn { template, count, answer }).await?;
        let worker_ids = spawned.map_err(|error| status::of_error(&error))?;
        Ok(Response::new(v1::SpawnResponse { worker_ids }))
    }

    async fn stop(&self, request: Request<v1::StopRequest>) -> Result<Response<v1::StopResponse>, Status> {
        let id = request.into_inner().worker_id;
        name(&id, "worker_id")?;
        let stopped = self.actor.ask(|answer| Message::Stop { id, answer }).await?;
        stopped.map_err(|error| status::of_error(&error))?;
        Ok(Response::new(v1::StopResponse {}))
    }

    async fn watch(&self, _: Request<v1::ProcessServiceWatchRequest>) -> Result<Response<Self::WatchStream>, Status> {
        let Some(updates) = self.actor.ask(|answer| Message::Watch { answer }).await? else {
            let message = "too many clients watch already";
            return Err(retry_later(Code::ResourceExhausted, "TOO_MANY", message, Duration::from_secs(1)));
        };
        let updates = ReceiverStream::new(updates)
            .map(|worker| Ok(v1::ProcessServiceWatchResponse { worker: Some(worker.into()) }));
        let last = futures::stream::once(async { Err(ending()) });
        let stream = updates.take_until(self.shutdown.clone().cancelled_owned()).chain(last);
        Ok(Response::new(Box::pin(stream)))
    }
}
