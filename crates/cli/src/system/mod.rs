//! A whole system on this machine: its config, its processes, its endpoint files.

pub(crate) mod catalogue;
pub(crate) mod config;
mod crashes;
pub(crate) mod drivers;
pub(crate) mod known;
mod launch;
mod patience;
pub(crate) mod workers;

use crate::failure::Failure;
use crate::output;
use anyhow::Context;
use config::{SystemConfig, is_same};
use crashes::Crashes;
use launch::Processes;
use nix::unistd::{AccessFlags, access};
use ratn_daemon::config::{Durability, state_directory};
use ratn_daemon::processor_demand;
use ratn_model::resource::Quantity;
use ratn_proto::types::PoolStatus;
use ratn_proto::v1::cell_service_client::CellServiceClient;
use ratn_proto::v1::{GetGroundTruthRequest, UnintendedContact};
use ratn_task_control::Endpoints;
use ratn_task_control::NotStarted;
use ratn_task_control::shell::{Place, Urgency};
use ratn_worker::client::{Channels, ProcessClient, ResourceClient, WorldClient};
use ratn_worker::endpoint::{self, Endpoint};
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::session::Standing;
use ratn_worker::tls::ClientTls;
use std::collections::BTreeMap;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};
use workers::Offered;

/// The environment variable with the directory of endpoint files.
pub(crate) const DIRECTORY_VARIABLE: &str = "RATN_RUNTIME_DIR";
/// The file in a runtime directory with the config of the system that runs there.
pub(crate) const CONFIG_FILE: &str = "system.toml";
const CELL: &str = "cell";
const PROCESS_MANAGER: &str = "process-manager";
/// Interval at which the process manager is asked why workers are missing at the start.
const ASK_POOLS: Duration = Duration::from_millis(250);
/// The kinds of objects that have to be carried upright.
const UPRIGHT: [&str; 2] = ["bowl", "cup"];

/// The true result of a task, according to the cell's ground truth.
#[derive(Debug)]
pub(crate) struct Judgement {
    /// Number of objects that are where the task was to bring them.
    pub(crate) delivered: usize,
    /// Maximum tilt of a bowl or a cup while it was held, in radians.
    pub(crate) greatest_tilt_rad: f64,
    /// Unintended contacts.
    pub(crate) unintended_contacts: Vec<UnintendedContact>,
    /// The share of the processor time that the system asked for in which it had none, because others had the processors; from 0 to 1.
    pub(crate) waited_share: f64,
}

/// The roles of a system on one machine, in the order of starting; the cell only where the robot has a workplace in it.
const ROLES: [&str; 4] = ["resource-manager", "world-pool", CELL, PROCESS_MANAGER];

fn roles(config: &SystemConfig) -> Vec<&'static str> {
    ROLES.into_iter().filter(|role| *role != CELL || config.has_cell()).collect()
}

/// A running system.
#[derive(Debug)]
pub(crate) struct System {
    pub(crate) config: SystemConfig,
    pub(crate) endpoints: Endpoints,
    /// The resources of a system that was found running.
    pub(crate) offered: Offered,
    /// Differences between its catalogue and its workers.
    pub(crate) mismatches: Vec<String>,
    /// The TLS settings of its clients.
    tls: ClientTls,
    directory: RuntimeDirectory,
    processes: Processes,
    /// A private directory, removed together with the system.
    _private: Option<tempfile::TempDir>,
}

impl System {
    /// Starts a system in a private directory, which is removed with it.
    pub(crate) async fn start_private(config: SystemConfig, tls: &ClientTls) -> anyhow::Result<System> {
        let private = tempfile::Builder::new().prefix("ratn-").tempdir().context("cannot make a runtime directory")?;
        let path = private.path().to_owned();
        // Boxed, because it holds the config of every role.
        Box::pin(System::start(config, &path, Some(private), tls)).await
    }

    /// Starts a system that others find in `directory`.
    pub(crate) async fn start_public(
        config: SystemConfig,
        directory: &Path,
        tls: &ClientTls,
    ) -> anyhow::Result<System> {
        Box::pin(System::start(config, directory, None, tls)).await
    }

