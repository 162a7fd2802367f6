//! The processes of the workers: starts them from their templates, signals them, waits until they serve, and cleans up after them.

use super::account::{self, Account};
use super::comparison::Comparison;
use super::config::ProcessManagerConfig;
use super::environment;
use super::limits::Groups;
use super::log::{Awaited, EndedLogs};
use super::log_file::log_file;
use super::parameter;
use super::predecessor::{self, Adopted, adopt_socket};
use super::readiness::{HealthCheck, Readiness, ReadinessCheck};
use super::roster::{Entry, Intent, Motions, Roster};
use super::spawner::{self, Job, Outcome};
use super::template::Template;
use super::tracking::{Children, Tracker};
use crate::processor_demand::of_tree;
use crate::resource_manager;
use futures::FutureExt;
use nix::sys::signal::Signal;
use ratn_model::catalogue::Catalogue;
use ratn_panic_point::panic_point;
use ratn_worker::adoption;
use ratn_worker::endpoint::Endpoint;
use ratn_worker::lease_watch::{ManagerLocation, RESOURCE_MANAGER_VARIABLE};
use ratn_worker::panic::{exit_on_panic, exit_on_panic_blocking};
use ratn_worker::pooled::{LISTEN_VARIABLE, PROVIDER_SESSION_VARIABLE, STANDSTILL_VARIABLE, STUCK_VARIABLE};
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::tls::ClientTls;
use ratn_worker::unix_socket::SocketAccess;
use std::collections::BTreeMap;
use std::convert::Infallible;
use std::ffi::OsStr;
use std::io;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::{mpsc, oneshot};
use tokio::task::AbortHandle;
use tokio_util::task::AbortOnDropHandle;

/// Capacity for events of processes that the actor has not handled yet.
const OUTCOMES: usize = 1_024;

/// Longer than the pools wait for a worker.
const FOR_EVER: Duration = Duration::from_secs(86_400);

/// Interval at which ended orphans are reaped.
const REAP_INTERVAL: Duration = Duration::from_secs(5);

/// The name of this part of the process in its log.
const HEALTH_OF_WORKER: &str = "the health check of a worker";

/// Events of the processes.
pub(super) struct ProcessEvents {
    pub(super) outcomes: mpsc::Receiver<Outcome>,
    /// The id of each worker that computes while it starts.
    pub(super) busy: mpsc::Receiver<String>,
    /// The id and the endpoint of each worker that serves.
    pub(super) serving: mpsc::Receiver<(String, String)>,
    /// The id of each worker that got a health check, with the result.
    pub(super) health: mpsc::Receiver<(String, Result<(), String>)>,
}

/// Why a worker cannot be started.
#[derive(Debug, thiserror::Error)]
pub(super) enum BeginError {
    /// Too many processes are being started at once.
    #[error("cannot be started: too many processes are being started")]
    Busy,
    /// The worker cannot run as the user of its template.
    #[error("cannot be started: {0}")]
    User(String),
    /// The socket of the worker's notifications cannot be made.
    #[error("cannot be started: no socket {} for it to notify: {reason}", socket.display())]
    Socket {
        /// The path of the socket.
        socket: PathBuf,
        /// Why the socket cannot be made.
        reason: String,
    },
}

pub(super) struct Processes {
    host: String,
    tls: ClientTls,
    told: ManagerContact,
    /// Whether the process manager is reached only by its socket in the runtime directory.
    is_local: bool,
    /// Variables in the environment of every worker.
    worker_environment: BTreeMap<&'static str, PathBuf>,
    /// The catalogue that workers are compared with, where it is known.
    catalogue: Option<Arc<Catalogue>>,
    max_log_bytes: u64,
    /// The directories in which cgroups are made.
    groups: Groups,
    directory: RuntimeDirectory,
    /// The program of a template that names none.
    this_program: PathBuf,
    jobs: mpsc::Sender<Job>,
    outcomes: mpsc::Sender<Outcome>,
    roster: Roster,
    tracker: Tracker,
    senders: EventSenders,
    by_id: BTreeMap<String, Process>,
    ended_logs: EndedLogs,
    /// Reaps orphans: waits for those that have ended.
    reaping: Option<AbortOnDropHandle<()>>,
}

#[derive(Debug, Clone)]
struct EventSenders {
    busy: mpsc::Sender<String>,
    serving: mpsc::Sender<(String, String)>,
    health: mpsc::Sender<(String, Result<(), String>)>,
}

