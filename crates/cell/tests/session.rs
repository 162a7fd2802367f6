//! The session of the cell with a real resource manager, when its id becomes another caller's.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_cell::config::CellConfig;
use ratn_daemon::access::{AccessConfig, Role, UserAccess};
use ratn_daemon::config::state_directory;
use ratn_daemon::metrics::Metrics;
use ratn_daemon::resource_manager::{self, ResourceManagerConfig};
use ratn_daemon::service::ServiceConfig;
use ratn_worker::client::{Channels, ResourceClient};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::session::Session;
use ratn_worker::tls::ClientTls;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio::time::timeout;
use tokio_util::sync::CancellationToken;

const DEADLINE: Duration = Duration::from_secs(30);
const LOOK_INTERVAL: Duration = Duration::from_millis(20);
const HOUR: Duration = Duration::from_secs(3_600);

/// A resource manager that can be ended.
struct Manager {
    endpoint: Endpoint,
    end: CancellationToken,
    running: JoinHandle<anyhow::Result<()>>,
}

impl Manager {
    /// In which this user provides and takes, and is no operator.
    async fn start(directory: &RuntimeDirectory, listen: Endpoint) -> Manager {
        let uid = std::fs::metadata(directory.path()).unwrap().uid();
        let user = UserAccess { uid, roles: vec![Role::Viewer, Role::Task, Role::Agent] };
        let access = AccessConfig { users: vec![user], ..AccessConfig::default() };
        let (service, end) = (ServiceConfig { access, ..ServiceConfig::default() }, CancellationToken::new());
        let metrics = Arc::new(Metrics::new(resource_manager::ROLE));
        let config = ResourceManagerConfig { listen, ..ResourceManagerConfig::default() };
        let running = tokio::spawn(resource_manager::run_as(
            watch::Sender::new(config).subscribe(),
            directory.clone(),
            service.serving(&metrics),
            metrics.clone(),
            end.clone(),
        ));
        let endpoint = directory.wait_for(resource_manager::ROLE, DEADLINE).await.unwrap();
        Manager { endpoint, end, running }
    }

    async fn end(self) {
        self.end.cancel();
        timeout(DEADLINE, self.running).await.unwrap().unwrap().unwrap();
    }

    /// The session that offers the arm, once it is another one than this.
    async fn offers_the_arm(&self, other_than: &str) -> String {
        let resources = ResourceClient::new(&Channels::new(&ClientTls::none()), &self.endpoint, "").unwrap();
        let offered = async {
            loop {
                match resources.get("arm@sim").await {
                    Ok(arm) if arm.session != other_than => return arm.session,
                    _ => tokio::time::sleep(LOOK_INTERVAL).await,
                }
            }
        };
        timeout(DEADLINE, offered).await.expect("the arm is not offered")
    }
}

fn state(directory: &Path) -> PathBuf {
    state_directory(directory).join(resource_manager::ROLE)
}

#[tokio::test(flavor = "multi_thread")]
async fn a_cell_whose_session_id_is_anothers_offers_its_arm_in_a_session_of_another_id() {
    let (here, elsewhere) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let directory = RuntimeDirectory::create(here.path()).unwrap();
    let end = CancellationToken::new();
    let config = CellConfig { host: "sim".to_owned(), ..CellConfig::default() };
    tokio::spawn(ratn_cell::run(config, directory.clone(), end.clone()));
    let manager = Manager::start(&directory, Endpoint::local()).await;
    let first = manager.offers_the_arm("").await;
    manager.end().await;

    // The manager comes back with a state in which the session is that of somebody who proves nothing.
    let other = RuntimeDirectory::create(elsewhere.path()).unwrap();
    let manager = Manager::start(&other, Endpoint::loopback()).await;
    let taken = Session::open_as(&Channels::new(&ClientTls::none()), &manager.endpoint, first.clone(), "another", HOUR);
    taken.alive(DEADLINE).await.unwrap();
    taken.abandon().await;
    manager.end().await;
    std::fs::remove_dir_all(state(here.path())).unwrap();
    std::fs::rename(state(elsewhere.path()), state(here.path())).unwrap();
    let manager = Manager::start(&directory, Endpoint::local()).await;
    assert_ne!(manager.offers_the_arm("").await, first);
    end.cancel();
    manager.end().await;
}
