//! The one task that owns the pools: performs their commands, and tells them what became of it.

use super::config::ProcessManagerConfig;
use super::log::EndedLogs;
use super::pool::{Command, PoolError, Pools};
use super::spawner::{self, Job, Outcome};
use super::usage::Usage;
use crate::demand::Shortages;
use crate::link::Wanted;
use nix::sys::signal::Signal;
use ratn_model::resource::ResourceClass;
use ratn_model::time::Timestamp;
use ratn_model::value::Value;
use ratn_proto::types::{Demand, PoolStatus, Resource, WorkerStatus};
use ratn_worker::client::wait_until_serving;
use ratn_worker::runtime_directory::RuntimeDirectory;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::{Duration, Instant};
use tokio::sync::{mpsc, oneshot, watch};
use tokio::task::{AbortHandle, JoinHandle};
use tokio_util::sync::CancellationToken;
use tonic::Status;

/// Messages that wait for the actor; more make their senders wait.
const INBOX: usize = 256;
/// What became of processes that waits for the actor.
const OUTCOMES: usize = 1_024;
/// Changes that wait for a watcher; one that has more to catch up with is cut off.
const WATCH_BUFFER: usize = 4_096;
/// Clients that watch at the same time.
const MAX_WATCHERS: usize = 256;
/// When the process manager ends, workers have this long to end by themselves: less than the grace of its own end.
const SHUTDOWN_PATIENCE: Duration = Duration::from_millis(400);
/// What is killed in the end is waited for this long.
const KILL_PATIENCE: Duration = Duration::from_millis(400);

/// What the service asks of the actor.
#[derive(Debug)]
pub(super) enum Message {
    List { answer: oneshot::Sender<Vec<PoolStatus>> },
    Spawn { template: String, count: u32, answer: oneshot::Sender<Result<Vec<String>, PoolError>> },
    Stop { id: String, answer: oneshot::Sender<Result<(), PoolError>> },
    Watch { answer: oneshot::Sender<Option<mpsc::Receiver<WorkerStatus>>> },
}

/// Sends messages to the actor.
#[derive(Debug, Clone)]
pub(super) struct Handle {
    inbox: mpsc::Sender<Message>,
}

/// What the actor is made of.
pub(super) struct Parts {
    pub(super) config: ProcessManagerConfig,
    pub(super) directory: RuntimeDirectory,
    /// What the link shall offer.
    pub(super) wanted: watch::Sender<Wanted>,
    /// What the link has offered.
    pub(super) there: mpsc::Receiver<String>,
    /// What is missing.
    pub(super) demand: mpsc::Receiver<Vec<Demand>>,
    /// Why there is no more.
    pub(super) short: watch::Sender<Shortages>,
}

struct Actor {
    config: ProcessManagerConfig,
    directory: RuntimeDirectory,
    /// What a template without a program runs.
    this_program: PathBuf,
    pools: Pools,
    start: Instant,
    wanted: watch::Sender<Wanted>,
    short: watch::Sender<Shortages>,
    jobs: mpsc::Sender<Job>,
    serving: mpsc::Sender<(String, String)>,
    processes: BTreeMap<String, Process>,
    ended_logs: EndedLogs,
    watchers: Vec<mpsc::Sender<WorkerStatus>>,
    usage: Usage,
}

#[derive(Debug, Default)]
struct Process {
    pid: u32,
    readiness: Option<AbortHandle>,
}

/// Starts the actor; it ends with the token, once every worker has.
pub(super) fn start(parts: Parts, shutdown: CancellationToken) -> std::io::Result<(Handle, JoinHandle<()>)> {
    let (inbox, messages) = mpsc::channel(INBOX);
    let (told, outcomes) = mpsc::channel(OUTCOMES);
    let (serving, served) = mpsc::channel(OUTCOMES);
    let Parts { config, directory, wanted, there, demand, short } = parts;
    let actor = Actor {
        this_program: std::env::current_exe()?,
        pools: Pools::new(&config.host, config.templates.iter().cloned()),
        config,
        directory,
        start: Instant::now(),
        wanted,
        short,
        jobs: spawner::start(told)?,
        serving,
        processes: BTreeMap::new(),
        ended_logs: EndedLogs::default(),
        watchers: Vec::new(),
        usage: Usage::new(),
    };
    let inputs = Inputs { messages, outcomes, served, there, demand };
    Ok((Handle { inbox }, tokio::spawn(actor.run(inputs, shutdown))))
}

