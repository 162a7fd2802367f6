//! The gRPC service in front of the actor.

use super::actor::{Handle, Message};
use super::log_file::{LogReader, log_file};
use super::pools::Restart;
use super::{log_stream, status};
use crate::access::Caller;
use crate::audit::{self, Mutation};
use crate::details::{ending, retry_later};
use futures::{Stream, StreamExt};
use ratn_proto::convert::name;
use ratn_proto::types::Scale;
use ratn_proto::v1;
use ratn_worker::runtime_directory::RuntimeDirectory;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::Semaphore;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::{Code, Request, Response, Status};

/// Maximum number of logs that are read at the same time.
const MAX_LOG_READERS: usize = 64;

/// The service; clones share the actor.
#[derive(Debug, Clone)]
pub(super) struct Service {
    actor: Handle,
    directory: RuntimeDirectory,
    log_readers: Arc<Semaphore>,
    shutdown: CancellationToken,
}

impl Service {
    pub(super) fn new(actor: Handle, directory: RuntimeDirectory, shutdown: CancellationToken) -> Service {
        Service { actor, directory, log_readers: Arc::new(Semaphore::new(MAX_LOG_READERS)), shutdown }
    }
}

#[tonic::async_trait]
impl v1::process_service_server::ProcessService for Service {
    type ReadLogStream = Pin<Box<dyn Stream<Item = Result<v1::ReadLogResponse, Status>> + Send>>;
    type WatchStream = Pin<Box<dyn Stream<Item = Result<v1::ProcessServiceWatchResponse, Status>> + Send>>;

    async fn list_pools(&self, _: Request<v1::ListPoolsRequest>) -> Result<Response<v1::ListPoolsResponse>, Status> {
        let pools = self.actor.ask(|answer| Message::List { answer }).await?;
        Ok(Response::new(pools.into()))
    }

    async fn spawn(&self, request: Request<v1::SpawnRequest>) -> Result<Response<v1::SpawnResponse>, Status> {
        let caller = Caller::of(&request);
        let v1::SpawnRequest { template, count } = request.into_inner();
        name(&template, "template")?;
        if count == 0 {
            return Err(crate::details::status(
                Code::InvalidArgument,
                "MALFORMED",
                "count: is 0: it must be at least 1",
            ));
        }
        let pending = audit::begin(&caller, "", || Mutation::Spawn { template: template.clone(), count });
        let spawned = self.actor.ask(|answer| Message::Spawn { template, count, answer }).await?;
        let spawned = spawned.map_err(|error| status::of_error(&error));
        pending.ended(&spawned);
        let worker_ids = spawned?;
        Ok(Response::new(v1::SpawnResponse { worker_ids }))
    }

    async fn stop(&self, request: Request<v1::StopRequest>) -> Result<Response<v1::StopResponse>, Status> {
        let (caller, id) = (Caller::of(&request), request.into_inner().worker_id);
        name(&id, "worker_id")?;
        let pending = audit::begin(&caller, "", || Mutation::Stop { worker: id.clone() });
        let stopped = self.actor.ask(|answer| Message::Stop { id, answer }).await?;
        let stopped = stopped.map_err(|error| status::of_error(&error));
        pending.ended(&stopped);
        stopped?;
        Ok(Response::new(v1::StopResponse {}))
    }

    async fn restart(&self, request: Request<v1::RestartRequest>) -> Result<Response<v1::RestartResponse>, Status> {
        use v1::restart_request::Target;
        let caller = Caller::of(&request);
        let which = match request.into_inner().target {
            Some(Target::Template(template)) => {
                name(&template, "template")?;
                Restart::Template(template)
            }
            Some(Target::WorkerId(id)) => {
                name(&id, "worker_id")?;
                Restart::Worker(id)
            }
            None => {
                let message = "target: is not set: a template or a worker";
                return Err(crate::details::status(Code::InvalidArgument, "MALFORMED", message));
            }
        };
        let target = |which: &Restart| match which {
            Restart::Template(template) => template.clone(),
            Restart::Worker(worker) => worker.clone(),
        };
        let pending = audit::begin(&caller, "", || Mutation::Restart { target: target(&which) });
        let restarted = self.actor.ask(|answer| Message::Restart { which, answer }).await?;
        let restarted = restarted.map_err(|error| status::of_error(&error));
        pending.ended(&restarted);
        let worker_ids = restarted?;
        Ok(Response::new(v1::RestartResponse { worker_ids }))
    }

    async fn scale(&self, request: Request<v1::ScaleRequest>) -> Result<Response<v1::ScaleResponse>, Status> {
        let caller = Caller::of(&request);
        let v1::ScaleRequest { template, min, max, spares } = request.into_inner();
        name(&template, "template")?;
        let scale = || Mutation::Scale { template: template.clone(), min, max, spares };
        let pending = audit::begin(&caller, "", scale);
        let scale = Scale { min, max, spares };
        let scaled = self.actor.ask(|answer| Message::Scale { template, scale, answer }).await?;
        let scaled = scaled.map_err(|error| status::of_error(&error));
        pending.ended(&scaled);
        let pool = scaled?;
        Ok(Response::new(v1::ScaleResponse { pool: Some(pool.into()) }))
    }

    async fn drain(&self, request: Request<v1::DrainRequest>) -> Result<Response<v1::DrainResponse>, Status> {
        let caller = Caller::of(&request);
        let draining = !request.into_inner().undo;
        let pending = audit::begin(&caller, "", || Mutation::Drain { undo: !draining });
        let left = self.actor.ask(|answer| Message::Drain { draining, answer }).await?;
        let left = left.map_err(|error| {
            let message = format!("nothing has changed: it cannot be written to the runtime directory: {error}");
            crate::details::status(Code::Internal, "NOT_WRITTEN", message)
        });
        pending.ended(&left);
        let worker_ids = left?;
        Ok(Response::new(v1::DrainResponse { worker_ids }))
    }

    async fn read_log(&self, request: Request<v1::ReadLogRequest>) -> Result<Response<Self::ReadLogStream>, Status> {
        let v1::ReadLogRequest { worker_id: id, follow } = request.into_inner();
        name(&id, "worker_id")?;
        let Ok(place) = self.log_readers.clone().try_acquire_owned() else {
            let message = "too many clients read logs already";
            return Err(retry_later(Code::ResourceExhausted, "TOO_MANY", message, Duration::from_secs(1)));
        };
        // The id becomes part of a file name.
        let reader = (!id.contains('/')).then(|| LogReader::open(&log_file(&self.directory, &id)).ok()).flatten();
        let Some(reader) = reader else {
            let message = format!("there is no log of a worker `{id}`; the logs of the last that ended are kept");
            return Err(crate::details::status(Code::NotFound, "LOG_UNKNOWN", message));
        };
        let actor = self.actor.clone();
        let lives = move || {
            let (actor, id) = (actor.clone(), id.clone());
            async move { actor.ask(|answer| Message::Lives { id, answer }).await.unwrap_or(false) }
        };
        let pieces = ReceiverStream::new(log_stream::send(reader, follow.then_some(lives), place));
        Ok(Response::new(Box::pin(pieces.take_until(self.shutdown.clone().cancelled_owned()))))
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
