//! Accepts connections in a thread of its own, so that a client that connects all the time delays no client that is connected. A connection
//! beyond its origin's rate is told why, and closed, in that thread.
//!
//! ```text
//!   listener ─ within the rate ─▶ queue ─▶ the server's runtime
//!       └───── beyond ─▶ GOAWAY with the reason (not with TLS, where nothing can be sent before a handshake) ─▶ closed
//! ```

use super::rates::Rates;
use super::{ConnectionLimits, Origin, OutOfConnections, Peer};
use crate::gate::{Gate, Identity};
use crate::panic::exit_on_panic;
use crate::unix_stream::UnixStream;
use std::collections::VecDeque;
use std::future::Future;
use std::io::{self, Read, Write};
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};
use tokio::net::{TcpListener, TcpStream, UnixListener};
use tokio::sync::mpsc;
use tokio_util::sync::{CancellationToken, DropGuard};

/// Maximum number of accepted connections that the server has not taken yet.
const QUEUE: usize = 64;
/// Pause before the next attempt after a system error (for example: no more open files).
const AGAIN: Duration = Duration::from_millis(100);

/// How long a connection that was told why it is closed stays open, so that its client, which speaks first, reads the reason.
const LINGER: Duration = Duration::from_millis(250);
/// Maximum number of connections that stay open for that.
const MOST_TOLD: usize = 64;

/// A listener and its connections.
pub(crate) trait Listen: Send + Sync + Sized + 'static {
    /// The listener without a runtime, while it moves from one runtime to another.
    type Detached: Send + 'static;
    /// A connection.
    type Stream: Goodbye + Send + 'static;

    fn detach(self) -> io::Result<Self::Detached>;
    fn attach(detached: Self::Detached) -> io::Result<Self>;
    fn accept(&self) -> impl Future<Output = io::Result<Self::Stream>> + Send;
    fn identity(stream: &Self::Stream) -> Identity;
    fn origin(stream: &Self::Stream, identity: &Identity) -> Origin;
}

/// A connection that can be told why it is closed.
pub(crate) trait Goodbye: Sized {
    /// The connection without a runtime, while it moves from one runtime to another.
    type Detached: Send + 'static;

    fn detach(self) -> io::Result<Self::Detached>;
    fn attach(detached: Self::Detached) -> io::Result<Self>;
    /// Non-blocking: reads what is ready, writes as much as is accepted at once.
    fn try_read(&self, buffer: &mut [u8]) -> io::Result<usize>;
    fn try_write(&self, bytes: &[u8]) -> io::Result<usize>;
}

/// The accepted connections of a listener, as a stream. Dropping it closes the listener before the drop returns.
pub(crate) struct Incoming<L: Listen> {
    accepted: mpsc::Receiver<(<L::Stream as Goodbye>::Detached, Peer)>,
    thread: Option<JoinHandle<()>>,
    stop: Option<DropGuard>,
}

/// Accepts connections at `listener`; `speaks` is true if clients understand a message without a handshake (no TLS).
pub(crate) fn accept_in_a_thread<L: Listen>(
    listener: L,
    limits: &ConnectionLimits,
    gate: Arc<dyn Gate>,
    speaks: bool,
) -> io::Result<Incoming<L>> {
    let (sender, accepted) = mpsc::channel(QUEUE);
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let (listener, stop) = (listener.detach()?, CancellationToken::new());
    let mut accepting =
        Accepting { rates: Rates::new(limits.per_s, limits.connections), per_s: limits.per_s, gate, speaks };
    let stopped = stop.clone();
    let work = async move {
        let listener = match L::attach(listener) {
            Ok(listener) => listener,
            Err(error) => return tracing::error!(%error, "the listener does not go to its thread"),
        };
        tokio::select! {
            () = accepting.accept(&listener, &sender) => {}
            () = stopped.cancelled() => {}
        }
    };
    let work = move || runtime.block_on(exit_on_panic("accepting", work));
    let thread = std::thread::Builder::new().name("accept".to_owned()).spawn(work)?;
    Ok(Incoming { accepted, thread: Some(thread), stop: Some(stop.drop_guard()) })
}

struct Accepting {
    rates: Rates,
    per_s: u32,
    gate: Arc<dyn Gate>,
    speaks: bool,
}

impl Accepting {
    /// Accepts until the receiver of connections is dropped.
    async fn accept<L: Listen>(
        &mut self,
        listener: &L,
        accepted: &mpsc::Sender<(<L::Stream as Goodbye>::Detached, Peer)>,
    ) {
        let mut told = VecDeque::<(Instant, L::Stream)>::new();
        loop {
            let oldest = told.front().map(|(since, _)| tokio::time::Instant::from_std(*since + LINGER));
            let stream = tokio::select! {
                stream = listener.accept() => stream,
                () = tokio::time::sleep_until(oldest.unwrap_or_else(tokio::time::Instant::now)), if oldest.is_some() => {
                    told.pop_front();
                    continue;
                }
            };
            let stream = match stream {
                Ok(stream) => stream,
                Err(error) => {
                    // A connection that ended before it was accepted says nothing about the next one.
                    if !matches!(error.kind(), io::ErrorKind::ConnectionAborted | io::ErrorKind::ConnectionReset) {
                        tracing::warn!(%error, "no connection can be accepted");
                        tokio::time::sleep(AGAIN).await;
                    }
                    continue;
                }
            };
            let identity = L::identity(&stream);
            let origin = L::origin(&stream, &identity);
            if !self.rates.admit(Instant::now(), origin) {
                let why = OutOfConnections::TooOften { origin, per_s: self.per_s };
                self.gate.out_of_connections(&why);
                if self.speaks {
                    say_goodbye(&stream, &why);
                    told.push_back((Instant::now(), stream));
                    if told.len() > MOST_TOLD {
                        told.pop_front();
                    }
                }
                continue;
            }
            let is_operator = matches!(origin, Origin::User(_)) && self.gate.caller(&identity).is_operator();
            let peer = Peer { origin, is_operator };
            let Ok(detached) = stream.detach() else { continue };
            if accepted.send((detached, peer)).await.is_err() {
                return;
            }
        }
    }
}

