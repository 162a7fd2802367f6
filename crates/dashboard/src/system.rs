//! The running system: its resources with their holders and queues, its hosts with their workers, and the runs under way.
//!
//! It asks the daemons as every client does, at most once per [`FRESH`] for all pages together, and reports a problem if they do not
//! answer. The daemons decide what a user may see and do (`docs/who-may-speak.md`).

use crate::{robot, wire};
use futures::future::join_all;
use ratn_daemon::{process_manager, resource_manager};
use ratn_model::pose::Pose;
use ratn_model::program::WORLD_MODEL;
use ratn_proto::types::{HostPools, PoolStatus, Resource, Scale, SessionStatus, WaitingAcquire, WorkerStatus};
use ratn_proto::v1::cell_service_client::CellServiceClient;
use ratn_proto::v1::{GetGroundTruthRequest, TrueObject};
use ratn_task_control::control::{self, Message, RunStatus, Word};
use ratn_worker::client::{CallError, Channels, ProcessClient, ResourceClient};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::tls::ClientTls;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::{Duration, Instant};
use tokio::sync::Mutex;

/// For this long an answer is reused.
const FRESH: Duration = Duration::from_millis(900);
const RUN_FRESH: Duration = Duration::from_millis(250);
const TRUTH_FRESH: Duration = Duration::from_millis(250);
/// Time limit for an answer.
const PATIENCE: Duration = Duration::from_secs(3);
/// The role of the simulated cell: the name of its endpoint file.
const CELL: &str = "cell";
/// Maximum number of resources, acquires, sessions, workers and objects sent.
const MOST: usize = 1_000;
/// Size of the shown end of a worker's output.
const TAIL_BYTES: usize = 16 << 10;
/// Maximum size of an output that is read for that.
const MOST_LOG_BYTES: usize = 64 << 20;

/// The answer about the runs of a system.
#[derive(Debug)]
pub(crate) enum Heard {
    /// They were asked a moment ago.
    JustNow,
    /// These are under way.
    Runs(Vec<RunStatus>),
}

/// A system, by its runtime directory.
#[derive(Debug)]
pub(crate) struct System {
    directory: PathBuf,
    channels: Channels,
    seen: Mutex<Option<(Instant, wire::System)>>,
    run: Mutex<Option<Instant>>,
    truth: Mutex<Option<(Instant, wire::Truth)>>,
}

impl System {
    /// The system with its endpoint files in this directory; it need not be running.
    pub(crate) fn of(directory: PathBuf, tls: &ClientTls) -> System {
        System {
            directory,
            channels: Channels::new(tls),
            seen: Mutex::default(),
            run: Mutex::default(),
            truth: Mutex::default(),
        }
    }

    /// The directory of its endpoint files.
    pub(crate) fn directory(&self) -> String {
        self.directory.display().to_string()
    }

    /// The statuses of its runs.
    pub(crate) async fn runs(&self) -> Heard {
        let mut asked = self.run.lock().await;
        if asked.is_some_and(|asked| asked.elapsed() < RUN_FRESH) {
            return Heard::JustNow;
        }
        let statuses = control::statuses(&self.directory).await;
        *asked = Some(Instant::now());
        Heard::Runs(statuses)
    }

    /// Sends a command to a run, by its id.
    pub(crate) async fn tell(&self, run: &str, word: Word) -> std::io::Result<()> {
        let told = control::tell(&self.directory, run, word).await;
        // Its new status has to be asked for at once.
        *self.run.lock().await = None;
        told
    }

    /// Sends a run the message that a state of it waits for; returns the result.
    pub(crate) async fn send(&self, message: &Message) -> std::io::Result<String> {
        let sent = control::send(&self.directory, message).await;
        *self.run.lock().await = None;
        sent
    }

    /// The true objects in the simulated cell; `None` without such a cell.
    pub(crate) async fn truth(&self) -> Option<wire::Truth> {
        let cell = RuntimeDirectory::at(&self.directory).find(CELL).ok()?;
        let mut seen = self.truth.lock().await;
        if let Some((_, truth)) = seen.as_ref().filter(|(at, _)| at.elapsed() < TRUTH_FRESH) {
            return Some(truth.clone());
        }
        let asked = async {
            let mut cell = CellServiceClient::new(self.channels.get(&cell).map_err(|error| error.to_string())?);
            let told = cell.get_ground_truth(GetGroundTruthRequest {}).await;
            told.map(|told| told.into_inner().objects).map_err(|status| status.message().to_owned())
        };
        let (objects, problem) = match tokio::time::timeout(PATIENCE, Box::pin(asked)).await {
            Ok(Ok(objects)) => (objects.iter().take(MOST).filter_map(true_object).collect(), String::new()),
            Ok(Err(problem)) => (Vec::new(), format!("the cell does not say where things are: {problem}")),
            Err(_) => (Vec::new(), format!("no answer from the cell within {} s", PATIENCE.as_secs())),
        };
        let truth = wire::Truth { objects, problem };
        *seen = Some((Instant::now(), truth.clone()));
        Some(truth)
    }

