//! The one task that owns the worlds: takes messages in order, ends projections with their leases.
//!
//! Whatever leaves goes through the outbox, and waits there until the commits that it may tell of are on the disk. When they cannot
//! be written, every commit is refused from then on; what can be read, and projected from, is what is on the disk.

use super::core::{HeldBy, ProjectError, ProjectRequest, WorldPool};
use super::history::{Commit, Difference, History, Kept, Version};
use super::leases::{Known, LiveLeases};
use super::{WorldPoolConfig, status};
use crate::details::{of_fault, retry_later, status as status_of};
use crate::journal::{Journal, floor};
use crate::metrics;
use crate::outbox::{Outbox, SendAnswer, send_answer};
use ratn_model::fact::{Change, FactKey, FactPattern, Footprint};
use ratn_model::id::{LeaseId, ProjectionId, Revision};
use ratn_model::ontology::Ontology;
use ratn_model::time::Timestamp;
use ratn_proto::types::Contradiction;
use ratn_storage::{Fault, Progress};
use ratn_world::digest::Digest;
use ratn_world::scene::delta::SceneDelta;
use ratn_world::world::{Fact, World};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::{mpsc, oneshot, watch};
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tonic::{Code, Status};

/// Messages that wait for the actor; more make their senders wait.
const INBOX: usize = 1_024;
/// How often projections without a lease are looked at.
const EXPIRY_INTERVAL: Duration = Duration::from_secs(1);

/// Updates that wait for a watcher; one that has more to catch up with is cut off.
const WATCH_BUFFER: usize = 4_096;
/// When a watch that was refused may be asked for again.
pub(super) const WATCH_AGAIN_AFTER: Duration = Duration::from_secs(1);

/// Facts of one revision.
pub(super) type Facts = (Vec<(FactKey, Fact)>, Revision);

/// What the service asks of the actor.
#[derive(Debug)]
pub(super) enum Message {
    Root {
        answer: Answer<World>,
    },
    Commit {
        commit: Commit,
        answer: Answer<(Revision, Vec<Contradiction>)>,
    },
    Project {
        projection: NewProjection,
        answer: Answer<ProjectionId>,
    },
    Query {
        projection: Option<ProjectionId>,
        at: Option<Revision>,
        patterns: Vec<FactPattern>,
        answer: Answer<Facts>,
    },
    Watch {
        /// Without a snapshot: the revisions after this.
        after: Option<Revision>,
        answer: Answer<mpsc::Receiver<Update>>,
    },
    Diff {
        from: Revision,
        /// Unset, the root as it is.
        to: Option<Revision>,
        answer: Answer<(Vec<Difference>, Revision)>,
    },
    WatchProjection {
        projection: ProjectionId,
        answer: Answer<watch::Receiver<Option<Contradiction>>>,
    },
    Versions {
        key: FactKey,
        limit: usize,
        answer: Answer<(Vec<Version>, Revision)>,
    },
    Scene {
        projection: Option<ProjectionId>,
        bases: Vec<Digest>,
        answer: Answer<SceneDelta>,
    },
    Release {
        projection: ProjectionId,
        answer: Answer<bool>,
    },
}

type Answer<T> = oneshot::Sender<Result<T, Status>>;

/// What watchers are told.
#[derive(Debug, Clone)]
pub(super) enum Update {
    /// What holds; every revision follows.
    Snapshot(World),
    Revision(Arc<Kept>),
}

/// A projection as it was asked for.
#[derive(Debug)]
pub(super) struct NewProjection {
    pub(super) request_id: String,
    pub(super) base: Revision,
    pub(super) changes: Vec<Change>,
    pub(super) writers: Vec<Arc<str>>,
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
    watchers: Vec<mpsc::Sender<Update>>,
    /// Contradictions that are to be told.
    contradicted: Vec<Contradiction>,
    /// Projections that somebody watches.
    watched: BTreeMap<ProjectionId, watch::Sender<Option<Contradiction>>>,
    leases: watch::Receiver<LiveLeases>,
    start: Instant,
}

/// Something that leaves.
enum Outgoing {
    Answer(SendAnswer),
    /// To everybody who watches.
    News(Arc<Kept>),
    /// To who watches the projection.
    Contradicted(Contradiction),
    /// From here on it sees every revision.
    Watcher(mpsc::Sender<Update>),
}

