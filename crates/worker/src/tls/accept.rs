//! The server's side of TLS handshakes. It stands in front of tonic's HTTP/2, because tonic keeps one TLS config from start to end.

use super::LiveServerTls;
use futures::future;
use std::io;
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio_rustls::TlsAcceptor;
use tokio_rustls::server::TlsStream;
use tokio_util::task::AbortOnDropHandle;

/// Connections whose handshake succeeded within `patience`. Handshakes run concurrently, as many as there may be connections:
/// [`crate::connections`] limits those, and ends the handshake of a connection that has to give way.
pub(crate) fn handshakes<S>(
    accepted: impl futures::Stream<Item = io::Result<S>>,
    tls: LiveServerTls,
    patience: Duration,
) -> impl futures::Stream<Item = io::Result<TlsStream<S>>>
where
    S: AsyncRead + AsyncWrite + Send + Unpin + 'static,
{
    use futures::StreamExt;
    let handshake = move |accepted: io::Result<S>| {
        let tls = tls.clone();
        AbortOnDropHandle::new(tokio::spawn(async move {
            match accepted {
                Ok(stream) => handshake(stream, &tls, patience).await.map(Ok),
                Err(error) => Some(Err(error)),
            }
        }))
    };
    accepted.map(handshake).buffer_unordered(usize::MAX).filter_map(|ended| future::ready(ended.ok().flatten()))
}

async fn handshake<S>(stream: S, tls: &LiveServerTls, patience: Duration) -> Option<TlsStream<S>>
where
    S: AsyncRead + AsyncWrite + Send + Unpin + 'static,
{
    let acceptor = TlsAcceptor::from(tls.current()?);
    match tokio::time::timeout(patience, acceptor.accept(stream)).await {
        Ok(Ok(stream)) => Some(stream),
        Ok(Err(error)) => {
            tracing::debug!(%error, "a handshake of TLS failed");
            None
        }
        Err(_) => {
            tracing::debug!("a handshake of TLS did not end in time");
            None
        }
    }
}
