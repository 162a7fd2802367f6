//! The server of every daemon and worker: bind, add health and reflection, serve until a token is cancelled, drain with a hard deadline.
//!
//! ```text
//!   serving ─ token cancelled ─▶ draining ─ no call under way, or the deadline ─▶ GOAWAY on all connections ─▶ over
//!                                NOT_SERVING, new calls: UNAVAILABLE with a retry delay
//! ```

use crate::access::RoleGate;
use crate::connections::accepting::{Goodbye, accept_in_a_thread, say_goodbye};
use crate::connections::{Connection, ConnectionLimits, Connections, OutOfConnections, Peer};
use crate::endpoint::{Endpoint, KEEPALIVE_INTERVAL, KEEPALIVE_TIMEOUT};
use crate::gate::{Calls, Gate, Gated};
use crate::tls::accept::handshakes;
use crate::tls::{LiveServerTls, TlsError};
use crate::unix_socket::{self, SocketAccess};
use crate::vitals::{CoreFailure, Vitals};
use futures::FutureExt;
use std::convert::Infallible;
use std::io;
use std::os::fd::AsFd;
use std::os::unix::fs::{DirBuilderExt, FileTypeExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use tokio::net::{TcpListener, UnixListener, UnixStream};
use tokio::sync::watch;
use tokio_stream::StreamExt;
use tokio_util::sync::CancellationToken;
use tonic::body::Body;
use tonic::codegen::{Service, http};
use tonic::server::NamedService;
use tonic::service::Routes;
use tonic_health::ServingStatus;

/// Calls that have not ended this long after the shutdown began are dropped.
pub const DRAIN_DEADLINE: Duration = Duration::from_millis(500);
/// Time for connections to close in order after the last call.
const CLOSE_PATIENCE: Duration = Duration::from_millis(100);
/// Interval at which the gate checks whether callers have lost permissions, even without calls.
const LOOK_AGAIN: Duration = Duration::from_secs(1);
/// Maximum size of the metadata of one call.
const MAX_METADATA_BYTES: u32 = 16 * 1024;

/// Flow-control window of a connection: maximum size of received requests that no service has read yet. It also bounds small messages: h2
/// closes a connection when the overhead of waiting small frames exceeds half of this (`data_frame_budget` of its server), at 256 bytes a
/// frame. So 4,096 requests may wait on a connection, however small: as many as a stream may have calls under way ([`crate::multiplex`]).
const CONNECTION_WINDOW_BYTES: u32 = 2 * 1024 * 1024;

/// How calls are admitted, and how serving ends.
#[derive(Clone)]
pub struct Serving {
    /// The addresses that may be listened on.
    pub exposure: Exposure,
    /// The gate that every call passes; by default one of roles, with [`crate::access::AccessConfig::default`].
    pub gate: Arc<dyn Gate>,
    /// Limits of connections: their number, and how long they may be idle.
    pub connections: ConnectionLimits,
    /// Replaces [`DRAIN_DEADLINE`]. With zero every connection is closed at once, which is right for a server that only refuses.
    pub drain: Duration,
    /// The phase of the server.
    pub phase: watch::Sender<Phase>,
    /// The condition of the core behind the services, as it reports it.
    pub vitals: Vitals,
}

/// The phase of a server.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Phase {
    /// Not serving yet.
    Starting,
    /// Every call is refused: another process leads, and this one takes over when that one is gone.
    StandingBy,
    /// Calls are served.
    Serving,
    /// Only calls under way are served.
    Draining,
    /// No call is under way any more. Connections are closed; a successor may take over what was served.
    Drained,
}

/// A listener that does not serve yet.
#[derive(Debug)]
pub struct Bound {
    listener: Listener,
    endpoint: Endpoint,
    tls: Option<LiveServerTls>,
}

#[derive(Debug)]
enum Listener {
    Tcp(TcpListener),
    /// The socket, and its file unless another process has to remove it.
    Unix(UnixListener, Option<SocketFile>),
}

/// Removes the socket's file when dropped, unless a successor has put its own there.
#[derive(Debug)]
struct SocketFile {
    path: PathBuf,
    /// Device and inode.
    identity: (u64, u64),
}

