//! The address of a server: TCP, with or without TLS, or a Unix socket. It is written `http://host:port`, `host:port`, `https://host:port`
//! or `unix:/path`. Several addresses, separated by commas, name servers of which one leads and the others stand by.

use crate::leader::LeaderConnector;
use crate::tls::ClientTls;
use crate::tls::connect::Connector;
use crate::trace::Traced;
use crate::unix_stream::UnixConnector;
use hyper_util::client::legacy::connect::HttpConnector;
use serde::{Deserialize, Serialize};
use std::error::Error;
use std::fmt;
use std::io;
use std::path::PathBuf;
use std::str::FromStr;
use std::time::Duration;

/// A connection attempt that takes longer has failed.
pub const CONNECT_TIMEOUT: Duration = Duration::from_secs(3);
/// Interval of keep-alive probes on a connection, idle or not: pings of both sides, or probes of the system (`Watched`).
pub const KEEPALIVE_INTERVAL: Duration = Duration::from_secs(5);
/// A connection is given up if a probe stays unanswered for this long.
pub const KEEPALIVE_TIMEOUT: Duration = Duration::from_secs(10);

/// A socket path has to fit into `sockaddr_un`, with its final zero.
const MAX_SOCKET_PATH_BYTES: usize = 107;

/// [`Endpoint::local`] as text.
const LOCAL: &str = "local";

/// The address that a server listens on, or can be reached at.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(into = "String", try_from = "String")]
pub enum Endpoint {
    /// Over TCP.
    Tcp {
        /// A host name or an address; an IPv6 address without its brackets.
        host: String,
        /// The port; 0 lets the system choose one, for listening only.
        port: u16,
    },
    /// Over TCP with TLS; the fields as above.
    Tls {
        /// The host name that the server's certificate must contain.
        host: String,
        /// The port.
        port: u16,
    },
    /// A Unix socket at this path.
    Unix(PathBuf),
    /// Whichever of these servers leads; the others stand by. For connecting only.
    AnyOf(Vec<Endpoint>),
}

/// Text that is no endpoint.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "`{text}` is not an endpoint: {problem}; expected http://host:port, https://host:port, host:port or unix:/path"
)]
pub struct EndpointError {
    /// What was written.
    pub text: String,
    /// What is wrong with it.
    pub problem: String,
}

/// A server that cannot be reached.
#[derive(Debug, thiserror::Error)]
#[error("cannot connect to {endpoint}")]
pub struct ConnectError {
    /// The server's endpoint.
    pub endpoint: Endpoint,
    /// The cause.
    #[source]
    pub source: tonic::transport::Error,
}

impl ConnectError {
    /// Whether nothing listens there: the server has ended.
    pub fn nobody_listens(&self) -> bool {
        let absent = [io::ErrorKind::ConnectionRefused, io::ErrorKind::NotFound];
        let causes = std::iter::successors(self.source.source(), |cause: &&(dyn Error + 'static)| (*cause).source());
        causes.filter_map(|cause| cause.downcast_ref::<io::Error>()).any(|error| absent.contains(&error.kind()))
    }
}

impl Endpoint {
    /// A port on the loopback interface that the system chooses.
    pub fn loopback() -> Endpoint {
        Endpoint::Tcp { host: "127.0.0.1".to_owned(), port: 0 }
    }

    /// For listening: a socket in the runtime directory with the server's name. Written `local`.
    pub fn local() -> Endpoint {
        Endpoint::Unix(PathBuf::new())
    }

    /// The addresses of the single servers; for a single server, the endpoint itself.
    pub fn members(&self) -> &[Endpoint] {
        match self {
            Endpoint::AnyOf(members) => members,
            one => std::slice::from_ref(one),
        }
    }

    /// Whether this is [`Endpoint::local`].
    pub fn is_local(&self) -> bool {
        *self == Endpoint::local()
    }
}

impl fmt::Display for Endpoint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Endpoint::Tcp { host, port } if host.contains(':') => write!(f, "http://[{host}]:{port}"),
            Endpoint::Tcp { host, port } => write!(f, "http://{host}:{port}"),
            Endpoint::Tls { host, port } if host.contains(':') => write!(f, "https://[{host}]:{port}"),
            Endpoint::Tls { host, port } => write!(f, "https://{host}:{port}"),
            Endpoint::Unix(_) if self.is_local() => f.write_str(LOCAL),
            Endpoint::Unix(path) => write!(f, "unix:{}", path.display()),
            Endpoint::AnyOf(members) => {
                let members: Vec<String> = members.iter().map(Endpoint::to_string).collect();
                f.write_str(&members.join(","))
            }
        }
    }
}

impl FromStr for Endpoint {
    type Err = EndpointError;

