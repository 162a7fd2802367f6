//! A system of daemons inside a test, on Unix sockets in a directory of its own.
#![allow(clippy::unwrap_used, dead_code, reason = "a test may panic; not every test file uses everything")]

use nix::mount::{MntFlags, MsFlags, mount, umount2};
use ratn_daemon::metrics::Metrics;
use ratn_daemon::{process_manager, resource_manager, world_pool};
use ratn_model::resource::{Requirement, ResourceOperation};
use ratn_proto::types::{ResourceEvent, ResourceEventKind, ResourceUpdate};
use ratn_worker::client::{Channels, ProcessClient, ResourceClient, ResourceWatch, WorldClient};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::server::Serving;
use ratn_worker::session::Session;
use ratn_worker::tls::ClientTls;
use std::future::Future;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

/// Nothing in a test takes longer.
pub(crate) const DEADLINE: Duration = Duration::from_secs(20);

/// A daemon that is ended by [`Daemon::end`], or with the test.
pub(crate) struct Daemon {
    shutdown: CancellationToken,
    running: JoinHandle<anyhow::Result<()>>,
    pub(crate) endpoint: Endpoint,
}

pub(crate) struct TestSystem {
    parent: tempfile::TempDir,
    pub(crate) directory: RuntimeDirectory,
    pub(crate) channels: Channels,
}

impl Daemon {
    pub(crate) async fn end(self) {
        self.shutdown.cancel();
        in_time(self.running).await.unwrap().unwrap();
    }
}

/// This process's group of cgroup v2, where there is one.
pub(crate) fn own_cgroup() -> Option<PathBuf> {
    let mounts = std::fs::read_to_string("/proc/self/mounts").unwrap_or_default();
    let mount = mounts.lines().find_map(|line| {
        let fields: Vec<&str> = line.split(' ').collect();
        (fields.get(2) == Some(&"cgroup2")).then(|| fields[1].to_owned())
    })?;
    let own = std::fs::read_to_string("/proc/self/cgroup").unwrap_or_default();
    let own = own.lines().find_map(|line| line.strip_prefix("0::"))?.trim_start_matches('/').to_owned();
    Some(Path::new(&mount).join(own))
}

impl Drop for TestSystem {
    /// A process manager that was killed could not take back its groups.
    fn drop(&mut self) {
        let instance = std::fs::read_to_string(self.directory.path().join("process-manager.instance"));
        let Some(groups) = own_cgroup().zip(instance.ok()).map(|(own, name)| own.join(format!("ratn-{name}"))) else {
            return;
        };
        for group in std::fs::read_dir(&groups).into_iter().flatten().flatten() {
            let _ = std::fs::write(group.path().join("cgroup.kill"), "1");
            let _ = std::fs::remove_dir(group.path());
        }
        let _ = std::fs::remove_dir(groups);
    }
}

impl TestSystem {
    pub(crate) fn new() -> TestSystem {
        let parent = tempfile::tempdir().unwrap();
        let directory = RuntimeDirectory::create(parent.path().join("run")).unwrap();
        TestSystem { parent, directory, channels: Channels::new(&ClientTls::none()) }
    }

    pub(crate) async fn resource_manager(&self) -> Daemon {
        self.resource_manager_at(self.directory.socket("rm")).await
    }

    pub(crate) async fn resource_manager_at(&self, listen: Endpoint) -> Daemon {
        self.resource_manager_with(resource_manager::ResourceManagerConfig { listen, ..Default::default() }).await
    }

    pub(crate) async fn resource_manager_with(&self, config: resource_manager::ResourceManagerConfig) -> Daemon {
        let shutdown = CancellationToken::new();
        let run = resource_manager::run(config, self.directory.clone(), shutdown.clone());
        self.started(resource_manager::ROLE, shutdown, run).await
    }

    pub(crate) fn world_pool_config(&self) -> world_pool::WorldPoolConfig {
        world_pool::WorldPoolConfig {
            listen: self.directory.socket("wp"),
            host: "compute".to_owned(),
            session_ttl_ms: 1_000,
            ..Default::default()
        }
    }

    pub(crate) async fn world_pool(&self, capacity: u32) -> Daemon {
        self.world_pool_with(world_pool::WorldPoolConfig { capacity, ..self.world_pool_config() }).await
    }

    pub(crate) async fn world_pool_with(&self, config: world_pool::WorldPoolConfig) -> Daemon {
        let shutdown = CancellationToken::new();
        let run = world_pool::run(config, self.directory.clone(), shutdown.clone());
        self.started(world_pool::ROLE, shutdown, run).await
    }

    pub(crate) async fn world_pool_serving(&self, config: world_pool::WorldPoolConfig, serving: Serving) -> Daemon {
        let (shutdown, metrics) = (CancellationToken::new(), Arc::new(Metrics::new(world_pool::ROLE)));
        let (directory, tls) = (self.directory.clone(), ClientTls::none());
        let run = world_pool::run_as(config, directory, serving, metrics, tls, shutdown.clone());
        self.started(world_pool::ROLE, shutdown, run).await
    }

