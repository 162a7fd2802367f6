//! The process around the cell's core.
//!
//! ```text
//!   lease watch ─▶ action service ─┐                                      ┌─▶ outcome of the goal
//!                                  ├─event─▶ cell_actor.rs (Cell, clock) ─┤
//!   cell service ──────────────────┘         wakes when the core says     └─▶ ground truth
//! ```
//! The cell's thread owns the core; all other tasks send it messages.

mod actions;
mod attention;
mod cell_actor;
pub(crate) mod link;
#[cfg(test)]
mod pace;
mod recorder;
mod service;

use crate::config::CellConfig;
use crate::core::cell::Cell;
use anyhow::Context;
use ratn_proto::v1::cell_service_server::CellServiceServer;
use ratn_worker::client::Channels;
use ratn_worker::panic::exit_on_panic;
use ratn_worker::robot_clock::RobotClock;
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::safety::Safety;
use ratn_worker::server::{Services, Serving, bind_as};
use ratn_worker::tls::ClientTls;
use recorder::Recorder;
use tokio_util::sync::CancellationToken;

/// The role's name: for its endpoint file, its command and its section of a config.
pub const ROLE: &str = "cell";

/// This file exists in the state directory while an emergency stop is in force: a restarted cell, also after a reboot, is still stopped.
const STOPPED_FILE: &str = "stopped";
/// The name of that file in the runtime directory, where earlier versions had it.
const EARLIER_STOPPED_FILE: &str = "cell.stopped";

/// Serves until `shutdown` is cancelled. The modules' resources are offered as soon as the resource manager is available.
///
/// # Errors
/// If the config is invalid, if it cannot listen or publish its endpoint, or if serving fails.
pub async fn run(config: CellConfig, directory: RuntimeDirectory, shutdown: CancellationToken) -> anyhow::Result<()> {
    run_as(config, directory, Serving::default(), ClientTls::none(), shutdown).await
}

/// As [`run`], with the host's serving options; `tls` is its TLS configuration as a client.
///
/// # Errors
/// As [`run`].
pub async fn run_as(
    config: CellConfig,
    directory: RuntimeDirectory,
    serving: Serving,
    tls: ClientTls,
    shutdown: CancellationToken,
) -> anyhow::Result<()> {
    config.check()?;
    let laid = config.clone();
    tracing::info!(robot = config.robot, "reading the robot and its meshes, and laying the scene");
    let cell = tokio::task::spawn_blocking(move || Cell::new(laid)).await.context("cannot lay the scene")??;
    let recorder = match &config.record {
        Some(file) => Recorder::begin(file, &cell)?,
        None => Recorder::none(),
    };
    let handle = cell_actor::start(cell, recorder, RobotClock::start(config.speed), serving.vitals.clone())
        .context("cannot start the cell")?;

    let bound = bind_as(&directory.listen(&config.listen, ROLE)?, &serving.exposure).await?;
    let endpoint = bound.endpoint().clone();
    let channels = Channels::new(&tls);
    let safety = safety(&config, &directory, &handle).await?;
    let leases = actions::leases(&handle, &config);
    // A simulated robot ends with its process: this new one has not moved yet.
    leases.brought_to_rest();
    let server = actions::server(&handle, &config, channels.clone(), safety.clone(), &leases);
    let services = Services::new()
        .with(server.clone().into_service())
        .with(safety.into_service())
        .with(CellServiceServer::new(service::Service::new(handle.clone(), config.scene)));
    let link = link::Link {
        config,
        directory: directory.clone(),
        channels,
        endpoint: endpoint.clone(),
        handle,
        leases,
        server,
        patience: serving.drain,
    };
    let over = shutdown.child_token();
    let _over = over.clone().drop_guard();
    let linked = tokio::spawn(exit_on_panic("the link to the resource manager", link.keep(over.clone())));
    let published = directory.publish(ROLE, &endpoint).context("cannot publish the endpoint")?;
    tracing::info!(%endpoint, "{ROLE} is ready");
    let served = bound.serve_as(services, serving, shutdown).await;
    drop(published);
    over.cancel();
    linked.await.context("the link to the resource manager")?;
    Ok(served?)
}

/// The safety of the cell: stopped if a stop was in force when the previous process ended. Nothing has moved yet.
async fn safety(
    config: &CellConfig,
    directory: &RuntimeDirectory,
    handle: &cell_actor::CellHandle,
) -> anyhow::Result<Safety> {
    let state = config.state_dir.clone().unwrap_or_else(|| directory.path().join("state").join(ROLE));
    let stopped = state.join(STOPPED_FILE);
    let safety = Safety::kept_in(stopped.clone(), handle.clone()).await;
    let safety = safety.with_context(|| format!("cannot tell from {} whether it is stopped", stopped.display()))?;
    let earlier = directory.path().join(EARLIER_STOPPED_FILE);
    match std::fs::read_to_string(&earlier) {
        Ok(reason) => {
            safety.stop(&reason).await.context("the stop that an earlier version kept is not taken over")?;
            std::fs::remove_file(&earlier).with_context(|| format!("cannot remove {}", earlier.display()))?;
        }
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => {}
        Err(error) => {
            return Err(error).with_context(|| format!("cannot tell from {} whether it is stopped", earlier.display()));
        }
    }
    Ok(safety)
}
