//! The byte stream of a connection that is counted, and closed at its deadline.

use super::Link;
use super::authority::Authority;
use std::io;
use std::pin::Pin;
use std::task::{Context, Poll};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio_util::sync::WaitForCancellationFutureOwned;
use tonic::transport::server::Connected;

/// A connection that ends when it is told to close.
#[derive(Debug)]
pub(crate) struct Connection<S> {
    pub(super) stream: S,
    pub(super) closed: Pin<Box<WaitForCancellationFutureOwned>>,
    pub(super) registered: Registered,
    pub(super) authority: Option<Authority>,
}

impl<S> Connection<S> {
    /// Whether the connection was told to close. The other end may neither say nor take anything then, so reading and writing both end.
    fn is_told_to_close(&mut self, context: &mut Context<'_>) -> io::Result<()> {
        match self.closed.as_mut().poll(context) {
            Poll::Ready(()) => {
                Err(io::Error::new(io::ErrorKind::TimedOut, "nothing was asked for, or taken, for too long"))
            }
            Poll::Pending => Ok(()),
        }
    }

    /// Marks a connection at a Unix socket, where clients may send the path as the server's name.
    pub(crate) fn at_a_path(mut self) -> Connection<S> {
        self.authority = Some(Authority::default());
        self
    }
}

#[derive(Debug)]
pub(super) struct Registered(pub(super) Link);

impl Drop for Registered {
    fn drop(&mut self) {
        self.0.end(true);
    }
}

/// Information about a connection: the system's, and its entry among the server's connections.
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
        self.is_told_to_close(context)?;
        let known = buffer.filled().len();
        let read = Pin::new(&mut self.stream).poll_read(context, buffer);
        if let Some(authority) = &mut self.authority {
            authority.pass(&mut buffer.filled_mut()[known..]);
        }
        read
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for Connection<S> {
    fn poll_write(mut self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        self.is_told_to_close(context)?;
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
        self.is_told_to_close(context)?;
        Pin::new(&mut self.stream).poll_write_vectored(context, parts)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }
}
