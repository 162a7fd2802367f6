//! The calls that come over one stream ([`ratn_worker::multiplex`]): each is admitted and counted like a separate call of the stream's
//! caller.

use crate::access::Caller;
use crate::details::retry_later;
use crate::metrics::Metrics;
use crate::quota::Quotas;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tonic::{Code, Status};

/// Retry delay after a refusal because of too many calls.
const RETRY_DELAY: Duration = Duration::from_millis(10);

/// Reason code of a refusal because of too many calls.
const TOO_MANY: &str = "TOO_MANY";

/// The caller of a stream, and where its calls are counted.
#[derive(Debug, Clone)]
pub(crate) struct StreamCaller {
    pub(crate) caller: Caller,
    /// The quotas for which its calls count; `None` where the server has no quotas.
    pub(crate) quotas: Option<Quotas>,
    pub(crate) metrics: Arc<Metrics>,
}

impl StreamCaller {
    /// The caller of a request that opens a stream.
    pub(crate) fn of<T>(request: &tonic::Request<T>, metrics: Arc<Metrics>) -> StreamCaller {
        let quotas = request.extensions().get::<Quotas>().cloned();
        StreamCaller { caller: Caller::of(request), quotas, metrics }
    }

    /// Performs a call to `path`, unless its caller is not allowed to make it or makes too many.
    pub(crate) async fn call<T>(
        self,
        path: &'static str,
        performed: impl Future<Output = Result<T, Status>>,
    ) -> Result<T, Status> {
        let StreamCaller { caller, quotas, metrics } = self;
        let began = Instant::now();
        let admitted = async {
            caller.admit(path)?;
            let _permit = quotas.map(|quotas| quotas.admit(&caller, path, began)).transpose()?;
            performed.await
        };
        let answered = admitted.await;
        let code = answered.as_ref().map_or_else(Status::code, |_| Code::Ok);
        metrics.call(path, code, began.elapsed());
        answered
    }

    /// The answer to a call where `most` are in progress on the stream.
    pub(crate) fn too_many(&self, most: usize) -> Status {
        self.metrics.refused("call", TOO_MANY.to_owned());
        let message = format!("{most} calls are under way on this stream: wait for answers");
        retry_later(Code::ResourceExhausted, TOO_MANY, message, RETRY_DELAY)
    }
}
