//! The link to the resource manager: a session, the modules and the battery as its resources, and the lease watch. It reconnects when the manager
//! returns at another endpoint.

use super::actions::resource_id;
use super::cell_actor::CellHandle;
use crate::config::CellConfig;
use crate::core::protocol::Module;
use ratn_model::resource::ResourceClass;
use ratn_model::value::Value;
use ratn_panic_point::panic_point;
use ratn_proto::types::Resource;
use ratn_worker::action::ActionServer;
use ratn_worker::client::{CallError, Channels};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::lease_watch::LeaseWatch;
use ratn_worker::provider::Provider;
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::session::Session;
use std::time::Duration;
use tokio_util::sync::CancellationToken;

/// The role of the resource manager in the runtime directory.
const RESOURCE_MANAGER: &str = "resource-manager";
/// How long one wait for the manager's endpoint file lasts, before it is looked for again.
const FIND_DEADLINE: Duration = Duration::from_secs(60);
/// The kind of the resource for the middle of a workplace, which several arms can reach.
pub const MIDDLE: &str = "Middle";

/// Interval for reading the battery and for checking whether the manager has moved.
const LOOK_INTERVAL: Duration = Duration::from_millis(500);
/// The battery's level is updated when it has changed by this much.
const LEVEL_STEP: f64 = 0.01;

pub(crate) struct Link {
    pub(crate) config: CellConfig,
    pub(crate) directory: RuntimeDirectory,
    pub(crate) channels: Channels,
    /// The endpoint of the modules' actions.
    pub(crate) endpoint: Endpoint,
    pub(crate) handle: CellHandle,
    /// The watch of the modules' leases.
    pub(crate) leases: LeaseWatch,
    /// The server of the modules' goals.
    pub(crate) server: ActionServer,
    /// Time that goals have to end in at the shutdown.
    pub(crate) patience: Duration,
}

impl Link {
    /// Keeps the link until `shutdown`; then all goals are stopped, and the session is closed when nothing moves any more.
    pub(crate) async fn keep(self, shutdown: CancellationToken) {
        while !shutdown.is_cancelled() {
            let Some(Some(manager)) = shutdown.run_until_cancelled(self.find()).await else { continue };
            let ttl = Duration::from_millis(self.config.session_ttl_ms);
            let session = Session::open(&self.channels, &manager, &format!("cell@{}", self.config.host), ttl);
            let linked = shutdown.run_until_cancelled(Box::pin(self.offer(&manager, &session))).await;
            if let Some(Err(error)) = linked {
                tracing::warn!(%manager, %error, "the resource manager does not want the cell's resources");
            }
            if shutdown.is_cancelled() {
                return self.end(session).await;
            }
            // The modules, and every lease of them, end with the session.
            self.leases.lost("the cell's session with the resource manager has ended");
            session.close().await;
            // Waits before it asks a manager that refused again.
            let _ = shutdown.run_until_cancelled(tokio::time::sleep(LOOK_INTERVAL)).await;
        }
    }

    async fn end(&self, session: Session) {
        match tokio::time::timeout(self.patience, self.server.shut_down()).await {
            Ok(()) => session.close().await,
            Err(_) => {
                tracing::error!(
                    "something still moves at the end: the modules are the cell's until its session has run out"
                );
                session.abandon().await;
            }
        }
    }

    async fn find(&self) -> Option<Endpoint> {
        match &self.config.resource_manager {
            Some(endpoint) => Some(endpoint.clone()),
            None => {
                let found = self.directory.wait_for(RESOURCE_MANAGER, FIND_DEADLINE).await;
                found.inspect_err(|error| tracing::warn!(%error, "the cell's modules are offered to nobody yet")).ok()
            }
        }
    }

    /// Offers all resources and keeps the battery's level up to date, until the manager has moved.
    async fn offer(&self, manager: &Endpoint, session: &Session) -> Result<(), CallError> {
        let provider = Provider::start_at_rest(&self.channels, manager, session, &self.leases)?;
        let patience = Duration::from_millis(self.config.session_ttl_ms);
        let watching = self.leases.follow_session(&self.channels, manager, session, patience)?;
        let offering = async {
            for module in self.handle.modules() {
                let id = resource_id(module, self.handle.robot(), &self.config.host);
                let mut resource =
                    Resource::new(id, ResourceClass::Module, module.kind()).with_endpoint(&self.endpoint);
                if module != Module::Camera {
                    resource = resource.with_standstill(self.config.standstill());
                }
                if let Some(arm) = module.arm_name(self.handle.robot()) {
                    resource = resource.with_attribute("arm", Value::String(arm.to_owned()));
                }
                provider.offer(resource.on_host(&self.config.host)).await?;
            }
            if self.handle.robot().workplace().is_some_and(|workplace| workplace.middle.is_some()) {
                provider.offer(self.middle()).await?;
            }
            let mut told = f64::NEG_INFINITY;
            loop {
                let level = self.handle.state().await.map_or(0.0, |state| state.battery);
                if (level - told).abs() >= LEVEL_STEP {
                    told = level;
                    provider.offer(self.battery(level)).await?;
                }
                tokio::time::sleep(LOOK_INTERVAL).await;
                panic_point("link");
                if self.has_moved_from(manager) {
                    return Ok(());
                }
            }
        };
        tokio::select! {
            offered = offering => offered,
            () = watching => Ok(()),
            // The next session has another id.
            () = session.taken() => Ok(()),
        }
    }

    fn middle(&self) -> Resource {
        // An arm of a run that is gone may still be braking there.
        Resource::new(format!("middle@{}", self.config.host), ResourceClass::System, MIDDLE)
            .with_standstill(self.config.standstill())
            .on_host(&self.config.host)
    }

    fn battery(&self, level: f64) -> Resource {
        Resource::new(format!("battery@{}", self.config.host), ResourceClass::System, "Battery")
            .divisible()
            .with_attribute("level", Value::Float((level * 1000.0).round() / 1000.0))
            .on_host(&self.config.host)
    }

    fn has_moved_from(&self, manager: &Endpoint) -> bool {
        self.config.resource_manager.is_none()
            && self.directory.find(RESOURCE_MANAGER).is_ok_and(|endpoint| endpoint != *manager)
    }
}
