//! The daemons and workers: this binary in other roles.

use super::reload::Reloading;
use super::{blocking, blocking_on};
use crate::arguments::{CellArguments, KeptRoleArguments, RoleArguments, WorkerArguments, WorkerKind};
use crate::failure::Failure;
use crate::output;
use crate::system::config::SystemConfig;
use crate::system::{public_directory, sockets_fit, variable};
use anyhow::Context;
use ratn_cell::core::recording::{self, Replayed};
use ratn_daemon::access::LiveAccess;
use ratn_daemon::config::StorageConfig;
use ratn_daemon::metrics::Metrics;
use ratn_daemon::resource_manager::ResourceManagerConfig;
use ratn_daemon::supervisor::Supervisor;
use ratn_daemon::{metrics, process_manager, resource_manager, telemetry, world_pool};
use ratn_motion::robot::Robot;
use ratn_storage::OpenError;
use ratn_worker::endpoint::Endpoint;
use ratn_worker::lease_watch::{ManagerLocation, RESOURCE_MANAGER_VARIABLE};
use ratn_worker::panic::exit_on_panic;
use ratn_worker::pooled;
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::server::{BindError, Exposure, Serving};
use ratn_worker::tls::ClientTls;
use ratn_worker::vitals::CoreFailure;
use ratn_worker::worker::WorkerOptions;
use ratn_worker::{shutdown, tls};
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

/// Environment variables with the folder for state; the second is systemd's.
const STATE_VARIABLES: [&str; 2] = ["RATN_STATE_DIR", "STATE_DIRECTORY"];

/// Time after the drain in which a daemon has to end what it owns: workers, a session, pending writes.
const EXIT_PATIENCE: Duration = Duration::from_secs(2);

/// `ratn resource-manager`.
pub(super) fn resource_manager(arguments: &KeptRoleArguments, tls: &ClientTls) -> Result<(), Failure> {
    let mut system = SystemConfig::load(arguments.role.config.as_deref())?;
    let config = &mut system.resource_manager;
    arguments.apply(resource_manager::ROLE, &mut config.storage);
    let arguments = &arguments.role;
    config.listen = arguments.listen.clone().unwrap_or(config.listen.clone());
    // On one thread requests are handled in the order of arrival; task control sends the most urgent first.
    let runtime = tokio::runtime::Builder::new_current_thread();
    daemon_on(runtime, arguments, system, tls, resource_manager::ROLE, async |_, host| {
        resource_manager::run_as(host.bounds, host.directory, host.serving, host.metrics, host.shutdown).await
    })
}

/// `ratn world-pool`.
pub(super) fn world_pool(arguments: &KeptRoleArguments, tls: &ClientTls) -> Result<(), Failure> {
    let system = SystemConfig::load(arguments.role.config.as_deref())?;
    // Every call goes to the one actor: on the same thread no other thread has to be woken.
    let runtime = tokio::runtime::Builder::new_current_thread();
    daemon_on(runtime, &arguments.role, system, tls, world_pool::ROLE, async |system, host| {
        let mut config = system.world_pool;
        arguments.apply(world_pool::ROLE, &mut config.storage);
        config.listen = host.listen.unwrap_or(config.listen);
        world_pool::run_as(config, host.directory, host.serving, host.metrics, host.tls, host.shutdown).await
    })
}

impl KeptRoleArguments {
    /// Applies the command line and the environment to a role's storage.
    fn apply(&self, role: &str, storage: &mut StorageConfig) {
        storage.durability = self.durability.unwrap_or(storage.durability);
        storage.directory = state_of(role, self.state_dir.as_deref(), storage.directory.take());
    }
}

/// Where a role keeps its state: by the command line, else its config, else the environment.
fn state_of(role: &str, argument: Option<&Path>, configured: Option<PathBuf>) -> Option<PathBuf> {
    let elsewhere = || STATE_VARIABLES.iter().find_map(|name| variable(name)).map(|place| place.join(role));
    argument.map(|place| place.join(role)).or(configured).or_else(elsewhere)
}

/// `ratn process-manager`.
pub(super) fn process_manager(arguments: &RoleArguments, tls: &ClientTls) -> Result<(), Failure> {
    if arguments.check_config {
        startable(&SystemConfig::load(arguments.config.as_deref())?)?;
    }
    daemon(arguments, tls, process_manager::ROLE, async |system, host| {
        let mut config = system.process_manager_config();
        config.owns_process = true;
        config.catalogue = Some(Arc::new(system.catalogue));
        config.worker_environment = system.service.for_workers(arguments.config.as_deref());
        config.listen = host.listen.unwrap_or(config.listen);
        process_manager::run_as(config, host.directory, host.serving, host.tls, host.shutdown).await
    })
}

/// Refuses a config with a template that cannot be started on this machine, or with a cell that cannot be slowed down so far.
pub(super) fn startable(config: &SystemConfig) -> Result<(), Failure> {
    if config.has_cell() {
        config.cell.check().map_err(|error| Failure::Refused(format!("ratn: [cell] {error}")))?;
    }
    let obstacles = config.process_manager.obstacles();
    if obstacles.is_empty() {
        return Ok(());
    }
    Err(Failure::Refused(format!("ratn: [process-manager] {}", obstacles.join("; "))))
}