    /// The system in the pages' notation.
    pub(crate) async fn told(&self) -> wire::System {
        let mut seen = self.seen.lock().await;
        if let Some((_, system)) = seen.as_ref().filter(|(at, _)| at.elapsed() < FRESH) {
            return system.clone();
        }
        let system = self.look().await;
        *seen = Some((Instant::now(), system.clone()));
        system
    }

    async fn look(&self) -> wire::System {
        let directory = RuntimeDirectory::at(&self.directory);
        let manager = match directory.find(resource_manager::ROLE) {
            Ok(manager) => manager,
            Err(error) => return wire::System { problem: error.to_string(), ..wire::System::default() },
        };
        match tokio::time::timeout(PATIENCE, Box::pin(self.ask(&directory, &manager))).await {
            Ok(Ok(system)) => system,
            Ok(Err(error)) => wire::System { problem: error.to_string(), ..wire::System::default() },
            Err(_) => {
                let problem = format!("no answer from {manager} within {} s", PATIENCE.as_secs());
                wire::System { problem, ..wire::System::default() }
            }
        }
    }

    async fn ask(&self, directory: &RuntimeDirectory, manager: &Endpoint) -> Result<wire::System, CallError> {
        let client = ResourceClient::new(&self.channels, manager, "")?;
        let (resources, waiting) = tokio::try_join!(client.list(&[]), client.explain(""))?;
        // A client that may not list sessions sees the rest.
        let sessions = client.sessions().await.unwrap_or_default();
        let hosts = hosts_in(directory, &resources);
        let mut hosts = join_all(hosts.into_iter().map(|(name, endpoint)| Box::pin(self.host(name, endpoint)))).await;
        hosts.sort_by(|a, b| a.name.cmp(&b.name));
        let expires: BTreeMap<&str, u64> = sessions.iter().map(|one| (one.id.as_str(), one.expires_in_ms)).collect();
        let things = resources.iter().filter(|one| one.kind != WORLD_MODEL);
        let told = things.take(MOST).map(|one| resource(one, &expires)).collect();
        Ok(wire::System {
            up: true,
            problem: String::new(),
            resources: told,
            waiting: waiting.into_iter().take(MOST).map(acquire).collect(),
            sessions: sessions.iter().take(MOST).map(session).collect(),
            hosts,
        })
    }

    async fn host(&self, name: String, endpoint: Endpoint) -> wire::Host {
        let asked = async { ProcessClient::new(&self.channels, &endpoint)?.pools().await };
        let answer = tokio::time::timeout(PATIENCE / 2, asked).await;
        let problem = match answer {
            Ok(Ok(HostPools { host, draining, pools, .. })) => {
                let pools = pools.iter().take(MOST).map(pool).collect();
                return wire::Host { name: host, problem: String::new(), draining, pools };
            }
            Ok(Err(error)) => error.to_string(),
            Err(_) => format!("no answer from {endpoint}"),
        };
        wire::Host { name, problem, ..wire::Host::default() }
    }

    /// All process managers.
    async fn hosts(&self, directory: &RuntimeDirectory) -> Result<Vec<(String, Endpoint)>, CallError> {
        let listed = match directory.find(resource_manager::ROLE) {
            Ok(manager) => {
                ResourceClient::new(&self.channels, &manager, "")?.list(&[process_manager::HOST_KIND]).await?
            }
            Err(_) => Vec::new(),
        };
        Ok(hosts_in(directory, &listed))
    }

    /// Changes the number of workers in a pool.
    pub(crate) async fn scale(&self, host: &str, template: &str, scale: Scale) -> Result<(), String> {
        let directory = RuntimeDirectory::at(&self.directory);
        let scaling = async {
            let hosts = self.hosts(&directory).await?;
            let Some((_, endpoint)) = hosts.into_iter().find(|(name, _)| name == host) else { return Ok(false) };
            ProcessClient::new(&self.channels, &endpoint)?.scale(template, scale).await?;
            Ok::<bool, CallError>(true)
        };
        let scaled = tokio::time::timeout(PATIENCE, Box::pin(scaling)).await;
        // The new number has to be asked for at once.
        *self.seen.lock().await = None;
        match scaled {
            Ok(Ok(true)) => Ok(()),
            Ok(Ok(false)) => Err(format!("there is no host {host}")),
            Ok(Err(error)) => Err(error.to_string()),
            Err(_) => Err(format!("no answer from {host} within {} s", PATIENCE.as_secs())),
        }
    }

