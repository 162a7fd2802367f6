//! How soon a worker that was killed has a successor, and what many of them cost: `scripts/bench-restart`.
//!
//! Workers are killed with SIGKILL, one at a time, each when its pool is whole again. Ready is when the resource manager has the
//! successor's resource, as a watcher of the process manager hears it. Starts of the same program without anybody between take turns.
//! All is measured, or the parts that are named: `plain`, `sdk`, `spare`, `crowd`, `sdk_crowd`, `rivals`.
//!
//! | key | what |
//! |---|---|
//! | `start_MIB_…` | from the start of a process that takes so much memory (0, 10, 256, 2048 MiB) to its word that it is ready |
//! | `restart_MIB_…` | from its kill to its successor's readiness, under the process manager; `…_above_start_…`: beyond the start |
//! | `sdk_…` | the same with a worker of the SDK, which serves gRPC and is asked for its health |
//! | `spare_…` | from the kill of a worker that performs a goal to the acceptance of the next goal by the spare |
//! | `supervisord_…`, `systemd_…` | `restart_0` with these, where they are installed and can run; readiness as the worker says it |
//! | `crowd_…`, `sdk_crowd_…` | 1,000 workers, such as only say that they are ready, or serve and are asked for their health: started per second, until their resources are there; what the process manager and the resource manager use while all are idle, in percent of a core, and memory |

use crate::hop;
use crate::process::{self, Process};
use crate::rivals;
use crate::times::Times;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use ratn_model::resource::{Requirement, ResourceOperation};
use ratn_proto::types::{Goal, WorkerState};
use ratn_proto::v1;
use ratn_proto::v1::action_service_client::ActionServiceClient;
use ratn_worker::client::{AcquireOptions, Channels, ProcessClient, ResourceClient, WorkerWatch};
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::session::{DEFAULT_TTL, Session};
use ratn_worker::tls::ClientTls;
use serde_json::json;
use std::collections::BTreeMap;
use std::os::unix::net::UnixDatagram;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// Megabytes of a worker, and how often it is killed.
const SIZES: [(usize, usize); 4] = [(0, 60), (10, 60), (256, 20), (2_048, 6)];
pub(crate) const KILLS: usize = 60;
const CROWD: usize = 1_000;
/// For how long the crowd is watched doing nothing.
const IDLE: Duration = Duration::from_secs(10);
const PATIENCE: Duration = Duration::from_secs(60);

pub(crate) async fn measure() {
    let directory = tempfile::tempdir().unwrap();
    let mut report = serde_json::Map::new();
    let mut note = |key: String, value: f64| drop(report.insert(key, json!((value * 1e3).round() / 1e3)));
    let parts: Vec<String> = std::env::args().skip_while(|argument| argument != "--restart").skip(1).collect();
    let named: Vec<&String> = parts.iter().filter(|part| !part.starts_with('-')).collect();
    let wanted = |part: &str| named.is_empty() || named.iter().any(|name| *name == part);
    for (mib, kills) in SIZES.into_iter().filter(|_| wanted("plain")) {
        plain(&directory.path().join(format!("plain-{mib}")), mib, kills, &mut note).await;
    }
    if wanted("sdk") {
        sdk(&directory.path().join("sdk"), &mut note).await;
    }
    if wanted("spare") {
        spare(&directory.path().join("spare"), &mut note).await;
    }
    let tiny = "args = [\"--tiny\", \"0\"]\nreadiness = { kind = \"notify\" }\n";
    for (key, worker) in [("crowd", tiny), ("sdk_crowd", SDK)].into_iter().filter(|(key, _)| wanted(key)) {
        crowd(&directory.path().join(key), key, worker, &mut note).await;
    }
    if wanted("rivals") {
        rivals::measure(directory.path(), &mut note);
    }
    println!("{}", serde_json::to_string_pretty(&report).unwrap());
}

/// A resource manager, and a process manager with one template.
struct Host {
    directory: PathBuf,
    channels: Channels,
    managers: [Process; 2],
}

impl Host {
    async fn start(directory: &Path, template: &str) -> Host {
        std::fs::create_dir_all(directory).unwrap();
        let config = directory.join("config.toml");
        let program = std::env::current_exe().unwrap();
        let text = format!(
            "[process-manager]\nhost = \"bench\"\n[[process-manager.template]]\nname = \"w\"\nkind = \"W\"\n\
             program = {program:?}\nstable_s = 0.001\n{template}\n"
        );
        std::fs::write(&config, text).unwrap();
        let config = config.to_str().unwrap();
        let arguments = ["--config", config, "--durability", "none"];
        let resources = process::role("resource-manager", directory, &arguments).await.0;
        let processes = process::role("process-manager", directory, &arguments[..2]).await.0;
        Host {
            directory: directory.to_owned(),
            channels: Channels::new(&ClientTls::none()),
            managers: [resources, processes],
        }
    }

