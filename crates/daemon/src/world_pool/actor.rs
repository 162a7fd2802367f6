//! The one task that owns the worlds: takes messages in order, ends projections with their leases.
//!
//! Whatever leaves goes through the outbox, and waits there until the commits that it may tell of are on the disk. When they cannot
//! be written, every commit is refused from then on; what can be read, and projected from, is what is on the disk.

use super::core::{HeldBy, ProjectError, ProjectRequest, WorldPool};
use super::history::History;
use super::leases::{Known, LiveLeases};
use super::{WorldPoolConfig, status};
use crate::details::of_fault;
use crate::journal::{Journal, floor};
use crate::metrics;
use crate::outbox::{Outbox, SendAnswer, send_answer};
use ratn_model::fact::{Change, FactKey, FactPattern, Footprint};
use ratn_model::id::{LeaseId, ProjectionId, Revision};
use ratn_model::time::Timestamp;
use ratn_storage::{Fault, Progress};
use ratn_world::world::{Fact, World};
use std::time::{Duration, Instant};
use tokio::sync::{mpsc, oneshot, watch};
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tonic::Status;

/// Messages that wait for the actor; more make their senders wait.
const INBOX: usize = 1_024;
/// How often projections without a lease are looked at.
const EXPIRY_INTERVAL: Duration = Duration::from_secs(1);

/// Facts of one revision.
pub(super) type Facts = (Vec<(FactKey, Fact)>, Revision);

/// What the service asks of the actor.
#[derive(Debug)]
pub(super) enum Message {
    Root { answer: Answer<World> },
    Commit { id: String, changes: Vec<Change>, expected: Option<Revision>, answer: Answer<Revision> },
    Project { projection: NewProjection, answer: Answer<ProjectionId> },
    Query { projection: Option<ProjectionId>, patterns: Vec<FactPattern>, answer: Answer<Facts> },
    Release { projection: ProjectionId, answer: Answer<bool> },
}

type Answer<T> = oneshot::Sender<Result<T, Status>>;

/// A projection as it was asked for.
#[derive(Debug)]
pub(super) struct NewProjection {
    pub(super) request_id: String,
    pub(super) base: Revision,
    pub(super) changes: Vec<Change>,
    pub(super) reads: Footprint,
    pub(super) lease: Option<LeaseId>,
}

/// Sends messages to the actor.
#[derive(Debug, Clone)]
pub(super) struct Handle {
    inbox: mpsc::Sender<Message>,
}

impl Handle {
    /// Sends a message and waits for the answer that it is to be given.
    pub(super) async fn ask<T>(&self, message: impl FnOnce(Answer<T>) -> Message) -> Result<T, Status> {
        let (answer, answered) = oneshot::channel();
        self.inbox.send(message(answer)).await.map_err(|_| crate::details::ending())?;
        answered.await.map_err(|_| crate::details::ending())?
    }
}

#[derive(Debug)]
struct Actor {
    config: WorldPoolConfig,
    pool: WorldPool,
    journal: Journal,
    outbox: Outbox<Outgoing>,
    /// Why nothing is committed any more.
    stopped: Option<Status>,
    /// Nor is anything shown: it is not known what is on the disk.
    unreadable: bool,
    leases: watch::Receiver<LiveLeases>,
    start: Instant,
}

/// Something that leaves.
struct Outgoing(SendAnswer);

/// Starts the actor on what was kept. It ends with the token, when everything is on the disk.
pub(super) fn start(
    config: WorldPoolConfig,
    (history, journal): (History, Journal),
    leases: watch::Receiver<LiveLeases>,
    over: CancellationToken,
) -> (Handle, JoinHandle<()>) {
    let (inbox, messages) = mpsc::channel(INBOX);
    // A pool that makes a projection every microsecond for as long as it lives would reach those of its successor.
    let pool = WorldPool::new(config.clone(), history, floor().saturating_mul(1_000));
    let (outbox, start) = (Outbox::default(), Instant::now());
    let actor = Actor { config, pool, journal, outbox, stopped: None, unreadable: false, leases, start };
    (Handle { inbox }, tokio::spawn(actor.run(messages, over)))
}

