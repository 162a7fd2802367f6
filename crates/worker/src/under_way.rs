//! An admitted call, until the last byte of its answer has been sent, the caller has gone, or the caller has lost a permission that it was
//! admitted with.
//!
//! ```text
//!   admitted ──▶ performed ──▶ answered ──▶ over
//!                    └──────────────┴─ roles have changed, Caller::goes_on refuses ──▶ dropped; the caller gets the refusal
//! ```
//! The part of an answer that the connection has not taken yet counts for its caller ([`Gate::unread`]), and the connection is closed if its client
//! takes none for long. An answer whose first part is ready is encoded at once, so that the number of waiting bytes is known.
//!
//! A call that is dropped because of a lost permission ends as if its client had gone away: an acquire leaves the queue, a goal has its
//! grace.

use crate::access::Caller;
use crate::connections::{InUse, Link, Waits};
use crate::gate::{Gate, Identity, Permit};
use bytes::Bytes;
use http_body::{Body as _, Frame, SizeHint};
use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use tokio::sync::watch;
use tokio_util::task::task_tracker::TaskTrackerToken;
use tonic::Status;
use tonic::body::Body;
use tonic::codegen::http;

/// Guards that live as long as a call is under way.
pub(crate) struct Held {
    pub(crate) _call: Option<TaskTrackerToken>,
    pub(crate) _permit: Option<Permit>,
    pub(crate) _in_use: Option<InUse>,
    pub(crate) revocation: Option<Revocation>,
    pub(crate) unread: Unread,
}

/// The caller whose answer waits to be read, its connection, and the gate that counts its bytes.
pub(crate) struct Unread {
    gate: Arc<dyn Gate>,
    caller: Caller,
    link: Option<Link>,
}

impl Unread {
    pub(crate) fn of(gate: Arc<dyn Gate>, caller: Caller, link: Option<Link>) -> Unread {
        Unread { gate, caller, link }
    }

    /// Counts a part of the answer until the connection has written all of it.
    fn counted(&self, part: Frame<Bytes>) -> Result<Frame<Bytes>, Status> {
        let bytes = match part.into_data() {
            Ok(bytes) if !bytes.is_empty() => bytes,
            Ok(bytes) => return Ok(Frame::data(bytes)),
            Err(other) => return Ok(other),
        };
        Ok(Frame::data(match self.gate.unread(&self.caller, bytes.len())? {
            None => bytes,
            Some(permit) => {
                let waits = self.link.as_ref().map(Link::waits);
                Bytes::from_owner(Counted { bytes, _permit: permit, _waits: waits })
            }
        }))
    }
}

/// Bytes that are counted as long as any slice of them lives.
struct Counted {
    bytes: Bytes,
    _permit: Permit,
    _waits: Option<Waits>,
}

impl AsRef<[u8]> for Counted {
    fn as_ref(&self) -> &[u8] {
        &self.bytes
    }
}

/// Resolves when a call's caller has lost a permission that it was admitted with.
pub(crate) struct Revocation(Pin<Box<dyn Future<Output = Status> + Send>>);

impl Revocation {
    /// For a call to `path` that was admitted for the caller `then`. `changes` was subscribed before `then` was determined.
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
    /// Waits for `answering`; the error is the revocation, if that comes first.
    pub(crate) async fn until<T>(&mut self, answering: impl Future<Output = T>) -> Result<T, Status> {
        let Some(revocation) = &mut self.revocation else { return Ok(answering.await) };
        tokio::select! {
            biased;
            answered = answering => Ok(answered),
            lost = std::future::poll_fn(|context| revocation.poll_lost(context)) => Err(lost),
        }
    }
}

/// The body of the answer to a call. The connection asks for a part when it has begun to send the one before.
pub(crate) struct Answer {
    body: Body,
    /// The part that was encoded before the connection asked for any.
    first: Option<Result<Frame<Bytes>, Status>>,
    /// Ends the answer in place of its first part.
    refused: Option<Status>,
    /// `None` after the call was ended early.
    held: Option<Held>,
}

impl Answer {
    /// Begins an answer; if its first part is ready, the part is encoded. An answer whose first part is refused ends with the refusal.
    pub(crate) async fn begin(mut body: Body, held: Held) -> Answer {
        let first = std::future::poll_fn(|context| match Pin::new(&mut body).poll_frame(context) {
            Poll::Ready(first) => Poll::Ready(Some(first)),
            Poll::Pending => Poll::Ready(None),
        });
        let (first, refused) = match first.await {
            Some(Some(Ok(first))) => match held.unread.counted(first) {
                Ok(first) => (Some(Ok(first)), None),
                Err(refused) => (None, Some(refused)),
            },
            Some(Some(Err(error))) => (Some(Err(error)), None),
            // The body is empty, and is not polled again.
            Some(None) => {
                body = Body::empty();
                (None, None)
            }
            None => (None, None),
        };
        Answer { body, first, refused, held: Some(held) }
    }

    /// The refusal of its first part.
    pub(crate) fn refusal(&self) -> Option<&Status> {
        self.refused.as_ref()
    }

    /// Ends the answer with this status.
    fn end(&mut self, with: &Status) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        (self.held, self.first, self.body) = (None, None, Body::empty());
        let mut trailers = http::HeaderMap::new();
        Poll::Ready(Some(with.add_header(&mut trailers).map(|()| Frame::trailers(trailers))))
    }
}

impl http_body::Body for Answer {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        let Some(held) = &mut self.held else { return Poll::Ready(None) };
        if let Some(Poll::Ready(lost)) = held.revocation.as_mut().map(|revocation| revocation.poll_lost(context)) {
            return self.end(&lost);
        }
        if let Some(refused) = self.refused.take() {
            return self.end(&refused);
        }
        if let Some(first) = self.first.take() {
            return Poll::Ready(Some(first));
        }
        let part = match Pin::new(&mut self.body).poll_frame(context) {
            Poll::Ready(Some(Ok(part))) => part,
            other => return other,
        };
        match self.held.as_ref().map(|held| held.unread.counted(part)) {
            None => Poll::Ready(None),
            Some(Ok(part)) => Poll::Ready(Some(Ok(part))),
            Some(Err(refused)) => self.end(&refused),
        }
    }

    fn is_end_stream(&self) -> bool {
        self.held.is_none() || (self.first.is_none() && self.refused.is_none() && self.body.is_end_stream())
    }

    fn size_hint(&self) -> SizeHint {
        if self.first.is_none() && self.refused.is_none() { self.body.size_hint() } else { SizeHint::default() }
    }
}