#[derive(Debug)]
struct Process {
    /// The directory of the worker's files.
    directory: RuntimeDirectory,
    pid: u32,
    /// The worker's template, and the session that it was told offers it, until the roster has them.
    started: Option<(Template, String)>,
    /// Gets the process id when it is known; the readiness check waits for that.
    known: Option<oneshot::Sender<u32>>,
    attended: Option<(AbortHandle, mpsc::Sender<Duration>)>,
}

/// What workers are told of the resource manager, which confirms the leases of their goals.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct ManagerContact {
    /// The address of the resource manager.
    pub(super) manager: ManagerLocation,
    /// The session that offers the workers there.
    pub(super) session: String,
}

/// The address of the resource manager for the workers of a process manager.
pub(super) fn manager_of(config: &ProcessManagerConfig, directory: &RuntimeDirectory) -> ManagerLocation {
    match &config.resource_manager {
        Some(endpoint) => ManagerLocation::At(endpoint.clone()),
        None => ManagerLocation::File(directory.endpoint_file(resource_manager::ROLE)),
    }
}

impl Processes {
    /// No processes yet. Needs a tokio runtime.
    pub(super) fn start(
        config: &ProcessManagerConfig,
        directory: RuntimeDirectory,
        tls: ClientTls,
        told: ManagerContact,
        roster: Roster,
        tracker: Tracker,
        sockets: &SocketAccess,
    ) -> io::Result<(Processes, ProcessEvents)> {
        let (outcome, outcomes) = mpsc::channel(OUTCOMES);
        let (busy, computing) = mpsc::channel(OUTCOMES);
        let (serving, served) = mpsc::channel(OUTCOMES);
        let (health, answered) = mpsc::channel(OUTCOMES);
        let processes = Processes {
            host: config.host.clone(),
            tls,
            told,
            // A worker's socket is only for its own user and group.
            is_local: config.listen.is_local() && sockets == &SocketAccess::default(),
            worker_environment: config.worker_environment.clone(),
            catalogue: config.catalogue.clone(),
            max_log_bytes: config.max_log_bytes,
            groups: Groups { v2: config.cgroup.clone(), v1: config.cgroup_v1.clone(), tracking: tracker.groups() },
            directory,
            this_program: std::env::current_exe()?,
            jobs: spawner::start(outcome.clone(), tracker.clone())?,
            outcomes: outcome,
            roster,
            reaping: tracker.children().map(|children| {
                AbortOnDropHandle::new(tokio::spawn(exit_on_panic("the reaper of orphans", reap(children))))
            }),
            tracker,
            senders: EventSenders { busy, serving, health },
            by_id: BTreeMap::new(),
            ended_logs: EndedLogs::default(),
        };
        Ok((processes, ProcessEvents { outcomes, busy: computing, serving: served, health: answered }))
    }

    /// Workers that are started from now on are told that this session offers them.
    pub(super) fn offered_by(&mut self, session: &str) {
        session.clone_into(&mut self.told.session);
    }