    fn endpoint(&self, role: &str) -> ratn_worker::endpoint::Endpoint {
        RuntimeDirectory::at(&self.directory).find(role).unwrap()
    }

    async fn watch(&self) -> WorkerWatch {
        let client = ProcessClient::new(&self.channels, &self.endpoint("process-manager")).unwrap();
        client.watch().await.unwrap()
    }
}

/// The process of the next worker that is ready.
async fn ready(watch: &mut WorkerWatch) -> u32 {
    next_ready(watch).await.1
}

/// The next worker that is ready: its id and its process.
async fn next_ready(watch: &mut WorkerWatch) -> (String, u32) {
    loop {
        let next = tokio::time::timeout(PATIENCE, watch.next()).await.unwrap();
        let worker = next.unwrap().unwrap();
        if worker.state == WorkerState::Ready {
            return (worker.id, worker.pid);
        }
    }
}

pub(crate) fn end(pid: u32) {
    assert!(pid > 1, "0 would be this process's own group");
    kill(Pid::from_raw(pid as i32), Signal::SIGKILL).unwrap();
}

/// A worker that only says that it is ready.
async fn plain(directory: &Path, mib: usize, kills: usize, note: &mut impl FnMut(String, f64)) {
    let template =
        format!("args = [\"--tiny\", \"{mib}\"]\nreadiness = {{ kind = \"notify\" }}\nstart_timeout_s = 60\n");
    let host = Host::start(directory, &template).await;
    let mut watch = host.watch().await;
    let mut pid = ready(&mut watch).await;
    let socket = Notified::bind(&directory.join("own.notify"));
    let [mut starts, mut restarts] = <[Times; 2]>::default();
    for _ in 0..kills {
        starts.add_us(socket.start(mib));
        let began = Instant::now();
        end(pid);
        pid = ready(&mut watch).await;
        restarts.add(began);
    }
    let (start, restart) = (starts.at(0.5), restarts.at(0.5));
    note(format!("start_{mib}_p50_ms"), start / 1e3);
    note(format!("restart_{mib}_p50_ms"), restart / 1e3);
    note(format!("restart_{mib}_p90_ms"), restarts.at(0.9) / 1e3);
    note(format!("restart_{mib}_above_start_p50_ms"), (restart - start) / 1e3);
}

/// Where workers that nobody manages say that they are ready.
pub(crate) struct Notified {
    socket: UnixDatagram,
    path: PathBuf,
}

impl Notified {
    pub(crate) fn bind(path: &Path) -> Notified {
        let socket = UnixDatagram::bind(path).unwrap();
        socket.set_read_timeout(Some(PATIENCE)).unwrap();
        Notified { socket, path: path.to_owned() }
    }

    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// The process that says so next.
    pub(crate) fn next(&self) -> u32 {
        let mut message = [0; 256];
        let length = self.socket.recv(&mut message).unwrap();
        let text = std::str::from_utf8(&message[..length]).unwrap();
        text.lines().find_map(|line| line.strip_prefix("MAINPID=")).unwrap().parse().unwrap()
    }

    /// Microseconds from the start of a process to its word.
    fn start(&self, mib: usize) -> f64 {
        let began = Instant::now();
        let mut command = Command::new(std::env::current_exe().unwrap());
        command.args(["--tiny", &mib.to_string()]).env("NOTIFY_SOCKET", &self.path).stdin(Stdio::piped());
        let mut child = command.spawn().unwrap();
        self.next();
        let took = began.elapsed().as_secs_f64() * 1e6;
        child.kill().unwrap();
        child.wait().unwrap();
        took
    }
}

const SDK: &str = "args = [\"--worker\", \"{id}\", \"{runtime_dir}\", \"{endpoint_file}\"]\n";

/// A worker that serves gRPC.
async fn sdk(directory: &Path, note: &mut impl FnMut(String, f64)) {
    let host = Host::start(directory, SDK).await;
    let mut watch = host.watch().await;
    let mut pid = ready(&mut watch).await;
    let [mut starts, mut restarts] = <[Times; 2]>::default();
    for _ in 0..KILLS {
        starts.add_us(start_sdk(directory).await);
        let began = Instant::now();
        end(pid);
        pid = ready(&mut watch).await;
        restarts.add(began);
    }
    let (start, restart) = (starts.at(0.5), restarts.at(0.5));
    note("sdk_start_p50_ms".to_owned(), start / 1e3);
    note("sdk_restart_p50_ms".to_owned(), restart / 1e3);
    note("sdk_restart_p90_ms".to_owned(), restarts.at(0.9) / 1e3);
    note("sdk_restart_above_start_p50_ms".to_owned(), (restart - start) / 1e3);
}

