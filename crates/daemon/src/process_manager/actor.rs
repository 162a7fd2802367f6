//! The one task that owns the pools. It performs their commands and passes the resulting events to them.

use super::config::{Labels, ProcessManagerConfig};
use super::drained::Drained;
use super::machine::Sample;
use super::offered;
use super::pools::{Command, Event, PoolError, Pools, Restart};
use super::predecessor::Adopted;
use super::processes::{ManagerContact, ProcessEvents, Processes};
use super::roster::{Motions, Roster};
use super::session_file::SessionFile;
use super::spawner::Outcome;
use super::tracking::Tracker;
use super::usage::Usage;
use super::withheld::Withheld;
use crate::demand::{Shortages, Use};
use crate::link::{OfferEvent, Wanted};
use nix::sys::signal::Signal;
use ratn_model::time::Timestamp;
use ratn_panic_point::panic_point;
use ratn_proto::types::{Demand, HostPools, PoolStatus, Scale, TrackingMode, WorkerStatus};
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::tls::ClientTls;
use ratn_worker::unix_socket::SocketAccess;
use ratn_worker::vitals::Vitals;
use std::collections::BTreeSet;
use std::time::{Duration, Instant, SystemTime};
use tokio::sync::{mpsc, oneshot, watch};
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tonic::Status;

/// Capacity for messages to the actor; beyond it senders wait.
const INBOX: usize = 256;
/// Answers to health checks that are handled in one turn.
const AT_ONCE: usize = 256;
/// The longest pause between two turns of the actor.
const TICK: Duration = Duration::from_secs(1);
/// Changes that wait for a watcher. A watcher that is further behind is cut off.
const WATCH_BUFFER: usize = 4_096;
/// Clients that watch at the same time.
const MAX_WATCHERS: usize = 256;
/// When the process manager ends, workers have this long to end by themselves: less than the grace of its own end.
const SHUTDOWN_PATIENCE: Duration = Duration::from_millis(400);
/// The actor waits this long for workers that it has killed at the end.
const KILL_PATIENCE: Duration = Duration::from_millis(400);

/// Requests of the service.
#[derive(Debug)]
pub(super) enum Message {
    List { answer: oneshot::Sender<HostPools> },
    Restart { which: Restart, answer: oneshot::Sender<Result<Vec<String>, PoolError>> },
    Scale { template: String, scale: Scale, answer: oneshot::Sender<Result<PoolStatus, PoolError>> },
    Drain { draining: bool, answer: oneshot::Sender<std::io::Result<Vec<String>>> },
    Lives { id: String, answer: oneshot::Sender<bool> },
    Spawn { template: String, count: u32, answer: oneshot::Sender<Result<Vec<String>, PoolError>> },
    Stop { id: String, answer: oneshot::Sender<Result<(), PoolError>> },
    Watch { answer: oneshot::Sender<Option<mpsc::Receiver<WorkerStatus>>> },
}

/// Sends messages to the actor.
#[derive(Debug, Clone)]
pub(super) struct Handle {
    inbox: mpsc::Sender<Message>,
}

/// The parts of the actor.
pub(super) struct Parts {
    pub(super) config: ProcessManagerConfig,
    pub(super) directory: RuntimeDirectory,
    /// TLS settings for health checks of workers.
    pub(super) tls: ClientTls,
    /// Address and session of the resource manager, for workers.
    pub(super) told: ManagerContact,
    pub(super) roster: Roster,
    /// Knows which processes belong to which worker.
    pub(super) tracker: Tracker,
    /// Who may connect to this manager's socket.
    pub(super) sockets: SocketAccess,
    /// The ids of the workers that the last process manager left.
    pub(super) before: Vec<String>,
    /// The workers among them that were taken over.
    pub(super) adopted: Vec<Adopted>,
    /// What earlier workers moved and may still move.
    pub(super) motions: Motions,
    /// The resources that the link is to offer.
    pub(super) wanted: watch::Sender<Wanted>,
    /// The ids of offered resources that are withdrawn as soon as nobody holds them.
    pub(super) drains: watch::Sender<BTreeSet<String>>,
    /// What became of these resources.
    pub(super) offer_events: mpsc::Receiver<OfferEvent>,
    /// Which workers are held.
    pub(super) uses: mpsc::Receiver<Use>,
    /// The demand for workers that do not exist.
    pub(super) demand: mpsc::Receiver<Vec<Demand>>,
    /// Why the demand cannot be met.
    pub(super) short: watch::Sender<Shortages>,
    /// Measurements of the machine.
    pub(super) looks: mpsc::Receiver<Sample>,
    /// Has the id of the session that offers the workers.
    pub(super) session_file: SessionFile,
    /// Requests of the link for another session id, because the present one belongs to another caller.
    pub(super) renewals: mpsc::Receiver<oneshot::Sender<String>>,
}

