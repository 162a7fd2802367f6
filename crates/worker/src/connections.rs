//! The connections of a server: how many there are, whose, and how long one may say nothing.
//!
//! ```text
//!   accepted ── first call ──▶ in use ── no call under way ──▶ idle
//!      │ none in FIRST_CALL_DEADLINE                             │ none in IDLE_DEADLINE
//!      └──────────────────────────▶ closed ◀─────────────────────┘
//! ```
//! A handshake that does not end is a connection without a call. Where there are as many as may be, the one that has had no call under way
//! for longest is closed for the new one: who connects and says nothing shuts nobody out. Nobody has more than a share of them in use.

use crate::gate::Identity;
use std::collections::BTreeMap;
use std::convert::Infallible;
use std::io;
use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll};
use std::time::{Duration, Instant};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio_util::sync::{CancellationToken, WaitForCancellationFutureOwned};
use tonic::transport::server::Connected;
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt};

/// Bounds of the connections of a server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ConnectionLimits {
    /// At once, whoever has them.
    pub connections: usize,
    /// Of one caller with calls under way.
    pub of_one_caller: usize,
    /// From being accepted to the first call, the handshake of TLS included.
    pub first_call: Duration,
    /// Without a call under way.
    pub idle: Duration,
}

impl Default for ConnectionLimits {
    fn default() -> ConnectionLimits {
        ConnectionLimits {
            connections: 768,
            of_one_caller: 512,
            first_call: Duration::from_secs(10),
            idle: Duration::from_secs(600),
        }
    }
}

/// How often it is looked for connections whose time is over.
const SWEEP_INTERVAL: Duration = Duration::from_millis(250);
/// When a caller with too many connections may try again.
const RETRY_DELAY: Duration = Duration::from_secs(1);

/// Those of one server. A handle: clones share everything.
#[derive(Debug, Clone)]
pub(crate) struct Connections {
    limits: ConnectionLimits,
    state: Arc<Mutex<State>>,
}

#[derive(Debug, Default)]
struct State {
    next: u64,
    open: BTreeMap<u64, Open>,
    /// Connections with calls under way, by caller.
    in_use: BTreeMap<String, usize>,
}

#[derive(Debug)]
struct Open {
    close: CancellationToken,
    /// Since when no call is under way.
    quiet_since: Instant,
    had_a_call: bool,
    calls: usize,
    /// Whom it is counted for.
    caller: Option<String>,
}

impl Connections {
    pub(crate) fn new(limits: ConnectionLimits) -> Connections {
        Connections { limits, state: Arc::default() }
    }

    /// One more; where there are too many, one that has nothing to do is closed for it. `None` where all have.
    pub(crate) fn accept<S>(&self, stream: S) -> Option<Connection<S>> {
        let mut state = self.state();
        let quiet = |(_, open): &(&u64, &Open)| open.calls == 0 && !open.close.is_cancelled();
        let there = state.open.values().filter(|open| !open.close.is_cancelled()).count();
        if there >= self.limits.connections {
            let oldest = state.open.iter().filter(quiet).min_by_key(|(_, open)| (open.had_a_call, open.quiet_since));
            let close = oldest.map(|(_, open)| open.close.clone())?;
            tracing::debug!(connections = there, "a connection that says nothing is closed for a new one");
            close.cancel();
        }
        let (id, close) = (state.next, CancellationToken::new());
        state.next += 1;
        let quiet_since = Instant::now();
        let open = Open { close: close.clone(), quiet_since, had_a_call: false, calls: 0, caller: None };
        state.open.insert(id, open);
        drop(state);
        let link = Link { id, connections: self.clone() };
        let closed = Box::pin(close.cancelled_owned());
        Some(Connection { stream, closed, registered: Registered(link) })
    }

    /// The same for what a listener gives.
    pub(crate) fn admit<S, E>(&self, accepted: Result<S, E>) -> Option<Result<Connection<S>, E>> {
        accepted.map(|stream| self.accept(stream)).transpose()
    }

