//! A call that was let in, until the last byte of its answer has been sent, nobody wants it any more, or its caller has lost what it
//! was let in with.
//!
//! ```text
//!   admitted ──▶ performed ──▶ answered ──▶ over
//!                    └──────────────┴─ roles have changed, Caller::goes_on refuses ──▶ dropped; the caller gets the refusal
//! ```
//! A call that is dropped like this ends as one whose client went away: an acquire leaves the queue, a goal has its grace.

use crate::access::Caller;
use crate::connections::InUse;
use crate::gate::{Gate, Identity, Permit};
use http_body::{Frame, SizeHint};
use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use tokio::sync::watch;
use tokio_util::task::task_tracker::TaskTrackerToken;
use tonic::Status;
use tonic::body::Body;
use tonic::codegen::http;

/// What lasts as long as a call is under way.
pub(crate) struct Held {
    pub(crate) _call: Option<TaskTrackerToken>,
    pub(crate) _permit: Option<Permit>,
    pub(crate) _in_use: Option<InUse>,
    pub(crate) revocation: Option<Revocation>,
}

/// Says when a call's caller has lost what it was let in with.
pub(crate) struct Revocation(Pin<Box<dyn Future<Output = Status> + Send>>);

impl Revocation {
    /// Of a call to `path` that `then` was let in for. `changes` was there before it was asked who that is.
    pub(crate) fn new(
        gate: Arc<dyn Gate>,
        mut changes: watch::Receiver<()>,
        identity: Identity,
        then: Caller,
        path: http::Uri,
    ) -> Revocation {
        Revocation(Box::pin(async move {
            while changes.changed().await.is_ok() {
                if let Err(lost) = gate.caller(&identity).goes_on(&then, path.path()) {
                    tracing::info!(who = %then, path = path.path(), "a call ends: {}", lost.message());
                    return lost;
                }
            }
            std::future::pending().await
        }))
    }

    fn poll_lost(&mut self, context: &mut Context<'_>) -> Poll<Status> {
        self.0.as_mut().poll(context)
    }
}

impl Held {
    /// Until `answering` is there; why the call ended where that came first.
    pub(crate) async fn until<T>(&mut self, answering: impl Future<Output = T>) -> Result<T, Status> {
        let Some(revocation) = &mut self.revocation else { return Ok(answering.await) };
        tokio::select! {
            biased;
            answered = answering => Ok(answered),
            lost = std::future::poll_fn(|context| revocation.poll_lost(context)) => Err(lost),
        }
    }
}

/// The body of the answer to a call.
pub(crate) struct Answer {
    pub(crate) body: Body,
    /// Nothing once the call has ended before its time.
    pub(crate) held: Option<Held>,
}

impl http_body::Body for Answer {
    type Data = <Body as http_body::Body>::Data;
    type Error = Status;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Self::Data>, Status>>> {
        let Some(held) = &mut self.held else { return Poll::Ready(None) };
        if let Some(Poll::Ready(lost)) = held.revocation.as_mut().map(|revocation| revocation.poll_lost(context)) {
            (self.held, self.body) = (None, Body::empty());
            let mut trailers = http::HeaderMap::new();
            return Poll::Ready(Some(lost.add_header(&mut trailers).map(|()| Frame::trailers(trailers))));
        }
        Pin::new(&mut self.body).poll_frame(context)
    }

    fn is_end_stream(&self) -> bool {
        self.held.is_none() || self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}