    /// The end of a worker's output.
    pub(crate) async fn tail(&self, worker: &str) -> Result<wire::Tail, String> {
        let directory = RuntimeDirectory::at(&self.directory);
        let reading = async {
            for (_, endpoint) in self.hosts(&directory).await? {
                match ProcessClient::new(&self.channels, &endpoint)?.log(worker, false).await {
                    Ok(mut pieces) => {
                        let (mut text, mut read) = (Vec::new(), 0);
                        while let Some(piece) = pieces.next().await? {
                            read += piece.len();
                            text.extend(piece);
                            text.drain(..text.len().saturating_sub(TAIL_BYTES));
                            if read > MOST_LOG_BYTES {
                                break;
                            }
                        }
                        return Ok(Some((text, read > TAIL_BYTES)));
                    }
                    Err(error) if !error.is_crash() => {}
                    Err(error) => return Err(error),
                }
            }
            Ok(None)
        };
        let read: Result<_, CallError> = tokio::time::timeout(PATIENCE, Box::pin(reading))
            .await
            .map_err(|_| format!("the log of {worker} was not there within {} s", PATIENCE.as_secs()))?;
        match read.map_err(|error| error.to_string())? {
            Some((text, cut)) => {
                let text = String::from_utf8_lossy(&text).into_owned();
                Ok(wire::Tail { worker: worker.to_owned(), text, cut })
            }
            None => Err(format!("no host has a log of {worker}")),
        }
    }
}

/// The hosts among the resources, and this one, which may not be registered with the resource manager yet.
fn hosts_in(directory: &RuntimeDirectory, resources: &[Resource]) -> Vec<(String, Endpoint)> {
    let registered = resources.iter().filter(|one| one.kind == process_manager::HOST_KIND);
    let mut hosts: Vec<(String, Endpoint)> =
        registered.filter_map(|one| Some((one.host.clone(), one.endpoint().parse().ok()?))).collect();
    if let Ok(own) = directory.find(process_manager::ROLE)
        && hosts.iter().all(|(_, endpoint)| *endpoint != own)
    {
        hosts.push((String::new(), own));
    }
    hosts
}

/// `None` for an object without a pose or a size.
fn true_object(one: &TrueObject) -> Option<wire::Object> {
    let pose = one.pose.as_ref().and_then(|pose| Pose::try_from(pose.clone()).ok())?;
    let size = one.size_m.clone().try_into().ok()?;
    Some(robot::true_object(&one.id, size, &pose, one.held))
}

fn resource(one: &Resource, expires: &BTreeMap<&str, u64>) -> wire::Resource {
    let holdings = one.holdings.iter().map(|holding| wire::Holding {
        holder: if holding.holder.is_empty() { holding.session.clone() } else { holding.holder.clone() },
        session: holding.session.clone(),
        lease: holding.lease.0,
        token: holding.token.0,
        expires_in_ms: expires.get(holding.session.as_str()).copied(),
    });
    wire::Resource {
        id: one.id.clone(),
        kind: one.kind.clone(),
        host: one.host.clone(),
        state: format!("{:?}", one.state).to_lowercase(),
        free: format!("{} of {}", one.free, one.capacity),
        holdings: holdings.collect(),
    }
}

fn acquire(one: WaitingAcquire) -> wire::Acquire {
    wire::Acquire {
        holder: if one.holder.is_empty() { one.session } else { one.holder },
        priority: one.priority,
        ahead: one.ahead,
        obstacles: one.obstacles,
    }
}

fn session(one: &SessionStatus) -> wire::Session {
    wire::Session {
        id: one.id.clone(),
        client: one.client.clone(),
        expires_in_ms: one.expires_in_ms,
        leases: one.leases.len(),
        resources: one.resources.len(),
    }
}

fn pool(one: &PoolStatus) -> wire::Pool {
    wire::Pool {
        template: one.template.clone(),
        kind: one.kind.clone(),
        min: one.min,
        max: one.max,
        spares: one.spares,
        crashes: one.crashes,
        last_exit: one.last_exit.clone(),
        failure: one.failure.clone(),
        workers: one.workers.iter().take(MOST).map(worker).collect(),
    }
}

fn worker(one: &WorkerStatus) -> wire::Worker {
    wire::Worker {
        id: one.id.clone(),
        state: format!("{:?}", one.state).to_lowercase(),
        pid: one.pid,
        resident_bytes: one.resident_bytes,
        cpu_millicores: one.cpu_millicores,
        age_s: one.age_s,
        held: one.held,
        limits: one.limits.clone(),
    }
}