    pub(crate) async fn process_manager(&self, templates: Vec<process_manager::Template>) -> Daemon {
        let config = process_manager::ProcessManagerConfig {
            listen: self.directory.socket("pm"),
            host: "compute".to_owned(),
            templates,
            ..Default::default()
        };
        let shutdown = CancellationToken::new();
        let run = process_manager::run(config, self.directory.clone(), shutdown.clone());
        self.started(process_manager::ROLE, shutdown, run).await
    }

    /// A second host, with a runtime directory of its own.
    pub(crate) async fn process_manager_of(
        &self,
        manager: &Daemon,
        host: &str,
        templates: Vec<process_manager::Template>,
    ) -> Daemon {
        let config = process_manager::ProcessManagerConfig { templates, ..Default::default() };
        self.process_manager_as(manager, host, config).await
    }

    /// The same with a config, of which the host is said besides.
    pub(crate) async fn process_manager_as(
        &self,
        manager: &Daemon,
        host: &str,
        config: process_manager::ProcessManagerConfig,
    ) -> Daemon {
        let directory = RuntimeDirectory::create(self.parent.path().join(host)).unwrap();
        let config = process_manager::ProcessManagerConfig {
            listen: directory.socket("pm"),
            host: host.to_owned(),
            resource_manager: Some(manager.endpoint.clone()),
            ..config
        };
        let shutdown = CancellationToken::new();
        let running = tokio::spawn(process_manager::run(config, directory.clone(), shutdown.clone()));
        let endpoint = directory.wait_for(process_manager::ROLE, DEADLINE).await.unwrap();
        Daemon { shutdown, running, endpoint }
    }

    async fn started(
        &self,
        role: &str,
        shutdown: CancellationToken,
        run: impl Future<Output = anyhow::Result<()>> + Send + 'static,
    ) -> Daemon {
        let running = tokio::spawn(run);
        let endpoint = self.directory.wait_for(role, DEADLINE).await.unwrap();
        Daemon { shutdown, running, endpoint }
    }

    pub(crate) async fn client(&self, manager: &Daemon, name: &str) -> Client {
        let session = Session::open(&self.channels, &manager.endpoint, name, Duration::from_secs(5));
        session.alive(DEADLINE).await.unwrap();
        let resources = ResourceClient::new(&self.channels, &manager.endpoint, session.id()).unwrap();
        Client { session, resources }
    }

    pub(crate) fn world(&self, pool: &Daemon) -> WorldClient {
        WorldClient::new(&self.channels, &pool.endpoint).unwrap()
    }

    pub(crate) fn processes(&self, manager: &Daemon) -> ProcessClient {
        ProcessClient::new(&self.channels, &manager.endpoint).unwrap()
    }

    /// Waits for an event of a watch that begins now, or for the snapshot to show it.
    pub(crate) async fn watch(&self, manager: &Daemon, kinds: &[&str]) -> Watch {
        let resources = ResourceClient::new(&self.channels, &manager.endpoint, "").unwrap();
        Watch { updates: resources.watch(kinds).await.unwrap() }
    }
}

pub(crate) struct Client {
    pub(crate) session: Session,
    pub(crate) resources: ResourceClient,
}

pub(crate) struct Watch {
    pub(crate) updates: ResourceWatch,
}

impl Watch {
    pub(crate) async fn next(&mut self) -> ResourceUpdate {
        in_time(self.updates.next()).await.unwrap().expect("the watch goes on")
    }

    pub(crate) async fn event(&mut self, wanted: impl Fn(&ResourceEvent) -> bool) -> ResourceEvent {
        loop {
            if let ResourceUpdate::Event(event) = self.next().await
                && wanted(&event)
            {
                return event;
            }
        }
    }

    /// The resource of a kind, from the snapshot or as soon as it is created.
    pub(crate) async fn created(&mut self, kind: &str) -> ratn_proto::types::Resource {
        loop {
            match self.next().await {
                ResourceUpdate::Snapshot { resources, .. } => {
                    if let Some(found) = resources.into_iter().find(|resource| resource.kind == kind) {
                        return found;
                    }
                }
                ResourceUpdate::Event(event) => {
                    if event.kind == ResourceEventKind::Created && event.resource.kind == kind {
                        return event.resource;
                    }
                }
            }
        }
    }
}

pub(crate) async fn in_time<T>(future: impl Future<Output = T>) -> T {
    tokio::time::timeout(DEADLINE, future).await.expect("in time")
}

pub(crate) fn block(kind: &str) -> Requirement {
    Requirement::new(ResourceOperation::Block, kind)
}

/// A file system that is soon full.
pub(crate) struct SmallDisk(tempfile::TempDir);

impl SmallDisk {
    /// Nothing where mounting is not allowed.
    pub(crate) fn mount() -> Option<SmallDisk> {
        let place = tempfile::tempdir().unwrap();
        match mount(Some("tmpfs"), place.path(), Some("tmpfs"), MsFlags::empty(), Some("size=256k")) {
            Ok(()) => Some(SmallDisk(place)),
            Err(error) => {
                eprintln!("skipped: cannot mount a small file system ({error}); run it as root");
                None
            }
        }
    }

    pub(crate) fn path(&self) -> &Path {
        self.0.path()
    }

    /// A file to fill it with.
    pub(crate) fn ballast(&self) -> PathBuf {
        self.0.path().join("ballast")
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = umount2(self.0.path(), MntFlags::MNT_DETACH);
    }
}
