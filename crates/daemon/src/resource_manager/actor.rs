//! The one task that owns the pool: takes messages in order, ends what time has ended, hands out grants and events.
//!
//! A grant that nobody takes any more (the call was dropped in the same moment) is released at once; a watcher that does
//! not keep up is cut off rather than waited for. Pings of sessions come first: a session does not expire because there is
//! much to do.
//!
//! Whatever leaves (answers, grants, events) goes through the outbox, and waits there until the records of what it tells of
//! are on the disk. When they cannot be written, every change is refused from then on; what can be read is the state that is
//! on the disk.

use super::outgoing::Outgoing;
use super::providers::Providers;
use super::{Granted, ResourceManagerConfig, journal, status, wire};
use crate::details::{ending, of_fault, retry_later, status as status_with};
use crate::journal::Journal;
use crate::metrics::{self, Amounts};
use crate::outbox::{Outbox, send_answer};
use ratn_model::id::{LeaseId, Revision};
use ratn_model::resource::Requirement;
use ratn_model::time::Timestamp;
use ratn_proto::types::{Demand, ResourceEvent, ResourceUpdate, SessionStatus, WaitingAcquire, WatchPosition};
use ratn_resources::{
    AcquireRequest, Change, Notice, Pool, PoolError, Quantity, Reply, Request, ResourceView, SessionId, WaiterId,
};
use ratn_storage::{Fault, Progress};
use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::{mpsc, oneshot, watch};
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tonic::{Code, Status};

/// Messages that wait for the actor; more make their senders wait.
const INBOX: usize = 1_024;
/// Messages that are put into an order of urgency together.
const AT_ONCE: usize = 64;
/// What came together is written down together, and nothing else is looked at meanwhile, unless that takes longer than this.
const TURN: Duration = Duration::from_millis(1);
/// Pings that wait for the actor.
const PINGS: usize = 1_024;
/// Updates that wait for a watcher; one that has more to catch up with is cut off.
const WATCH_BUFFER: usize = 4_096;
/// Waiters that are explained together at the most.
const EXPLAINED: usize = 100;
/// A session lives at least this long.
const MIN_SESSION_TTL: Duration = Duration::from_millis(50);

/// What a keep-alive came to.
#[derive(Debug)]
pub(super) struct KeptAlive {
    pub(super) ttl: Duration,
    pub(super) created: bool,
    pub(super) revision: Revision,
}

/// A ping of a session.
#[derive(Debug)]
struct Ping {
    session: SessionId,
    client: String,
    ttl: Duration,
    answer: Answer<KeptAlive>,
}

/// What the service asks of the actor.
#[derive(Debug)]
pub(super) enum Message {
    Perform {
        request_id: String,
        request: Request,
        answer: Answer<(Reply, Revision)>,
    },
    Acquire {
        ticket: u64,
        request_id: String,
        request: AcquireRequest,
        wait: Duration,
        answer: oneshot::Sender<Granted>,
    },
    /// The call with this ticket was dropped before its answer.
    Abandon {
        ticket: u64,
    },
    Withdraw {
        session: SessionId,
        request_id: String,
        answer: Answer<bool>,
    },
    /// The call was dropped after its answer and before it was read.
    Return {
        lease: LeaseId,
    },
    Find {
        requirement: Requirement,
        answer: oneshot::Sender<(Quantity, Vec<String>)>,
    },
    Get {
        id: String,
        answer: oneshot::Sender<Option<ResourceView>>,
    },
    List {
        answer: oneshot::Sender<(Vec<ResourceView>, Revision)>,
    },
    Revision {
        answer: oneshot::Sender<Revision>,
    },
    Sessions {
        answer: oneshot::Sender<Vec<SessionStatus>>,
    },
    /// Why the acquire of a request id waits, or the first of the queue; and how many wait.
    Explain {
        request_id: String,
        answer: Answer<(Vec<WaitingAcquire>, usize)>,
    },
    WatchDemand {
        session: SessionId,
        /// What it can provide: kinds, and how many of each at the most.
        kinds: BTreeMap<String, u32>,
        answer: Answer<watch::Receiver<Vec<Demand>>>,
    },
    ReportShortage {
        session: SessionId,
        kind: String,
        reason: String,
        answer: Answer<()>,
    },
    Watch {
        /// Without a snapshot: what happened after this.
        after: Option<WatchPosition>,
        answer: Answer<mpsc::Receiver<Arc<ResourceUpdate>>>,
    },
}

pub(super) type Answer<T> = oneshot::Sender<Result<T, Status>>;

/// Sends messages to the actor.
#[derive(Debug, Clone)]
pub(super) struct Handle {
    inbox: mpsc::Sender<Message>,
    pings: mpsc::Sender<Ping>,
}

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