    async fn start(
        config: SystemConfig,
        directory: &Path,
        private: Option<tempfile::TempDir>,
        tls: &ClientTls,
    ) -> anyhow::Result<System> {
        sockets_fit(&config.listens(), directory)?;
        let directory = RuntimeDirectory::create(directory).map_err(|error| {
            let error = anyhow::Error::from(error);
            NotStarted(format!("cannot make the runtime directory {}: {error:#}", directory.display()))
        })?;
        let mut config = config;
        let kept = [&mut config.resource_manager.storage, &mut config.world_pool.storage];
        for (role, storage) in ROLES.iter().zip(kept).filter(|(_, storage)| storage.directory.is_none()) {
            // All roles start and end together: the resources and the world of the last system that was here are gone with it.
            forget_state(&directory, role)?;
            storage.durability = Durability::None;
        }
        let file = directory.path().join(CONFIG_FILE);
        std::fs::write(&file, config.to_toml()?).with_context(|| format!("cannot write {}", file.display()))?;
        if !config.has_cell() {
            output::progress(format_args!(
                "the robot `{}` has no [workplace], so there is no simulated cell: drivers offer its arm and what else it has (docs/workers.md)",
                config.robot
            ));
        }
        let mut processes = Processes::start(&roles(&config), &file, directory.path())?;
        let keeps = private.is_none().then(|| directory.path());
        match ready(&mut processes, &directory, &config, tls, keeps).await {
            Ok(endpoints) => {
                let offered = Box::pin(Offered::known(tls, &endpoints.resource_manager)).await;
                let mismatches = offered.mismatches(&config.catalogue);
                offered.extend(&mut config.catalogue);
                let tls = tls.clone();
                Ok(System { config, endpoints, offered, mismatches, tls, directory, processes, _private: private })
            }
            Err(error) => {
                processes.stop().await;
                Err(error)
            }
        }
    }

    /// The system that runs in `directory`, if there is one. Without `config` it uses the one with which the system was started. Its workers'
    /// descriptions extend its catalogue.
    pub(crate) async fn find(
        directory: &Path,
        config: Option<SystemConfig>,
        tls: &ClientTls,
    ) -> anyhow::Result<Option<System>> {
        let Some(endpoints) = running(directory, tls).await? else { return Ok(None) };
        let mut config = config_of(directory, config)?;
        let directory = RuntimeDirectory::at(directory);
        let offered = Box::pin(Offered::known(tls, &endpoints.resource_manager)).await;
        let mismatches = offered.mismatches(&config.catalogue);
        offered.extend(&mut config.catalogue);
        Ok(Some(System {
            config,
            endpoints,
            offered,
            mismatches,
            tls: tls.clone(),
            directory,
            processes: Processes::default(),
            _private: None,
        }))
    }

    /// Asks again for the resources: workers may have come since.
    pub(crate) async fn ask_again(&mut self) {
        self.offered = Box::pin(Offered::known(&self.tls, &self.endpoints.resource_manager)).await;
        self.mismatches = self.offered.mismatches(&self.config.catalogue);
        self.offered.extend(&mut self.config.catalogue);
    }

    /// The addresses and settings that a run needs. From here on the run sends its spans where the daemons send theirs.
    pub(crate) fn place(&self) -> Place {
        let resource = vec![("service.name", "ratn".to_owned())];
        // The config was checked, so this succeeds.
        let _ = ratn_otlp::start(&self.config.service.otlp, resource, |said| {
            output::progress(format_args!("warning: {said}"));
        });
        Place {
            endpoints: self.endpoints.clone(),
            tls: self.tls.clone(),
            directory: self.directory.path().to_owned(),
            catalogue: Arc::new(self.config.catalogue.clone()),
            robot: self.config.robot.clone(),
            speed: self.config.speed,
            messages: output::messages(),
            alone: false,
            urgency: Urgency::Normal,
            standing: Standing::default(),
        }
    }

    /// The directory of its endpoint files and logs.
    pub(crate) fn directory(&self) -> &RuntimeDirectory {
        &self.directory
    }

    /// Resolves with an error when one of the processes that were started for it ends.
    pub(crate) async fn one_ended(&mut self) -> anyhow::Error {
        self.processes.one_ended().await
    }

    /// The true result of a task, which only the cell knows.
    pub(crate) async fn judgement(&self) -> anyhow::Result<Judgement> {
        let channel = Channels::new(&self.tls).get(&self.directory.find(CELL)?)?;
        let truth = CellServiceClient::new(channel).get_ground_truth(GetGroundTruthRequest {}).await;
        let truth = truth.context("the cell does not say where its objects are")?.into_inner();
        let upright = truth.objects.iter().filter(|one| UPRIGHT.contains(&one.kind.as_str()));
        Ok(Judgement {
            delivered: truth.objects.iter().filter(|one| one.in_place && !one.held).count(),
            greatest_tilt_rad: upright.map(|one| one.greatest_tilt_rad).fold(0.0, f64::max),
            unintended_contacts: truth.unintended_contacts,
            waited_share: processor_demand::of_tree(std::process::id()).waited_share(),
        })
    }

