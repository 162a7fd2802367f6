//! A connection over a Unix socket that wakes its task when data arrive, but not when the other side has read something.
//!
//! Each time the other side reads, the system reports a Unix socket as writable to a process that waits for that, even if there was room
//! all along. Tokio's own stream always waits for it, so that every message that is sent wakes its sender once more. This stream waits for
//! it only while a write would block.

use hyper_util::rt::TokioIo;
use std::future::Future;
use std::io::{self, IoSlice, Read, Write};
use std::net::Shutdown;
use std::os::unix::net::UnixStream as StdStream;
use std::path::PathBuf;
use std::pin::Pin;
use std::task::{Context, Poll, ready};
use tokio::io::unix::AsyncFd;
use tokio::io::{AsyncRead, AsyncWrite, Interest, ReadBuf};
use tokio::net::UnixStream as TokioStream;
use tonic::codegen::{Service, http::Uri};
use tonic::transport::server::{Connected, UdsConnectInfo};

/// A connection. It has to be made within a tokio runtime.
#[derive(Debug)]
pub(crate) struct UnixStream {
    stream: AsyncFd<StdStream>,
    /// While a write waits: a second handle of the same socket.
    room: Option<AsyncFd<StdStream>>,
    peer: UdsConnectInfo,
}

impl UnixStream {
    /// Wraps tokio's stream.
    pub(crate) fn of(stream: TokioStream) -> io::Result<UnixStream> {
        let peer = stream.connect_info();
        Ok(UnixStream { stream: watched(stream.into_std()?, Interest::READABLE)?, room: None, peer })
    }

    /// Connects to the server that listens at `path`.
    pub(crate) async fn connect(path: PathBuf) -> io::Result<UnixStream> {
        UnixStream::of(TokioStream::connect(path).await?)
    }

    /// The stream, detached from the runtime.
    pub(crate) fn into_std(self) -> StdStream {
        self.stream.into_inner()
    }

    /// The socket itself, which is non-blocking.
    pub(crate) fn socket(&self) -> &StdStream {
        self.stream.get_ref()
    }

    /// The identity of the other end.
    pub(crate) fn peer(&self) -> &UdsConnectInfo {
        &self.peer
    }

    fn poll_sent(
        &mut self,
        context: &mut Context<'_>,
        mut send: impl FnMut(&StdStream) -> io::Result<usize>,
    ) -> Poll<io::Result<usize>> {
        loop {
            match send(self.stream.get_ref()) {
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                    if self.room.is_none() {
                        self.room = Some(watched(self.socket().try_clone()?, Interest::WRITABLE)?);
                    }
                    if let Some(room) = &self.room {
                        ready!(room.poll_write_ready(context))?.clear_ready();
                    }
                }
                sent => {
                    self.room = None;
                    return Poll::Ready(sent);
                }
            }
        }
    }
}

#[expect(
    deprecated,
    reason = "what takes its place is unsafe, for types that do not own what they name; a stream owns its socket"
)]
fn watched(socket: StdStream, interest: Interest) -> io::Result<AsyncFd<StdStream>> {
    AsyncFd::with_interest(socket, interest)
}

impl AsyncRead for UnixStream {
    fn poll_read(self: Pin<&mut Self>, context: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        loop {
            let mut ready = ready!(self.stream.poll_read_ready(context))?;
            let free = buffer.initialize_unfilled();
            let room = free.len();
            match ready.get_inner().read(free) {
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => ready.clear_ready(),
                Err(error) => return Poll::Ready(Err(error)),
                Ok(read) => {
                    // The read was short, so the socket is empty: the system will report further data.
                    if (1..room).contains(&read) {
                        ready.clear_ready();
                    }
                    buffer.advance(read);
                    return Poll::Ready(Ok(()));
                }
            }
        }
    }
}

impl AsyncWrite for UnixStream {
    fn poll_write(self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        self.get_mut().poll_sent(context, |mut stream| stream.write(bytes))
    }

    fn poll_write_vectored(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
        parts: &[IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        self.get_mut().poll_sent(context, |mut stream| stream.write_vectored(parts))
    }

    fn is_write_vectored(&self) -> bool {
        true
    }

    fn poll_flush(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }

    fn poll_shutdown(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(self.socket().shutdown(Shutdown::Write))
    }
}

impl Connected for UnixStream {
    type ConnectInfo = UdsConnectInfo;