    /// Starts a worker of a template.
    pub(super) fn begin(&mut self, id: &str, template: &Template) -> Result<(), BeginError> {
        let directory = account::directory_of(&self.directory, template);
        let account = template.user.as_deref().map(Account::named).transpose().map_err(BeginError::User)?;
        if let Some(Err(error)) = account.as_ref().map(|account| account.make_directory(&self.directory, &directory)) {
            return Err(BeginError::User(format!(
                "no directory {} for its files: {error}",
                directory.path().display()
            )));
        }
        let endpoint_file = directory.endpoint_file(id);
        let builtin = |name: &str| match name {
            "id" => Some(id.to_owned()),
            "kind" => Some(template.kind.clone()),
            "host" => Some(self.host.clone()),
            "runtime_dir" => Some(directory.path().display().to_string()),
            "endpoint_file" => Some(endpoint_file.display().to_string()),
            _ => None,
        };
        let fill = |text: &str| parameter::fill(text, &builtin, &template.parameters);
        let _ = std::fs::remove_file(&endpoint_file);
        let socket = notify_socket(&directory, id);
        let readiness_check =
            template.readiness.readiness_check(&socket, &self.tls).and_then(|readiness_check| {
                match (&readiness_check, &account) {
                    (ReadinessCheck::Notify { .. }, Some(account)) => account.give(&socket).map(|()| readiness_check),
                    _ => Ok(readiness_check),
                }
            });
        let readiness_check = readiness_check
            .map_err(|error| BeginError::Socket { socket: socket.clone(), reason: error.to_string() })?;
        let mut env = environment::passed(std::env::vars_os(), &template.pass_env);
        // Inserted last: a template cannot change the marker.
        let marker = self.tracker.environment(id);
        env.insert(RESOURCE_MANAGER_VARIABLE.into(), self.told.manager.to_string().into());
        env.insert(PROVIDER_SESSION_VARIABLE.into(), self.told.session.clone().into());
        // A value from this process's own environment is not for the worker.
        env.remove(OsStr::new(STANDSTILL_VARIABLE));
        env.extend(template.standstill_ms.map(|bound| (STANDSTILL_VARIABLE.into(), bound.to_string().into())));
        env.remove(OsStr::new(STUCK_VARIABLE));
        env.extend(template.stuck_timeout().map(|bound| (STUCK_VARIABLE.into(), bound.as_millis().to_string().into())));
        env.extend(self.worker_environment.iter().map(|(name, file)| ((*name).into(), file.into())));
        env.remove(OsStr::new(LISTEN_VARIABLE));
        let listen = account.is_none().then(|| self.socket_for(id, &directory)).flatten();
        env.extend(listen.map(|socket| (LISTEN_VARIABLE.into(), socket.to_string().into())));
        env.extend(account.iter().flat_map(Account::environment));
        env.extend(template.env.iter().map(|(name, value)| (name.into(), fill(value).into())));
        if template.adopt {
            env.insert(adoption::SOCKET_VARIABLE.into(), adopt_socket(&directory, id).into());
            env.insert(adoption::GRACE_VARIABLE.into(), template.adopt_grace_s.to_string().into());
        }
        if let ReadinessCheck::Notify { watchdog, .. } = readiness_check {
            env.insert("NOTIFY_SOCKET".into(), socket.into());
            let patience_us = template.liveness.timeout().as_micros().to_string();
            env.extend(watchdog.then(|| ("WATCHDOG_USEC".into(), patience_us.into())));
        }
        env.extend([marker]);
        let awaited = match (&readiness_check, &template.readiness) {
            (ReadinessCheck::Line(seen), Readiness::Line { contains }) => Some(Awaited::new(contains, seen.clone())),
            _ => None,
        };
        let (program, args) = template.invocation();
        let job = Job {
            id: id.to_owned(),
            args: args.iter().map(|arg| fill(arg)).collect(),
            env,
            directory: template.directory.clone(),
            account,
            limits: template.limits,
            groups: self.groups.clone(),
            awaited,
            log: self.log_file(id),
            max_log_bytes: self.max_log_bytes,
            outlives: template.adopt,
            program: program.unwrap_or_else(|| self.this_program.clone()),
        };
        let place = self.jobs.try_reserve().map_err(|_| BeginError::Busy)?;
        // Recorded before the process exists, so that a successor knows every process.
        let group = self.tracker.group_of(id);
        self.roster.starts(Intent { id: id.to_owned(), group, template: template.clone() });
        place.send(job);
        let (ask, questions) = mpsc::channel(1);
        let within = template.start_timeout();
        let (known, is_known) = oneshot::channel();
        let describes_itself = matches!(readiness_check, ReadinessCheck::Health(_));
        let comparison = self.catalogue.clone().filter(|_| describes_itself).map(|catalogue| Comparison {
            catalogue,
            kind: template.kind.clone(),
            tls: self.tls.clone(),
        });
        let attended = attend(
            directory.clone(),
            id.to_owned(),
            (readiness_check, within, comparison),
            is_known,
            questions,
            self.senders.clone(),
        );
        let attended = Some((tokio::spawn(exit_on_panic(HEALTH_OF_WORKER, attended)).abort_handle(), ask));
        let started = Some((template.clone(), self.told.session.clone()));
        let process = Process { directory, pid: 0, started, known: Some(known), attended };
        self.by_id.insert(id.to_owned(), process);
        Ok(())
    }

