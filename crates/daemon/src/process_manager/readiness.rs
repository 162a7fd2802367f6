//! When a worker is ready, and whether it still is.

use super::template::Template;
use crate::config::{ConfigError, rule};
use ratn_worker::client::Health;
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::tls::ClientTls;
use serde::{Deserialize, Serialize};
use std::io;
use std::net::Ipv4Addr;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;
use tokio::net::{TcpStream, UnixDatagram};
use tokio::sync::Notify;
use tokio_util::task::AbortOnDropHandle;

/// Pause between two connection attempts to a port.
const TRY_AGAIN_AFTER: Duration = Duration::from_millis(20);
/// Maximum length of an `sd_notify` message.
const MESSAGE_BYTES: usize = 4_096;
/// Maximum length of an awaited line in bytes.
const MAX_LINE_BYTES: usize = 256;

/// How a worker shows that it is ready.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum Readiness {
    /// Its endpoint file exists, and its gRPC health there is SERVING.
    #[default]
    Health,
    /// It sends `READY=1` to the socket of `NOTIFY_SOCKET` (`sd_notify(3)`).
    Notify {
        /// It also sends `WATCHDOG=1` there, more often than every `WATCHDOG_USEC` (`sd_watchdog_enabled(3)`); otherwise it counts as
        /// hung.
        #[serde(default)]
        watchdog: bool,
    },
    /// A line of its standard output contains this text.
    Line {
        /// The text.
        contains: String,
    },
    /// A TCP port on loopback accepts connections.
    Port {
        /// The port.
        port: u16,
    },
}

/// A check that waits until a worker is ready.
#[derive(Debug)]
pub(super) enum ReadinessCheck {
    /// Asked with the TLS settings of the process manager.
    Health(ClientTls),
    Notify {
        socket: UnixDatagram,
        watchdog: bool,
    },
    Line(Arc<Notify>),
    Port(u16),
}

/// A check whether a worker still serves.
#[derive(Debug)]
pub(super) enum HealthCheck {
    Health(Health),
    Port(u16),
    Watchdog(Watchdog),
    /// There is none; the worker reports readiness once.
    None,
}

impl Readiness {
    /// What a worker that was not ready in time has not done.
    pub(super) fn missing(&self, id: &str) -> String {
        match self {
            Readiness::Health => {
                format!("its endpoint file {id}.endpoint is not there, or its gRPC health there does not say SERVING")
            }
            Readiness::Notify { .. } => "it has not said READY=1 to the socket of NOTIFY_SOCKET".to_owned(),
            Readiness::Line { contains } => format!("no line of its standard output has `{contains}` in it"),
            Readiness::Port { port } => format!("port {port} of loopback takes no connection"),
        }
    }

    pub(super) fn check(&self, at: &str, template: &Template) -> Result<(), ConfigError> {
        match self {
            Readiness::Health | Readiness::Notify { .. } => Ok(()),
            Readiness::Line { contains } => {
                let holds = (1..=MAX_LINE_BYTES).contains(&contains.len()) && !contains.contains(char::is_control);
                rule(format!("{at}.contains"), holds, format!("1 to {MAX_LINE_BYTES} bytes of one line"))
            }
            Readiness::Port { port } => {
                rule(format!("{at}.port"), *port > 0, "from 1 to 65535")?;
                let one = template.max_workers() == 1;
                rule(format!("{at}.port"), one, "two workers cannot have the same port: max has to be 1")
            }
        }
    }

    /// Whether a ready worker can be checked later.
    pub(super) fn can_be_asked(&self) -> bool {
        matches!(self, Readiness::Health | Readiness::Port { .. } | Readiness::Notify { watchdog: true })
    }

    /// The health check of a worker that was ready; `None` where there is none.
    pub(super) fn health_check(&self, socket: &Path, endpoint: &str, tls: &ClientTls) -> Option<HealthCheck> {
        match self {
            Readiness::Health => Some(HealthCheck::Health(Health::of(endpoint.parse().ok()?, tls))),
            Readiness::Port { port } => Some(HealthCheck::Port(*port)),
            Readiness::Notify { watchdog: true } => {
                bind(socket).ok().map(|socket| HealthCheck::Watchdog(Watchdog::on(socket)))
            }
            Readiness::Notify { watchdog: false } | Readiness::Line { .. } => None,
        }
    }

