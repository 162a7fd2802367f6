//! The daemons and workers: this binary as something else.

use super::{blocking, blocking_on};
use crate::arguments::{ResourceManagerArguments, RoleArguments, WorkerArguments, WorkerKind};
use crate::failure::Failure;
use crate::output;
use crate::system::config::SystemConfig;
use crate::system::{public_directory, variable};
use anyhow::Context;
use ratn_daemon::service::ServiceConfig;
use ratn_daemon::{process_manager, resource_manager, telemetry, world_pool};
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::server::{Exposure, Serving};
use ratn_worker::worker::WorkerOptions;
use ratn_worker::{shutdown, tls};
use std::path::PathBuf;
use std::time::Duration;
use tokio_util::sync::CancellationToken;

/// The environment variables that say where state is kept; the second is systemd's.
const STATE_VARIABLES: [&str; 2] = ["RATN_STATE_DIR", "STATE_DIRECTORY"];

/// After the drain a daemon has this long to end what it owns: workers, a session, what is still to be written.
const EXIT_PATIENCE: Duration = Duration::from_secs(2);

/// `ratn resource-manager`
pub(super) fn resource_manager(arguments: &ResourceManagerArguments) -> Result<(), Failure> {
    let ResourceManagerArguments { role: arguments, durability, state_dir } = arguments;
    let system = SystemConfig::load(arguments.config.as_deref())?;
    let mut config = system.resource_manager.clone();
    config.listen = arguments.listen.clone().unwrap_or(config.listen);
    let storage = &mut config.storage;
    storage.durability = durability.unwrap_or(storage.durability);
    let of_this_role = |directory: PathBuf| directory.join(resource_manager::ROLE);
    let elsewhere = || STATE_VARIABLES.iter().find_map(|name| variable(name)).map(of_this_role);
    storage.directory = state_dir.clone().map(of_this_role).or(storage.directory.take()).or_else(elsewhere);
    // On one thread requests are handled in the order in which they arrive; task control sends the most urgent first.
    let runtime = tokio::runtime::Builder::new_current_thread();
    daemon_on(runtime, arguments, &system.service, async |host| {
        resource_manager::run_as(config, host.directory, host.serving, host.shutdown).await
    })
}

/// `ratn world-pool`
pub(super) fn world_pool(arguments: &RoleArguments) -> Result<(), Failure> {
    let system = SystemConfig::load(arguments.config.as_deref())?;
    let mut config = system.world_pool.clone();
    config.listen = arguments.listen.clone().unwrap_or(config.listen);
    daemon(arguments, &system.service, async |host| {
        world_pool::run_as(config, host.directory, host.serving, host.shutdown).await
    })
}

/// `ratn process-manager`
pub(super) fn process_manager(arguments: &RoleArguments) -> Result<(), Failure> {
    let system = SystemConfig::load(arguments.config.as_deref())?;
    let mut config = system.process_manager_config();
    config.listen = arguments.listen.clone().unwrap_or(config.listen);
    daemon(arguments, &system.service, async |host| {
        process_manager::run_as(config, host.directory, host.serving, host.shutdown).await
    })
}

/// `ratn cell`
pub(super) fn cell(arguments: &RoleArguments) -> Result<(), Failure> {
    let system = SystemConfig::load(arguments.config.as_deref())?;
    let mut config = system.cell.clone();
    config.listen = arguments.listen.clone().unwrap_or(config.listen);
    daemon(arguments, &system.service, async |host| {
        ratn_cell::run_as(config, host.directory, host.serving, host.shutdown).await
    })
}

/// `ratn worker …`
pub(super) fn worker(arguments: &WorkerArguments) -> Result<(), Failure> {
    telemetry::start();
    let options = WorkerOptions {
        id: arguments.id.clone(),
        kind: arguments.kind.clone(),
        listen: arguments.listen.clone(),
        endpoint_file: arguments.endpoint_file.clone(),
        exit_with_parent: arguments.exit_with_parent,
        resource_manager: arguments.resource_manager.clone(),
        host: arguments.host.clone(),
        exposure: Exposure { tls: tls::server_from_environment(), insecure: arguments.insecure },
    };
    let speed = arguments.speed;
    blocking(async {
        match arguments.worker {
            WorkerKind::PathPlanner => ratn_workers::path_planner::run(options, speed).await?,
            WorkerKind::Detector => ratn_workers::detector::run(options, speed).await?,
        }
        Ok(())
    })
}

/// What a daemon finds where it runs.
struct Host {
    directory: RuntimeDirectory,
    serving: Serving,
    shutdown: CancellationToken,
}

fn daemon(
    arguments: &RoleArguments,
    service: &ServiceConfig,
    run: impl AsyncFnOnce(Host) -> anyhow::Result<()>,
) -> Result<(), Failure> {
    daemon_on(tokio::runtime::Builder::new_multi_thread(), arguments, service, run)
}

/// What every daemon does around its own work.
fn daemon_on(
    runtime: tokio::runtime::Builder,
    arguments: &RoleArguments,
    service: &ServiceConfig,
    run: impl AsyncFnOnce(Host) -> anyhow::Result<()>,
) -> Result<(), Failure> {
    if arguments.check_config {
        output::progress("the config is good");
        return Ok(());
    }
    let mut service = service.clone();
    service.insecure |= arguments.insecure;
    service.trust().context("[service.tls]")?;
    let _logs = telemetry::start_as(&service.log, service.audit_file.as_deref())?;
    blocking_on(runtime, async {
        let shutdown = CancellationToken::new();
        let patience = Duration::from_millis(service.drain_ms) + EXIT_PATIENCE;
        shutdown::on_signals_within(&shutdown, patience).context("cannot catch signals")?;
        if arguments.exit_with_parent {
            shutdown::exit_with_parent(&shutdown).context("cannot watch standard input")?;
        }
        let directory = public_directory(arguments.runtime_dir.as_deref());
        let directory = RuntimeDirectory::create(&directory)
            .with_context(|| format!("cannot make the runtime directory {}", directory.display()))?;
        Ok(run(Host { directory, serving: service.serving(), shutdown }).await?)
    })
}