struct Actor {
    host: String,
    labels: Labels,
    tracking: TrackingMode,
    pools: Pools,
    processes: Processes,
    withheld: Withheld,
    start: Instant,
    wanted: watch::Sender<Wanted>,
    drains: watch::Sender<BTreeSet<String>>,
    short: watch::Sender<Shortages>,
    watchers: Vec<mpsc::Sender<WorkerStatus>>,
    usage: Usage,
    drained: Drained,
    session_file: SessionFile,
}

/// Starts the actor. `shutdown` ends it, once every worker has ended.
pub(super) fn start(
    parts: Parts,
    vitals: Vitals,
    shutdown: CancellationToken,
) -> std::io::Result<(Handle, JoinHandle<()>)> {
    let (inbox, messages) = mpsc::channel(INBOX);
    let (config, adopted) = (parts.config, parts.adopted);
    let (drained, tracking) = (Drained::of(&parts.directory), parts.tracker.mode());
    let (processes, events) =
        Processes::start(&config, parts.directory, parts.tls, parts.told, parts.roster, parts.tracker, &parts.sockets)?;
    let mut pools = Pools::new(&config.host, config.templates).with_labels(config.labels.clone());
    pools.go_on_after(&parts.before);
    pools.moved_before(Timestamp(0), &parts.motions);
    let actor = Actor {
        pools,
        processes,
        withheld: Withheld::default(),
        host: config.host,
        labels: config.labels,
        tracking,
        start: Instant::now(),
        wanted: parts.wanted,
        drains: parts.drains,
        short: parts.short,
        watchers: Vec::new(),
        usage: Usage::new(),
        drained,
        session_file: parts.session_file,
    };
    let inputs = Inputs {
        messages,
        events,
        offer_events: parts.offer_events,
        uses: parts.uses,
        demand: parts.demand,
        looks: parts.looks,
        renewals: parts.renewals,
    };
    let running = async move {
        let _ = vitals.guard("the actor of the pools", actor.run(adopted, inputs, &vitals, shutdown)).await;
    };
    Ok((Handle { inbox }, tokio::spawn(running)))
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
    events: ProcessEvents,
    offer_events: mpsc::Receiver<OfferEvent>,
    uses: mpsc::Receiver<Use>,
    demand: mpsc::Receiver<Vec<Demand>>,
    looks: mpsc::Receiver<Sample>,
    renewals: mpsc::Receiver<oneshot::Sender<String>>,
}

