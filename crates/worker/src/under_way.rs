//! An admitted call, until the last byte of its answer has been sent, the caller has gone, or the caller has lost a permission that it was
//! admitted with.
//!
//! ```text
//!   admitted ──▶ performed ──▶ answered ──▶ over
//!                    └──────────────┴─ roles have changed, Caller::goes_on refuses ──▶ dropped; the caller gets the refusal
//! ```
//! The part of an answer that the connection has not taken yet counts for its caller ([`Gate::unread`]), and the connection is closed if its client
//! takes nothing of it for long: a part that counts is passed on in pieces, so that a client that takes a long one slowly is not taken for one that
//! takes nothing. An answer whose first part is ready is encoded at once, so that the number of waiting bytes is known.
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

/// Size of a piece of a part that counts; each that the connection has written says that the client takes something.
const PIECE_BYTES: usize = 64 << 10;

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
    fn counted(&self, part: Frame<Bytes>) -> Result<Part, Status> {
        let bytes = match part.into_data() {
            Ok(bytes) if !bytes.is_empty() => bytes,
            Ok(bytes) => return Ok(Part::Whole(Frame::data(bytes))),
            Err(other) => return Ok(Part::Whole(other)),
        };
        Ok(match self.gate.unread(&self.caller, bytes.len())? {
            None => Part::Whole(Frame::data(bytes)),
            Some(permit) => {
                let waits = self.link.as_ref().map(Link::waits);
                let bytes = Bytes::from_owner(Counted { bytes, _permit: permit, _waits: waits });
                Part::InPieces { bytes, link: self.link.clone() }
            }
        })
    }
}

/// A part of an answer, for the connection.
enum Part {
    Whole(Frame<Bytes>),
    /// Bytes that are counted, without those that were passed on.
    InPieces {
        bytes: Bytes,
        link: Option<Link>,
    },
}

impl Part {
    /// The next piece, and what is left.
    fn next(self) -> (Frame<Bytes>, Option<Part>) {
        match self {
            Part::Whole(part) => (part, None),
            Part::InPieces { mut bytes, link } => {
                let piece = bytes.split_to(bytes.len().min(PIECE_BYTES));
                let piece = Frame::data(Bytes::from_owner(Piece { bytes: piece, link: link.clone() }));
                (piece, (!bytes.is_empty()).then_some(Part::InPieces { bytes, link }))
            }
        }
    }
}

/// A piece of a part that counts, until the connection has written it.
struct Piece {
    bytes: Bytes,
    link: Option<Link>,
}

impl AsRef<[u8]> for Piece {
    fn as_ref(&self) -> &[u8] {
        &self.bytes
    }
}

impl Drop for Piece {
    fn drop(&mut self) {
        self.link.iter().for_each(Link::takes);
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
    first: Option<Result<Part, Status>>,
    /// What is left of a part that was passed on in pieces.
    rest: Option<Part>,
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
        Answer { body, first, rest: None, refused, held: Some(held) }
    }

    /// The refusal of its first part.
    pub(crate) fn refusal(&self) -> Option<&Status> {
        self.refused.as_ref()
    }

    /// Whether what comes next comes from the body.
    fn has_only_its_body(&self) -> bool {
        self.first.is_none() && self.rest.is_none() && self.refused.is_none()
    }

    /// Passes a part on, or its first piece.
    fn pass(&mut self, part: Part) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        let (piece, rest) = part.next();
        self.rest = rest;
        Poll::Ready(Some(Ok(piece)))
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
        // A message that has begun is passed on to its end.
        if let Some(rest) = self.rest.take() {
            return self.pass(rest);
        }
        let Some(held) = &mut self.held else { return Poll::Ready(None) };
        if let Some(Poll::Ready(lost)) = held.revocation.as_mut().map(|revocation| revocation.poll_lost(context)) {
            return self.end(&lost);
        }
        if let Some(refused) = self.refused.take() {
            return self.end(&refused);
        }
        match self.first.take() {
            Some(Ok(first)) => return self.pass(first),
            Some(Err(error)) => return Poll::Ready(Some(Err(error))),
            None => {}
        }
        let part = match Pin::new(&mut self.body).poll_frame(context) {
            Poll::Ready(Some(Ok(part))) => part,
            other => return other,
        };
        match self.held.as_ref().map(|held| held.unread.counted(part)) {
            None => Poll::Ready(None),
            Some(Ok(part)) => self.pass(part),
            Some(Err(refused)) => self.end(&refused),
        }
    }

    fn is_end_stream(&self) -> bool {
        self.held.is_none() || (self.has_only_its_body() && self.body.is_end_stream())
    }

    fn size_hint(&self) -> SizeHint {
        if self.has_only_its_body() { self.body.size_hint() } else { SizeHint::default() }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use crate::connections::{ConnectionLimits, Connections, Peer};
    use std::time::Duration;
    use tonic::Code;
    use tonic::transport::server::Connected;

    /// Counts everything.
    struct Counts;

    impl Gate for Counts {
        fn caller(&self, _: &Identity) -> Caller {
            Caller::default()
        }

        fn admit(&self, _: &Caller, _: &str, _: &mut http::Extensions) -> Result<(), Status> {
            Ok(())
        }

        fn answered(&self, _: &str, _: Code, _: Duration) {}

        fn unread(&self, _: &Caller, _: usize) -> Result<Option<Permit>, Status> {
            Ok(Some(Permit::new(())))
        }
    }

    /// A body of one part.
    struct One(Option<Bytes>);

    impl http_body::Body for One {
        type Data = Bytes;
        type Error = Status;

        fn poll_frame(mut self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
            Poll::Ready(self.0.take().map(|bytes| Ok(Frame::data(bytes))))
        }
    }

    #[tokio::test]
    async fn who_takes_a_piece_of_a_long_message_has_as_long_again_for_the_rest_and_gets_all_of_it() {
        let connections = Connections::new(ConnectionLimits::default());
        let (near, _far) = tokio::io::duplex(1);
        let connection = connections.accept(near, Peer::of_host(None)).unwrap();
        let link = connection.connect_info().link;
        let sent: Bytes = (0..3 * PIECE_BYTES + 7).map(|at| (at % 251) as u8).collect();
        let unread = Unread::of(Arc::new(Counts), Caller::default(), Some(link.clone()));
        let held = Held { _call: None, _permit: None, _in_use: None, revocation: None, unread };
        let mut answer = Answer::begin(Body::new(One(Some(sent.clone()))), held).await;
        let (mut taken, mut before) = (Vec::new(), link.unread().unwrap());
        assert_eq!(before.0, 1, "it waits");
        while let Some(piece) = std::future::poll_fn(|context| Pin::new(&mut answer).poll_frame(context)).await {
            let piece = piece.unwrap().into_data().unwrap();
            taken.extend_from_slice(&piece);
            tokio::time::sleep(Duration::from_millis(1)).await;
            assert_eq!(link.unread().unwrap(), before, "it is not written yet");
            drop(piece);
            let now = link.unread().unwrap();
            assert!(now.1 > before.1 && now.0 == usize::from(taken.len() < sent.len()), "{now:?}");
            before = now;
        }
        assert!(taken == sent);
    }
}