    /// Closes those whose time is over, for as long as it is polled.
    pub(crate) async fn sweep(&self) -> Infallible {
        let mut interval = tokio::time::interval(SWEEP_INTERVAL);
        loop {
            interval.tick().await;
            let state = self.state();
            for open in state.open.values().filter(|open| open.calls == 0) {
                let patience = if open.had_a_call { self.limits.idle } else { self.limits.first_call };
                if open.quiet_since.elapsed() >= patience {
                    open.close.cancel();
                }
            }
        }
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Which connection a request came over; among its extensions.
#[derive(Debug, Clone)]
pub(crate) struct Link {
    id: u64,
    connections: Connections,
}

impl Link {
    /// A call begins: the connection is in use until what is returned is dropped.
    pub(crate) fn begin(&self, identity: &Identity) -> Result<InUse, Status> {
        let mut state = self.connections.state();
        let State { open, in_use, .. } = &mut *state;
        // One that is being closed: its calls end with it.
        let Some(open) = open.get_mut(&self.id) else { return Ok(InUse(self.clone())) };
        if open.calls == 0 {
            let caller = name_of(identity);
            let count = in_use.entry(caller.clone()).or_default();
            let most = self.connections.limits.of_one_caller;
            if *count >= most {
                open.close.cancel();
                return Err(too_many(&caller, most));
            }
            *count += 1;
            open.caller = Some(caller);
        }
        open.calls += 1;
        open.had_a_call = true;
        Ok(InUse(self.clone()))
    }

    fn end(&self, all: bool) {
        let mut state = self.connections.state();
        let State { open, in_use, .. } = &mut *state;
        let Some(known) = open.get_mut(&self.id) else { return };
        known.calls = if all { 0 } else { known.calls.saturating_sub(1) };
        if known.calls == 0 {
            known.quiet_since = Instant::now();
            if let Some(caller) = known.caller.take()
                && let Some(count) = in_use.get_mut(&caller)
            {
                *count = count.saturating_sub(1);
                if *count == 0 {
                    in_use.remove(&caller);
                }
            }
        }
        if all {
            open.remove(&self.id);
        }
    }
}

/// A call is under way on a connection.
#[derive(Debug)]
pub(crate) struct InUse(Link);

impl Drop for InUse {
    fn drop(&mut self) {
        self.0.end(false);
    }
}

/// A connection that ends when its time is over.
#[derive(Debug)]
pub(crate) struct Connection<S> {
    stream: S,
    closed: Pin<Box<WaitForCancellationFutureOwned>>,
    registered: Registered,
}

#[derive(Debug)]
struct Registered(Link);

impl Drop for Registered {
    fn drop(&mut self) {
        self.0.end(true);
    }
}

/// What is known of a connection: what the system says, and which it is.
#[derive(Debug, Clone)]
pub(crate) struct LinkInfo<I> {
    pub(crate) info: I,
    pub(crate) link: Link,
}

impl<S: Connected> Connected for Connection<S> {
    type ConnectInfo = LinkInfo<S::ConnectInfo>;

    fn connect_info(&self) -> Self::ConnectInfo {
        LinkInfo { info: self.stream.connect_info(), link: self.registered.0.clone() }
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for Connection<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        if self.closed.as_mut().poll(context).is_ready() {
            return Poll::Ready(Err(io::Error::new(io::ErrorKind::TimedOut, "nothing was asked for too long")));
        }
        Pin::new(&mut self.stream).poll_read(context, buffer)
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for Connection<S> {
    fn poll_write(mut self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write(context, bytes)
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        parts: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write_vectored(context, parts)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }
}

/// The same for all connections of one caller.
fn name_of(identity: &Identity) -> String {
    match identity {
        Identity::User { uid, .. } => format!("uid {uid}"),
        Identity::Certificate { der } => {
            let sum = der
                .iter()
                .fold(0xcbf2_9ce4_8422_2325_u64, |sum, byte| (sum ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3));
            format!("the certificate {sum:016x}")
        }
        Identity::Anonymous => "anonymous".to_owned(),
    }
}

fn too_many(caller: &str, most: usize) -> Status {
    let mut details = ErrorDetails::with_error_info("QUOTA_CONNECTIONS", "ratn", []);
    details.set_retry_info(Some(RETRY_DELAY));
    let message = format!("connections of {caller}: the quota of {most} with calls under way is reached");
    Status::with_error_details(Code::ResourceExhausted, message, details)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use tokio::io::{AsyncReadExt, DuplexStream, duplex};

    fn limits() -> ConnectionLimits {
        ConnectionLimits { connections: 3, of_one_caller: 2, ..ConnectionLimits::default() }
    }

    fn link(connection: &Connection<DuplexStream>) -> Link {
        connection.registered.0.clone()
    }

    async fn is_closed(connection: &mut Connection<DuplexStream>) -> bool {
        let mut byte = [0];
        let read = tokio::time::timeout(Duration::from_millis(1), connection.read(&mut byte)).await;
        read.is_ok_and(|read| read.is_err())
    }

    #[tokio::test]
    async fn who_says_nothing_gives_way_the_longest_first_and_who_has_a_call_stays() {
        let connections = Connections::new(limits());
        let (mut ends, mut open) = (Vec::new(), Vec::new());
        for _ in 0..3 {
            let (near, far) = duplex(1);
            open.push(connections.accept(near).unwrap());
            ends.push(far);
        }
        let users = [1, 2, 3].map(|uid| Identity::User { uid, pid: None });
        let call = link(&open[0]).begin(&users[0]).unwrap();
        assert!(!is_closed(&mut open[1]).await, "as many as may be");
        let (near, _far) = duplex(1);
        open.push(connections.accept(near).unwrap());
        assert!(is_closed(&mut open[1]).await && !is_closed(&mut open[0]).await && !is_closed(&mut open[2]).await);
        let others = [link(&open[2]).begin(&users[1]).unwrap(), link(&open[3]).begin(&users[2]).unwrap()];
        drop(open.remove(1));
        let (near, _further) = duplex(1);
        assert!(connections.accept(near).is_none(), "all have something to do");
        drop((call, others));
        let (near, _further) = duplex(1);
        assert!(connections.accept(near).is_some());
    }

    #[tokio::test]
    async fn one_caller_has_its_share_of_connections_and_the_refusal_says_whose() {
        let connections = Connections::new(limits());
        let (caller, other) = (Identity::User { uid: 7, pid: Some(1) }, Identity::Anonymous);
        let open: Vec<Connection<DuplexStream>> = (0..3).map(|_| connections.accept(duplex(1).0).unwrap()).collect();
        let first = link(&open[0]).begin(&caller).unwrap();
        let _again = link(&open[0]).begin(&caller).unwrap();
        let _second = link(&open[1]).begin(&caller).unwrap();
        let refused = link(&open[2]).begin(&caller).unwrap_err();
        assert!(refused.message().contains("connections of uid 7: the quota of 2"), "{refused}");
        assert!(link(&open[2]).begin(&other).is_ok());
        drop(first);
        assert!(link(&open[2]).begin(&caller).is_err() || connections.state().in_use["uid 7"] == 2, "one call is left");
    }

    #[tokio::test]
    async fn a_connection_without_a_call_is_closed_at_its_deadline() {
        let connections = Connections::new(ConnectionLimits {
            first_call: Duration::ZERO,
            idle: Duration::from_secs(3_600),
            ..limits()
        });
        let ((one, _one), (other, _other)) = (duplex(1), duplex(1));
        let (mut silent, mut used) = (connections.accept(one).unwrap(), connections.accept(other).unwrap());
        drop(link(&used).begin(&Identity::Anonymous).unwrap());
        let _ = tokio::time::timeout(SWEEP_INTERVAL, connections.sweep()).await;
        assert!(is_closed(&mut silent).await);
        assert!(!is_closed(&mut used).await, "it has longer");
    }
}