    fn from_str(text: &str) -> Result<Endpoint, EndpointError> {
        let refuse = |problem: String| EndpointError { text: text.to_owned(), problem };
        if text.contains(',') {
            let members: Vec<Endpoint> =
                text.split(',').map(|member| member.trim().parse()).collect::<Result<_, _>>()?;
            if members.iter().any(Endpoint::is_local) {
                return Err(refuse("`local` is the one server of this host, and none of several".to_owned()));
            }
            return Ok(Endpoint::AnyOf(members));
        }
        if text == LOCAL {
            return Ok(Endpoint::local());
        }
        if let Some(path) = text.strip_prefix("unix:") {
            let path = path.strip_prefix("//").unwrap_or(path);
            if !path.starts_with('/') {
                return Err(refuse("the path is not absolute".to_owned()));
            }
            if path.len() > MAX_SOCKET_PATH_BYTES {
                let problem = format!("the path has {} bytes, a socket's at most {MAX_SOCKET_PATH_BYTES}", path.len());
                return Err(refuse(problem));
            }
            return Ok(Endpoint::Unix(PathBuf::from(path)));
        }
        let (tls, address) = match text.strip_prefix("https://") {
            Some(address) => (true, address),
            None => (false, text.strip_prefix("http://").unwrap_or(text)),
        };
        let address = address.strip_suffix('/').unwrap_or(address);
        let (host, port) = address.rsplit_once(':').ok_or_else(|| refuse("no port is given".to_owned()))?;
        let port = port.parse().map_err(|_| refuse(format!("`{port}` is no port")))?;
        let host = host.strip_prefix('[').and_then(|h| h.strip_suffix(']')).unwrap_or(host);
        if host.is_empty() || host.contains(['/', '@', ' ']) {
            return Err(refuse(format!("`{host}` is no host")));
        }
        let host = host.to_owned();
        Ok(if tls { Endpoint::Tls { host, port } } else { Endpoint::Tcp { host, port } })
    }
}

impl From<Endpoint> for String {
    fn from(endpoint: Endpoint) -> String {
        endpoint.to_string()
    }
}

impl TryFrom<String> for Endpoint {
    type Error = EndpointError;

    fn try_from(text: String) -> Result<Endpoint, EndpointError> {
        text.parse()
    }
}

/// A channel that connects at its first call, and again whenever the connection broke; with the TLS settings that `tls` has at that time.
/// Needs a tokio runtime.
///
/// # Errors
/// [`ConnectError`] if the endpoint makes no URI.
pub fn connect_lazily(endpoint: &Endpoint, tls: &ClientTls) -> Result<Traced, ConnectError> {
    connect_lazily_as(endpoint, tls, Watched::ByPings)
}

/// As [`connect_lazily`].
pub(crate) fn connect_lazily_as(
    endpoint: &Endpoint,
    tls: &ClientTls,
    watched: Watched,
) -> Result<Traced, ConnectError> {
    let configured = match watched {
        Watched::ByPings => configured(endpoint)?,
        Watched::BySystem => unwatched(endpoint)?,
    };
    Ok(Traced::new(match connector_of(endpoint, tls) {
        By::Tls(connector) => configured.connect_with_connector_lazy(connector),
        By::Leader(connector) => configured.connect_with_connector_lazy(connector),
        By::Tcp(connector) => configured.connect_with_connector_lazy(connector),
        By::Unix(connector) => configured.connect_with_connector_lazy(connector),
    }))
}

/// How a client notices that the other side of a quiet connection is gone.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Watched {
    /// By HTTP/2 pings: a process that does not answer is suspended or gone. For the daemons of a system.
    ByPings,
    /// By the system's own TCP probes (keep-alive, and a limit for unacknowledged data), which detect that the host is gone. For providers,
    /// whose processes are monitored by leases and health checks. Servers of other gRPC libraries close a connection with GOAWAY
    /// (`too_many_pings`) after the third ping within five minutes without data, and no setting of the client prevents that.
    BySystem,
}

/// A connector for TCP; the system detects when the other host is gone.
pub(crate) fn over_tcp() -> HttpConnector {
    let mut tcp = HttpConnector::new();
    tcp.enforce_http(false);
    tcp.set_nodelay(true);
    tcp.set_connect_timeout(Some(CONNECT_TIMEOUT));
    tcp.set_keepalive(Some(KEEPALIVE_INTERVAL));
    tcp.set_keepalive_interval(Some(KEEPALIVE_INTERVAL));
    // This limit applies to unanswered probes and to unacknowledged data.
    tcp.set_tcp_user_timeout(Some(KEEPALIVE_INTERVAL + KEEPALIVE_TIMEOUT));
    tcp
}

/// A channel that is connected, as [`connect_lazily`].
///
/// # Errors
/// [`ConnectError`] if no server answers within [`CONNECT_TIMEOUT`].
pub async fn connect(endpoint: &Endpoint, tls: &ClientTls) -> Result<Traced, ConnectError> {
    connected(endpoint, tls, configured(endpoint)?).await
}