impl Handle {
    pub(super) async fn ask<T>(&self, message: impl FnOnce(oneshot::Sender<T>) -> Message) -> Result<T, Status> {
        let (answer, answered) = oneshot::channel();
        self.inbox.send(message(answer)).await.map_err(|_| crate::details::ending())?;
        answered.await.map_err(|_| crate::details::ending())
    }
}

struct Inputs {
    messages: mpsc::Receiver<Message>,
    outcomes: mpsc::Receiver<Outcome>,
    served: mpsc::Receiver<(String, String)>,
    there: mpsc::Receiver<String>,
    demand: mpsc::Receiver<Vec<Demand>>,
}

impl Actor {
    async fn run(mut self, mut inputs: Inputs, shutdown: CancellationToken) {
        self.pools.advance(self.now());
        self.perform();
        loop {
            let deadline = self.pools.next_deadline().map(|at| self.start + Duration::from_nanos(at.0));
            tokio::select! {
                Some(outcome) = inputs.outcomes.recv() => self.became(outcome),
                Some((id, endpoint)) = inputs.served.recv() => self.pools.serving(self.now(), &id, &endpoint),
                Some(id) = inputs.there.recv() => self.pools.resource_there(&id),
                Some(demand) = inputs.demand.recv() => self.pools.demanded(self.now(), &demand),
                Some(message) = inputs.messages.recv() => self.receive(message),
                () = sleep_until(deadline) => self.pools.advance(self.now()),
                () = shutdown.cancelled() => break,
            }
            self.perform();
        }
        self.end(&mut inputs.outcomes).await;
    }

    /// Ends every worker, whatever it takes.
    async fn end(&mut self, outcomes: &mut mpsc::Receiver<Outcome>) {
        self.watchers.clear();
        self.pools.shut_down(self.now(), SHUTDOWN_PATIENCE);
        self.perform();
        let last = Instant::now() + SHUTDOWN_PATIENCE + KILL_PATIENCE;
        while !self.pools.is_empty() && Instant::now() < last {
            let deadline = self.pools.next_deadline().map(|at| self.start + Duration::from_nanos(at.0));
            tokio::select! {
                Some(outcome) = outcomes.recv() => self.became(outcome),
                () = sleep_until(deadline) => self.pools.advance(self.now()),
                () = tokio::time::sleep_until(last.into()) => {}
            }
            self.perform();
        }
        for process in self.processes.values() {
            spawner::signal(process.pid, Signal::SIGKILL);
        }
    }

    fn now(&self) -> Timestamp {
        Timestamp(u64::try_from(self.start.elapsed().as_nanos()).unwrap_or(u64::MAX))
    }

    // Answers that nobody waits for any more are of no consequence.
    fn receive(&mut self, message: Message) {
        let now = self.now();
        match message {
            Message::List { answer } => {
                let mut pools = self.pools.status();
                self.usage.fill_in(&mut pools);
                let _ = answer.send(pools);
            }
            Message::Spawn { template, count, answer } => {
                let _ = answer.send(self.pools.spawn(now, &template, count));
            }
            Message::Stop { id, answer } => drop(answer.send(self.pools.stop(now, &id))),
            Message::Watch { answer } => drop(answer.send(self.watch())),
        }
    }

    fn watch(&mut self) -> Option<mpsc::Receiver<WorkerStatus>> {
        self.watchers.retain(|watcher| !watcher.is_closed());
        if self.watchers.len() >= MAX_WATCHERS {
            return None;
        }
        let (sender, updates) = mpsc::channel(WATCH_BUFFER);
        for worker in self.pools.status().into_iter().flat_map(|pool| pool.workers) {
            sender.try_send(worker).ok()?;
        }
        self.watchers.push(sender);
        Some(updates)
    }

    fn became(&mut self, outcome: Outcome) {
        match outcome {
            Outcome::Spawned { id, pid } => {
                tracing::info!(id, pid, "worker started");
                self.processes.entry(id.clone()).or_default().pid = pid;
                self.pools.spawned(&id, pid);
            }
            Outcome::Exited { id, reason, last_words } => {
                tracing::info!(id, reason, last_words, "worker gone");
                if let Some(readiness) = self.processes.remove(&id).and_then(|process| process.readiness) {
                    readiness.abort();
                }
                // One that was killed could not take it back itself.
                let _ = std::fs::remove_file(self.directory.endpoint_file(&id));
                self.ended_logs.add(self.log_file(&id));
                self.pools.exited(self.now(), &id, &reason, &last_words);
            }
        }
    }