    fn connect_info(&self) -> UdsConnectInfo {
        self.peer.clone()
    }
}

/// A connector to one path, for a channel of tonic.
#[derive(Debug, Clone)]
pub(crate) struct UnixConnector(pub(crate) PathBuf);

impl Service<Uri> for UnixConnector {
    type Response = TokioIo<UnixStream>;
    type Error = io::Error;
    type Future = Pin<Box<dyn Future<Output = io::Result<TokioIo<UnixStream>>> + Send>>;

    fn poll_ready(&mut self, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }

    fn call(&mut self, _: Uri) -> Self::Future {
        let path = self.0.clone();
        Box::pin(async { UnixStream::connect(path).await.map(TokioIo::new) })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use futures::FutureExt;
    use std::sync::Arc;
    use std::sync::atomic::{AtomicUsize, Ordering};
    use std::task::Wake;
    use tokio::io::{AsyncReadExt, AsyncWriteExt};

    fn pair() -> (UnixStream, TokioStream) {
        let (one, other) = TokioStream::pair().unwrap();
        (UnixStream::of(one).unwrap(), other)
    }

    struct Counted(AtomicUsize);

    impl Wake for Counted {
        fn wake(self: Arc<Self>) {
            self.0.fetch_add(1, Ordering::SeqCst);
        }
    }

    #[tokio::test]
    async fn a_sender_is_not_woken_by_what_the_other_side_has_read() {
        let (mut stream, mut other) = pair();
        let woken = Arc::new(Counted(AtomicUsize::new(0)));
        let waker = Arc::clone(&woken).into();
        let mut context = Context::from_waker(&waker);
        let mut buffer = [0; 8];
        let mut read = ReadBuf::new(&mut buffer);
        assert!(Pin::new(&mut stream).poll_read(&mut context, &mut read).is_pending());
        for _ in 0..10 {
            stream.write_all(b"ask").await.unwrap();
            other.read_exact(&mut [0; 3]).await.unwrap();
            tokio::time::sleep(std::time::Duration::from_millis(1)).await;
        }
        assert_eq!(woken.0.load(Ordering::SeqCst), 0);
        other.write_all(b"answer").await.unwrap();
        tokio::time::sleep(std::time::Duration::from_millis(10)).await;
        assert_eq!(woken.0.load(Ordering::SeqCst), 1);
        assert!(Pin::new(&mut stream).poll_read(&mut context, &mut read).is_ready());
        assert_eq!(read.filled(), b"answer");
    }

    #[tokio::test]
    async fn what_does_not_fit_waits_for_room_and_arrives_whole_both_ways() {
        let (mut stream, mut other) = pair();
        let all: Vec<u8> = (0..4_000_000_u32).map(|number| (number % 251) as u8).collect();
        let mut blocked = Box::pin(stream.write_all(&all));
        assert!(blocked.as_mut().now_or_never().is_none());
        let mut heard = vec![0; all.len()];
        let (sent, read) = tokio::join!(blocked, other.read_exact(&mut heard));
        assert!(sent.is_ok() && read.is_ok() && heard == all);
        assert!(stream.room.is_none());
        heard.fill(0);
        let (sent, read) = tokio::join!(other.write_all(&all), stream.read_exact(&mut heard));
        assert!(sent.is_ok() && read.is_ok() && heard == all);
    }

    #[tokio::test]
    async fn the_end_of_the_other_side_is_heard_by_who_reads_and_by_who_waits_for_room() {
        let (mut stream, other) = pair();
        let mut blocked = Box::pin(stream.write_all(&[0; 4_000_000]));
        assert!(blocked.as_mut().now_or_never().is_none());
        drop(other);
        assert!(blocked.await.is_err());
        let (mut stream, mut other) = pair();
        other.write_all(b"last").await.unwrap();
        drop(other);
        let mut heard = Vec::new();
        stream.read_to_end(&mut heard).await.unwrap();
        assert_eq!(heard, b"last");
        // The same in the other direction.
        let (mut stream, mut other) = pair();
        stream.shutdown().await.unwrap();
        assert_eq!(other.read(&mut [0; 8]).await.unwrap(), 0);
    }
}
