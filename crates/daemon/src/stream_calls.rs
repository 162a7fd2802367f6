//! The calls that come over one stream ([`ratn_worker::multiplex`]): each is let in and counted as if it had come alone, for the caller of
//! the stream.

use crate::access::Caller;
use crate::details::retry_later;
use crate::metrics::Metrics;
use crate::quota::Quotas;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tonic::{Code, Status};

/// When to ask again after a refusal for the number of calls.
const RETRY_DELAY: Duration = Duration::from_millis(10);

/// The reason of a refusal for the number of calls.
const TOO_MANY: &str = "TOO_MANY";

/// Who calls over a stream, and where its calls are counted.
#[derive(Debug, Clone)]
pub(crate) struct StreamCaller {
    pub(crate) caller: Caller,
    /// What its calls count for; none where the server has no quotas.
    pub(crate) quotas: Option<Quotas>,
    pub(crate) metrics: Arc<Metrics>,
}

impl StreamCaller {
    /// The caller of a request that opens a stream.
    pub(crate) fn of<T>(request: &tonic::Request<T>, metrics: Arc<Metrics>) -> StreamCaller {
        let quotas = request.extensions().get::<Quotas>().cloned();
        StreamCaller { caller: Caller::of(request), quotas, metrics }
    }

    /// Performs a call to `path` unless its caller may not make it, or makes too many.
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

    /// What is answered to a call where `most` are under way on the stream.
    pub(crate) fn too_many(&self, most: usize) -> Status {
        self.metrics.refused("call", TOO_MANY.to_owned());
        let message = format!("{most} calls are under way on this stream: wait for answers");
        retry_later(Code::ResourceExhausted, TOO_MANY, message, RETRY_DELAY)
    }
}
