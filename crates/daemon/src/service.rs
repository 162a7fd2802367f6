//! What surrounds every daemon, whatever it serves: who may connect and do what, logs, metrics, the drain.
//!
//! ```text
//!   [service] of the config ──▶ ServiceConfig ──serving(role)──▶ ratn_worker::server::Serving (exposure, gate, drain)
//! ```

use crate::access::{AccessConfig, Operation};
use crate::config::{Check, ConfigError, rule};
use crate::metrics;
use crate::quota::{QuotaConfig, Quotas};
use crate::telemetry::{self, LogConfig};
use ratn_worker::gate::{Gate, Identity};
use ratn_worker::server::{Exposure, Serving};
use ratn_worker::tls::{self, ClientTls, ServerTls, TlsError};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::{Arc, PoisonError, RwLock};
use std::time::{Duration, Instant};
use tonic::codegen::http;
use tonic::{Code, Status};

/// The section `[service]`, the same for every daemon of a host. All keys are optional.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ServiceConfig {
    /// Serve addresses beyond loopback also without TLS: the network itself is trusted.
    pub insecure: bool,
    /// Calls under way at the end are given this long, in milliseconds.
    pub drain_ms: u64,
    /// Logs.
    pub log: LogConfig,
    /// Append every mutation to this file, one JSON object a line.
    pub audit_file: Option<PathBuf>,
    /// Where each role shows its metrics, `resource-manager = "127.0.0.1:9464"`; a role that is not named shows none.
    pub metrics: BTreeMap<String, SocketAddr>,
    /// With it every TCP address is served with TLS, and only to who shows a certificate.
    pub tls: Option<ServerTls>,
    /// Who may do what.
    pub access: AccessConfig,
    /// How much of it one caller may do at the same time.
    pub quotas: QuotaConfig,
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
            access: AccessConfig::default(),
            quotas: QuotaConfig::default(),
        }
    }
}

impl Check for ServiceConfig {
    fn check(&self) -> Result<(), ConfigError> {
        rule("drain_ms", (1..=600_000).contains(&self.drain_ms), "from 1 ms to 10 minutes")?;
        rule("log.filter", telemetry::is_filter(&self.log.filter), "a filter, as `info,ratn_daemon=debug`")?;
        self.quotas.check()?;
        self.access.check()
    }
}

impl ServiceConfig {
    /// What this process shows to others and whom it trusts, where the environment did not say: its own certificate and the
    /// authority of its clients, one authority being for a whole system.
    ///
    /// # Errors
    /// [`TlsError`] of a file that cannot be read.
    pub fn trust(&self) -> Result<(), TlsError> {
        if let Some(files) = &self.tls {
            tls::install(ClientTls::read(&files.client_ca, Some((&files.cert, &files.key)))?);
        }
        Ok(())
    }

    /// How a daemon serves.
    pub fn serving(&self) -> Serving {
        self.serving_with(&LiveAccess::new(self.access.clone()))
    }

    /// As [`ServiceConfig::serving`], with roles that may change meanwhile.
    pub fn serving_with(&self, access: &LiveAccess) -> Serving {
        Serving {
            exposure: Exposure { tls: self.tls.clone(), insecure: self.insecure },
            gate: Arc::new(RoleGate {
                access: access.clone(),
                own_uid: nix::unistd::geteuid().as_raw(),
                quotas: Quotas::new(self.quotas.clone()),
            }),
            connections: self.quotas.connections(),
            drain: Duration::from_millis(self.drain_ms),
            ..Serving::default()
        }
    }
}

/// Who has which roles, as of now.
#[derive(Debug, Clone)]
pub struct LiveAccess(Arc<RwLock<AccessConfig>>);

impl LiveAccess {
    /// As a config says.
    pub fn new(access: AccessConfig) -> LiveAccess {
        LiveAccess(Arc::new(RwLock::new(access)))
    }

    /// From the next call on, and the next stream of calls.
    pub fn replace(&self, access: AccessConfig) {
        *self.0.write().unwrap_or_else(PoisonError::into_inner) = access;
    }
}

/// Admits by the table of [`crate::access`], and leaves the [`Caller`] in the request.
struct RoleGate {
    access: LiveAccess,
    own_uid: u32,
    quotas: Quotas,
}

impl Gate for RoleGate {
    fn admit(&self, identity: &Identity, path: &str, extensions: &mut http::Extensions) -> Result<(), Status> {
        let access = self.access.0.read().unwrap_or_else(PoisonError::into_inner);
        let caller = access.caller(identity, self.own_uid);
        drop(access);
        caller.admit(Operation::of_path(path))?;
        if let Some(permit) = self.quotas.admit(&caller, path, Instant::now())? {
            extensions.insert(permit);
        }
        // For the calls on a stream.
        extensions.insert(self.quotas.clone());
        extensions.insert(caller);
        Ok(())
    }

    fn answered(&self, path: &str, code: Code, took: Duration) {
        if let Some(metrics) = metrics::get() {
            metrics.call(path, code, took);
        }
    }
}