    /// A notice about a system that was used before: its facts remain, and objects are where they were left.
    pub(crate) async fn left_behind(&self) -> Option<String> {
        let world = WorldClient::new(&Channels::new(&self.tls), &self.endpoints.world_pool).ok()?;
        let (_, facts) = world.root().await.ok()?;
        let reset = match self.directory.find(CELL) {
            Ok(_) => "; `ratn reset` lays a new table and forgets them",
            Err(_) => "",
        };
        let many = output::counted(facts.len(), "fact");
        (!facts.is_empty())
            .then(|| format!("its world has {many} from before, and things are where earlier runs left them{reset}"))
    }

    /// Ends the processes that were started for it.
    pub(crate) async fn stop(self) {
        self.processes.stop().await;
    }
}

/// Maximum length of a Unix socket path in bytes (`sun_path` has 108, with the final zero).
const MAX_SOCKET_PATH: usize = 107;

/// Refuses a directory that is too deep for the sockets of these roles, before anything is started.
pub(crate) fn sockets_fit(listens: &[(&str, &Endpoint)], directory: &Path) -> Result<(), NotStarted> {
    let absolute = std::path::absolute(directory).unwrap_or_else(|_| directory.to_owned());
    let place = absolute.canonicalize().unwrap_or(absolute);
    let local = listens.iter().filter(|(_, listen)| listen.is_local());
    let sockets = local.map(|(role, _)| place.join(format!("{role}.sock")));
    let Some(longest) = sockets.max_by_key(|path| path.as_os_str().len()) else {
        return Ok(());
    };
    let length = longest.as_os_str().len();
    if length <= MAX_SOCKET_PATH {
        return Ok(());
    }
    Err(NotStarted(format!(
        "the runtime directory {} is too deep: {} would have {length} bytes, and the path of a Unix socket has {MAX_SOCKET_PATH} at the \
         most; name one that is at least {} bytes shorter (--runtime-dir, $RATN_RUNTIME_DIR, or $TMPDIR for a system that `run` starts)",
        place.display(),
        longest.display(),
        length - MAX_SOCKET_PATH
    )))
}

/// The config of the system that runs in `directory`. A given config provides the catalogue and the rest, but the speed and the robot are those
/// of the running system, and another robot is refused.
fn config_of(directory: &Path, given: Option<SystemConfig>) -> anyhow::Result<SystemConfig> {
    let own = SystemConfig::read(&directory.join(CONFIG_FILE));
    match (given, own) {
        (Some(given), Ok(own)) if !is_same(&given.robot, &own.robot) => anyhow::bail!(
            "the system that runs in {} has the robot `{}`, the config says `{}`: leave --config out, or start a system of your own",
            directory.display(),
            own.robot,
            given.robot
        ),
        (Some(given), Ok(own)) => Ok(given.at_speed(own.speed)),
        (Some(given), Err(_)) => Ok(given),
        (None, own) => own.with_context(|| {
            let place = directory.display();
            format!("a system runs in {place}, but not under `ratn up`: say its config with --config FILE")
        }),
    }
}

fn forget_state(directory: &RuntimeDirectory, role: &str) -> anyhow::Result<()> {
    let state = state_directory(directory.path()).join(role);
    match std::fs::remove_dir_all(&state) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
            Err(error).with_context(|| format!("cannot remove {}", state.display()))
        }
        _ => Ok(()),
    }
}

/// The endpoints of the system that runs in `directory`, if there is one. The files of a system that was killed do not count.
///
/// # Errors
/// A process listens at the system's endpoint but cannot be spoken to: it may run with a certificate that is not trusted here.
pub(crate) async fn running(directory: &Path, tls: &ClientTls) -> anyhow::Result<Option<Endpoints>> {
    let files = RuntimeDirectory::at(directory);
    let (Ok(resource_manager), Ok(world_pool)) = (files.find(ROLES[0]), files.find(ROLES[1])) else { return Ok(None) };
    for endpoint in [&resource_manager, &world_pool] {
        match endpoint::connect(endpoint, tls).await {
            Ok(_) => {}
            Err(error) if error.nobody_listens() => return Ok(None),
            Err(error) => {
                let place = directory.display();
                return Err(error).with_context(|| format!("whether a system runs in {place} cannot be told"));
            }
        }
    }
    Ok(Some(Endpoints { resource_manager, world_pool }))
}

