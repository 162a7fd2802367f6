//! The one task that owns the pool: takes messages in order, ends what time has ended, hands out grants and events.
//!
//! A grant that nobody takes any more (the call was dropped in the same moment) is released at once; a watcher that does
//! not keep up is cut off rather than waited for. Pings of sessions come first: a session does not expire because there is
//! much to do.
//!
//! Whatever leaves (answers, grants, events) goes through the outbox, and waits there until the records of what it tells of
//! are on the disk. When they cannot be written, every change is refused from then on; what can be read is the state that is
//! on the disk.

mod calls;
mod demands;
mod leaving;
mod looks;
mod message;
mod watchers;

pub(super) use message::{Handle, KeptAlive, Message};

use super::outgoing::Outgoing;
use super::providers::Providers;
use super::{Granted, ResourceManagerConfig, status};
use crate::details::ending;
use crate::journal::Journal;
use crate::metrics::{self, Amounts};
use crate::outbox::Outbox;
use message::{Ping, most_urgent_first};
use ratn_model::id::LeaseId;
use ratn_model::time::Timestamp;
use ratn_proto::types::ResourceUpdate;
use ratn_resources::{Pool, PoolError, Reply, Request, SessionId, Speaker, WaiterId};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::{mpsc, oneshot, watch};
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tonic::Status;

/// Messages that wait for the actor; more make their senders wait.
const INBOX: usize = 1_024;
/// Messages that are put into an order of urgency together.
const AT_ONCE: usize = 64;
/// What came together is written down together, and nothing else is looked at meanwhile, unless that takes longer than this.
const TURN: Duration = Duration::from_millis(1);
/// Pings that wait for the actor.
const PINGS: usize = 1_024;
/// A session lives at least this long.
const MIN_SESSION_TTL: Duration = Duration::from_millis(50);

/// What the actor hears.
struct Inputs {
    messages: mpsc::Receiver<Message>,
    pinged: mpsc::Receiver<Ping>,
    live: watch::Receiver<ResourceManagerConfig>,
}

#[derive(Debug)]
struct Actor {
    config: ResourceManagerConfig,
    pool: Pool,
    journal: Journal,
    /// What came up since the last look at the pool's records, in order.
    outgoing: Vec<Outgoing>,
    outbox: Outbox<Outgoing>,
    /// Why nothing changes any more.
    stopped: Option<Status>,
    /// Nobody waits in the queue any more.
    draining: bool,
    start: Instant,
    /// Who waits for the answer of which waiter; a repeated request joins.
    calls: BTreeMap<WaiterId, Vec<(u64, oneshot::Sender<Granted>)>>,
    tickets: BTreeMap<u64, WaiterId>,
    /// How many calls got a lease, where a repeated request had joined: as many have to be dropped before it goes back.
    shared: BTreeMap<LeaseId, usize>,
    watchers: Vec<mpsc::Sender<Arc<ResourceUpdate>>>,
    /// What waits for more than exists.
    demand: Vec<ratn_resources::Demand>,
    /// What of it is asked of whom.
    providers: Providers,
}

/// Starts the actor on what was kept. With `draining` everybody who waits is told to ask the successor; with `over` it ends.
pub(super) fn start(
    live: watch::Receiver<ResourceManagerConfig>,
    (pool, journal): (Pool, Journal),
    draining: CancellationToken,
    over: CancellationToken,
) -> (Handle, JoinHandle<()>) {
    let (inbox, messages) = mpsc::channel(INBOX);
    let (pings, pinged) = mpsc::channel(PINGS);
    let actor = Actor {
        pool,
        journal,
        outgoing: Vec::new(),
        outbox: Outbox::default(),
        stopped: None,
        draining: false,
        config: live.borrow().clone(),
        start: Instant::now(),
        calls: BTreeMap::new(),
        tickets: BTreeMap::new(),
        shared: BTreeMap::new(),
        watchers: Vec::new(),
        demand: Vec::new(),
        providers: Providers::new(live.borrow().provider_patience()),
    };
    let running = tokio::spawn(actor.run(Inputs { messages, pinged, live }, draining, over));
    (Handle { inbox, pings }, running)
}

