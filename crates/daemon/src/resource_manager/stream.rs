//! A session's stream: many calls over one HTTP/2 stream, each answered when it is.
//!
//! The stream of answers is what is polled: it takes questions from the connection, keeps the calls under way and hands out their
//! answers, all in the connection's task, so that a question costs one hop to the actor and one back. Dropped, it drops the
//! calls under way, which leave the queue as unary calls do. A client that does not read its answers is not read from either.
//! When the manager drains, no more questions are taken; what is under way is answered, then the stream ends.

use super::service::{Service, kept_alive};
use crate::access::{Caller, Operation};
use crate::details::{retry_later, status};
use crate::metrics;
use futures::stream::FuturesUnordered;
use futures::{FutureExt, Stream, StreamExt};
use ratn_proto::v1::resource_service_server::ResourceService;
use ratn_proto::v1::{self, session_request, session_response};
use ratn_worker::trace::{self, TraceContext};
use std::future::Future;
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::{Duration, Instant};
use tokio_util::sync::{CancellationToken, WaitForCancellationFutureOwned};
use tonic::{Code, Status, Streaming};
use tracing::Instrument;

/// Calls under way of one stream; more are refused.
const MAX_CALLS: usize = 4_096;
/// Questions taken in before answers get their turn.
const AT_ONCE: usize = 64;
/// When to ask again after a refusal for their number.
const RETRY_DELAY: Duration = Duration::from_millis(10);

type Call = Pin<Box<dyn Future<Output = v1::SessionResponse> + Send>>;

/// The answers of one stream.
pub(super) struct SessionStream {
    service: Service,
    caller: Caller,
    questions: Option<Streaming<v1::SessionRequest>>,
    calls: FuturesUnordered<Call>,
    shutdown: Pin<Box<WaitForCancellationFutureOwned>>,
    draining: bool,
}

impl SessionStream {
    pub(super) fn new(
        service: Service,
        caller: Caller,
        questions: Streaming<v1::SessionRequest>,
        shutdown: CancellationToken,
    ) -> SessionStream {
        let shutdown = Box::pin(shutdown.cancelled_owned());
        SessionStream {
            service,
            caller,
            questions: Some(questions),
            calls: FuturesUnordered::new(),
            shutdown,
            draining: false,
        }
    }
}

impl Stream for SessionStream {
    type Item = Result<v1::SessionResponse, Status>;

    fn poll_next(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        let this = self.get_mut();
        if !this.draining && this.shutdown.poll_unpin(context).is_ready() {
            this.draining = true;
        }
        let mut may_be_more = true;
        for _ in 0..AT_ONCE {
            let Some(questions) = this.questions.as_mut().filter(|_| !this.draining) else {
                may_be_more = false;
                break;
            };
            match questions.poll_next_unpin(context) {
                Poll::Ready(Some(Ok(question))) if this.calls.len() >= MAX_CALLS => {
                    return Poll::Ready(Some(Ok(answer(question.id, Err(too_many())))));
                }
                Poll::Ready(Some(Ok(question))) => {
                    this.calls.push(call(this.service.clone(), this.caller.clone(), question))
                }
                Poll::Ready(None) => this.questions = None,
                // Nobody is there to read an answer.
                Poll::Ready(Some(Err(_))) => return Poll::Ready(None),
                Poll::Pending => {
                    may_be_more = false;
                    break;
                }
            }
        }
        if may_be_more {
            context.waker().wake_by_ref();
        }
        match this.calls.poll_next_unpin(context) {
            Poll::Ready(Some(answer)) => Poll::Ready(Some(Ok(answer))),
            Poll::Ready(None) if this.draining => Poll::Ready(Some(Err(crate::details::ending()))),
            Poll::Ready(None) if this.questions.is_none() => Poll::Ready(None),
            Poll::Ready(None) | Poll::Pending => Poll::Pending,
        }
    }
}

/// One call, as if it had come on its own, from the stream's caller.
fn call(service: Service, caller: Caller, question: v1::SessionRequest) -> Call {
    use session_request::Kind as Asked;
    use session_response::Kind;
    let id = question.id;
    let context = question.traceparent.parse::<TraceContext>().ok().map(TraceContext::child);
    let called = async move {
        let began = Instant::now();
        let path = match question.kind {
            Some(Asked::Block(_)) => "/ratn.v1.ResourceService/Block",
            Some(Asked::Acquire(_)) => "/ratn.v1.ResourceService/Acquire",
            Some(Asked::Withdraw(_)) => "/ratn.v1.ResourceService/Withdraw",
            Some(Asked::Release(_)) => "/ratn.v1.ResourceService/Release",
            Some(Asked::KeepAlive(_)) | None => "/ratn.v1.ResourceService/KeepAlive",
        };
        if let Err(refused) = caller.admit(Operation::of_path(path)) {
            return answer(id, Err(refused));
        }
        let answered = match question.kind {
            Some(Asked::KeepAlive(ping)) => kept_alive(&service.actor, &caller, ping).await.map(Kind::KeepAlive),
            Some(Asked::Block(block)) => {
                service.block(caller.request(block)).await.map(|lease| Kind::Block(lease.into_inner()))
            }
            Some(Asked::Acquire(acquire)) => {
                service.acquire(caller.request(acquire)).await.map(|lease| Kind::Acquire(lease.into_inner()))
            }
            Some(Asked::Release(release)) => {
                service.release(caller.request(release)).await.map(|ended| Kind::Release(ended.into_inner()))
            }
            Some(Asked::Withdraw(withdraw)) => {
                service.withdraw(caller.request(withdraw)).await.map(|undone| Kind::Withdraw(undone.into_inner()))
            }
            None => Err(status(Code::InvalidArgument, "MALFORMED", "kind: is missing: set one of the calls")),
        };
        if let Some(metrics) = metrics::get() {
            let code = answered.as_ref().map_or_else(Status::code, |_| Code::Ok);
            metrics.call(path, code, began.elapsed());
        }
        answer(id, answered)
    };
    match context {
        None => Box::pin(called),
        Some(context) => Box::pin(trace::within(context, called).instrument(context.entered())),
    }
}

fn answer(id: u64, answered: Result<session_response::Kind, Status>) -> v1::SessionResponse {
    let kind = answered.unwrap_or_else(|status| {
        session_response::Kind::Failure(v1::CallFailure {
            code: status.code().into(),
            message: status.message().to_owned(),
            details: status.details().to_vec(),
        })
    });
    v1::SessionResponse { id, kind: Some(kind) }
}

fn too_many() -> Status {
    let message = format!("{MAX_CALLS} calls are under way on this stream: wait for answers");
    retry_later(Code::ResourceExhausted, "TOO_MANY", message, RETRY_DELAY)
}
