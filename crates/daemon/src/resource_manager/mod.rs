//! The resource manager: owns every resource of a system and grants leases of them.
//!
//! ```text
//!   gRPC call ──▶ service/ ──message──▶ actor (Pool of ratn-resources, a clock) ──answer, event──▶ service/
//!   session's stream ──▶ stream.rs, whose every message is such a call
//!   durable_actor ──records──▶ journal.rs (ratn-storage) ──durable──▶ outbox ──▶ replies and events are sent
//! ```
//! After a restart everything acknowledged is restored: resources, leases with their tokens, consumption, answers by request id. The times of
//! sessions and of leases with a maximum holding time begin anew. Waiting requests have to be repeated.

mod actor;
mod config;
mod handout;
mod journal;
mod providers;
mod round;
mod service;
mod status;
mod stream;
mod watch_filter;
mod watch_message;
mod wire;

pub use config::ResourceManagerConfig;

use crate::metrics::Metrics;
use crate::standby::{self, Place};
use anyhow::Context;
use ratn_model::resource::Lease;
use ratn_proto::v1::resource_service_server::ResourceServiceServer;
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::server::{Services, Serving};
use std::sync::Arc;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

/// The role name: for the endpoint file, the command and the config section.
pub const ROLE: &str = "resource-manager";

/// The result of an acquire.
type Granted = Result<Lease, tonic::Status>;

/// Serves until `shutdown` is cancelled.
///
/// # Errors
/// Its state cannot be opened, it cannot listen or publish its endpoint, or serving fails.
pub async fn run(
    config: ResourceManagerConfig,
    directory: RuntimeDirectory,
    shutdown: CancellationToken,
) -> anyhow::Result<()> {
    let (live, metrics) = (watch::Sender::new(config).subscribe(), Arc::new(Metrics::new(ROLE)));
    run_as(live, directory, Serving::default(), metrics, shutdown).await
}

/// Like [`run`], with the host's settings for serving and metrics. Limits are updated when the config changes.
///
/// # Errors
/// The same as [`run`].
pub async fn run_as(
    live: watch::Receiver<ResourceManagerConfig>,
    directory: RuntimeDirectory,
    serving: Serving,
    metrics: Arc<Metrics>,
    shutdown: CancellationToken,
) -> anyhow::Result<()> {
    let config = live.borrow().clone();
    let (storage, limits) = (config.storage.clone(), config.limits.clone());
    let open = move |store| journal::open(&storage, store, limits.clone());
    let place = Place {
        role: ROLE,
        storage: &config.storage,
        listen: &config.listen,
        directory: &directory,
        serving: &serving,
    };
    let Some(((pool, journal), bound)) = place.take(open, &shutdown).await? else { return Ok(()) };
    let kept = (pool.with_kinds(config.hierarchy()), journal.counting(&metrics.journal));
    let endpoint = bound.endpoint().clone();
    let over = CancellationToken::new();
    let _over = over.clone().drop_guard();
    let (actor, ended) =
        actor::start(live, kept, shutdown.clone(), serving.vitals.clone(), metrics.clone(), over.clone())?;
    let service = ResourceServiceServer::new(service::Service::new(actor, shutdown.clone(), metrics))
        .max_decoding_message_size(ratn_proto::MAX_MESSAGE_BYTES)
        .max_encoding_message_size(ratn_proto::MAX_MESSAGE_BYTES);
    let published = directory.publish(ROLE, &endpoint).context("cannot publish the endpoint")?;
    tracing::info!(%endpoint, "{ROLE} is ready");
    let served = standby::serve(bound, Services::new().with(service), serving, shutdown, &over).await;
    drop(published);
    // After this, everything has been written to disk.
    over.cancel();
    let _ = ended.await;
    Ok(served?)
}