/// Starts the actor on what was kept. It ends with the token, when everything is on the disk.
pub(super) fn start(
    config: WorldPoolConfig,
    ontology: Option<Ontology>,
    (history, journal): (History, Journal),
    leases: watch::Receiver<LiveLeases>,
    over: CancellationToken,
) -> (Handle, JoinHandle<()>) {
    let (inbox, messages) = mpsc::channel(INBOX);
    let pool = WorldPool::new(config.clone(), ontology, history, floor());
    let (outbox, start) = (Outbox::default(), Instant::now());
    let actor = Actor {
        config,
        pool,
        journal,
        outbox,
        stopped: None,
        unreadable: false,
        watchers: Vec::new(),
        contradicted: Vec::new(),
        watched: BTreeMap::new(),
        leases,
        start,
    };
    (Handle { inbox }, tokio::spawn(actor.run(messages, over)))
}

impl Actor {
    async fn run(mut self, mut messages: mpsc::Receiver<Message>, over: CancellationToken) {
        let mut expiry = tokio::time::interval(EXPIRY_INTERVAL);
        let mut leases = self.leases.clone();
        loop {
            let (running, room) = (self.stopped.is_none(), !self.outbox.is_full());
            let stale = self.pool.next_expiry().filter(|_| running).map(|at| self.start + Duration::from_nanos(at.0));
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
                () = sleep_until(stale) => {
                    self.pool.expire_facts(self.now());
                    self.write(None);
                }
                message = messages.recv(), if room => match message {
                    Some(message) => self.receive(message),
                    None => return self.end(),
                },
            }
            self.deliver();
            let pool = &self.pool;
            self.watched.retain(|id, watched| pool.has(*id) && !watched.is_closed());
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
            Message::Commit { commit, answer } => {
                let now = self.now();
                let committed = match &self.stopped {
                    Some(stopped) => Err(stopped.clone()),
                    None => self.pool.commit(now, &commit).map_err(|error| status::of_commit(&error)),
                };
                let contradictions = self.pool.take_contradictions();
                self.contradicted.extend(contradictions.iter().cloned());
                let committed = committed.map(|revision| (revision, contradictions));
                tracing::debug!(id = commit.id, changes = commit.changes.len(), ?committed, "commit");
                self.reply(answer, committed);
            }
            Message::Project { projection, answer } => {
                let projected = self.project(projection);
                self.reply(answer, projected);
            }
            Message::Query { projection, at, patterns, answer } => {
                let found = self.pool.query(projection, at, &patterns).map_err(|error| status::of_query(&error));
                self.reply(answer, found);
            }
            Message::Watch { after, answer } => match self.watch(after) {
                Ok((sender, updates)) => {
                    self.reply(answer, Ok(updates));
                    // Revisions of before that wait for the disk are in what it was given.
                    self.write(Some(Outgoing::Watcher(sender)));
                }
                Err(refused) => self.reply(answer, Err(refused)),
            },
            Message::WatchProjection { projection, answer } => {
                let watch = match self.pool.contradiction(projection) {
                    Ok(contradiction) => {
                        let known = contradiction.cloned();
                        let new = || watch::Sender::new(known);
                        Ok(self.watched.entry(projection).or_insert_with(new).subscribe())
                    }
                    Err(error) => Err(status::of_query(&error)),
                };
                self.reply(answer, watch);
            }
            Message::Diff { from, to, answer } => {
                let to = to.unwrap_or(self.pool.root().revision());
                let differences = self.pool.history.diff(from, to).map_err(status::of_revision);
                self.reply(answer, differences.map(|differences| (differences, to)));
            }
            Message::Versions { key, limit, answer } => {
                let versions = self.pool.history.versions(&key, limit);
                self.reply(answer, Ok(versions));
            }
            Message::Scene { projection, bases, answer } => {
                let scene = self.pool.scene(projection, &bases).map_err(|error| status::of_query(&error));
                self.reply(answer, scene);
            }
            Message::Release { projection, answer } => {
                let released = self.pool.release(projection);
                self.reply(answer, Ok(released));
            }
        }
    }

    fn reply<T: Send + 'static>(&mut self, answer: Answer<T>, result: Result<T, Status>) {
        self.write(Some(Outgoing::Answer(send_answer(answer, result))));
    }

    /// Writes down what was committed; what is said about it waits for that.
    fn write(&mut self, outgoing: Option<Outgoing>) {
        if self.stopped.is_some() {
            let refused = self.stopped.clone().filter(|_| self.unreadable);
            outgoing.into_iter().for_each(|outgoing| self.hand_out(outgoing, refused.as_ref()));
            return;
        }
        let written = self.journal.write(&mut self.pool.history);
        // What could not be written is not on the disk either when all else is.
        let position = if written.is_ok() { self.journal.last() } else { self.journal.last().next() };
        for kept in self.pool.history.take_news() {
            self.outbox.hold(position, Outgoing::News(kept));
        }
        self.contradicted.extend(self.pool.take_contradictions());
        for contradiction in self.contradicted.drain(..) {
            self.outbox.hold(position, Outgoing::Contradicted(contradiction));
        }
        outgoing.into_iter().for_each(|outgoing| self.outbox.hold(position, outgoing));
        if let Err(error) = written {
            self.stop(&error);
        }
    }

    /// What a watcher begins with is in its channel already.
    fn watch(&mut self, after: Option<Revision>) -> Result<(mpsc::Sender<Update>, mpsc::Receiver<Update>), Status> {
        self.watchers.retain(|watcher| !watcher.is_closed());
        if self.watchers.len() >= self.config.max_watchers {
            let message = format!("{} clients watch already", self.watchers.len());
            return Err(retry_later(Code::ResourceExhausted, "TOO_MANY", message, WATCH_AGAIN_AFTER));
        }
        let first: Vec<Update> = match after {
            None => vec![Update::Snapshot(self.pool.root().clone())],
            Some(after) => {
                let missed = self.pool.history.after(after).map_err(status::of_revision)?;
                missed.map(|kept| Update::Revision(Arc::clone(kept))).collect()
            }
        };
        let (sender, updates) = mpsc::channel(WATCH_BUFFER + first.len());
        for update in first {
            sender.try_send(update).map_err(|_| status_of(Code::Internal, "BROKEN", "a new watch took no update"))?;
        }
        Ok((sender, updates))
    }

    /// Or a status instead.
    fn hand_out(&mut self, outgoing: Outgoing, refused: Option<&Status>) {
        match outgoing {
            Outgoing::Answer(answer) => answer(refused),
            Outgoing::Watcher(watcher) if refused.is_none() => self.watchers.push(watcher),
            Outgoing::News(kept) if refused.is_none() => {
                self.watchers.retain(|watcher| match watcher.try_send(Update::Revision(Arc::clone(&kept))) {
                    Ok(()) => true,
                    Err(mpsc::error::TrySendError::Closed(_)) => false,
                    Err(mpsc::error::TrySendError::Full(_)) => {
                        tracing::warn!("a watcher did not keep up and was cut off");
                        false
                    }
                });
            }
            Outgoing::Contradicted(contradiction) if refused.is_none() => {
                if let Some(watched) = self.watched.get(&contradiction.projection) {
                    watched.send_if_modified(|first| {
                        let is_first = first.is_none();
                        first.get_or_insert(contradiction);
                        is_first
                    });
                }
            }
            Outgoing::Watcher(_) | Outgoing::News(_) | Outgoing::Contradicted(_) => {}
        }
    }

    /// Hands out what is on the disk.
    fn deliver(&mut self) {
        while self.outbox.waits_for().is_some_and(|position| self.journal.reached(position)) {
            if let Some(outgoing) = self.outbox.take() {
                self.hand_out(outgoing, None);
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
            self.hand_out(outgoing, Some(&stopped));
        }
        // They find a root that may be behind the one they would have seen, and watch again.
        self.watchers.clear();
        match self.journal.read(|recovered| History::restore(recovered, &self.config)) {
            Ok(history) => self.pool.replace_history(self.now(), history),
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
        let NewProjection { request_id, base, changes, writers, reads, .. } = new;
        let request = ProjectRequest { request_id, base, changes, writers, reads, held_by };
        self.pool.project(request).map_err(|error: ProjectError| status::of_project(&error))
    }
}

async fn sleep_until(deadline: Option<Instant>) {
    match deadline {
        Some(deadline) => tokio::time::sleep_until(deadline.into()).await,
        None => std::future::pending().await,
    }
}

impl std::fmt::Debug for Outgoing {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Outgoing::Answer(_) => "Answer",
            Outgoing::News(_) => "News",
            Outgoing::Contradicted(_) => "Contradicted",
            Outgoing::Watcher(_) => "Watcher",
        })
    }
}
