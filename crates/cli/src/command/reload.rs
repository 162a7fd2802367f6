//! SIGHUP to a daemon: its config is read again. Settings that can be changed are changed; all others are named; a bad config
//! changes nothing.

use crate::system::config::SystemConfig;
use anyhow::Context;
use ratn_daemon::access::LiveAccess;
use ratn_daemon::reload;
use ratn_daemon::resource_manager::ResourceManagerConfig;
use ratn_daemon::telemetry::Logs;
use ratn_worker::tls::{self, ClientTls, LiveServerTls};
use std::path::PathBuf;
use tokio::sync::watch;

/// Sections that all daemons share.
const SHARED: [&str; 2] = ["service", "speed"];

/// A daemon's config and the parts that may change.
pub(super) struct Reloading {
    /// `None`: only the audit log is reopened, and certificates are read again.
    pub(super) file: Option<PathBuf>,
    /// The config with which the process began.
    pub(super) running: SystemConfig,
    /// The name of the daemon's section.
    pub(super) role: &'static str,
    pub(super) logs: Logs,
    /// The TLS settings of the server.
    pub(super) tls: Option<LiveServerTls>,
    /// The TLS settings of every client in the daemon.
    pub(super) client_tls: ClientTls,
    pub(super) access: LiveAccess,
    /// Limits of the resource manager.
    pub(super) bounds: watch::Sender<ResourceManagerConfig>,
}

impl Reloading {
    /// Reloads the config, as far as possible.
    pub(super) fn reload(&self) {
        match self.try_reload() {
            Ok(rest) if rest.is_empty() => tracing::info!("the config was read again and taken over"),
            Ok(rest) => {
                tracing::warn!(need_a_restart = rest.join(", "), "the config was taken over but for these keys")
            }
            Err(error) => tracing::error!("the config stays as it was: {error:#}"),
        }
    }

    /// Reloads; returns the keys that need a restart.
    fn try_reload(&self) -> anyhow::Result<Vec<String>> {
        let wanted = match &self.file {
            Some(file) => SystemConfig::read(file)?,
            None => self.running.clone(),
        };
        let (old, new) = (toml::Table::try_from(&self.running)?, toml::Table::try_from(&wanted)?);
        let renewed = tls::read_again(self.tls.as_ref(), &self.client_tls).context("[service.tls]")?;
        self.logs.reload(&wanted.service.log).context("[service.log]")?;
        renewed.take_over();
        self.access.replace(wanted.service.access);
        self.bounds.send_replace(wanted.resource_manager);
        let mine =
            |key: &String| SHARED.iter().chain([&self.role]).any(|section| key.split('.').next() == Some(section));
        Ok(reload::need_a_restart(&old, &new).into_iter().filter(mine).collect())
    }
}
