//! The resource manager: owns every resource of a system, and says who has what.
//!
//! ```text
//!   gRPC call ──▶ service.rs ──message──▶ actor.rs (Pool of ratn-resources, a clock) ──answer, event──▶ service.rs
//!   session's stream ──▶ stream.rs, whose every message is such a call
//! ```
//! In memory: after a restart sessions are opened anew and providers offer their resources again; only fencing tokens
//! keep growing.

mod actor;
mod config;
mod service;
mod status;
mod stream;
mod wire;

pub use config::ResourceManagerConfig;

use anyhow::Context;
use ratn_model::resource::Lease;
use ratn_proto::v1::resource_service_server::ResourceServiceServer;
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::server::{Services, Serving, bind_as};
use tokio_util::sync::CancellationToken;

/// The role's name: of its endpoint file, its command and its section of a config.
pub const ROLE: &str = "resource-manager";

/// How an acquire ends.
type Granted = Result<Lease, tonic::Status>;

/// Serves until `shutdown` is cancelled.
///
/// # Errors
/// Where it cannot listen or publish its endpoint, or where serving fails.
pub async fn run(
    config: ResourceManagerConfig,
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
    config: ResourceManagerConfig,
    directory: RuntimeDirectory,
    serving: Serving,
    shutdown: CancellationToken,
) -> anyhow::Result<()> {
    let bound = bind_as(&directory.listen(&config.listen, ROLE)?, &serving.exposure).await?;
    let endpoint = bound.endpoint().clone();
    let actor = actor::start(config, shutdown.clone());
    let service = ResourceServiceServer::new(service::Service::new(actor, shutdown.clone()))
        .max_decoding_message_size(ratn_proto::MAX_MESSAGE_BYTES)
        .max_encoding_message_size(ratn_proto::MAX_MESSAGE_BYTES);
    let published = directory.publish(ROLE, &endpoint).context("cannot publish the endpoint")?;
    tracing::info!(%endpoint, "{ROLE} is ready");
    let served = bound.serve_as(Services::new().with(service), serving, shutdown).await;
    drop(published);
    Ok(served?)
}
