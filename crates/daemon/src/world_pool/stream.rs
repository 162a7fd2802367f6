//! The calls on a client's stream, each handled like a separate call of the stream's caller. If the stream breaks, calls that have reached the
//! actor are still performed: commits and projections can be requested again by the same ids.

use super::service::Service;
use crate::access::Caller;
use crate::details::status;
use crate::stream_calls::StreamCaller;
use futures::StreamExt;
use futures::stream::once;
use ratn_proto::v1::calls_request::Kind as Asked;
use ratn_proto::v1::calls_response::Kind;
use ratn_proto::v1::world_pool_service_server::WorldPoolService;
use ratn_worker::multiplex::server::{CallAnswers, Serve};
use ratn_worker::multiplex::{Protocol, WorldCalls};
use ratn_worker::trace::{self, TraceContext};
use tonic::{Code, Status};
use tracing::Instrument;

/// The path under which an empty request is counted.
const CALLS: &str = "/ratn.v1.WorldPoolService/Calls";

/// Performs the calls of one caller.
#[derive(Debug)]
pub(super) struct CallerService {
    service: Service,
    caller: StreamCaller,
}

impl CallerService {
    pub(super) fn new(service: Service, caller: StreamCaller) -> CallerService {
        CallerService { service, caller }
    }
}

impl Serve<WorldCalls> for CallerService {
    const MAX_CALLS: usize = 4_096;

    fn begin(&mut self, call: Option<Asked>, context: Option<TraceContext>) -> CallAnswers<WorldCalls> {
        let Some(call) = call else {
            let missing = status(Code::InvalidArgument, "MALFORMED", "kind: is missing: set one of the calls");
            return once(self.caller.clone().call(CALLS, std::future::ready(Err(missing)))).boxed();
        };
        let (path, caller) = (WorldCalls::path(&call), self.caller.caller.clone());
        let performed = performed(self.service.clone(), caller, call);
        let counted = self.caller.clone().call(path, performed);
        match context {
            None => once(counted).boxed(),
            Some(context) => once(trace::within(context, counted).instrument(context.entered())).boxed(),
        }
    }

    /// No call of this stream ends another one.
    fn end(&mut self, _: u64, _: Asked, _: impl FnOnce() -> bool) -> Option<Result<Kind, Status>> {
        None
    }

    fn too_many(&self) -> Status {
        self.caller.too_many(Self::MAX_CALLS)
    }
}

async fn performed(service: Service, caller: Caller, call: Asked) -> Result<Kind, Status> {
    Ok(match call {
        Asked::Commit(commit) => Kind::Commit(service.commit(caller.request(commit)).await?.into_inner()),
        Asked::Project(project) => Kind::Project(service.project(caller.request(project)).await?.into_inner()),
        Asked::Release(release) => Kind::Release(service.release(caller.request(release)).await?.into_inner()),
    })
}
