//! HTTP for one page, by hyper. Bounded: few connections, small requests, short timeouts; each connection is closed
//! after its answer.

use super::Metrics;
use hyper::body::Incoming;
use hyper::header::{ALLOW, CONTENT_TYPE, HeaderValue};
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper::{Method, Request, Response, StatusCode};
use hyper_util::rt::{TokioIo, TokioTimer};
use std::convert::Infallible;
use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;

/// Maximum number of connections at the same time; further ones are closed at once.
const MAX_CONNECTIONS: usize = 16;
/// The head of a request has at most this many bytes (hyper accepts no smaller limit) …
const MAX_REQUEST_BYTES: usize = 8 * 1024;
/// … and this many headers …
const MAX_HEADERS: usize = 64;
/// … and is read and answered in this time.
const PATIENCE: Duration = Duration::from_secs(5);
/// Pause after `accept` failed: the process is out of file descriptors.
const ACCEPT_AGAIN: Duration = Duration::from_millis(100);
const PATH: &str = "/metrics";
const PLAIN: &str = "text/plain; charset=utf-8";
const OPENMETRICS: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// An address at which metrics cannot be shown.
#[derive(Debug, thiserror::Error)]
pub enum ListenError {
    /// Other machines could read the metrics, and callers are not authenticated.
    #[error("metrics at {address} could be read from other machines: say a loopback address, or --insecure")]
    Exposed {
        /// The address.
        address: SocketAddr,
    },
    /// The system refuses the address.
    #[error("cannot show metrics at {address}")]
    Refused {
        /// The address.
        address: SocketAddr,
        /// The reason.
        #[source]
        source: io::Error,
    },
}

/// Serves metrics at `http://address/metrics` for as long as the runtime lives. Returns the address that is in use.
///
/// # Errors
/// [`ListenError`]; also for an address beyond loopback, unless `insecure`.
pub async fn listen(metrics: Arc<Metrics>, address: SocketAddr, insecure: bool) -> Result<SocketAddr, ListenError> {
    if !address.ip().is_loopback() && !insecure {
        return Err(ListenError::Exposed { address });
    }
    let refused = |source| ListenError::Refused { address, source };
    let listener = TcpListener::bind(address).await.map_err(refused)?;
    let address = listener.local_addr().map_err(refused)?;
    tokio::spawn(serve(metrics, listener));
    Ok(address)
}

async fn serve(metrics: Arc<Metrics>, listener: TcpListener) {
    let places = Arc::new(Semaphore::new(MAX_CONNECTIONS));
    loop {
        let Ok((connection, _)) = listener.accept().await else {
            tokio::time::sleep(ACCEPT_AGAIN).await;
            continue;
        };
        let Ok(place) = Arc::clone(&places).try_acquire_owned() else { continue };
        let metrics = metrics.clone();
        tokio::spawn(async move {
            // A client that left or was too slow gets no answer.
            let _ = tokio::time::timeout(PATIENCE, answer(&metrics, connection)).await;
            drop(place);
        });
    }
}

/// Answers the one request of a connection.
async fn answer(metrics: &Metrics, connection: TcpStream) -> hyper::Result<()> {
    let page = service_fn(async |request: Request<Incoming>| Ok::<_, Infallible>(page(metrics, &request)));
    http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(PATIENCE)
        .max_buf_size(MAX_REQUEST_BYTES)
        .max_headers(MAX_HEADERS)
        .keep_alive(false)
        .half_close(true)
        .serve_connection(TokioIo::new(connection), page)
        .await
}

