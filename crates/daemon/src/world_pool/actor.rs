//! The one task that owns the worlds: takes messages in order, ends projections with their leases.

use super::core::{CommitError, HeldBy, ProjectError, ProjectRequest, QueryError, WorldPool};
use super::leases::{Known, LiveLeases};
use super::{WorldPoolConfig, status};
use ratn_model::fact::{Change, FactKey, FactPattern, Footprint};
use ratn_model::id::{LeaseId, ProjectionId, Revision};
use ratn_model::time::Timestamp;
use ratn_world::world::{Fact, World};
use std::time::{Duration, Instant};
use tokio::sync::{mpsc, oneshot, watch};
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
    Root {
        answer: oneshot::Sender<World>,
    },
    Commit {
        id: String,
        changes: Vec<Change>,
        expected: Option<Revision>,
        answer: oneshot::Sender<Result<Revision, CommitError>>,
    },
    Project {
        projection: NewProjection,
        answer: oneshot::Sender<Result<ProjectionId, Status>>,
    },
    Query {
        projection: Option<ProjectionId>,
        patterns: Vec<FactPattern>,
        answer: oneshot::Sender<Result<Facts, QueryError>>,
    },
    Release {
        projection: ProjectionId,
        answer: oneshot::Sender<bool>,
    },
}

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
    pub(super) async fn ask<T>(&self, message: impl FnOnce(oneshot::Sender<T>) -> Message) -> Result<T, Status> {
        let (answer, answered) = oneshot::channel();
        self.inbox.send(message(answer)).await.map_err(|_| crate::details::ending())?;
        answered.await.map_err(|_| crate::details::ending())
    }
}

struct Actor {
    pool: WorldPool,
    leases: watch::Receiver<LiveLeases>,
    start: Instant,
}

/// Starts the actor; it ends with the token.
pub(super) fn start(
    config: WorldPoolConfig,
    leases: watch::Receiver<LiveLeases>,
    shutdown: CancellationToken,
) -> Handle {
    let (inbox, messages) = mpsc::channel(INBOX);
    let actor = Actor { pool: WorldPool::new(config), leases, start: Instant::now() };
    tokio::spawn(actor.run(messages, shutdown));
    Handle { inbox }
}

impl Actor {
    async fn run(mut self, mut messages: mpsc::Receiver<Message>, shutdown: CancellationToken) {
        let mut expiry = tokio::time::interval(EXPIRY_INTERVAL);
        let mut leases = self.leases.clone();
        loop {
            tokio::select! {
                message = messages.recv() => match message {
                    Some(message) => self.receive(message),
                    None => return,
                },
                changed = leases.changed() => {
                    if changed.is_err() {
                        return;
                    }
                    let live = leases.borrow_and_update();
                    let ended = self.pool.keep_leases(|lease| live.known(lease) == Known::Lives);
                    if ended > 0 {
                        tracing::debug!(ended, left = self.pool.projections(), "projections ended with their leases");
                    }
                }
                _ = expiry.tick() => self.pool.expire(self.now()),
                () = shutdown.cancelled() => return,
            }
        }
    }

    fn now(&self) -> Timestamp {
        Timestamp(u64::try_from(self.start.elapsed().as_nanos()).unwrap_or(u64::MAX))
    }

    // An answer that nobody waits for any more is of no consequence: commits and projections are idempotent by id.
    fn receive(&mut self, message: Message) {
        match message {
            Message::Root { answer } => drop(answer.send(self.pool.root().clone())),
            Message::Commit { id, changes, expected, answer } => {
                let committed = self.pool.commit(&id, &changes, expected);
                tracing::debug!(id, changes = changes.len(), ?committed, "commit");
                let _ = answer.send(committed);
            }
            Message::Project { projection, answer } => drop(answer.send(self.project(projection))),
            Message::Query { projection, patterns, answer } => {
                let _ = answer.send(self.pool.query(projection, &patterns));
            }
            Message::Release { projection, answer } => drop(answer.send(self.pool.release(projection))),
        }
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