/// Why an address cannot be listened on.
#[derive(Debug, thiserror::Error)]
pub enum BindError {
    /// The system refuses it.
    #[error("cannot listen on {endpoint}")]
    Refused {
        /// The endpoint.
        endpoint: Endpoint,
        /// The cause.
        #[source]
        source: io::Error,
    },
    /// Other machines could reach it, and callers would not be identified.
    #[error(
        "{endpoint} can be reached from other machines and has no TLS: give `[service.tls]` in the config, listen on a Unix \
         socket or on loopback, or say --insecure where the network itself is trusted"
    )]
    Exposed {
        /// The endpoint.
        endpoint: Endpoint,
    },
    /// `https` without a certificate.
    #[error("{endpoint} is to be served with TLS, and no certificate is given")]
    NoCertificate {
        /// The endpoint.
        endpoint: Endpoint,
    },
    /// A TLS file cannot be read, or holds nothing usable.
    #[error(transparent)]
    Tls(#[from] TlsError),
}

impl BindError {
    /// Whether another process listens there.
    pub fn is_taken(&self) -> bool {
        matches!(self, BindError::Refused { source, .. } if source.kind() == io::ErrorKind::AddrInUse)
    }
}

/// The addresses that a server may listen on.
#[derive(Debug, Clone, Default)]
pub struct Exposure {
    /// If set, every TCP address is served with TLS.
    pub tls: Option<LiveServerTls>,
    /// Allows addresses beyond loopback without TLS.
    pub insecure: bool,
    /// Who may connect to a Unix socket.
    pub socket: SocketAccess,
}