/// `ratn cell`.
pub(super) fn cell(arguments: &CellArguments, tls: &ClientTls) -> Result<(), Failure> {
    if let Some(file) = &arguments.replay {
        return replay(file);
    }
    if let Some(file) = &arguments.picture {
        let system = SystemConfig::load_for(arguments.role.config.as_deref(), arguments.robot.as_deref())?;
        let mut config = system.cell;
        config.scene = arguments.scene.unwrap_or(config.scene);
        let png = ratn_cell::photo(config, arguments.from, arguments.towards)?;
        std::fs::write(file, png).with_context(|| format!("cannot write {}", file.display()))?;
        output::progress(format!("{} shows the cell", file.display()));
        return Ok(());
    }
    let role = &arguments.role;
    let system = SystemConfig::load_for(role.config.as_deref(), arguments.robot.as_deref())?;
    daemon_on(tokio::runtime::Builder::new_multi_thread(), role, system, tls, ratn_cell::ROLE, async |system, host| {
        let mut config = system.cell;
        config.scene = arguments.scene.unwrap_or(config.scene);
        config.faults.extend(&arguments.faults.fault);
        config.state_dir = state_of(ratn_cell::ROLE, arguments.state_dir.as_deref(), config.state_dir.take());
        config.record = arguments.record.clone().or(config.record);
        config.listen = host.listen.unwrap_or(config.listen);
        ratn_cell::run_as(config, host.directory, host.serving, host.tls, host.shutdown).await
    })
}

/// `ratn cell --replay FILE`.
fn replay(file: &Path) -> Result<(), Failure> {
    let opened = ratn_regular_file::open(file).with_context(|| format!("cannot read {}", file.display()))?;
    let replayed = recording::replay(BufReader::new(opened).lines());
    let Replayed { events, goals, end_s, tracking } = replayed.with_context(|| file.display().to_string())?;
    output::result(format_args!(
        "the same came of {events} events in {end_s:.1} s of the robot: {goals} goals ended as they had; trajectories were \
         followed within {:.2} mrad and {:.2} mm",
        tracking.most_rad * 1e3,
        tracking.most_m * 1e3
    ))?;
    Ok(())
}

/// `ratn worker …`.
pub(super) fn worker(arguments: &WorkerArguments, tls: &ClientTls) -> Result<(), Failure> {
    telemetry::start();
    let told = ManagerLocation::from_environment();
    let told = told.map_err(|error| Failure::Refused(format!("ratn: {RESOURCE_MANAGER_VARIABLE}: {error}")))?;
    if told.is_none() && arguments.resource_manager.is_none() {
        return Err(Failure::Refused(format!(
            "ratn: goals of worker `{}` need a lease, and nobody says which resource manager confirms it: give --resource-manager \
             ADDRESS, or set {RESOURCE_MANAGER_VARIABLE}",
            arguments.id
        )));
    }
    let options = WorkerOptions {
        id: arguments.id.clone(),
        kind: arguments.kind.clone(),
        listen: arguments.listen.clone().unwrap_or_else(pooled::listen),
        endpoint_file: arguments.endpoint_file.clone(),
        exit_with_parent: arguments.exit_with_parent,
        resource_manager: arguments.resource_manager.clone(),
        host: arguments.host.clone(),
        exposure: Exposure {
            tls: tls::server_from_environment().map(Into::into),
            insecure: arguments.insecure,
            ..Exposure::default()
        },
        access: arguments.config.clone(),
        tls: Some(tls.clone()),
    };
    let robot = Robot::named_or_file(&arguments.robot);
    let robot = robot.map_err(|error| Failure::Refused(format!("ratn: --robot: {error}")))?;
    let speed = arguments.speed;
    let run = async {
        match arguments.worker {
            WorkerKind::PathPlanner => ratn_workers::path_planner::run(options, robot, speed).await,
            WorkerKind::Detector => ratn_workers::detector::run(options, robot, arguments.pictures.clone()).await,
        }
        .map_err(refused_if_not_started)
    };
    blocking(exit_on_panic("the worker", run))
}

/// The environment of a daemon.
struct Host {
    /// Overrides the config's address.
    listen: Option<Endpoint>,
    directory: RuntimeDirectory,
    serving: Serving,
    /// The TLS settings of its clients.
    tls: ClientTls,
    metrics: Arc<Metrics>,
    shutdown: CancellationToken,
    /// The resource manager's section, with its changes.
    bounds: watch::Receiver<ResourceManagerConfig>,
}

fn daemon(
    arguments: &RoleArguments,
    tls: &ClientTls,
    role: &'static str,
    run: impl AsyncFnOnce(SystemConfig, Host) -> anyhow::Result<()>,
) -> Result<(), Failure> {
    let system = SystemConfig::load(arguments.config.as_deref())?;
    daemon_on(tokio::runtime::Builder::new_multi_thread(), arguments, system, tls, role, run)
}