impl Actor {
    async fn run(mut self, inputs: Inputs, draining: CancellationToken, over: CancellationToken) {
        let Inputs { mut messages, mut pinged, mut live } = inputs;
        let mut arrived = Vec::new();
        loop {
            let running = self.stopped.is_none();
            let deadline = self.pool.next_deadline().into_iter().chain(self.providers.deadline()).min();
            let deadline = deadline.filter(|_| running);
            let deadline = deadline.map(|at| self.start + Duration::from_nanos(at.0));
            let room = !self.outbox.is_full();
            tokio::select! {
                biased;
                () = over.cancelled() => return self.end(),
                () = draining.cancelled(), if !self.draining => self.drain(),
                Some(ping) = pinged.recv() => self.pinged(ping),
                Ok(()) = live.changed() => self.reconfigure(&live.borrow_and_update()),
                progress = self.journal.changed(), if running => self.written(progress),
                () = sleep_until(deadline) => self.pool.advance(self.now()),
                count = messages.recv_many(&mut arrived, AT_ONCE), if room => {
                    if count == 0 {
                        return self.end();
                    }
                    most_urgent_first(&mut arrived);
                    let mut turn = Instant::now();
                    for message in arrived.drain(..) {
                        while let Ok(ping) = pinged.try_recv() {
                            self.pinged(ping);
                        }
                        self.receive(message);
                        if turn.elapsed() > TURN {
                            self.deliver();
                            // So that pings that came meanwhile are read.
                            tokio::task::yield_now().await;
                            turn = Instant::now();
                        }
                    }
                }
            }
            self.deliver();
            self.spread_demand();
            self.measure();
        }
    }

    fn measure(&self) {
        let Some(metrics) = metrics::get() else { return };
        let [resources, sessions, leases, waiters] = self.pool.amounts();
        metrics.set(Amounts { resources, sessions, leases, waiters, watchers: self.watchers.len() });
    }

    /// Takes over the bounds of a config; the rest needs a restart.
    fn reconfigure(&mut self, config: &ResourceManagerConfig) {
        let ResourceManagerConfig { max_session_ttl_ms, max_wait_ms, max_watchers, limits, .. } = config.clone();
        self.pool.set_limits(limits.clone());
        self.config =
            ResourceManagerConfig { max_session_ttl_ms, max_wait_ms, max_watchers, limits, ..self.config.clone() };
    }

    /// Whoever waits is told, and leaves the queue.
    fn drain(&mut self) {
        self.draining = true;
        self.tickets.clear();
        let calls = std::mem::take(&mut self.calls);
        tracing::info!(waiting = calls.len(), "draining: nobody is granted anything any more");
        let now = self.now();
        for (waiter, calls) in calls {
            // Unknown when it was answered in this moment: then the grant finds nobody, and goes back.
            let _ = self.pool.cancel(now, waiter);
            for (_, call) in calls {
                let _ = call.send(Err(ending()));
            }
        }
        self.collect();
    }

    /// Lets out what is on the disk by now, and what the rest of it was waiting for.
    fn end(mut self) {
        self.deliver();
        match self.journal.close() {
            Ok(()) => self.deliver(),
            Err(fault) => self.stop(&fault),
        }
    }

    fn now(&self) -> Timestamp {
        Timestamp(u64::try_from(self.start.elapsed().as_nanos()).unwrap_or(u64::MAX))
    }

    fn pinged(&mut self, Ping { speaker, session, client, ttl, answer }: Ping) {
        let kept = match &self.stopped {
            Some(stopped) => Err(stopped.clone()),
            None => self.keep_alive(&speaker, &session, &client, ttl).map_err(|error| status::of_error(&error)),
        };
        self.reply(answer, kept);
        self.collect();
    }