/// Why serving ended early.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// The transport failed.
    #[error("serving on {endpoint} failed")]
    Transport {
        /// The endpoint.
        endpoint: Endpoint,
        /// The cause.
        #[source]
        source: tonic::transport::Error,
    },
    /// No connections can be accepted.
    #[error("cannot accept connections on {endpoint}")]
    Accept {
        /// The endpoint.
        endpoint: Endpoint,
        /// The cause.
        #[source]
        source: io::Error,
    },
    /// The core behind the services has ended.
    #[error(transparent)]
    Core(#[from] CoreFailure),
    /// The descriptors do not make a reflection service.
    #[error("no reflection for the services")]
    Reflection(#[source] tonic_reflection::server::Error),
}

/// The services of a server. A service sets its own message limits (`max_decoding_message_size(ratn_proto::MAX_MESSAGE_BYTES)`).
#[derive(Debug, Clone, Default)]
pub struct Services {
    routes: Routes,
    names: Vec<&'static str>,
}

impl Services {
    /// Without any service.
    pub fn new() -> Services {
        Services::default()
    }

    /// Adds a service, as generated by tonic.
    #[must_use]
    pub fn with<S>(mut self, service: S) -> Services
    where
        S: Service<http::Request<Body>, Response = http::Response<Body>, Error = Infallible>
            + NamedService
            + Clone
            + Send
            + Sync
            + 'static,
        S::Future: Send + 'static,
    {
        self.routes = self.routes.add_service(service);
        self.names.push(S::NAME);
        self
    }
}

/// Binds `listen`; the result has the real port. A Unix socket that no process listens on any more is replaced.
///
/// # Errors
/// [`BindError`] if the address is not available, or is beyond loopback.
pub async fn bind(listen: &Endpoint) -> Result<Bound, BindError> {
    bind_as(listen, &Exposure::default()).await
}

/// As [`bind`], with TLS or for addresses that other machines can reach.
///
/// # Errors
/// [`BindError`] if the address is not available, or `exposure` does not allow it.
pub async fn bind_as(listen: &Endpoint, exposure: &Exposure) -> Result<Bound, BindError> {
    let failed = |source| BindError::Refused { endpoint: listen.clone(), source };
    match listen {
        Endpoint::Tcp { host, port } | Endpoint::Tls { host, port } => {
            let tls = exposure.tls.clone();
            tls.as_ref().map(LiveServerTls::load).transpose()?;
            if tls.is_none() && matches!(listen, Endpoint::Tls { .. }) {
                return Err(BindError::NoCertificate { endpoint: listen.clone() });
            }
            let listener = TcpListener::bind((host.as_str(), *port)).await.map_err(failed)?;
            let address = listener.local_addr().map_err(failed)?;
            if tls.is_none() && !address.ip().is_loopback() && !exposure.insecure {
                return Err(BindError::Exposed { endpoint: listen.clone() });
            }
            let (host, port) = (host.clone(), address.port());
            let endpoint = if tls.is_some() { Endpoint::Tls { host, port } } else { Endpoint::Tcp { host, port } };
            Ok(Bound { listener: Listener::Tcp(listener), endpoint, tls })
        }
        Endpoint::Unix(path) => {
            if let Some(parent) = path.parent() {
                std::fs::DirBuilder::new().recursive(true).mode(0o700).create(parent).map_err(failed)?;
            }
            if is_dead_socket(path).await {
                std::fs::remove_file(path).map_err(failed)?;
            }
            let listener = unix_socket::listen(path, &exposure.socket).map_err(failed)?;
            let file = SocketFile { path: path.clone(), identity: identity(path).map_err(failed)? };
            let listener = Listener::Unix(listener, Some(file));
            Ok(Bound { listener, endpoint: listen.clone(), tls: None })
        }
        Endpoint::AnyOf(_) => Err(failed(io::Error::new(
            io::ErrorKind::InvalidInput,
            "a server listens on one address; several are for those who connect",
        ))),
    }
}

impl Default for Serving {
    fn default() -> Serving {
        Serving {
            exposure: Exposure::default(),
            gate: Arc::new(RoleGate::default()),
            connections: ConnectionLimits::default(),
            drain: DRAIN_DEADLINE,
            phase: watch::Sender::new(Phase::Starting),
            vitals: Vitals::default(),
        }
    }
}

impl Bound {
    /// A second handle of the same listener, for a process that serves before the real service does.
    ///
    /// # Errors
    /// The system refuses.
    pub fn again(&self) -> io::Result<Bound> {
        let listener = match &self.listener {
            Listener::Tcp(listener) => {
                let copy = std::net::TcpListener::from(listener.as_fd().try_clone_to_owned()?);
                Listener::Tcp(TcpListener::from_std(copy)?)
            }
            Listener::Unix(listener, _) => {
                let copy = std::os::unix::net::UnixListener::from(listener.as_fd().try_clone_to_owned()?);
                Listener::Unix(UnixListener::from_std(copy)?, None)
            }
        };
        Ok(Bound { listener, endpoint: self.endpoint.clone(), tls: self.tls.clone() })
    }

    /// The endpoint at which the server can be reached.
    pub fn endpoint(&self) -> &Endpoint {
        &self.endpoint
    }

    /// Serves until `shutdown` is cancelled, then lets calls under way end within [`DRAIN_DEADLINE`] and refuses new ones with
    /// [`crate::gate::ending`]. Health is SERVING from the first answer on, for the server (the empty name) and for each service; it is
    /// NOT_SERVING while the core reports that it cannot do its work ([`Vitals`]), and during the drain. Services must end endless streams,
    /// and calls that wait for something, on the same token.
    ///
    /// # Errors
    /// [`ServeError`] if the transport fails.
    pub async fn serve(self, services: Services, shutdown: CancellationToken) -> Result<(), ServeError> {
        self.serve_as(services, Serving::default(), shutdown).await
    }

    /// As [`Bound::serve`], with these settings.
    ///
    /// # Errors
    /// [`ServeError`] if the transport fails, or the core behind the services has ended: then no call is answered any more, and there is no
    /// drain.
    pub async fn serve_as(
        self,
        services: Services,
        serving: Serving,
        shutdown: CancellationToken,
    ) -> Result<(), ServeError> {
        let (health, health_service) = tonic_health::server::health_reporter();
        let names: Vec<&'static str> = services.names.iter().copied().chain([""]).collect();
        let say = async |status| {
            for name in &names {
                health.set_service_status(name, status).await;
            }
        };
        let mut condition = serving.vitals.condition();
        let status_of = |unwell: bool| if unwell { ServingStatus::NotServing } else { ServingStatus::Serving };
        let unwell = condition.borrow_and_update().unwell.is_some();
        say(status_of(unwell)).await;
        let reflection = tonic_reflection::server::Builder::configure()
            .register_encoded_file_descriptor_set(ratn_proto::FILE_DESCRIPTOR_SET)
            .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
            .build_v1()
            .map_err(ServeError::Reflection)?;
        let calls = Calls::until(shutdown.clone());
        let closing = CancellationToken::new();
        let router = tonic::transport::Server::builder()
            .http2_max_header_list_size(MAX_METADATA_BYTES)
            .initial_connection_window_size(CONNECTION_WINDOW_BYTES)
            .layer(Gated { gate: serving.gate.clone(), calls: calls.clone() })
            .http2_keepalive_interval(Some(KEEPALIVE_INTERVAL))
            .http2_keepalive_timeout(Some(KEEPALIVE_TIMEOUT))
            .add_routes(services.routes.add_service(health_service).add_service(reflection));

        let limits = serving.connections;
        let first_call = limits.first_call;
        let connections = Connections::new(limits.clone());
        let (taking, gate) = (connections.clone(), serving.gate.clone());
        let endpoint = self.endpoint;
        let cannot_accept = |source| ServeError::Accept { endpoint: endpoint.clone(), source };
        let served = {
            let stop = closing.clone().cancelled_owned();
            // Boxed, because it is large and part of the future of every daemon.
            match self.listener {
                Listener::Tcp(listener) => {
                    let speaks = self.tls.is_none();
                    let incoming =
                        accept_in_a_thread(listener, &limits, gate.clone(), speaks).map_err(cannot_accept)?;
                    let incoming =
                        incoming.filter_map(move |accepted| take_in(&taking, &*gate, accepted, speaks).transpose());
                    match self.tls {
                        Some(tls) => {
                            let incoming = handshakes(incoming, tls, first_call);
                            router.serve_with_incoming_shutdown(incoming, stop).boxed()
                        }
                        None => router.serve_with_incoming_shutdown(incoming, stop).boxed(),
                    }
                }
                Listener::Unix(listener, file) => {
                    let incoming = accept_in_a_thread(listener, &limits, gate.clone(), true).map_err(cannot_accept)?;
                    let take_in = move |accepted| take_in(&taking, &*gate, accepted, true);
                    let incoming = incoming.filter_map(move |accepted| {
                        take_in(accepted).map(|taken| taken.map(Connection::at_a_path)).transpose()
                    });
                    // The file is removed before listening stops: afterwards it could be a successor's.
                    let stop = async {
                        stop.await;
                        drop(file);
                    };
                    router.serve_with_incoming_shutdown(incoming, stop).boxed()
                }
            }
        };
        serving.phase.send_replace(Phase::Serving);
        let drained = async {
            loop {
                tokio::select! {
                    biased;
                    () = shutdown.cancelled() => break,
                    Ok(()) = condition.changed() => {
                        let unwell = condition.borrow_and_update().unwell.is_some();
                        say(status_of(unwell)).await;
                    }
                }
            }
            serving.phase.send_replace(Phase::Draining);
            say(ServingStatus::NotServing).await;
            if tokio::time::timeout(serving.drain, calls.ended()).await.is_err() && !serving.drain.is_zero() {
                let drain_ms = u64::try_from(serving.drain.as_millis()).unwrap_or(u64::MAX);
                tracing::warn!(drain_ms, "calls were still under way at the end of the drain: they are dropped");
            }
            serving.phase.send_replace(Phase::Drained);
            closing.cancel();
            // A client that watches health would keep its connection open for ever.
            tokio::time::sleep(CLOSE_PATIENCE.min(serving.drain)).await;
            connections.close_all();
        };
        let gate = serving.gate;
        tokio::select! {
            biased;
            failure = serving.vitals.failed() => Err(failure.into()),
            served = served => served.map_err(|source| ServeError::Transport { endpoint, source }),
            () = drained => Ok(()),
            never = connections.sweep() => match never {},
            never = look_again(&*gate) => match never {},
        }
    }
}

/// Registers an accepted connection; `None` if there are too many.
fn take_in<S: Goodbye>(
    connections: &Connections,
    gate: &dyn Gate,
    accepted: io::Result<(S, Peer)>,
    speaks: bool,
) -> io::Result<Option<Connection<S>>> {
    let (stream, peer) = accepted?;
    match connections.accept(stream, peer) {
        Ok(connection) => Ok(Some(connection)),
        Err(stream) => {
            gate.out_of_connections(&OutOfConnections::All);
            if speaks {
                say_goodbye(&stream, &OutOfConnections::All);
            }
            Ok(None)
        }
    }
}

/// Makes the gate check its roles regularly, for as long as it is polled.
async fn look_again(gate: &dyn Gate) -> Infallible {
    let mut interval = tokio::time::interval(LOOK_AGAIN);
    loop {
        interval.tick().await;
        gate.look_again();
    }
}

/// Whether the socket was left behind by a killed process.
async fn is_dead_socket(path: &Path) -> bool {
    let is_socket = std::fs::symlink_metadata(path).is_ok_and(|is| is.file_type().is_socket());
    let refused = |error: io::Error| error.kind() == io::ErrorKind::ConnectionRefused;
    is_socket && UnixStream::connect(path).await.is_err_and(refused)
}

fn identity(path: &Path) -> io::Result<(u64, u64)> {
    std::fs::symlink_metadata(path).map(|is| (is.dev(), is.ino()))
}

impl Drop for SocketFile {
    fn drop(&mut self) {
        if identity(&self.path).is_ok_and(|there| there == self.identity) {
            let _ = std::fs::remove_file(&self.path);
        }
    }
}