    /// The readiness check, made before the worker is started. `socket` is where the worker may notify.
    pub(super) fn readiness_check(&self, socket: &Path, tls: &ClientTls) -> io::Result<ReadinessCheck> {
        Ok(match self {
            Readiness::Health => ReadinessCheck::Health(tls.clone()),
            Readiness::Notify { watchdog } => ReadinessCheck::Notify { socket: bind(socket)?, watchdog: *watchdog },
            Readiness::Line { .. } => ReadinessCheck::Line(Arc::default()),
            Readiness::Port { port } => ReadinessCheck::Port(*port),
        })
    }
}

impl ReadinessCheck {
    /// Returns the worker's endpoint (empty where it has none) once it is ready.
    pub(super) async fn ready(
        self,
        directory: &RuntimeDirectory,
        id: &str,
        within: Duration,
    ) -> Result<(String, HealthCheck), String> {
        // A worker that is not a server has no endpoint.
        let endpoint = || directory.find(id).map(|endpoint| endpoint.to_string()).unwrap_or_default();
        match self {
            ReadinessCheck::Health(tls) => {
                let endpoint = directory.wait_for(id, within).await.map_err(|error| error.to_string())?;
                let mut health = Health::of(endpoint.clone(), &tls);
                health.serving(within).await.map_err(|error| error.to_string())?;
                Ok((endpoint.to_string(), HealthCheck::Health(health)))
            }
            ReadinessCheck::Notify { socket, watchdog } => {
                heard(&socket, b"READY=1").await.map_err(|error| error.to_string())?;
                let health_check =
                    if watchdog { HealthCheck::Watchdog(Watchdog::on(socket)) } else { HealthCheck::None };
                Ok((endpoint(), health_check))
            }
            ReadinessCheck::Line(seen) => {
                seen.notified().await;
                Ok((endpoint(), HealthCheck::None))
            }
            ReadinessCheck::Port(port) => {
                let mut health_check = HealthCheck::Port(port);
                health_check.check(within).await?;
                Ok((format!("http://{}:{port}", Ipv4Addr::LOCALHOST), health_check))
            }
        }
    }
}

impl HealthCheck {
    /// Returns once the worker has shown that it serves.
    pub(super) async fn check(&mut self, within: Duration) -> Result<(), String> {
        match self {
            HealthCheck::Health(health) => health.serving(within).await.map_err(|error| error.to_string()),
            HealthCheck::Port(port) => {
                let connected = tokio::time::timeout(within, async {
                    while TcpStream::connect((Ipv4Addr::LOCALHOST, *port)).await.is_err() {
                        tokio::time::sleep(TRY_AGAIN_AFTER).await;
                    }
                });
                connected
                    .await
                    .map_err(|_| format!("no connection to port {port} within {:.1} s", within.as_secs_f64()))
            }
            HealthCheck::Watchdog(watchdog) => {
                let heard = tokio::time::timeout(within, watchdog.heard.notified()).await;
                heard.map_err(|_| format!("no WATCHDOG=1 within {:.1} s", within.as_secs_f64()))
            }
            HealthCheck::None => Ok(()),
        }
    }
}

/// Receives the watchdog pings of a worker; they are read at once, so that the worker never has to wait.
#[derive(Debug)]
pub(super) struct Watchdog {
    /// Notified by each ping; a waiting check takes it.
    heard: Arc<Notify>,
    _listening: AbortOnDropHandle<()>,
}

impl Watchdog {
    fn on(socket: UnixDatagram) -> Watchdog {
        let known: Arc<Notify> = Arc::default();
        let tell = known.clone();
        let listening = tokio::spawn(async move {
            while heard(&socket, b"WATCHDOG=1").await.is_ok() {
                tell.notify_one();
            }
        });
        Watchdog { heard: known, _listening: AbortOnDropHandle::new(listening) }
    }
}

fn bind(socket: &Path) -> io::Result<UnixDatagram> {
    let _ = std::fs::remove_file(socket);
    UnixDatagram::bind(socket)
}

/// Returns once a message contains this line.
async fn heard(socket: &UnixDatagram, wanted: &[u8]) -> io::Result<()> {
    let mut message = vec![0; MESSAGE_BYTES];
    loop {
        let length = socket.recv(&mut message).await?;
        if message[..length].split(|byte| *byte == b'\n').any(|line| line == wanted) {
            return Ok(());
        }
    }
}