    fn receive(&mut self, message: Message) {
        if let Some(stopped) = self.stopped.clone() {
            return self.receive_stopped(message, stopped);
        }
        let now = self.now();
        match message {
            Message::Perform { speaker, request_id, request, answer } => {
                let reply = self.may_speak(&speaker, request.session()).and_then(|()| {
                    let reply =
                        self.pool.handle(now, &request_id, request).map_err(|error| status::of_error(&error))?;
                    Ok((reply, self.pool.revision()))
                });
                self.reply(answer, reply);
            }
            Message::Acquire { answer, .. } if self.draining => drop(answer.send(Err(ending()))),
            Message::Acquire { speaker, ticket, request_id, mut request, wait, answer } => {
                if let Err(refused) = self.may_speak(&speaker, Some(&request.session)) {
                    return self.reply(answer, Err(refused));
                }
                request.deadline = Some(now + wait.min(self.config.max_wait()));
                match self.pool.handle(now, &request_id, Request::Acquire(request)) {
                    Ok(Reply::Queued(waiter)) => {
                        self.tickets.insert(ticket, waiter);
                        self.calls.entry(waiter).or_default().push((ticket, answer));
                    }
                    // Repeated after the grant: whoever asks again has it already, so a dropped call keeps it.
                    Ok(Reply::Granted(lease)) => self.reply(answer, Ok(lease)),
                    Ok(reply) => debug_assert!(false, "an acquire is queued or granted, not {reply:?}"),
                    Err(error) => self.reply(answer, Err(status::of_error(&error))),
                }
            }
            Message::Abandon { ticket } => self.abandon(ticket),
            Message::Withdraw { speaker, session, request_id, answer } => {
                let withdrawn = self.may_speak(&speaker, Some(&session)).and_then(|()| {
                    self.pool.withdraw(now, &session, &request_id).map_err(|error| status::of_error(&error))
                });
                self.reply(answer, withdrawn);
            }
            Message::Return { lease } => self.give_back(lease),
            Message::Find { requirement, answer } => {
                let fitting = self.pool.fitting(&requirement);
                let found = (self.pool.exists(&requirement), fitting);
                self.tell(answer, found);
            }
            Message::Get { id, answer } => self.tell(answer, self.pool.get(&id)),
            Message::List { answer } => self.tell(answer, (self.pool.list(), self.pool.revision())),
            Message::Revision { answer } => self.tell(answer, self.pool.revision()),
            Message::Sessions { answer } => self.tell(answer, self.sessions()),
            Message::WatchDemand { speaker, session, provisions, answer } => {
                let allowed = self.may_speak(&speaker, Some(&session));
                let watch = allowed.and_then(|()| self.watch_demand(session, provisions));
                self.reply(answer, watch);
            }
            Message::ReportShortage { speaker, session, kind, most, reason, answer } => {
                let reported = self.may_speak(&speaker, Some(&session)).and_then(|()| {
                    let reported = self.pool.report_shortage(now, &session, &kind, &reason);
                    reported.map_err(|error| status::of_error(&error))
                });
                if reported.is_ok() {
                    self.providers.bound(&session, &kind, (!reason.is_empty()).then_some(most));
                }
                self.reply(answer, reported);
            }
            Message::Explain { request_id, answer } => {
                let explained = self.explain(&request_id);
                self.reply(answer, explained);
            }
            Message::Watch { after, answer } => {
                let watch = self.watch(after);
                self.reply(answer, watch);
            }
        }
        self.collect();
    }

    /// Whether the speaker may do something in the name of a session; without one they do it as an operator.
    fn may_speak(&mut self, speaker: &Speaker, session: Option<&SessionId>) -> Result<(), Status> {
        match session {
            Some(session) => {
                let now = self.now();
                self.pool.check_speaker(now, speaker, session).map_err(|error| status::of_error(&error))
            }
            None if speaker.for_anybody => Ok(()),
            None => Err(status::without_session(&speaker.name)),
        }
    }

    /// Reads go on, of what is on the disk.
    fn receive_stopped(&mut self, message: Message, stopped: Status) {
        match message {
            Message::Perform { answer, .. } => drop(answer.send(Err(stopped))),
            Message::Acquire { answer, .. } => drop(answer.send(Err(stopped))),
            Message::Withdraw { answer, .. } => drop(answer.send(Err(stopped))),
            Message::Abandon { .. } | Message::Return { .. } => {}
            Message::Find { requirement, answer } => {
                let fitting = self.pool.fitting(&requirement);
                let _ = answer.send((self.pool.exists(&requirement), fitting));
            }
            Message::Get { id, answer } => drop(answer.send(self.pool.get(&id))),
            Message::List { answer } => drop(answer.send((self.pool.list(), self.pool.revision()))),
            Message::Revision { answer } => drop(answer.send(self.pool.revision())),
            Message::Sessions { answer } => drop(answer.send(self.sessions())),
            Message::WatchDemand { answer, .. } => drop(answer.send(Err(stopped))),
            Message::ReportShortage { answer, .. } => drop(answer.send(Err(stopped))),
            Message::Explain { request_id, answer } => drop(answer.send(self.explain(&request_id))),
            Message::Watch { after, answer } => drop(answer.send(self.watch(after))),
        }
    }

    fn keep_alive(
        &mut self,
        speaker: &Speaker,
        session: &SessionId,
        client: &str,
        ttl: Duration,
    ) -> Result<KeptAlive, PoolError> {
        let now = self.now();
        let ttl = ttl.min(self.config.max_session_ttl());
        let created = if ttl.is_zero() {
            self.pool.check_speaker(now, speaker, session)?;
            match self.pool.close_session(now, session) {
                Err(PoolError::UnknownSession { .. }) | Ok(()) => false,
                Err(error) => return Err(error),
            }
        } else {
            self.pool.keep_alive_as(now, speaker, session, client, ttl.max(MIN_SESSION_TTL))?
        };
        if created {
            tracing::info!(%session, client, opened_by = %speaker.name, ttl_ms = ttl.as_millis(), "session opened");
        }
        Ok(KeptAlive { ttl, created, revision: self.pool.revision() })
    }
}

async fn sleep_until(deadline: Option<Instant>) {
    match deadline {
        Some(deadline) => tokio::time::sleep_until(deadline.into()).await,
        None => std::future::pending().await,
    }
}