    /// The process of a worker has been started.
    pub(super) fn spawned(&mut self, id: &str, pid: u32, limits: &str, groups: Vec<PathBuf>) {
        let Some(process) = self.by_id.get_mut(id) else { return };
        process.pid = pid;
        if let Some(known) = process.known.take() {
            // The readiness check may have ended.
            let _ = known.send(pid);
        }
        if let (Some((template, session)), Some(began)) = (process.started.take(), predecessor::began(pid)) {
            let limits = limits.to_owned();
            let (manager, session) = (Some(self.told.manager.to_string()), Some(session));
            self.roster.began(Entry {
                id: id.to_owned(),
                pid,
                began,
                endpoint: None,
                manager,
                session,
                limits,
                groups,
                template,
            });
        }
    }

    /// The socket of a worker whose template does not say otherwise: where both managers are reached only by their sockets in the runtime
    /// directory, the worker uses one, too, unless others than this user and group may connect there. A call over loopback TCP costs more, and
    /// other users could make one.
    fn socket_for(&self, id: &str, directory: &RuntimeDirectory) -> Option<Endpoint> {
        let manager = directory.find(resource_manager::ROLE).ok()?;
        let is_meant = self.is_local
            && matches!(self.told.manager, ManagerLocation::File(_))
            && directory.listen(&Endpoint::local(), resource_manager::ROLE).is_ok_and(|own| own == manager);
        // A path that is too long for a socket does not parse.
        is_meant.then(|| directory.socket(id).to_string().parse().ok()).flatten()
    }

    /// The worker serves at this endpoint.
    pub(super) fn serves(&mut self, id: &str, endpoint: &str) {
        self.roster.serves(id, endpoint);
    }

    /// Watches a worker that was taken over from an earlier process manager.
    pub(super) fn adopt(&mut self, adopted: Adopted) {
        let entry = adopted.entry.clone();
        let id = entry.id.clone();
        let (ask, questions) = mpsc::channel(1);
        let endpoint = entry.endpoint.clone().unwrap_or_default();
        let directory = account::directory_of(&self.directory, &entry.template);
        let account = entry.template.user.as_deref().and_then(|user| Account::named(user).ok());
        let socket = notify_socket(&directory, &id);
        let health_check = entry.template.readiness.health_check(&socket, &endpoint, &self.tls);
        if let Some(account) = account {
            // A worker that does not notify has no socket.
            let _ = account.give(&socket);
        }
        let attended = health_check.map(|health_check| {
            let answered = answer(health_check, id.clone(), questions, self.senders.health.clone());
            (tokio::spawn(exit_on_panic(HEALTH_OF_WORKER, answered)).abort_handle(), ask)
        });
        let process = Process { directory, pid: entry.pid, started: None, known: None, attended };
        self.by_id.insert(id.clone(), process);
        self.roster.began(entry);
        let tracker = self.tracker.clone();
        spawner::watch_adopted(adopted, &self.log_file(&id), self.max_log_bytes, tracker, self.outcomes.clone());
    }

    /// Records what may move from now on, for a successor; returns whether a successor would find it.
    pub(super) fn keep_motions(&mut self, motions: &Motions) -> bool {
        self.roster.keep_motions(motions)
    }

    /// The process of a worker has ended.
    pub(super) fn exited(&mut self, id: &str) {
        if let Some(Process { directory, attended, .. }) = self.by_id.remove(id) {
            if let Some((attended, _)) = attended {
                attended.abort();
            }
            // A worker that was killed could not remove its files itself.
            let _ = std::fs::remove_file(notify_socket(&directory, id));
            predecessor::remove_files_in(&directory, id);
        }
        self.roster.gone(id);
        self.ended_logs.add(self.log_file(id));
    }

    /// Sends a health check to a worker.
    pub(super) fn check(&self, id: &str, within: Duration) {
        if let Some((_, ask)) = self.by_id.get(id).and_then(|process| process.attended.as_ref()) {
            // The queue is full while the last check has no answer: that answer will do.
            let _ = ask.try_send(within);
        }
    }

    /// Signals a worker. Without a process yet, the pools ask again once it is there.
    pub(super) fn signal(&self, id: &str, signal: Signal) {
        if let Some(process) = self.by_id.get(id).filter(|process| process.pid != 0) {
            spawner::signal(process.pid, signal);
        }
    }