impl Actor {
    async fn run(mut self, mut messages: mpsc::Receiver<Message>, over: CancellationToken) {
        let mut expiry = tokio::time::interval(EXPIRY_INTERVAL);
        let mut leases = self.leases.clone();
        loop {
            let (running, room) = (self.stopped.is_none(), !self.outbox.is_full());
            tokio::select! {
                biased;
                () = over.cancelled() => return self.end(),
                changed = leases.changed() => {
                    if changed.is_err() {
                        return self.end();
                    }
                    let live = leases.borrow_and_update();
                    let ended = self.pool.keep_leases(|lease| live.known(lease) == Known::Lives);
                    if ended > 0 {
                        tracing::debug!(ended, left = self.pool.projections(), "projections ended with their leases");
                    }
                }
                progress = self.journal.changed(), if running => self.written(progress),
                _ = expiry.tick() => self.pool.expire(self.now()),
                message = messages.recv(), if room => match message {
                    Some(message) => self.receive(message),
                    None => return self.end(),
                },
            }
            self.deliver();
        }
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

    // An answer that nobody waits for any more is of no consequence: commits and projections are idempotent by id.
    fn receive(&mut self, message: Message) {
        match message {
            Message::Root { answer } => self.reply(answer, Ok(self.pool.root().clone())),
            Message::Commit { id, changes, expected, answer } => {
                let committed = match &self.stopped {
                    Some(stopped) => Err(stopped.clone()),
                    None => self.pool.commit(&id, &changes, expected).map_err(|error| status::of_commit(&error)),
                };
                tracing::debug!(id, changes = changes.len(), ?committed, "commit");
                self.reply(answer, committed);
            }
            Message::Project { projection, answer } => {
                let projected = self.project(projection);
                self.reply(answer, projected);
            }
            Message::Query { projection, patterns, answer } => {
                let found = self.pool.query(projection, &patterns).map_err(|error| status::of_query(&error));
                self.reply(answer, found);
            }
            Message::Release { projection, answer } => {
                let released = self.pool.release(projection);
                self.reply(answer, Ok(released));
            }
        }
    }

    fn reply<T: Send + 'static>(&mut self, answer: Answer<T>, result: Result<T, Status>) {
        self.say(Outgoing(send_answer(answer, result)));
    }

    /// Writes down what was committed; what is said about it waits for that.
    fn say(&mut self, outgoing: Outgoing) {
        if let Some(stopped) = &self.stopped {
            return outgoing.hand_out(self.unreadable.then_some(stopped));
        }
        match self.journal.write(&mut self.pool.history) {
            Ok(()) => self.outbox.hold(self.journal.last(), outgoing),
            Err(error) => {
                self.outbox.hold(self.journal.last().next(), outgoing);
                self.stop(&error);
            }
        }
    }

    /// Hands out what is on the disk.
    fn deliver(&mut self) {
        while self.outbox.waits_for().is_some_and(|position| self.journal.reached(position)) {
            if let Some(outgoing) = self.outbox.take() {
                outgoing.hand_out(None);
            }
        }
    }

    /// More is on the disk, or something went wrong.
    fn written(&mut self, progress: Result<Progress, Fault>) {
        match progress {
            Ok(Progress { fault: Some(fault), .. }) | Err(fault) => return self.stop(&fault),
            Ok(Progress { compaction_failure: Some(failure), compacting: false, .. }) => {
                tracing::warn!(%failure, "the log grows on; the next snapshot is tried later");
            }
            Ok(_) => {}
        }
        if let Some(metrics) = metrics::get() {
            metrics.journal.commits.inc();
        }
    }

    /// Nothing is committed any more. What was not on the disk has not happened.
    fn stop(&mut self, fault: &dyn std::error::Error) {
        let stopped = of_fault(fault);
        tracing::error!(fault = stopped.message(), "commits are refused from now on");
        if let Some(metrics) = metrics::get() {
            metrics.journal.failed.set(1);
        }
        self.deliver();
        while let Some(outgoing) = self.outbox.take() {
            outgoing.hand_out(Some(&stopped));
        }
        match self.journal.read(|recovered| History::restore(recovered, &self.config)) {
            Ok(history) => self.pool.replace_history(history),
            Err(error) => {
                let error = anyhow::Error::new(error);
                tracing::error!(error = format!("{error:#}"), "what is on the disk cannot be read either");
                self.unreadable = true;
            }
        }
        self.stopped = Some(stopped);
    }

    fn project(&mut self, new: NewProjection) -> Result<ProjectionId, Status> {
        let unbound = HeldBy::Until(self.now() + self.pool.unbound_ttl());
        // Looked at here and not where the call came in: a lease that ends from now on ends the projection, too.
        let held_by = match new.lease {
            None => unbound,
            Some(lease) => match self.leases.borrow().known(lease) {
                Known::Lives => HeldBy::Lease(lease),
                Known::Ended => return Err(status::lease_ended(lease)),
                // A lease without a resource is never told of.
                Known::NotYet => unbound,
            },
        };
        let NewProjection { request_id, base, changes, reads, .. } = new;
        let request = ProjectRequest { request_id, base, changes, reads, held_by };
        self.pool.project(request).map_err(|error: ProjectError| status::of_project(&error))
    }
}

impl Outgoing {
    /// Or a status instead.
    fn hand_out(self, refused: Option<&Status>) {
        self.0(refused);
    }
}

impl std::fmt::Debug for Outgoing {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Answer")
    }
}