impl Actor {
    async fn run(mut self, adopted: Vec<Adopted>, mut inputs: Inputs, vitals: &Vitals, shutdown: CancellationToken) {
        for worker in adopted {
            self.adopt(worker);
        }
        if self.drained.is_set() {
            tracing::warn!("the host is drained: no worker is started until `ratn drain --undo`");
            let commands = self.pools.drain(self.now(), true);
            self.perform(commands);
        }
        self.handle(Event::Time);
        let mut tick = tokio::time::interval(TICK);
        loop {
            vitals.beat();
            panic_point("process-manager-actor");
            let deadline = self.pools.next_deadline().map(|at| self.start + Duration::from_nanos(at.0));
            tokio::select! {
                Some(outcome) = inputs.events.outcomes.recv() => self.became(outcome),
                Some(id) = inputs.events.busy.recv() => self.handle(Event::Busy { id }),
                Some((id, endpoint)) = inputs.events.serving.recv() => {
                    self.processes.serves(&id, &endpoint);
                    self.handle(Event::Serving { id, endpoint });
                }
                Some(health) = inputs.events.health.recv() => {
                    // They are asked together, so they answer together.
                    let more = std::iter::from_fn(|| inputs.events.health.try_recv().ok()).take(AT_ONCE);
                    for (id, answer) in std::iter::once(health).chain(more) {
                        self.handle(match answer {
                            Ok(()) => Event::Answered { id },
                            Err(why) => Event::Unanswered { id, why },
                        });
                    }
                }
                Some(event) = inputs.offer_events.recv() => self.handle(match event {
                    OfferEvent::Offered(id) => Event::Offered { id },
                    OfferEvent::Refused(id, why) => Event::Refused { id, why },
                    OfferEvent::Withdrawn(id) => Event::Withdrawn { id },
                    OfferEvent::StillHeld(id) => Event::Kept { id },
                }),
                Some(Use { id, held }) = inputs.uses.recv() => self.handle(Event::Used { id, held }),
                Some(demand) = inputs.demand.recv() => self.handle(Event::Demanded(demand)),
                Some(sample) = inputs.looks.recv() => self.handle(Event::Looked(sample)),
                Some(answer) = inputs.renewals.recv() => self.renew_session(answer),
                Some(message) = inputs.messages.recv() => self.receive(message),
                // A file that could not be written is tried again, whatever else happens.
                _ = tick.tick() => self.perform(Vec::new()),
                () = sleep_until(deadline) => self.handle(Event::Time),
                () = shutdown.cancelled() => break,
            }
        }
        self.end(&mut inputs.events.outcomes).await;
    }

    fn adopt(&mut self, adopted: Adopted) {
        let (worker, outdated) = (adopted.status(), adopted.outdated);
        let Some(commands) = self.pools.adopt(self.now(), &worker, adopted.standstill, outdated) else { return };
        self.processes.adopt(adopted);
        self.perform(commands);
    }

    /// The session that offers the workers gets another id. Workers that know only the old id would take another caller's leases for their
    /// own, so all of them are withdrawn, ended at once and replaced.
    fn renew_session(&mut self, answer: oneshot::Sender<String>) {
        let (id, written) = self.session_file.renew();
        if let Err(error) = written {
            tracing::error!(%error, "the session's new id is not on the disk: a successor does not go on with it");
        }
        tracing::warn!(session = id, "the session has another id now: every worker is replaced");
        self.processes.offered_by(&id);
        let commands = self.pools.renew(self.now());
        self.perform(commands);
        // By now no old worker is to be offered any more.
        let _ = answer.send(id);
    }

    /// Ends every worker, by force if necessary.
    async fn end(&mut self, outcomes: &mut mpsc::Receiver<Outcome>) {
        self.watchers.clear();
        let commands = self.pools.shut_down(self.now(), SHUTDOWN_PATIENCE);
        self.perform(commands);
        let last = Instant::now() + SHUTDOWN_PATIENCE + KILL_PATIENCE;
        while !self.pools.is_empty() && Instant::now() < last {
            let deadline = self.pools.next_deadline().map(|at| self.start + Duration::from_nanos(at.0));
            tokio::select! {
                Some(outcome) = outcomes.recv() => self.became(outcome),
                () = sleep_until(deadline) => self.handle(Event::Time),
                () = tokio::time::sleep_until(last.into()) => {}
            }
        }
        self.processes.end_all().await;
    }

    fn now(&self) -> Timestamp {
        Timestamp(u64::try_from(self.start.elapsed().as_nanos()).unwrap_or(u64::MAX))
    }

    // An answer whose receiver is gone does no harm.
    fn receive(&mut self, message: Message) {
        let now = self.now();
        match message {
            Message::List { answer } => {
                let mut pools = self.pools.status();
                self.usage.fill_in(&mut pools);
                let draining = self.pools.is_draining();
                let (host, tracking) = (self.host.clone(), Some(self.tracking));
                let _ = answer.send(HostPools { host, draining, clock_us: wall_clock_us(), tracking, pools });
            }
            Message::Lives { id, answer } => drop(answer.send(self.pools.knows(&id))),
            Message::Restart { which, answer } => {
                let restarted = self.pools.restart(now, &which);
                let _ = answer.send(self.performed(restarted));
            }
            Message::Scale { template, scale, answer } => {
                let scaled = self.pools.scale(now, &template, scale);
                let _ = answer.send(self.performed(scaled));
            }
            Message::Drain { draining, answer } => drop(answer.send(self.drain(draining))),
            Message::Spawn { template, count, answer } => {
                let spawned = self.pools.spawn(now, &template, count);
                let _ = answer.send(self.performed(spawned));
            }
            Message::Stop { id, answer } => {
                let stopped = self.pools.stop(now, &id).map(|commands| ((), commands));
                let _ = answer.send(self.performed(stopped));
            }
            Message::Watch { answer } => drop(answer.send(self.watch())),
        }
    }