/// Waits until every role and every resource that the config promises exists. `keeps` is the directory, where it remains after a failed start.
async fn ready(
    processes: &mut Processes,
    directory: &RuntimeDirectory,
    config: &SystemConfig,
    tls: &ClientTls,
    keeps: Option<&Path>,
) -> anyhow::Result<Endpoints> {
    let wanted = config.promised_resources();
    let channels = Channels::new(tls);
    let (mut crashes, mut asked) = (Crashes::default(), None::<Instant>);
    let missing = async || {
        let roles = roles(config).into_iter().filter(|role| directory.find(role).is_err());
        let roles: Vec<String> = roles.map(str::to_owned).collect();
        if !roles.is_empty() {
            return Ok(roles);
        }
        let client = ResourceClient::new(&channels, &directory.find(ROLES[0])?, "")?;
        // A manager that does not answer yet is asked again.
        let Ok(resources) = client.list(&[]).await else { return Ok(vec!["an answer of the resource manager".into()]) };
        let mut there: BTreeMap<String, Quantity> = BTreeMap::new();
        for resource in resources {
            *there.entry(resource.kind).or_default() += resource.capacity;
        }
        let missing = launch::missing(&wanted, &there);
        if !missing.is_empty() && asked.is_none_or(|at| at.elapsed() >= ASK_POOLS) {
            asked = Some(Instant::now());
            let pools = pools(&channels, directory).await;
            if let Some(why) = crashes::given_up(&pools, &missing.keys().copied().collect()) {
                anyhow::bail!("the system cannot be started: {why}{}", keeps.map(whole_logs).unwrap_or_default());
            }
            for said in crashes.news(&pools) {
                output::progress(said);
            }
        }
        Ok(missing.into_values().collect())
    };
    processes.wait_until(missing).await?;
    Ok(Endpoints { resource_manager: directory.find(ROLES[0])?, world_pool: directory.find(ROLES[1])? })
}

/// A hint where the complete logs of workers are.
fn whole_logs(directory: &Path) -> String {
    format!(" (the whole logs of workers are in {})", directory.join("logs").display())
}

/// The pools of the process manager. A manager that does not answer yet is asked again later.
async fn pools(channels: &Channels, directory: &RuntimeDirectory) -> Vec<PoolStatus> {
    let client = directory.find(PROCESS_MANAGER).ok().and_then(|at| ProcessClient::new(channels, &at).ok());
    let Some(client) = client else { return Vec::new() };
    match tokio::time::timeout(ASK_POOLS, client.pools()).await {
        Ok(Ok(host)) => host.pools,
        Ok(Err(_)) | Err(_) => Vec::new(),
    }
}

/// The directory of endpoint files, as in [`directory_of`].
///
/// # Errors
/// Where it belongs to another user and may not be accessed.
pub(crate) fn public_directory(given: Option<&Path>) -> Result<PathBuf, Failure> {
    let directory = directory_of(given);
    match denied(&directory) {
        None => Ok(directory),
        Some(why) => {
            let help = "name one of your own with --runtime-dir DIR or $RATN_RUNTIME_DIR";
            Err(Failure::Refused(format!("ratn: {why}; {help}")))
        }
    }
}

/// Why the system in a directory may not be used: it belongs to another user, who allows this user neither to look nor to connect.
pub(crate) fn denied(directory: &Path) -> Option<String> {
    let is = match directory.metadata() {
        Ok(is) => is,
        Err(error) if error.kind() == std::io::ErrorKind::PermissionDenied => {
            return Some(format!(
                "permission denied: {} is below a directory that you may not enter",
                directory.display()
            ));
        }
        Err(_) => return None,
    };
    let me = nix::unistd::geteuid();
    if is.uid() == me.as_raw() {
        return None;
    }
    let may = |path: &Path, how: AccessFlags| access(path, how).is_ok();
    let sockets = ROLES.iter().map(|role| directory.join(format!("{role}.sock"))).filter(|socket| socket.exists());
    let closed: Vec<bool> = sockets.map(|socket| !may(&socket, AccessFlags::W_OK)).collect();
    let is_closed = !may(directory, AccessFlags::R_OK | AccessFlags::X_OK)
        || (!closed.is_empty() && closed.into_iter().all(|closed| closed));
    is_closed.then(|| {
        format!(
            "permission denied: the system in {} belongs to uid {}, and you are uid {me}",
            directory.display(),
            is.uid()
        )
    })
}