/// What every daemon does around its own work.
fn daemon_on(
    runtime: tokio::runtime::Builder,
    arguments: &RoleArguments,
    system: SystemConfig,
    tls: &ClientTls,
    role: &'static str,
    run: impl AsyncFnOnce(SystemConfig, Host) -> anyhow::Result<()>,
) -> Result<(), Failure> {
    if arguments.check_config {
        output::progress("the config is good");
        return Ok(());
    }
    // The config as in the file: arguments of the command line stay in force until the end.
    let running = SystemConfig::load(arguments.config.as_deref())?;
    let mut service = system.service.clone();
    service.insecure |= arguments.insecure;
    let refused = |error: anyhow::Error| Failure::Refused(format!("ratn: {error:#}"));
    let client_tls = service.client_tls(tls).context("[service.tls]").map_err(refused)?;
    let logs = telemetry::start_as(&service.log, service.audit_file.as_deref());
    let logs = logs.map_err(|error| refused(error.into()))?;
    blocking_on(runtime, async {
        let shutdown = CancellationToken::new();
        let patience = Duration::from_millis(service.drain_ms) + EXIT_PATIENCE;
        shutdown::on_signals_within(&shutdown, patience).context("cannot catch signals")?;
        let supervisor = Supervisor::start().context("cannot catch SIGHUP")?;
        if arguments.exit_with_parent {
            shutdown::exit_with_parent(&shutdown).context("cannot watch standard input")?;
        }
        let directory = public_directory(arguments.runtime_dir.as_deref())?;
        let own = system.listens().into_iter().find(|(other, _)| *other == role).map(|(_, listen)| listen);
        if let Some(listen) = arguments.listen.as_ref().or(own) {
            sockets_fit(&[(role, listen)], &directory)?;
        }
        let directory = RuntimeDirectory::create(&directory)
            .with_context(|| format!("cannot make the runtime directory {}", directory.display()))?;
        let resource = vec![("service.name", format!("ratn-{role}"))];
        let spans = ratn_otlp::start(&service.otlp, resource, |said| tracing::warn!("{said}"));
        // The config was checked, so this succeeds.
        let spans = spans.ok().flatten();
        let metrics = Arc::new(Metrics::new(role).with_spans());
        if let Some(address) = arguments.metrics.or_else(|| service.metrics.get(role).copied()) {
            let listening = metrics::listen(metrics.clone(), address, service.insecure).await;
            let address = listening.map_err(|error| refused(error.into()))?;
            tracing::info!("metrics are at http://{address}/metrics");
        }
        let (access, bounds) =
            (LiveAccess::new(service.access.clone()), watch::Sender::new(system.resource_manager.clone()));
        let serving = service.serving_with(&access, &metrics);
        let tls = serving.exposure.tls.clone();
        let (listen, bounds_of) = (arguments.listen.clone(), bounds.subscribe());
        let host = Host { listen, directory, shutdown, bounds: bounds_of, serving, tls: client_tls.clone(), metrics };
        let file = arguments.config.clone();
        let reloading = Reloading { file, running, role, logs, tls, client_tls, access, bounds };
        // Reports to the service manager until the state is closed, not only while the process serves.
        let phase = host.serving.phase.clone();
        let followed =
            supervisor.follow(host.serving.phase.subscribe(), host.serving.vitals.clone(), move || reloading.reload());
        let followed = tokio::spawn(exit_on_panic("the link to the service manager", followed));
        let vitals = host.serving.vitals.clone();
        // The cleanup after the end of the core may hang.
        let overdue = async {
            let failure = vitals.failed().await;
            tokio::time::sleep(EXIT_PATIENCE).await;
            failure
        };
        let ended = tokio::select! {
            biased;
            ended = exit_on_panic(role, run(system, host)) => ended,
            failure = overdue => core_ended(&failure),
        };
        if let Some(spans) = spans {
            spans.flush(ratn_otlp::END_OF_SERVER).await;
        }
        // Also where the core failed during the drain.
        let failure = vitals.condition().borrow().failure.clone();
        if let Some(failure) = failure {
            core_ended(&failure);
        }
        drop(phase);
        let _ = followed.await;
        ended.map_err(refused_if_not_started)
    })
}

/// The core has failed: the process ends, whatever else of it still runs.
fn core_ended(failure: &CoreFailure) -> ! {
    output::progress(format_args!("ratn: {failure}"));
    std::process::exit(failure.exit_code().into())
}

/// Refused where it could not listen, or another process has its state or its place: then it has not begun. Failed
/// otherwise.
fn refused_if_not_started(error: anyhow::Error) -> Failure {
    let not_started = error
        .chain()
        .any(|cause| cause.is::<BindError>() || cause.is::<OpenError>() || cause.is::<process_manager::RosterError>());
    if not_started { Failure::Refused(format!("ratn: {error:#}")) } else { Failure::Failed(error) }
}