    /// Starts or ends the drain; returns the ids of the workers that still exist.
    fn drain(&mut self, draining: bool) -> std::io::Result<Vec<String>> {
        self.drained.set(draining)?;
        let commands = self.pools.drain(self.now(), draining);
        self.perform(commands);
        tracing::info!(draining, "the host was told whether it takes work");
        let workers = self.pools.status().into_iter().flat_map(|pool| pool.workers);
        Ok(workers.map(|worker| worker.id).collect())
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
            Outcome::Spawned { id, pid, limits, groups } => {
                tracing::info!(id, pid, limits, "worker started");
                self.processes.spawned(&id, pid, &limits, groups);
                self.handle(Event::Spawned { id, pid, limits });
            }
            Outcome::Exited { id, reason, last_words } => {
                tracing::info!(id, reason, last_words, "worker gone");
                self.processes.exited(&id);
                self.handle(Event::Exited { id, reason, last_words });
            }
        }
    }

    fn handle(&mut self, event: Event) {
        let commands = self.pools.handle(self.now(), event);
        self.perform(commands);
    }

    fn performed<T>(&mut self, asked: Result<(T, Vec<Command>), PoolError>) -> Result<T, PoolError> {
        let (answer, commands) = asked?;
        self.perform(commands);
        Ok(answer)
    }

    fn perform(&mut self, commands: Vec<Command>) {
        // The motions are written before any of their workers is offered.
        let kept = self.processes.keep_motions(&self.pools.motions(self.now()));
        let mut commands = self.withheld.pass(commands, kept);
        while let Some(command) = commands.pop_front() {
            match command {
                Command::Start { id, template } => {
                    let Some(template) = self.pools.template(&template) else { continue };
                    if let Err(error) = self.processes.begin(&id, template) {
                        let exited = Event::Exited { id, reason: error.to_string(), last_words: String::new() };
                        commands.extend(self.pools.handle(self.now(), exited));
                    }
                }
                Command::Terminate { id } => self.processes.signal(&id, Signal::SIGTERM),
                Command::Kill { id } => self.processes.signal(&id, Signal::SIGKILL),
                Command::Offer { worker, kind, standstill } => self.offer(&worker, &kind, standstill),
                Command::Withdraw { id } => {
                    self.wanted.send_if_modified(|wanted| wanted.remove(&id).is_some());
                    self.drains.send_if_modified(|drains| drains.remove(&id));
                }
                // Sent even where the worker is draining already: then the withdrawal is tried at once.
                Command::Retire { id } => self.drains.send_modify(|drains| {
                    drains.insert(id);
                }),
                Command::Keep { id } => {
                    self.drains.send_if_modified(|drains| drains.remove(&id));
                }
                Command::Check { id, within } => self.processes.check(&id, within),
                Command::Notify(worker) => self.watchers.retain(|watcher| watcher.try_send(worker.clone()).is_ok()),
            }
        }
        self.short.send_if_modified(|said| {
            let shortages = self.pools.shortages();
            let changed = *said != shortages;
            *said = shortages;
            changed
        });
    }

    fn offer(&self, worker: &WorkerStatus, kind: &str, standstill: Option<Duration>) {
        let resource = offered::worker(&self.host, &self.labels, worker, kind, standstill);
        self.wanted.send_modify(|wanted| {
            wanted.insert(worker.id.clone(), resource);
        });
    }
}

/// Wall-clock time; no decision depends on it.
#[allow(clippy::disallowed_methods, reason = "somebody asks how far the clocks of hosts are apart")]
fn wall_clock_us() -> u64 {
    let since_1970 = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since_1970.as_micros()).unwrap_or(u64::MAX)
}

async fn sleep_until(deadline: Option<Instant>) {
    match deadline {
        Some(deadline) => tokio::time::sleep_until(deadline.into()).await,
        None => std::future::pending().await,
    }
}
