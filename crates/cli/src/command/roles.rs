//! The daemons and workers: this binary as something else.

use super::{blocking, blocking_on};
use crate::arguments::{RoleArguments, WorkerArguments, WorkerKind};
use crate::failure::Failure;
use crate::output;
use crate::system::config::SystemConfig;
use crate::system::public_directory;
use anyhow::Context;
use ratn_daemon::{process_manager, resource_manager, telemetry, world_pool};
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::shutdown;
use ratn_worker::worker::WorkerOptions;
use tokio_util::sync::CancellationToken;

/// `ratn resource-manager`
pub(super) fn resource_manager(arguments: &RoleArguments) -> Result<(), Failure> {
    let mut config = SystemConfig::load(arguments.config.as_deref())?.resource_manager;
    config.listen = arguments.listen.clone().unwrap_or(config.listen);
    // On one thread requests are handled in the order in which they arrive; task control sends the most urgent first.
    let runtime = tokio::runtime::Builder::new_current_thread();
    daemon_on(runtime, arguments, async |directory, token| resource_manager::run(config, directory, token).await)
}

/// `ratn world-pool`
pub(super) fn world_pool(arguments: &RoleArguments) -> Result<(), Failure> {
    let mut config = SystemConfig::load(arguments.config.as_deref())?.world_pool;
    config.listen = arguments.listen.clone().unwrap_or(config.listen);
    daemon(arguments, async |directory, token| world_pool::run(config, directory, token).await)
}

/// `ratn process-manager`
pub(super) fn process_manager(arguments: &RoleArguments) -> Result<(), Failure> {
    let mut config = SystemConfig::load(arguments.config.as_deref())?.process_manager_config();
    config.listen = arguments.listen.clone().unwrap_or(config.listen);
    daemon(arguments, async |directory, token| process_manager::run(config, directory, token).await)
}

/// `ratn cell`
pub(super) fn cell(arguments: &RoleArguments) -> Result<(), Failure> {
    let mut config = SystemConfig::load(arguments.config.as_deref())?.cell;
    config.listen = arguments.listen.clone().unwrap_or(config.listen);
    daemon(arguments, async |directory, token| ratn_cell::run(config, directory, token).await)
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

fn daemon(
    arguments: &RoleArguments,
    run: impl AsyncFnOnce(RuntimeDirectory, CancellationToken) -> anyhow::Result<()>,
) -> Result<(), Failure> {
    daemon_on(tokio::runtime::Builder::new_multi_thread(), arguments, run)
}

/// What every daemon does around its own work.
fn daemon_on(
    runtime: tokio::runtime::Builder,
    arguments: &RoleArguments,
    run: impl AsyncFnOnce(RuntimeDirectory, CancellationToken) -> anyhow::Result<()>,
) -> Result<(), Failure> {
    if arguments.check_config {
        output::progress("the config is good");
        return Ok(());
    }
    telemetry::start();
    blocking_on(runtime, async {
        let token = CancellationToken::new();
        shutdown::on_signals(&token).context("cannot catch signals")?;
        if arguments.exit_with_parent {
            shutdown::exit_with_parent(&token).context("cannot watch standard input")?;
        }
        let directory = public_directory(arguments.runtime_dir.as_deref());
        let directory = RuntimeDirectory::create(&directory)
            .with_context(|| format!("cannot make the runtime directory {}", directory.display()))?;
        Ok(run(directory, token).await?)
    })
}
