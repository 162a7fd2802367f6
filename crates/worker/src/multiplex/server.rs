//! The server side: polling the stream of answers drives everything. It takes requests from the connection, keeps the calls under way and
//! hands out their answers, all in the connection's task, so that a call needs no switch between tasks.
//!
//! Dropping the stream drops the calls under way. No requests are read from a client that does not read its answers. When the process
//! drains, no more requests are taken; calls under way are answered, then the stream ends with [`ending`]. After a request that is too
//! large, the stream ends in the same way, with that error.

use super::Protocol;
use crate::gate::ending;
use crate::trace::{self, Answering, TraceContext};
use futures::FutureExt;
use futures::stream::{AbortHandle, Abortable, BoxStream, SelectAll, Stream, StreamExt, abortable};
use std::collections::BTreeMap;
use std::pin::Pin;
use std::task::{Context, Poll};
use tokio_util::sync::{CancellationToken, WaitForCancellationFutureOwned};
use tonic::{Code, Status, Streaming};

/// Maximum number of requests taken before answers get their turn.
const AT_ONCE: usize = 64;

/// The answers to one call; the last one ends the call, as does an error.
pub type CallAnswers<P> = BoxStream<'static, Result<<P as Protocol>::Answer, Status>>;

/// Performs the calls of a stream.
pub trait Serve<P: Protocol>: Send + Unpin + 'static {
    /// Maximum number of calls under way on one stream; further ones are refused.
    const MAX_CALLS: usize;

    /// Begins a call, in this trace. `None` is an empty request.
    fn begin(&mut self, call: Option<P::Call>, context: Option<TraceContext>) -> CallAnswers<P>;

    /// The last answer of a call is about to be sent.
    fn answered(&mut self, _id: u64, _answer: &Result<P::Answer, Status>) {}

    /// Performs a call that ends another one. `end` ends that other call, and returns whether it was under way; if it was not, its answer
    /// may still be unread. `None`: no answer is sent.
    fn end(&mut self, ended: u64, by: P::Call, end: impl FnOnce() -> bool) -> Option<Result<P::Answer, Status>>;

    /// The answer to a call beyond [`Serve::MAX_CALLS`].
    fn too_many(&self) -> Status;
}

/// The answers of one stream.
pub struct Answers<P: Protocol, S> {
    serve: S,
    requests: Option<Streaming<P::Request>>,
    calls: SelectAll<Call<P>>,
    under_way: usize,
    /// Handles that end calls early, by id. Calls with the id 0 need not be told apart.
    by_id: BTreeMap<u64, AbortHandle>,
    draining: Option<Pin<Box<WaitForCancellationFutureOwned>>>,
    /// The status with which the stream ends when all calls under way are answered.
    ends_with: Option<Status>,
}

/// A call under way.
struct Call<P: Protocol> {
    id: u64,
    answers: Abortable<CallAnswers<P>>,
    /// Ends with the last answer.
    span: Option<Answering>,
}

impl<P: Protocol, S: Serve<P>> Answers<P, S> {
    /// Serves the requests of a client until there are no more, or the process drains.
    pub fn new(serve: S, requests: Streaming<P::Request>, draining: Option<CancellationToken>) -> Answers<P, S> {
        Answers {
            serve,
            requests: Some(requests),
            calls: SelectAll::new(),
            under_way: 0,
            by_id: BTreeMap::new(),
            draining: draining.map(|draining| Box::pin(draining.cancelled_owned())),
            ends_with: None,
        }
    }

    /// Begins the requested call, or returns an immediate answer with its id.
    fn take(&mut self, request: P::Request) -> Option<(u64, Result<P::Answer, Status>)> {
        let (id, call, traceparent) = P::parts(request);
        let call = match call.map(|call| (P::ends_call(id, &call), call)) {
            Some((Some(ended), by)) => {
                let (by_id, under_way) = (&mut self.by_id, &mut self.under_way);
                let end = || {
                    let call = by_id.remove(&ended);
                    *under_way -= usize::from(call.is_some());
                    call.map(|call| call.abort()).is_some()
                };
                return self.serve.end(ended, by, end).map(|answer| (id, answer));
            }
            other => other.map(|(_, call)| call),
        };
        if self.by_id.contains_key(&id) {
            return Some((id, Err(Status::invalid_argument(format!("id: {id} is that of a call under way")))));
        }
        if self.under_way >= S::MAX_CALLS {
            return Some((id, Err(self.serve.too_many())));
        }
        let caller = traceparent.parse::<TraceContext>().ok();
        let own = caller.map(TraceContext::child);
        let traced = caller.zip(own).zip(call.as_ref());
        let span = traced.and_then(|((caller, own), call)| trace::answering(P::path(call), caller, own));
        let (answers, abort) = abortable(self.serve.begin(call, own));
        self.calls.push(Call { id, answers, span });
        self.under_way += 1;
        if id != 0 {
            self.by_id.insert(id, abort);
        }
        None
    }

    fn poll_drain(&mut self, context: &mut Context<'_>) {
        if self.draining.as_mut().is_some_and(|draining| draining.poll_unpin(context).is_ready()) {
            (self.draining, self.requests) = (None, None);
            self.ends_with.get_or_insert_with(ending);
        }
    }
}

impl<P: Protocol, S: Serve<P>> Stream for Answers<P, S> {
    type Item = Result<P::Response, Status>;

    fn poll_next(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        let this = self.get_mut();
        this.poll_drain(context);
        for turn in 0..=AT_ONCE {
            let Some(requests) = &mut this.requests else { break };
            if turn == AT_ONCE {
                context.waker().wake_by_ref();
                break;
            }
            let request = requests.poll_next_unpin(context);
            match request {
                Poll::Ready(Some(Ok(request))) => {
                    if let Some((id, answer)) = this.take(request) {
                        return Poll::Ready(Some(Ok(P::response(id, answer))));
                    }
                }
                // The client sends no more requests; calls under way are still answered.
                Poll::Ready(None) => this.requests = None,
                // A request is too large: no further one is read, and calls under way are still answered.
                Poll::Ready(Some(Err(status))) if status.code() == Code::OutOfRange => {
                    this.requests = None;
                    this.ends_with.get_or_insert(status);
                }
                // The client is usually gone and reads no answer.
                Poll::Ready(Some(Err(status))) => return Poll::Ready(Some(Err(status))),
                Poll::Pending => break,
            }
        }
        match this.calls.poll_next_unpin(context) {
            Poll::Ready(Some((id, answer))) => {
                if answer.as_ref().map_or(true, P::is_last) {
                    this.by_id.remove(&id);
                    this.under_way -= 1;
                    this.serve.answered(id, &answer);
                }
                Poll::Ready(Some(Ok(P::response(id, answer))))
            }
            Poll::Ready(None) if this.requests.is_none() => Poll::Ready(this.ends_with.take().map(Err)),
            Poll::Ready(None) | Poll::Pending => Poll::Pending,
        }
    }
}

impl<P: Protocol> Stream for Call<P> {
    type Item = (u64, Result<P::Answer, Status>);

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        let id = self.id;
        let answer = self.answers.poll_next_unpin(context);
        if let (Some(span), Poll::Ready(Some(answer))) = (&mut self.span, &answer)
            && answer.as_ref().map_or(true, P::is_last)
        {
            span.ended(answer.as_ref().map_or_else(Status::code, |_| Code::Ok));
            self.span = None;
        }
        answer.map(|answer| answer.map(|answer| (id, answer)))
    }
}

impl<P: Protocol, S> std::fmt::Debug for Answers<P, S> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Answers").field("under_way", &self.under_way).finish_non_exhaustive()
    }
}