    /// Kills the workers and all processes that they started.
    pub(super) async fn end_all(&mut self) {
        self.by_id.values().for_each(|process| spawner::signal(process.pid, Signal::SIGKILL));
        drop(self.reaping.take());
        let tracker = self.tracker.clone();
        let end = || exit_on_panic_blocking("the end of all workers", move || tracker.end());
        if let Err(error) = tokio::task::spawn_blocking(end).await {
            tracing::error!(%error, "what workers left is not ended");
        }
    }

    fn log_file(&self, id: &str) -> PathBuf {
        log_file(&self.directory, id)
    }
}

/// Reaps orphans again and again: one that has ended is a zombie until its parent waits for it.
async fn reap(children: Children) {
    let mut looks = tokio::time::interval(REAP_INTERVAL);
    loop {
        looks.tick().await;
        panic_point("reaper");
        children.reap();
    }
}

fn notify_socket(directory: &RuntimeDirectory, id: &str) -> PathBuf {
    directory.path().join(format!("{id}.notify"))
}

/// Reports when a worker is ready, then answers each health check; until then, whenever it computes. The pools end a worker that is not ready in
/// time. A small worker can be ready before its process id is known: the report waits for the id, because the worker's resource names it.
async fn attend(
    directory: RuntimeDirectory,
    id: String,
    (readiness_check, within, comparison): (ReadinessCheck, Duration, Option<Comparison>),
    known: oneshot::Receiver<u32>,
    questions: mpsc::Receiver<Duration>,
    senders: EventSenders,
) {
    let known = known.shared();
    // The pools decide how long it is waited for.
    let ready = readiness_check.ready(&directory, &id, FOR_EVER);
    let ready = tokio::select! {
        ready = ready => ready,
        never = tell_busy(known.clone(), &id, within, &senders.busy) => match never {},
    };
    let (endpoint, health_check) = match ready {
        Ok((endpoint, health_check)) => {
            let _ = known.await;
            drop(senders.serving.send((id.clone(), endpoint.clone())).await);
            (endpoint, health_check)
        }
        Err(reason) => return tracing::debug!(id, reason, "a worker is not ready"),
    };
    let compare = async {
        if let Some(comparison) = comparison {
            comparison.tell(&id, &endpoint).await;
        }
    };
    tokio::join!(compare, answer(health_check, id.clone(), questions, senders.health));
}

/// Reports a starting worker each time that it has asked for a thirtieth of a processor since.
async fn tell_busy(
    known: impl Future<Output = Result<u32, oneshot::error::RecvError>>,
    id: &str,
    within: Duration,
    busy: &mpsc::Sender<String>,
) -> Infallible {
    let Ok(pid) = known.await else { return std::future::pending().await };
    let mut told = Duration::ZERO;
    loop {
        tokio::time::sleep(within / 10).await;
        let asked_for = of_tree(pid).total();
        // A descendant that has ended counts no more.
        told = told.min(asked_for);
        if asked_for - told >= within / 30 {
            told = asked_for;
            drop(busy.send(id.to_owned()).await);
        }
    }
}

/// Answers each health check of a worker.
async fn answer(
    mut health_check: HealthCheck,
    id: String,
    mut questions: mpsc::Receiver<Duration>,
    health: mpsc::Sender<(String, Result<(), String>)>,
) {
    while let Some(within) = questions.recv().await {
        let answer = health_check.check(within).await;
        if health.send((id.clone(), answer)).await.is_err() {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use std::sync::Arc;
    use tokio::sync::Notify;

    #[tokio::test]
    async fn a_worker_that_is_ready_before_its_process_is_known_is_told_of_afterwards() {
        let place = tempfile::tempdir().unwrap();
        let directory = RuntimeDirectory::create(place.path()).unwrap();
        let (serving, mut served) = mpsc::channel(1);
        let (known, is_known) = oneshot::channel();
        let seen = Arc::new(Notify::new());
        seen.notify_one();
        let readiness_check = (ReadinessCheck::Line(seen), Duration::from_secs(10), None);
        let senders = EventSenders { busy: mpsc::channel(1).0, serving, health: mpsc::channel(1).0 };
        let attended = attend(directory, "w-1@here".to_owned(), readiness_check, is_known, mpsc::channel(1).1, senders);
        let attended = tokio::spawn(attended);
        for _ in 0..100 {
            tokio::task::yield_now().await;
        }
        assert!(served.try_recv().is_err());
        known.send(std::process::id()).unwrap();
        assert_eq!(served.recv().await.unwrap().0, "w-1@here");
        attended.await.unwrap();
    }
}
