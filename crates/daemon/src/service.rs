//! What every daemon has around its own service: access control, logs, metrics, draining.
//!
//! ```text
//!   [service] of the config ──▶ ServiceConfig ──serving(role)──▶ ratn_worker::server::Serving (exposure, gate, drain)
//! ```

use crate::access::{ACCESS_VARIABLE, AccessConfig, Caller, LiveAccess, RoleGate};
use crate::config::{Check, ConfigError, rule};
use crate::metrics::Metrics;
use crate::quota::{QuotaConfig, Quotas};
use crate::telemetry::{self, LogConfig};
use ratn_otlp::OtlpConfig;
use ratn_worker::connections::OutOfConnections;
use ratn_worker::gate::{Gate, Identity, Permit};
use ratn_worker::server::{Exposure, Serving};
use ratn_worker::tls::{self, ClientTls, LiveServerTls, ServerTls, TlsError};
use ratn_worker::unix_socket::SocketAccess;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::watch;
use tonic::codegen::http;
use tonic::{Code, Status};

/// The section `[service]`, the same for every daemon of a host. All keys are optional.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ServiceConfig {
    /// Serves addresses beyond loopback even without TLS: the network itself is trusted.
    pub insecure: bool,
    /// Grace period for calls in progress at the end, in milliseconds.
    pub drain_ms: u64,
    /// Logs.
    pub log: LogConfig,
    /// Appends every mutation to this file, one JSON object per line.
    pub audit_file: Option<PathBuf>,
    /// Address of each role's metrics, such as `resource-manager = "127.0.0.1:9464"`; a role that is not listed serves none.
    pub metrics: BTreeMap<String, SocketAddr>,
    /// Serves every TCP address with TLS, only to clients with a certificate.
    pub tls: Option<ServerTls>,
    /// Who may connect to a Unix socket.
    pub socket: SocketAccess,
    /// Who may do what.
    pub access: AccessConfig,
    /// Limits of what one caller may do at the same time.
    pub quotas: QuotaConfig,
    /// Destination of OpenTelemetry spans.
    pub otlp: OtlpConfig,
}

impl Default for ServiceConfig {
    fn default() -> Self {
        ServiceConfig {
            insecure: false,
            drain_ms: 500,
            log: LogConfig::default(),
            audit_file: None,
            metrics: BTreeMap::new(),
            tls: None,
            socket: SocketAccess::default(),
            access: AccessConfig::default(),
            quotas: QuotaConfig::default(),
            otlp: OtlpConfig::default(),
        }
    }
}

impl Check for ServiceConfig {
    fn check(&self) -> Result<(), ConfigError> {
        rule("drain_ms", (1..=600_000).contains(&self.drain_ms), "from 1 ms to 10 minutes")?;
        rule("log.filter", telemetry::is_filter(&self.log.filter), "a filter, as `info,ratn_daemon=debug`")?;
        self.quotas.check()?;
        self.otlp.fault().map_or(Ok(()), |fault| rule(fault.key, false, fault.rule))?;
        self.socket.fault().map_or(Ok(()), |(key, broken)| rule(key, false, broken))?;
        self.access.check()
    }
}

impl ServiceConfig {
    /// The certificate that a daemon shows as a client, and the authority that it trusts. These come from the environment
    /// (`from_environment`), else they are its own certificate and the authority of its clients, because a system has one authority.
    ///
    /// # Errors
    /// [`TlsError`] of a file that cannot be read.
    pub fn client_tls(&self, from_environment: &ClientTls) -> Result<ClientTls, TlsError> {
        match &self.tls {
            Some(files) if from_environment.is_none() => {
                ClientTls::read(&files.client_ca, Some((&files.cert, &files.key)))
            }
            _ => Ok(from_environment.clone()),
        }
    }

    /// Environment variables of the processes that a daemon starts, so that they admit the same clients and show the same certificate.
    /// `file` is the system's config. TLS variables in the environment of this process stay as they are.
    pub fn for_workers(&self, file: Option<&Path>) -> BTreeMap<&'static str, PathBuf> {
        let mut environment = BTreeMap::new();
        if let Some(file) = file.and_then(|file| std::path::absolute(file).ok()) {
            environment.insert(ACCESS_VARIABLE, file);
        }
        if let Some(files) = self.tls.as_ref().filter(|_| std::env::var_os(tls::CA_VARIABLE).is_none()) {
            environment.insert(tls::CA_VARIABLE, files.client_ca.clone());
            environment.insert(tls::CERT_VARIABLE, files.cert.clone());
            environment.insert(tls::KEY_VARIABLE, files.key.clone());
        }
        environment
    }

    /// How a daemon serves that counts its calls in `metrics`.
    pub fn serving(&self, metrics: &Arc<Metrics>) -> Serving {
        self.serving_with(&LiveAccess::new(self.access.clone()), metrics)
    }

    /// As [`ServiceConfig::serving`], with roles that may change while it runs.
    pub fn serving_with(&self, access: &LiveAccess, metrics: &Arc<Metrics>) -> Serving {
        Serving {
            exposure: Exposure {
                tls: self.tls.clone().map(LiveServerTls::new),
                insecure: self.insecure,
                socket: self.socket.clone(),
            },
            gate: Arc::new(QuotaGate {
                roles: RoleGate::new(access.clone()),
                quotas: Quotas::new(self.quotas.clone(), metrics.clone()),
                metrics: metrics.clone(),
            }),
            connections: self.quotas.connections(),
            drain: Duration::from_millis(self.drain_ms),
            ..Serving::default()
        }
    }
}

/// The gate of every server, with quotas for each caller; it also counts calls.
struct QuotaGate {
    roles: RoleGate,
    quotas: Quotas,
    metrics: Arc<Metrics>,
}

impl Gate for QuotaGate {
    fn caller(&self, identity: &Identity) -> Caller {
        self.roles.caller(identity)
    }

    fn admit(&self, caller: &Caller, path: &str, extensions: &mut http::Extensions) -> Result<(), Status> {
        self.roles.admit(caller, path, extensions)?;
        if let Some(permit) = self.quotas.admit(caller, path, Instant::now())? {
            extensions.insert(permit);
        }
        // For calls that come on a stream.
        extensions.insert(self.quotas.clone());
        Ok(())
    }

    fn changes(&self) -> Option<watch::Receiver<()>> {
        self.roles.changes()
    }

    fn look_again(&self) {
        self.roles.look_again();
    }

    fn answered(&self, path: &str, code: Code, took: Duration) {
        self.metrics.call(path, code, took);
    }

    fn unread(&self, caller: &Caller, bytes: usize) -> Result<Option<Permit>, Status> {
        self.quotas.unread(caller, bytes, Instant::now())
    }

    fn out_of_connections(&self, why: &OutOfConnections) {
        self.metrics.refused("connect", why.reason().to_owned());
    }
}
