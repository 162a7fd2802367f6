//! HTTP for one page. Bounded: few connections, little to read, little time; each is closed after its answer.

use super::Metrics;
use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;

/// Connections at the same time; more are closed at once.
const MAX_CONNECTIONS: usize = 16;
/// A request has at most this many bytes …
const MAX_REQUEST_BYTES: usize = 8 * 1024;
/// … and is read and answered in this time.
const PATIENCE: Duration = Duration::from_secs(5);
/// After a connection that could not be had: the process is out of descriptors.
const ACCEPT_AGAIN: Duration = Duration::from_millis(100);
const PATH: &str = "/metrics";
const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// An address at which metrics cannot be shown.
#[derive(Debug, thiserror::Error)]
pub enum ListenError {
    /// Other machines could read them, and nothing would say who they are.
    #[error("metrics at {address} could be read from other machines: say a loopback address, or --insecure")]
    Exposed {
        /// Which.
        address: SocketAddr,
    },
    /// The system does not give it.
    #[error("cannot show metrics at {address}")]
    Refused {
        /// Which.
        address: SocketAddr,
        /// Why.
        #[source]
        source: io::Error,
    },
}

/// Shows metrics at `http://address/metrics` for as long as the runtime lives; where that is.
///
/// # Errors
/// [`ListenError`]; beyond loopback unless `insecure`.
pub async fn listen(metrics: &'static Metrics, address: SocketAddr, insecure: bool) -> Result<SocketAddr, ListenError> {
    if !address.ip().is_loopback() && !insecure {
        return Err(ListenError::Exposed { address });
    }
    let refused = |source| ListenError::Refused { address, source };
    let listener = TcpListener::bind(address).await.map_err(refused)?;
    let address = listener.local_addr().map_err(refused)?;
    tokio::spawn(serve(metrics, listener));
    Ok(address)
}

async fn serve(metrics: &'static Metrics, listener: TcpListener) {
    let places = Arc::new(Semaphore::new(MAX_CONNECTIONS));
    loop {
        let Ok((connection, _)) = listener.accept().await else {
            tokio::time::sleep(ACCEPT_AGAIN).await;
            continue;
        };
        let Ok(place) = Arc::clone(&places).try_acquire_owned() else { continue };
        tokio::spawn(async move {
            // Who left, or was too slow, hears nothing.
            let _ = tokio::time::timeout(PATIENCE, answer(metrics, connection)).await;
            drop(place);
        });
    }
}

async fn answer(metrics: &Metrics, mut connection: TcpStream) -> io::Result<()> {
    let mut request = Vec::new();
    while !request.windows(4).any(|window| window == b"\r\n\r\n") {
        if request.len() >= MAX_REQUEST_BYTES || connection.read_buf(&mut request).await? == 0 {
            return connection.write_all(&page("400 Bad Request", "a request is expected\n")).await;
        }
    }
    let line = request.split(|byte| *byte == b'\r').next().unwrap_or_default();
    let mut words = line.split(|byte| *byte == b' ');
    let (method, target) = (words.next().unwrap_or_default(), words.next().unwrap_or_default());
    let path = target.split(|byte| *byte == b'?').next().unwrap_or_default();
    let page = match (method, path == PATH.as_bytes()) {
        (b"GET", true) => page("200 OK", &metrics.text()),
        (b"GET", false) => page("404 Not Found", "the metrics are at /metrics\n"),
        _ => page("405 Method Not Allowed", "only GET\n"),
    };
    connection.write_all(&page).await?;
    connection.shutdown().await
}

fn page(status: &str, body: &str) -> Vec<u8> {
    let kind = if status.starts_with("200") { CONTENT_TYPE } else { "text/plain; charset=utf-8" };
    let length = body.len();
    format!("HTTP/1.1 {status}\r\ncontent-type: {kind}\r\ncontent-length: {length}\r\nconnection: close\r\n\r\n{body}")
        .into_bytes()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    async fn ask(address: SocketAddr, request: &[u8]) -> String {
        let mut connection = TcpStream::connect(address).await.unwrap();
        connection.write_all(request).await.unwrap();
        connection.shutdown().await.unwrap();
        let mut answer = String::new();
        connection.read_to_string(&mut answer).await.unwrap();
        answer
    }

    #[tokio::test]
    async fn the_page_is_shown_and_nothing_else() {
        let metrics = super::super::install("resource-manager");
        let address = listen(metrics, "127.0.0.1:0".parse().unwrap(), false).await.unwrap();
        let shown = ask(address, b"GET /metrics HTTP/1.1\r\nHost: here\r\n\r\n").await;
        assert!(shown.starts_with("HTTP/1.1 200 OK\r\n") && shown.ends_with("# EOF\n"), "{shown}");
        assert!(ask(address, b"GET / HTTP/1.1\r\n\r\n").await.starts_with("HTTP/1.1 404"));
        assert!(ask(address, b"POST /metrics HTTP/1.1\r\n\r\n").await.starts_with("HTTP/1.1 405"));
        assert!(ask(address, b"\xff\x00").await.starts_with("HTTP/1.1 400"));
        assert!(ask(address, &[b'x'; MAX_REQUEST_BYTES]).await.starts_with("HTTP/1.1 400"));
    }

    #[tokio::test]
    async fn other_machines_see_it_only_where_it_is_said() {
        let metrics = super::super::install("resource-manager");
        let refused = listen(metrics, "0.0.0.0:0".parse().unwrap(), false).await.unwrap_err();
        assert!(matches!(refused, ListenError::Exposed { .. }), "{refused}");
    }
}
