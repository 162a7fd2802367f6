//! A whole system on this machine: its config, its processes, its endpoint files.

pub(crate) mod config;
mod launch;

use crate::failure::NotStarted;
use crate::task_control::Endpoints;
use crate::task_control::shell::Place;
use anyhow::Context;
use config::SystemConfig;
use launch::Processes;
use ratn_daemon::config::{Durability, state_directory};
use ratn_model::resource::Quantity;
use ratn_proto::v1::cell_service_client::CellServiceClient;
use ratn_proto::v1::{GetGroundTruthRequest, UnintendedContact};
use ratn_worker::client::{Channels, ResourceClient};
use ratn_worker::endpoint;
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::tls::ClientTls;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The environment variable that says where endpoint files are.
const DIRECTORY_VARIABLE: &str = "RATN_RUNTIME_DIR";
/// In a runtime directory: the config of the system that runs there.
const CONFIG_FILE: &str = "system.toml";
const CELL: &str = "cell";
/// The kinds of objects that have to be carried upright.
const UPRIGHT: [&str; 2] = ["bowl", "cup"];

/// What really came of a task, by the cell's ground truth.
#[derive(Debug)]
pub(crate) struct Judgement {
    /// How many objects are where the task was to bring them.
    pub(crate) delivered: usize,
    /// How far a bowl or a cup leaned at the most while it was held, in radians.
    pub(crate) greatest_tilt_rad: f64,
    /// What touched that should not have.
    pub(crate) unintended_contacts: Vec<UnintendedContact>,
}

/// The roles of a system on one machine, in the order in which they are started.
const ROLES: [&str; 4] = ["resource-manager", "world-pool", CELL, "process-manager"];

/// A running system.
#[derive(Debug)]
pub(crate) struct System {
    pub(crate) config: SystemConfig,
    pub(crate) endpoints: Endpoints,
    /// What its clients trust and show.
    tls: ClientTls,
    directory: RuntimeDirectory,
    processes: Processes,
    /// Removed with it.
    _private: Option<tempfile::TempDir>,
}

impl System {
    /// Starts one in a directory of its own, which goes with it.
    pub(crate) async fn start_private(config: SystemConfig, tls: &ClientTls) -> anyhow::Result<System> {
        let private = tempfile::Builder::new().prefix("ratn-").tempdir().context("cannot make a runtime directory")?;
        let path = private.path().to_owned();
        // Boxed: it holds the config of every role.
        Box::pin(System::start(config, &path, Some(private), tls)).await
    }