/// The directory of endpoint files: as given, else as in the environment, else a directory of this user.
pub(crate) fn directory_of(given: Option<&Path>) -> PathBuf {
    if let Some(path) = given {
        return path.to_owned();
    }
    variable(DIRECTORY_VARIABLE)
        .or_else(|| variable("XDG_RUNTIME_DIR").map(|dir| dir.join("ratn")))
        .unwrap_or_else(|| std::env::temp_dir().join(format!("ratn-{}", nix::unistd::getuid())))
}

/// A path from the environment.
pub(crate) fn variable(name: &str) -> Option<PathBuf> {
    std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    #[test]
    fn a_directory_that_is_too_deep_for_a_socket_is_refused_before_anything_is_made() {
        let config = SystemConfig::load(None).unwrap();
        let root = tempfile::tempdir().unwrap();
        let room =
            MAX_SOCKET_PATH - root.path().canonicalize().unwrap().as_os_str().len() - "//resource-manager.sock".len();
        let fits = root.path().join("x".repeat(room));
        assert!(sockets_fit(&config.listens(), &fits).is_ok());
        let deep = root.path().join("x".repeat(room + 3));
        let refused = sockets_fit(&config.listens(), &deep).unwrap_err().to_string();
        assert!(refused.contains("110 bytes") && refused.contains("3 bytes shorter"), "{refused}");
        assert!(!deep.exists());
        // A single role only needs room for its own socket.
        assert!(sockets_fit(&[(CELL, &config.cell.listen)], &deep).is_ok());
    }

    #[test]
    fn a_directory_of_ones_own_and_one_that_is_not_there_are_not_denied() {
        let place = tempfile::tempdir().unwrap();
        assert_eq!(denied(place.path()), None);
        assert_eq!(denied(&place.path().join("nowhere")), None);
    }

    #[test]
    fn a_running_system_keeps_its_speed_whatever_config_is_given() {
        let place = tempfile::tempdir().unwrap();
        let given = || SystemConfig::load(None).unwrap();
        assert!(config_of(place.path(), None).is_err());
        assert_eq!(config_of(place.path(), Some(given())).unwrap().speed, given().speed);
        let running = given().at_speed(17.0);
        std::fs::write(place.path().join(CONFIG_FILE), running.to_toml().unwrap()).unwrap();
        assert_eq!(config_of(place.path(), Some(given())).unwrap().speed, 17.0);
        assert_eq!(config_of(place.path(), None).unwrap().speed, 17.0);
    }

    #[test]
    fn a_running_system_keeps_its_robot_and_a_config_for_another_one_is_refused() {
        let place = tempfile::tempdir().unwrap();
        let of = |robot: &str| SystemConfig::load_for(None, Some(robot)).unwrap();
        std::fs::write(place.path().join(CONFIG_FILE), of("panda").to_toml().unwrap()).unwrap();
        assert_eq!(config_of(place.path(), Some(of("panda"))).unwrap().robot, "panda");
        let refused = config_of(place.path(), Some(of("ur5"))).unwrap_err().to_string();
        assert!(refused.contains("`panda`") && refused.contains("`ur5`") && refused.contains("--config"), "{refused}");
    }

    #[tokio::test]
    async fn a_system_that_is_not_trusted_here_may_run_and_one_where_nobody_listens_does_not() {
        let directory = tempfile::tempdir().unwrap();
        let files = RuntimeDirectory::create(directory.path()).unwrap();
        let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let port = listener.local_addr().unwrap().port();
        let publish = |scheme: &str| {
            let endpoint: Endpoint = format!("{scheme}://127.0.0.1:{port}").parse().unwrap();
            ROLES.iter().map(|role| files.publish(role, &endpoint).unwrap()).collect::<Vec<_>>()
        };
        let tls = ClientTls::none();
        let with_tls = publish("https");
        let error = running(directory.path(), &tls).await.err().unwrap();
        assert!(format!("{error:#}").contains("RATN_TLS_CA"), "{error:#}");
        drop((with_tls, listener));
        let _without = publish("http");
        assert!(running(directory.path(), &tls).await.unwrap().is_none());
    }
}