/// Tells the other end, which should speak HTTP/2, why its connection is closed; as much of the message as is accepted at once.
pub(crate) fn say_goodbye(stream: &impl Goodbye, why: &OutOfConnections) {
    // Closing a socket with unread data resets the connection, and the reset may overtake the message.
    let _ = stream.try_read(&mut [0; 1_024]);
    let _ = stream.try_write(&goodbye(&why.to_string()));
}

/// The first frame of an HTTP/2 server (RFC 9113: an empty SETTINGS) and the last (GOAWAY with ENHANCE_YOUR_CALM and the reason).
fn goodbye(why: &str) -> Vec<u8> {
    const SETTINGS: [u8; 9] = [0, 0, 0, 4, 0, 0, 0, 0, 0];
    const GOAWAY: u8 = 7;
    const ENHANCE_YOUR_CALM: u32 = 0xb;
    let length = u32::try_from(8 + why.len()).unwrap_or_default();
    let mut bytes = SETTINGS.to_vec();
    bytes.extend_from_slice(&length.to_be_bytes()[1..]);
    bytes.extend_from_slice(&[GOAWAY, 0]);
    bytes.extend_from_slice(&[0; 8]);
    bytes.extend_from_slice(&ENHANCE_YOUR_CALM.to_be_bytes());
    bytes.extend_from_slice(why.as_bytes());
    bytes
}

impl<L: Listen> Unpin for Incoming<L> {}

impl<L: Listen> futures::Stream for Incoming<L> {
    type Item = io::Result<(L::Stream, Peer)>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        let attach = |(detached, peer)| <L::Stream as Goodbye>::attach(detached).map(|stream| (stream, peer));
        self.accepted.poll_recv(context).map(|accepted| accepted.map(attach))
    }
}

impl<L: Listen> Drop for Incoming<L> {
    fn drop(&mut self) {
        self.stop = None;
        // The thread waits for nothing but the end of this stream and the next connection.
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

impl Listen for UnixListener {
    type Detached = std::os::unix::net::UnixListener;
    type Stream = UnixStream;

    fn detach(self) -> io::Result<Self::Detached> {
        self.into_std()
    }

    fn attach(detached: Self::Detached) -> io::Result<Self> {
        UnixListener::from_std(detached)
    }

    async fn accept(&self) -> io::Result<UnixStream> {
        UnixListener::accept(self).await.and_then(|(stream, _)| UnixStream::of(stream))
    }

    fn identity(stream: &UnixStream) -> Identity {
        match stream.peer().peer_cred {
            Some(peer) => Identity::User { uid: peer.uid(), pid: peer.pid() },
            None => Identity::Anonymous,
        }
    }

    fn origin(_: &UnixStream, identity: &Identity) -> Origin {
        Peer::of_user(identity, false).origin
    }
}

impl Listen for TcpListener {
    type Detached = std::net::TcpListener;
    type Stream = TcpStream;

    fn detach(self) -> io::Result<Self::Detached> {
        self.into_std()
    }

    fn attach(detached: Self::Detached) -> io::Result<Self> {
        TcpListener::from_std(detached)
    }

    async fn accept(&self) -> io::Result<TcpStream> {
        let (stream, _) = TcpListener::accept(self).await?;
        stream.set_nodelay(true)?;
        Ok(stream)
    }

    fn identity(_: &TcpStream) -> Identity {
        Identity::Anonymous
    }

    fn origin(stream: &TcpStream, _: &Identity) -> Origin {
        Peer::of_host(stream.peer_addr().ok().map(|address| address.ip())).origin
    }
}

impl Goodbye for UnixStream {
    type Detached = std::os::unix::net::UnixStream;

    fn detach(self) -> io::Result<Self::Detached> {
        Ok(self.into_std())
    }

    fn attach(detached: Self::Detached) -> io::Result<Self> {
        UnixStream::of(tokio::net::UnixStream::from_std(detached)?)
    }

    fn try_read(&self, buffer: &mut [u8]) -> io::Result<usize> {
        self.socket().read(buffer)
    }

    fn try_write(&self, bytes: &[u8]) -> io::Result<usize> {
        self.socket().write(bytes)
    }
}

impl Goodbye for TcpStream {
    type Detached = std::net::TcpStream;

    fn detach(self) -> io::Result<Self::Detached> {
        self.into_std()
    }

    fn attach(detached: Self::Detached) -> io::Result<Self> {
        TcpStream::from_std(detached)
    }

    fn try_read(&self, buffer: &mut [u8]) -> io::Result<usize> {
        TcpStream::try_read(self, buffer)
    }

    fn try_write(&self, bytes: &[u8]) -> io::Result<usize> {
        TcpStream::try_write(self, bytes)
    }
}