    fn perform(&mut self) {
        loop {
            let commands = self.pools.take_commands();
            if commands.is_empty() {
                self.short.send_if_modified(|said| {
                    let shortages = self.pools.shortages();
                    let changed = *said != shortages;
                    *said = shortages;
                    changed
                });
                return;
            }
            for command in commands {
                match command {
                    Command::Start { id, template } => self.begin(&id, &template),
                    Command::Terminate { id } => self.signal(&id, Signal::SIGTERM),
                    Command::Kill { id } => self.signal(&id, Signal::SIGKILL),
                    Command::Offer { worker, kind } => self.offer(&worker, &kind),
                    Command::Withdraw { id } => {
                        self.wanted.send_if_modified(|wanted| wanted.remove(&id).is_some());
                    }
                    Command::Tell(worker) => self.tell(&worker),
                }
            }
        }
    }

    fn begin(&mut self, id: &str, template: &str) {
        let Some(template) = self.pools.template(template).cloned() else { return };
        let runtime_dir = self.directory.path().display().to_string();
        let endpoint_file = self.directory.endpoint_file(id);
        let fill = |text: &str| {
            text.replace("{id}", id)
                .replace("{kind}", &template.kind)
                .replace("{host}", &self.config.host)
                .replace("{runtime_dir}", &runtime_dir)
                .replace("{endpoint_file}", &endpoint_file.display().to_string())
        };
        let _ = std::fs::remove_file(&endpoint_file);
        let job = Job {
            id: id.to_owned(),
            args: template.args.iter().map(|arg| fill(arg)).collect(),
            env: template.env.iter().map(|(name, value)| (name.clone(), fill(value))).collect(),
            log: self.log_file(id),
            max_log_bytes: self.config.max_log_bytes,
            program: template.program.clone().unwrap_or_else(|| self.this_program.clone()),
        };
        if self.jobs.try_send(job).is_err() {
            self.pools.exited(self.now(), id, "cannot be started: too many processes are being started", "");
            return;
        }
        let readiness = ready(self.directory.clone(), id.to_owned(), template.start_timeout(), self.serving.clone());
        let readiness = tokio::spawn(readiness).abort_handle();
        self.processes.entry(id.to_owned()).or_default().readiness = Some(readiness);
    }

    fn log_file(&self, id: &str) -> PathBuf {
        self.directory.path().join("logs").join(format!("{id}.log"))
    }

    fn signal(&self, id: &str, signal: Signal) {
        // Without a process yet, the pools ask again once it is there.
        if let Some(process) = self.processes.get(id).filter(|process| process.pid != 0) {
            spawner::signal(process.pid, signal);
        }
    }

    fn offer(&self, worker: &WorkerStatus, kind: &str) {
        let resource = Resource::new(&worker.id, ResourceClass::Process, kind)
            .with_endpoint(&worker.endpoint)
            .with_attribute("host", Value::String(self.config.host.clone()))
            .with_attribute("pid", Value::Int(i64::from(worker.pid)))
            .on_host(&self.config.host);
        self.wanted.send_modify(|wanted| {
            wanted.insert(worker.id.clone(), resource);
        });
    }

    fn tell(&mut self, worker: &WorkerStatus) {
        self.watchers.retain(|watcher| watcher.try_send(worker.clone()).is_ok());
    }
}

/// Tells the actor once a worker serves. One that does not is the pools' business: they know when it is too late.
async fn ready(directory: RuntimeDirectory, id: String, deadline: Duration, serving: mpsc::Sender<(String, String)>) {
    let found = match directory.wait_for(&id, deadline).await {
        Ok(endpoint) => endpoint,
        Err(error) => return tracing::debug!(id, %error, "no endpoint of a worker"),
    };
    match wait_until_serving(&found, deadline).await {
        Ok(()) => drop(serving.send((id, found.to_string())).await),
        Err(error) => tracing::debug!(id, %error, "a worker does not serve"),
    }
}

async fn sleep_until(deadline: Option<Instant>) {
    match deadline {
        Some(deadline) => tokio::time::sleep_until(deadline.into()).await,
        None => std::future::pending().await,
    }
}
