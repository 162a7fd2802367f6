//! Many goals over one stream of a client. Each is treated as if it had come alone, but there is no message that a goal was accepted.

use super::ActionServer;
use super::service::Messages;
use crate::access::Caller;
use crate::multiplex::GoalCalls;
use crate::multiplex::server::{CallAnswers, Serve};
use crate::trace::{self, TraceContext};
use futures::stream::{StreamExt, once, unfold};
use futures::{FutureExt, TryFutureExt};
use ratn_proto::v1::ExecuteRequest;
use ratn_proto::v1::execute_response::Kind as Heard;
use ratn_proto::v1::perform_request::Kind as Asked;
use ratn_proto::v1::perform_response::Kind;
use tonic::Status;
use tracing::Instrument;

/// Takes the goals of one caller.
#[derive(Debug)]
pub struct CallerGoals {
    pub(super) server: ActionServer,
    pub(super) caller: Caller,
}

impl Serve<GoalCalls> for CallerGoals {
    const MAX_CALLS: usize = 1_024;

    fn begin(&mut self, call: Option<Asked>, context: Option<TraceContext>) -> CallAnswers<GoalCalls> {
        let Some(Asked::Execute(execute)) = call else {
            let refused = Status::invalid_argument("kind: is missing: set one of the questions");
            return once(std::future::ready(Err(refused))).boxed();
        };
        let admitted = admitted(self.server.clone(), self.caller.clone(), execute);
        let admitted = match context {
            None => admitted.left_future(),
            Some(context) => trace::within(context, admitted).instrument(context.entered()).right_future(),
        };
        let refused = |refused| once(std::future::ready(Err(refused))).left_stream();
        admitted.map_ok_or_else(refused, |messages| told(messages).right_stream()).flatten_stream().boxed()
    }

    fn end(&mut self, _: u64, _: Asked, end: impl FnOnce() -> bool) -> Option<Result<Kind, Status>> {
        end();
        None
    }

    fn too_many(&self) -> Status {
        let most = <CallerGoals as Serve<GoalCalls>>::MAX_CALLS;
        Status::resource_exhausted(format!("{most} executes are under way on this stream: no more at once"))
    }
}

async fn admitted(server: ActionServer, caller: Caller, execute: ExecuteRequest) -> Result<Messages, Status> {
    server.given(&caller, execute).await
}

/// The messages to a client about a goal, the goal's end as the last.
fn told(messages: Messages) -> impl futures::Stream<Item = Result<Kind, Status>> + Send + 'static {
    unfold(messages, async |mut messages| {
        loop {
            let kind = match messages.next().await? {
                // On this stream the acceptance of a goal is not reported.
                Ok(Heard::Accepted(_)) => continue,
                Ok(Heard::Progress(progress)) => Ok(Kind::Progress(progress)),
                Ok(Heard::Improved(better)) => Ok(Kind::Improved(better)),
                Ok(Heard::Result(result)) => Ok(Kind::Result(result)),
                Err(status) => Err(status),
            };
            return Some((kind, messages));
        }
    })
}