/// As [`connect`], without pings while no call is under way: for calls that are repeated at short intervals, each with a deadline.
///
/// # Errors
/// As [`connect`].
pub(crate) async fn connect_to_ask(endpoint: &Endpoint, tls: &ClientTls) -> Result<Traced, ConnectError> {
    connected(endpoint, tls, unwatched(endpoint)?).await
}

async fn connected(
    endpoint: &Endpoint,
    tls: &ClientTls,
    configured: tonic::transport::Endpoint,
) -> Result<Traced, ConnectError> {
    let connected = match connector_of(endpoint, tls) {
        By::Tls(connector) => configured.connect_with_connector(connector).await,
        By::Leader(connector) => configured.connect_with_connector(connector).await,
        By::Tcp(connector) => configured.connect_with_connector(connector).await,
        By::Unix(connector) => configured.connect_with_connector(connector).await,
    };
    connected.map(Traced::new).map_err(|source| ConnectError { endpoint: endpoint.clone(), source })
}

/// Connectors for what tonic does not do by itself.
enum By {
    /// TLS: tonic's own connector would keep the settings of the time when the channel was made.
    Tls(Connector),
    Leader(LeaderConnector),
    /// TCP: tonic's own connector sets no limit for unacknowledged data.
    Tcp(HttpConnector),
    /// Unix sockets: tonic's own connector is woken whenever the other side reads.
    Unix(UnixConnector),
}

fn connector_of(endpoint: &Endpoint, tls: &ClientTls) -> By {
    match endpoint {
        Endpoint::Tls { host, .. } => By::Tls(Connector::to(host, tls)),
        Endpoint::AnyOf(members) => By::Leader(LeaderConnector::among(members, tls)),
        Endpoint::Tcp { .. } => By::Tcp(over_tcp()),
        Endpoint::Unix(path) => By::Unix(UnixConnector(path.clone())),
    }
}

fn configured(endpoint: &Endpoint) -> Result<tonic::transport::Endpoint, ConnectError> {
    Ok(unwatched(endpoint)?
        .http2_keep_alive_interval(KEEPALIVE_INTERVAL)
        .keep_alive_timeout(KEEPALIVE_TIMEOUT)
        .keep_alive_while_idle(true))
}

fn unwatched(endpoint: &Endpoint) -> Result<tonic::transport::Endpoint, ConnectError> {
    let failed = |source| ConnectError { endpoint: endpoint.clone(), source };
    let mut configured = tonic::transport::Endpoint::from_shared(address_of(endpoint)).map_err(failed)?;
    if let Some(endpoint @ Endpoint::Tls { .. }) = endpoint.members().first() {
        let origin = tonic::transport::Endpoint::from_shared(endpoint.to_string()).map_err(failed)?;
        configured = configured.origin(origin.uri().clone());
    }
    Ok(configured.connect_timeout(CONNECT_TIMEOUT))
}

/// The address in the form for tonic, which does not know of TLS here.
fn address_of(endpoint: &Endpoint) -> String {
    match endpoint {
        Endpoint::Tls { host, port } => Endpoint::Tcp { host: host.clone(), port: *port }.to_string(),
        Endpoint::Tcp { .. } | Endpoint::Unix(_) => endpoint.to_string(),
        // Only for the server's name in requests: the connector knows the real addresses.
        Endpoint::AnyOf(members) => members.first().map(address_of).unwrap_or_default(),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    #[test]
    fn an_endpoint_reads_back_as_printed() {
        for (text, printed) in [
            ("127.0.0.1:0", "http://127.0.0.1:0"),
            ("http://compute:4000", "http://compute:4000"),
            ("https://compute:4000", "https://compute:4000"),
            ("http://[::1]:4000/", "http://[::1]:4000"),
            ("local", "local"),
            ("unix:/run/ratn/x.sock", "unix:/run/ratn/x.sock"),
            ("unix:///run/ratn/x.sock", "unix:/run/ratn/x.sock"),
            ("https://a:4000, https://b:4000", "https://a:4000,https://b:4000"),
        ] {
            let endpoint: Endpoint = text.parse().unwrap();
            assert_eq!(endpoint.to_string(), printed);
            assert_eq!(printed.parse::<Endpoint>().unwrap(), endpoint);
        }
    }

    #[test]
    fn what_is_no_endpoint_is_refused_with_the_reason() {
        for text in ["", "compute", "compute:port", ":80", "unix:relative", "http://a/b:80", "a:1,", "a:1,compute"] {
            let error = text.parse::<Endpoint>().unwrap_err().to_string();
            assert!(error.contains("expected http://host:port"), "{error}");
        }
        let long = format!("unix:/{}", "x".repeat(200));
        assert!(long.parse::<Endpoint>().unwrap_err().to_string().contains("at most 107"));
    }
}
