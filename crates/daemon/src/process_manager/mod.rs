//! The process manager of one host (the paper's process pools, Section V-C): starts worker processes from the templates
//! of its config, offers each to the resource manager once it serves, and replaces those that die.
//!
//! ```text
//!   gRPC call ──▶ service.rs ──message──▶ actor.rs ──command──▶ spawner.rs (one thread) ──▶ worker processes
//!                                          │ ▲ pools/ (what there should be)                  │ exit, health
//!                  resource manager ◀──link┘ └─────────────────────────────────────────────────┘
//! ```
//! What the workers do, and who uses them, it does not know.

mod actor;
mod config;
mod drained;
mod environment;
mod limits;
mod log;
pub mod log_file;
mod log_stream;
mod order;
mod parameter;
pub mod pools;
mod processes;
mod readiness;
mod service;
mod spawner;
mod status;
mod template;
mod usage;

pub use config::ProcessManagerConfig;
pub use limits::Limits;
pub use parameter::Parameter;
pub use readiness::Readiness;
pub use template::{Liveness, Template};

use crate::demand::{DemandLink, Shortages};
use crate::link::{Link, Manager, Turnover, Wanted};
use anyhow::Context;
use ratn_model::resource::ResourceClass;
use ratn_model::value::Value;
use ratn_proto::types::Resource;
use ratn_proto::v1::process_service_server::ProcessServiceServer;
use ratn_worker::endpoint::Endpoint;
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::server::{Services, Serving, bind_as};
use std::collections::BTreeSet;
use std::time::Duration;
use tokio::sync::{mpsc, watch};
use tokio_util::sync::CancellationToken;

/// The role's name: of its endpoint file, its command and its section of a config.
pub const ROLE: &str = "process-manager";
/// What became of resources which the actor was not told of yet.
const THERE: usize = 1_024;
/// States of the demand that the actor was not told of yet.
const DEMANDS: usize = 16;

/// The kind of the resource that a host is: by its endpoint the host's process manager is found.
pub const HOST_KIND: &str = "Host";

/// Serves until `shutdown` is cancelled, and returns once every worker is gone.
///
/// # Errors
/// Where it cannot listen, publish its endpoint or start its thread, or where serving fails.
pub async fn run(
    config: ProcessManagerConfig,
    directory: RuntimeDirectory,
    shutdown: CancellationToken,
) -> anyhow::Result<()> {
    run_as(config, directory, Serving::default(), shutdown).await
}

/// As [`run`], served as its host wants it.
///
/// # Errors
/// As [`run`].
pub async fn run_as(
    config: ProcessManagerConfig,
    directory: RuntimeDirectory,
    serving: Serving,
    shutdown: CancellationToken,
) -> anyhow::Result<()> {
    let bound = bind_as(&directory.listen(&config.listen, ROLE)?, &serving.exposure).await?;
    let endpoint = bound.endpoint().clone();
    let (wanted, to_offer) = watch::channel(Wanted::new());
    let (told, there) = mpsc::channel(THERE);
    let (leaves, leaving) = watch::channel(BTreeSet::new());
    let (used, uses) = mpsc::channel(THERE);
    let (heard, demand) = mpsc::channel(DEMANDS);
    let (short, shortages) = watch::channel(Shortages::new());
    let link = Link {
        manager: Manager { configured: config.resource_manager.clone(), directory: directory.clone() },
        client: format!("{ROLE}@{}", config.host),
        ttl: Duration::from_millis(config.session_ttl_ms),
        wanted: to_offer,
        there: Some(Turnover { told, leaving }),
        demand: Some(DemandLink { kinds: config.kinds(), heard, shortages, used }),
    };
    let linked = tokio::spawn(link.keep(shutdown.clone()));
    let host = host_resource(&config, &endpoint);
    wanted.send_modify(|wanted| drop(wanted.insert(host.id.clone(), host)));
    let parts = actor::Parts { config, directory: directory.clone(), wanted, leaves, there, uses, demand, short };
    let (actor, ended) = actor::start(parts, shutdown.clone()).context("cannot start workers")?;
    let service = ProcessServiceServer::new(service::Service::new(actor, directory.clone(), shutdown.clone()));
    let published = directory.publish(ROLE, &endpoint).context("cannot publish the endpoint")?;
    tracing::info!(%endpoint, "{ROLE} is ready");
    let served = bound.serve_as(Services::new().with(service), serving, shutdown.clone()).await;
    drop(published);
    shutdown.cancel();
    let _ = tokio::join!(linked, ended);
    Ok(served?)
}

/// This host, as everybody finds it at the resource manager.
fn host_resource(config: &ProcessManagerConfig, endpoint: &Endpoint) -> Resource {
    Resource::new(format!("host@{}", config.host), ResourceClass::System, HOST_KIND)
        .with_endpoint(endpoint)
        .with_attribute("host", Value::String(config.host.clone()))
        .on_host(&config.host)
}