/// Microseconds from the start of such a worker to a connection to it.
async fn start_sdk(directory: &Path) -> f64 {
    let file = directory.join("own.endpoint");
    let began = Instant::now();
    let mut command = Command::new(std::env::current_exe().unwrap());
    command.args(["--worker", "own"]).arg(directory).arg(&file).stdin(Stdio::piped());
    let mut child = command.spawn().unwrap();
    while !file.exists() {
        tokio::time::sleep(Duration::from_micros(200)).await;
    }
    let took = began.elapsed().as_secs_f64() * 1e6;
    child.kill().unwrap();
    child.wait().unwrap();
    let _ = std::fs::remove_file(file);
    took
}

/// A goal's worker is killed; the goal is given again, to the spare.
async fn spare(directory: &Path, note: &mut impl FnMut(String, f64)) {
    let host = Host::start(directory, &format!("{SDK}max = 4\nspares = 1\n")).await;
    let mut watch = host.watch().await;
    let manager = host.endpoint("resource-manager");
    let session = Session::open(&host.channels, &manager, "bench", DEFAULT_TTL);
    session.alive(PATIENCE).await.unwrap();
    let resources = ResourceClient::new(&host.channels, &manager, session.id()).unwrap();
    let mut pids = BTreeMap::from([next_ready(&mut watch).await, next_ready(&mut watch).await]);
    let mut accepted = Accepted::give(&host, &resources, 0).await;
    let mut times = Times::default();
    for round in 1..=KILLS {
        let began = Instant::now();
        end(pids[&accepted.worker]);
        // Its client hears of it from the connection.
        while let Ok(Some(_)) = accepted.messages.message().await {}
        accepted = Accepted::give(&host, &resources, round).await;
        times.add(began);
        pids.extend([next_ready(&mut watch).await]);
    }
    note("spare_next_goal_p50_ms".to_owned(), times.at(0.5) / 1e3);
    note("spare_next_goal_p90_ms".to_owned(), times.at(0.9) / 1e3);
}

/// A goal that a worker has accepted.
struct Accepted {
    worker: String,
    messages: tonic::Streaming<v1::ExecuteResponse>,
}

impl Accepted {
    async fn give(host: &Host, resources: &ResourceClient, round: usize) -> Accepted {
        let requirement = Requirement::new(ResourceOperation::Block, "W");
        let options = AcquireOptions { deadline: PATIENCE, ..AcquireOptions::default() };
        let lease = resources.block(requirement, options).await.unwrap();
        let worker = lease.resource("W").unwrap().clone();
        let channel = host.channels.get(&worker.endpoint.parse().unwrap()).unwrap();
        let goal =
            Goal { id: format!("goal-{round}"), action: hop::WAIT.to_owned(), lease: Some(lease), ..Goal::default() };
        let question = v1::ExecuteRequest { goal: Some(goal.into()) };
        let mut messages = ActionServiceClient::new(channel).execute(question).await.unwrap().into_inner();
        messages.message().await.unwrap().unwrap();
        Accepted { worker: worker.id, messages }
    }
}

/// Many at once.
async fn crowd(directory: &Path, key: &str, worker: &str, note: &mut impl FnMut(String, f64)) {
    let template = format!("{worker}start_timeout_s = 60\nmin = {CROWD}\nmax = {CROWD}\n");
    let began = Instant::now();
    let host = Host::start(directory, &template).await;
    let mut watch = host.watch().await;
    for _ in 0..CROWD {
        ready(&mut watch).await;
    }
    note(format!("{key}_started_per_s"), CROWD as f64 / began.elapsed().as_secs_f64());
    tokio::time::sleep(Duration::from_secs(1)).await;
    let used = || host.managers.each_ref().map(|manager| process::cpu_us(manager.id()));
    let (began, before) = (Instant::now(), used());
    tokio::time::sleep(IDLE).await;
    let took = began.elapsed().as_secs_f64() * 1e6;
    let after = used();
    note(format!("{key}_idle_resource_manager_percent"), (after[0] - before[0]) / took * 100.0);
    note(format!("{key}_idle_process_manager_percent"), (after[1] - before[1]) / took * 100.0);
    note(format!("{key}_process_manager_mib"), host.managers[1].resident_bytes() / f64::from(1 << 20));
}