fn page(metrics: &Metrics, request: &Request<Incoming>) -> Response<String> {
    let (status, kind, body) = match (request.method(), request.uri().path()) {
        (&Method::GET, PATH) => (StatusCode::OK, OPENMETRICS, metrics.text()),
        (&Method::GET, _) => (StatusCode::NOT_FOUND, PLAIN, "the metrics are at /metrics\n".to_owned()),
        _ => (StatusCode::METHOD_NOT_ALLOWED, PLAIN, "only GET\n".to_owned()),
    };
    let mut response = Response::new(body);
    *response.status_mut() = status;
    response.headers_mut().insert(CONTENT_TYPE, HeaderValue::from_static(kind));
    if status == StatusCode::METHOD_NOT_ALLOWED {
        response.headers_mut().insert(ALLOW, HeaderValue::from_static("GET"));
    }
    response
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use tokio::io::{AsyncReadExt, AsyncWriteExt};

    async fn ask(address: SocketAddr, request: &[u8]) -> String {
        let mut connection = TcpStream::connect(address).await.unwrap();
        connection.write_all(request).await.unwrap();
        connection.shutdown().await.unwrap();
        let mut answer = String::new();
        // The server may reset a connection whose request it refused before the end.
        let _ = connection.read_to_string(&mut answer).await;
        answer
    }

    #[tokio::test]
    async fn the_page_is_shown_and_nothing_else() {
        let metrics = Arc::new(Metrics::new("resource-manager"));
        let address = listen(metrics, "127.0.0.1:0".parse().unwrap(), false).await.unwrap();
        let shown = ask(address, b"GET /metrics HTTP/1.1\r\nHost: here\r\n\r\n").await;
        assert!(shown.starts_with("HTTP/1.1 200 OK\r\n") && shown.ends_with("# EOF\n"), "{shown}");
        assert!(shown.contains("content-type: application/openmetrics-text"), "{shown}");
        let ago = ask(address, b"GET /metrics?of=all HTTP/1.0\r\n\r\n").await;
        assert!(ago.starts_with("HTTP/1.0 200 OK\r\n") && ago.ends_with("# EOF\n"), "{ago}");
        assert!(ask(address, b"GET / HTTP/1.1\r\n\r\n").await.starts_with("HTTP/1.1 404"));
        assert!(ask(address, b"POST /metrics HTTP/1.1\r\n\r\n").await.starts_with("HTTP/1.1 405"));
        assert!(ask(address, b"\xff\x00").await.starts_with("HTTP/1.1 400"));
    }

    #[tokio::test]
    async fn a_head_has_so_many_headers_and_bytes_and_no_more() {
        let metrics = Arc::new(Metrics::new("resource-manager"));
        let address = listen(metrics, "127.0.0.1:0".parse().unwrap(), false).await.unwrap();
        let with_headers = |count: usize| {
            let headers: String = (0..count).map(|n| format!("x-{n}: y\r\n")).collect();
            format!("GET /metrics HTTP/1.1\r\n{headers}\r\n")
        };
        assert!(ask(address, with_headers(MAX_HEADERS).as_bytes()).await.starts_with("HTTP/1.1 200"));
        assert!(ask(address, with_headers(MAX_HEADERS + 1).as_bytes()).await.starts_with("HTTP/1.1 431"));
        let of_bytes = |bytes: usize| {
            let (begin, end) = ("GET /metrics HTTP/1.1\r\nx: ", "\r\n\r\n");
            format!("{begin}{}{end}", "y".repeat(bytes - begin.len() - end.len()))
        };
        assert!(ask(address, of_bytes(MAX_REQUEST_BYTES - 1).as_bytes()).await.starts_with("HTTP/1.1 200"));
        let refused = ask(address, of_bytes(2 * MAX_REQUEST_BYTES).as_bytes()).await;
        assert!(!refused.starts_with("HTTP/1.1 200"), "{refused}");
    }

    #[tokio::test]
    async fn more_connections_than_there_are_places_for_are_closed_at_once() {
        let metrics = Arc::new(Metrics::new("resource-manager"));
        let address = listen(metrics, "127.0.0.1:0".parse().unwrap(), false).await.unwrap();
        let mut silent = Vec::new();
        for _ in 0..MAX_CONNECTIONS {
            silent.push(TcpStream::connect(address).await.unwrap());
        }
        let mut one_more = TcpStream::connect(address).await.unwrap();
        let read = tokio::time::timeout(PATIENCE / 2, one_more.read(&mut [0; 1])).await.unwrap();
        assert!(matches!(read, Ok(0) | Err(_)), "{read:?}");
        drop(silent);
    }

    #[tokio::test]
    async fn other_machines_see_it_only_where_it_is_said() {
        let metrics = Arc::new(Metrics::new("resource-manager"));
        let refused = listen(metrics, "0.0.0.0:0".parse().unwrap(), false).await.unwrap_err();
        assert!(matches!(refused, ListenError::Exposed { .. }), "{refused}");
    }
}