    /// Starts one that others find in `directory`.
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
        let directory = RuntimeDirectory::create(directory).map_err(|error| {
            let error = anyhow::Error::from(error);
            NotStarted(format!("cannot make the runtime directory {}: {error:#}", directory.display()))
        })?;
        let mut config = config;
        let kept = [&mut config.resource_manager.storage, &mut config.world_pool.storage];
        for (role, storage) in ROLES.iter().zip(kept).filter(|(_, storage)| storage.directory.is_none()) {
            // All of it starts and ends together: whose resources and what world these were is gone with the last system that was
            // here.
            forget_state(&directory, role)?;
            storage.durability = Durability::None;
        }
        let file = directory.path().join(CONFIG_FILE);
        std::fs::write(&file, config.to_toml()?).with_context(|| format!("cannot write {}", file.display()))?;
        let mut processes = Processes::start(&ROLES, &file, directory.path())?;
        match ready(&mut processes, &directory, &config, tls).await {
            Ok(endpoints) => {
                Ok(System { config, endpoints, tls: tls.clone(), directory, processes, _private: private })
            }
            Err(error) => {
                processes.stop().await;
                Err(error)
            }
        }
    }

    /// The one that runs in `directory`, if one does. Without a config of your own it is the one that it was started with.
    pub(crate) async fn find(
        directory: &Path,
        config: Option<SystemConfig>,
        tls: &ClientTls,
    ) -> anyhow::Result<Option<System>> {
        let Some(endpoints) = running(directory, tls).await? else { return Ok(None) };
        let config = match config {
            Some(config) => config,
            None => SystemConfig::read(&directory.join(CONFIG_FILE)).with_context(|| {
                let place = directory.display();
                format!("a system runs in {place}, but not under `ratn up`: say its config with --config FILE")
            })?,
        };
        let directory = RuntimeDirectory::at(directory);
        Ok(Some(System {
            config,
            endpoints,
            tls: tls.clone(),
            directory,
            processes: Processes::default(),
            _private: None,
        }))
    }

    /// Where a run finds what it needs of it.
    pub(crate) fn place(&self) -> Place {
        Place {
            endpoints: self.endpoints.clone(),
            tls: self.tls.clone(),
            directory: self.directory.path().to_owned(),
            catalogue: Arc::new(self.config.catalogue.clone()),
            speed: self.config.speed,
        }
    }

    /// Where its endpoint files and logs are.
    pub(crate) fn directory(&self) -> &RuntimeDirectory {
        &self.directory
    }

    /// Resolves when one of the processes that were started for it ends, with what is known of it.
    pub(crate) async fn one_ended(&mut self) -> anyhow::Error {
        self.processes.one_ended().await
    }

    /// What really came of a task, as only the cell knows.
    pub(crate) async fn judgement(&self) -> anyhow::Result<Judgement> {
        let channel = Channels::new(&self.tls).get(&self.directory.find(CELL)?)?;
        let truth = CellServiceClient::new(channel).get_ground_truth(GetGroundTruthRequest {}).await;
        let truth = truth.context("the cell does not say where its objects are")?.into_inner();
        let upright = truth.objects.iter().filter(|one| UPRIGHT.contains(&one.kind.as_str()));
        Ok(Judgement {
            delivered: truth.objects.iter().filter(|one| one.in_place && !one.held).count(),
            greatest_tilt_rad: upright.map(|one| one.greatest_tilt_rad).fold(0.0, f64::max),
            unintended_contacts: truth.unintended_contacts,
        })
    }

    /// Ends what was started for it.
    pub(crate) async fn stop(self) {
        self.processes.stop().await;
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

/// Where the system that runs in `directory` is reached, if one does. The files of a system that was killed do not count.
///
/// # Errors
/// Somebody listens where a system did, and cannot be spoken to: it may run, under a certificate that is not trusted here.
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

/// Waits until every role is there and every resource that the config promises.
async fn ready(
    processes: &mut Processes,
    directory: &RuntimeDirectory,
    config: &SystemConfig,
    tls: &ClientTls,
) -> anyhow::Result<Endpoints> {
    let wanted = config.promised_resources();
    let channels = Channels::new(tls);
    let missing = async || {
        let roles = ROLES.iter().filter(|role| directory.find(role).is_err());
        let roles: Vec<String> = roles.map(|&role| role.to_owned()).collect();
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
        Ok(launch::missing(&wanted, &there))
    };
    processes.wait_until(missing).await?;
    Ok(Endpoints { resource_manager: directory.find(ROLES[0])?, world_pool: directory.find(ROLES[1])? })
}

/// Where endpoint files are unless said otherwise: as the environment says, else a directory of this user.
pub(crate) fn public_directory(given: Option<&Path>) -> PathBuf {
    if let Some(path) = given {
        return path.to_owned();
    }
    variable(DIRECTORY_VARIABLE)
        .or_else(|| variable("XDG_RUNTIME_DIR").map(|dir| dir.join("ratn")))
        .unwrap_or_else(|| std::env::temp_dir().join(format!("ratn-{}", nix::unistd::getuid())))
}

/// A path that the environment says.
pub(crate) fn variable(name: &str) -> Option<PathBuf> {
    std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use ratn_worker::endpoint::Endpoint;

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