impl Handle {
    /// Sends a message and waits for the answer that it is to be given.
    pub(super) async fn ask<T>(&self, message: impl FnOnce(oneshot::Sender<T>) -> Message) -> Result<T, Status> {
        let (answer, answered) = oneshot::channel();
        self.send(message(answer)).await?;
        answered.await.map_err(|_| ending())
    }

    pub(super) async fn keep_alive(
        &self,
        session: SessionId,
        client: String,
        ttl: Duration,
    ) -> Result<KeptAlive, Status> {
        let (answer, answered) = oneshot::channel();
        let ping = Ping { session, client, ttl, answer };
        self.pings.send(ping).await.map_err(|_| ending())?;
        answered.await.map_err(|_| ending())?
    }

    pub(super) async fn send(&self, message: Message) -> Result<(), Status> {
        self.inbox.send(message).await.map_err(|_| ending())
    }

    /// Sends a message from where nothing can be waited for.
    pub(super) fn send_later(&self, message: Message) {
        if let Err(mpsc::error::TrySendError::Full(message)) = self.inbox.try_send(message) {
            let inbox = self.inbox.clone();
            tokio::spawn(async move { inbox.send(message).await });
        }
    }
}

/// Calls that arrive together are handled by separate tasks, so in no order of their own: the most urgent acquire goes first,
/// and what is given back comes after those who ask for it. The rest keeps its order.
fn most_urgent_first(messages: &mut [Message]) {
    messages.sort_by_key(|message| match message {
        Message::Acquire { request, .. } => (0, Reverse(request.priority)),
        _ => (1, Reverse(0)),
    });
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

    fn pinged(&mut self, Ping { session, client, ttl, answer }: Ping) {
        let kept = match &self.stopped {
            Some(stopped) => Err(stopped.clone()),
            None => self.keep_alive(&session, &client, ttl).map_err(|error| status::of_error(&error)),
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
            Message::Perform { request_id, request, answer } => {
                let reply = self.pool.handle(now, &request_id, request);
                let revision = self.pool.revision();
                self.reply(answer, reply.map(|reply| (reply, revision)).map_err(|error| status::of_error(&error)));
            }
            Message::Acquire { answer, .. } if self.draining => drop(answer.send(Err(ending()))),
            Message::Acquire { ticket, request_id, mut request, wait, answer } => {
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
            Message::Withdraw { session, request_id, answer } => {
                let withdrawn = self.pool.withdraw(now, &session, &request_id);
                self.reply(answer, withdrawn.map_err(|error| status::of_error(&error)));
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
            Message::WatchDemand { session, kinds, answer } => {
                let watch = self.watch_demand(session, kinds);
                self.reply(answer, watch);
            }
            Message::ReportShortage { session, kind, reason, answer } => {
                let reported = self.pool.report_shortage(now, &session, &kind, &reason);
                self.providers.changed();
                self.reply(answer, reported.map_err(|error| status::of_error(&error)));
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

    /// Answers when what the answer tells of is on the disk.
    fn reply<T: Send + 'static>(&mut self, answer: Answer<T>, result: Result<T, Status>) {
        self.outgoing.push(Outgoing::Answer(send_answer(answer, result)));
    }

    /// As [`Actor::reply`], to one who only looks; without an answer they ask again.
    fn tell<T: Send + 'static>(&mut self, answer: oneshot::Sender<T>, told: T) {
        self.outgoing.push(Outgoing::Answer(Box::new(move |stopped| {
            if stopped.is_none() {
                let _ = answer.send(told);
            }
        })));
    }

    fn keep_alive(&mut self, session: &SessionId, client: &str, ttl: Duration) -> Result<KeptAlive, PoolError> {
        let now = self.now();
        let ttl = ttl.min(self.config.max_session_ttl());
        let created = if ttl.is_zero() {
            match self.pool.close_session(now, session) {
                Err(PoolError::UnknownSession { .. }) | Ok(()) => false,
                Err(error) => return Err(error),
            }
        } else {
            self.pool.keep_alive(now, session, client, ttl.max(MIN_SESSION_TTL))?
        };
        if created {
            tracing::info!(%session, client, ttl_ms = ttl.as_millis(), "session opened");
        }
        Ok(KeptAlive { ttl, created, revision: self.pool.revision() })
    }

    fn abandon(&mut self, ticket: u64) {
        let Some(waiter) = self.tickets.remove(&ticket) else { return };
        let Some(calls) = self.calls.get_mut(&waiter) else { return };
        calls.retain(|(other, _)| *other != ticket);
        if calls.is_empty() {
            self.calls.remove(&waiter);
            // Unknown when it was answered in this moment: then the answer could not be delivered and was undone.
            let _ = self.pool.cancel(self.now(), waiter);
        }
    }

    fn give_back(&mut self, lease: LeaseId) {
        if let Some(calls) = self.shared.get_mut(&lease).filter(|calls| **calls > 1) {
            *calls -= 1;
            return;
        }
        tracing::debug!(%lease, "granted to a call that was dropped: taken back");
        // Unknown when it has ended meanwhile.
        let _ = self.pool.undo_grant(self.now(), lease);
    }

    fn watch_demand(
        &mut self,
        session: SessionId,
        kinds: BTreeMap<String, u32>,
    ) -> Result<watch::Receiver<Vec<Demand>>, Status> {
        self.providers.join(session, kinds, self.config.max_watchers).map_err(|there| {
            let message = format!("{there} providers watch already");
            retry_later(Code::ResourceExhausted, "TOO_MANY", message, Duration::from_secs(1))
        })
    }

    /// Tells providers what is missing, where that may have changed.
    fn spread_demand(&mut self) {
        let now = self.now();
        let changed = self.pool.take_demand();
        if changed.is_none() && !self.providers.are_due(now) {
            return;
        }
        self.demand = changed.unwrap_or_else(|| std::mem::take(&mut self.demand));
        self.providers.tell(now, &self.pool, &self.demand);
    }

    fn sessions(&self) -> Vec<SessionStatus> {
        let now = self.now();
        self.pool.sessions().into_iter().map(|session| wire::session(session, now)).collect()
    }

    fn explain(&self, request_id: &str) -> Result<(Vec<WaitingAcquire>, usize), Status> {
        let waiters = if request_id.is_empty() {
            self.pool.first_waiters(EXPLAINED)
        } else {
            let waiter = self.pool.waiter_of(request_id).ok_or_else(|| {
                let message = format!("no acquire of request id `{request_id}` waits: it was answered, or never asked");
                status_with(Code::NotFound, "WAITER_UNKNOWN", message)
            })?;
            vec![waiter]
        };
        let explained = |id: WaiterId| {
            let (request_id, request) = self.pool.waiter(id)?;
            Some(wire::waiting(request_id, request, &self.pool.explain(id)?))
        };
        Ok((waiters.into_iter().filter_map(explained).collect(), self.pool.waiting()))
    }

    fn watch(&mut self, after: Option<WatchPosition>) -> Result<mpsc::Receiver<Arc<ResourceUpdate>>, Status> {
        self.watchers.retain(|watcher| !watcher.is_closed());
        if self.watchers.len() >= self.config.max_watchers {
            let message = format!("{} clients watch already", self.watchers.len());
            return Err(retry_later(Code::ResourceExhausted, "TOO_MANY", message, Duration::from_secs(1)));
        }
        if let Some(after) = after {
            // Some of this revision may have been seen.
            let before = Revision(after.revision.0.saturating_sub(u64::from(after.part.is_some())));
            let events = self.pool.changes_after(before).map_err(|compacted| status::of_compacted(&compacted))?;
            let events = events.iter().flat_map(|event| wire::events(event));
            let unseen = |event: &ResourceEvent| event.revision > after.revision || Some(event.part) > after.part;
            let events: Vec<ResourceEvent> = events.filter(unseen).collect();
            let (sender, updates) = mpsc::channel(WATCH_BUFFER + events.len());
            for event in events {
                sender
                    .try_send(Arc::new(ResourceUpdate::Event(event)))
                    .map_err(|_| status_with(Code::Internal, "BROKEN", "a new watch took no event"))?;
            }
            // Events of before that wait for the disk are in the history.
            self.outgoing.push(Outgoing::Watcher(sender));
            return Ok(updates);
        }
        let (sender, updates) = mpsc::channel(WATCH_BUFFER);
        let resources = self.pool.list().iter().map(wire::resource).collect();
        let (revision, youngest) = (self.pool.revision(), self.pool.youngest_lease());
        let snapshot = ResourceUpdate::Snapshot { revision, resources, youngest };
        sender
            .try_send(Arc::new(snapshot))
            .map_err(|_| status_with(Code::Internal, "BROKEN", "a new watch took no snapshot"))?;
        // Events of before that wait for the disk are in the snapshot.
        self.outgoing.push(Outgoing::Watcher(sender));
        Ok(updates)
    }

    /// What the pool has to say goes behind what was to be said before.
    fn collect(&mut self) {
        self.outgoing.extend(self.pool.take_notices().into_iter().map(Outgoing::Notice));
    }

    /// Writes down what has changed, and hands out what is on the disk, including what that in turn leads to.
    fn deliver(&mut self) {
        while self.stopped.is_none() {
            self.collect();
            if let Err(error) = self.journal.write(&mut self.pool) {
                return self.stop(&error);
            }
            let position = self.journal.last();
            for outgoing in self.outgoing.drain(..) {
                self.outbox.hold(position, outgoing);
            }
            let reached = |position| self.journal.reached(position);
            let Some(outgoing) = self.outbox.waits_for().filter(|at| reached(*at)).and_then(|_| self.outbox.take())
            else {
                return;
            };
            self.hand_out(outgoing);
        }
        for outgoing in std::mem::take(&mut self.outgoing) {
            self.hand_out(outgoing);
        }
    }

    fn hand_out(&mut self, outgoing: Outgoing) {
        match outgoing {
            Outgoing::Answer(answer) => answer(None),
            Outgoing::Watcher(watcher) => self.watchers.push(watcher),
            Outgoing::Notice(Notice::Event(event)) => {
                if let Change::LeaseEnded { lease, .. } = &event.change {
                    self.shared.remove(lease);
                }
                wire::events(&event).into_iter().for_each(|event| self.publish(event));
            }
            Outgoing::Notice(Notice::Granted { waiter, lease }) => {
                let id = lease.id;
                match self.answer(waiter, Ok(lease)) {
                    0 => self.give_back(id),
                    1 => {}
                    calls => drop(self.shared.insert(id, calls)),
                }
            }
            Outgoing::Notice(Notice::Refused { waiter, refusal }) => {
                self.answer(waiter, Err(status::of_refusal(&refusal)));
            }
        }
    }

    /// More is on the disk, or something went wrong.
    fn written(&mut self, progress: Result<Progress, Fault>) {
        match progress {
            Ok(Progress { fault: Some(fault), .. }) | Err(fault) => self.stop(&fault),
            Ok(Progress { compaction_failure: Some(failure), compacting: false, .. }) => {
                tracing::warn!(%failure, "the log grows on; the next snapshot is tried later");
            }
            Ok(_) => {}
        }
        if let (None, Some(metrics)) = (&self.stopped, metrics::get()) {
            metrics.journal.commits.inc();
        }
    }

    /// Nothing changes any more. What was not on the disk has not happened.
    fn stop(&mut self, fault: &dyn std::error::Error) {
        let stopped = of_fault(fault);
        tracing::error!(fault = stopped.message(), "changes are refused from now on");
        if let Some(metrics) = metrics::get() {
            metrics.journal.failed.set(1);
        }
        // What was let out before was on the disk.
        let mut refused = std::mem::take(&mut self.outgoing);
        while let Some(outgoing) = self.outbox.take() {
            refused.push(outgoing);
        }
        for outgoing in refused {
            if let Outgoing::Answer(answer) = outgoing {
                answer(Some(&stopped));
            }
        }
        for (_, call) in std::mem::take(&mut self.calls).into_values().flatten() {
            let _ = call.send(Err(stopped.clone()));
        }
        self.tickets.clear();
        self.shared.clear();
        // They find a state that may be behind the one they saw coming, and watch again.
        self.watchers.clear();
        match journal::read(&self.journal, self.config.limits.clone()) {
            Ok(pool) => self.pool = pool.with_kinds(self.config.hierarchy()),
            Err(error) => {
                let error = anyhow::Error::new(error);
                tracing::error!(error = format!("{error:#}"), "what is on the disk cannot be read either");
                self.pool = Pool::new(self.config.limits.clone());
            }
        }
        self.stopped = Some(stopped);
    }

    /// How many calls took it.
    fn answer(&mut self, waiter: WaiterId, granted: Granted) -> usize {
        let mut taken = 0;
        for (ticket, call) in self.calls.remove(&waiter).unwrap_or_default() {
            self.tickets.remove(&ticket);
            taken += usize::from(call.send(granted.clone()).is_ok());
        }
        taken
    }

    fn publish(&mut self, event: ResourceEvent) {
        if self.watchers.is_empty() {
            return;
        }
        tracing::trace!(revision = event.revision.0, kind = ?event.kind, resource = event.resource.id, "event");
        let update = Arc::new(ResourceUpdate::Event(event));
        self.watchers.retain(|watcher| match watcher.try_send(update.clone()) {
            Ok(()) => true,
            Err(mpsc::error::TrySendError::Closed(_)) => false,
            Err(mpsc::error::TrySendError::Full(_)) => {
                tracing::warn!("a watcher did not keep up and was cut off");
                false
            }
        });
    }
}

async fn sleep_until(deadline: Option<Instant>) {
    match deadline {
        Some(deadline) => tokio::time::sleep_until(deadline.into()).await,
        None => std::future::pending().await,
    }
}
