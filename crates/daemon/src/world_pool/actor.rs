//! The worlds as the core of an actor: requests to them, and the projections that end with their leases.
//!
//! A commit's answer and its updates to watchers wait until the commit is on the disk. When commits cannot be written, every commit
//! is refused from then on; reads and projections use the state that is on the disk.

use super::core::{HeldBy, ProjectError, ProjectRequest, WorldPool};
use super::history::{Between, Commit, History, Kept, Version};
use super::leases::{Known, LiveLeases};
use super::parked::Parked;
use super::query::View;
use super::{WorldPoolConfig, size, status};
use crate::access::Caller;
use crate::durable_actor::{self, Core, Journal, JournalError, TurnContext, floor};
use ratn_model::fact::{Change, FactKey, FactPattern, Footprint};
use ratn_model::id::{LeaseId, ProjectionId, Revision};
use ratn_model::ontology::Ontology;
use ratn_model::time::Timestamp;
use ratn_proto::types::Contradiction;
use ratn_worker::vitals::Vitals;
use ratn_world::digest::Digest;
use ratn_world::scene::delta::SceneDelta;
use std::collections::BTreeMap;
use std::convert::Infallible;
use std::sync::{Arc, Weak};
use std::time::Duration;
use tokio::sync::{mpsc, oneshot, watch};
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tonic::Status;

/// Interval at which expired projections are removed.
const EXPIRY_INTERVAL: Duration = Duration::from_secs(1);

/// Retry delay of a watch that has ended.
pub(super) const WATCH_AGAIN_AFTER: Duration = Duration::from_secs(1);

/// Requests of the service.
#[derive(Debug)]
pub(super) enum Message {
    Commit {
        commit: Commit,
        answer: Answer<(Revision, Vec<Contradiction>)>,
    },
    Project {
        projection: NewProjection,
        /// Number of ids to promise together with it.
        promise: u32,
        answer: Answer<(ProjectionId, Vec<ProjectionId>)>,
    },
    Query {
        by: Arc<str>,
        projection: Option<ProjectionId>,
        at: Option<Revision>,
        patterns: Vec<FactPattern>,
        answer: Answer<View>,
    },
    Watch {
        /// With this revision no snapshot is sent, only the revisions after it.
        after: Option<Revision>,
        answer: Answer<mpsc::Receiver<Update>>,
    },
    Diff {
        from: Revision,
        /// `None` for the current root.
        to: Option<Revision>,
        answer: Answer<(Between, Revision)>,
    },
    WatchProjection {
        by: Arc<str>,
        projection: ProjectionId,
        answer: Answer<watch::Receiver<Option<Contradiction>>>,
    },
    Versions {
        key: FactKey,
        limit: usize,
        answer: Answer<(Vec<Version>, Revision)>,
    },
    Scene {
        by: Arc<str>,
        projection: Option<ProjectionId>,
        bases: Vec<Digest>,
        answer: Answer<SceneDelta>,
    },
    Release {
        by: Caller,
        projection: ProjectionId,
        answer: Answer<bool>,
    },
}

type Answer<T> = oneshot::Sender<Result<T, Status>>;

/// An update for watchers. Weak, so that a slow watcher does not make the history keep more revisions.
#[derive(Debug, Clone)]
pub(super) enum Update {
    /// The facts of this revision; every later revision follows.
    Snapshot(Weak<Kept>),
    Revision(Weak<Kept>),
}

/// A projection as requested.
#[derive(Debug)]
pub(super) struct NewProjection {
    pub(super) by: Caller,
    pub(super) request_id: String,
    pub(super) id: Option<ProjectionId>,
    pub(super) after: Option<String>,
    pub(super) base: Revision,
    pub(super) changes: Vec<Change>,
    pub(super) writers: Vec<Arc<str>>,
    pub(super) reads: Footprint,
    pub(super) lease: Option<LeaseId>,
}

/// Sends messages to the actor.
pub(super) type Handle = durable_actor::Handle<WorldCore>;

type WorldTurn = TurnContext<WorldCore>;

#[derive(Debug)]
pub(super) struct WorldCore {
    config: WorldPoolConfig,
    pool: WorldPool,
    /// Contradictions that are still to be reported.
    contradicted: Vec<Contradiction>,
    /// Projections that somebody watches.
    watched: BTreeMap<ProjectionId, watch::Sender<Option<Contradiction>>>,
    leases: watch::Receiver<LiveLeases>,
    /// Messages that came before the projection or commit that they need.
    parked: Parked<Message>,
    /// When expired projections are removed next.
    next_look: Timestamp,
}

/// Messages that a commit causes.
#[derive(Debug)]
pub(super) enum Said {
    /// To all watchers.
    News(Arc<Kept>),
    /// To those who watch the projection.
    Contradicted(Contradiction),
}

/// Starts the actor on the restored history. `over` ends it, when everything is on the disk.
pub(super) fn start(
    config: WorldPoolConfig,
    ontology: Option<Ontology>,
    (history, journal): (History, Journal),
    leases: watch::Receiver<LiveLeases>,
    vitals: Vitals,
    over: CancellationToken,
) -> Result<(Handle, JoinHandle<()>), JournalError> {
    let pool = WorldPool::new(config.clone(), ontology, history, floor());
    let core = WorldCore {
        config,
        pool,
        contradicted: Vec::new(),
        watched: BTreeMap::new(),
        leases: leases.clone(),
        parked: Parked::default(),
        next_look: Timestamp(0),
    };
    durable_actor::start(core, journal, leases, vitals, CancellationToken::new(), over)
}

impl Core for WorldCore {
    type State = History;
    type Message = Message;
    type Urgent = Infallible;
    type Said = Said;
    type Update = Update;
    type Signal = LiveLeases;

    fn state(&mut self) -> &mut History {
        &mut self.pool.history
    }

    fn restore(&mut self, journal: &Journal, context: &WorldTurn) -> Result<(), JournalError> {
        let history = journal.read(|recovered| History::restore(recovered, &self.config))?;
        self.pool.replace_history(context.now(), history);
        Ok(())
    }

    fn next_deadline(&self, context: &WorldTurn) -> Option<Timestamp> {
        let stale = self.pool.next_expiry().filter(|_| context.stopped().is_none());
        stale.into_iter().chain([self.next_look]).chain(self.parked.next_deadline()).min()
    }

    fn advance(&mut self, context: &mut WorldTurn) {
        let now = context.now();
        if now >= self.next_look {
            self.pool.expire(now);
            self.next_look = now + EXPIRY_INTERVAL;
        }
        if context.stopped().is_none() {
            self.pool.expire_facts(now);
        }
        self.take_up(context);
    }

    fn receive_urgent(&mut self, urgent: Infallible, _: &mut WorldTurn) {
        match urgent {}
    }

    fn receive(&mut self, message: Message, context: &mut WorldTurn) {
        if !is_early(&self.pool, &message) {
            let lets_go_on =
                matches!(message, Message::Commit { .. } | Message::Project { .. } | Message::Release { .. });
            self.perform(message, context);
            if lets_go_on {
                self.take_up(context);
            }
        } else if let Err(message) = self.parked.park(context.now(), message.whose(), message.bytes(), message) {
            message.refused(status::too_many_wait());
        }
    }

    fn signal(&mut self, live: &LiveLeases, _: &mut WorldTurn) {
        let ended = self.pool.keep_leases(|lease| matches!(live.known(lease), Known::Lives { .. }));
        if ended > 0 {
            tracing::debug!(ended, left = self.pool.projections(), "projections ended with their leases");
        }
    }

    fn collect(&mut self, context: &mut WorldTurn) {
        for kept in self.pool.history.take_news() {
            context.say(Said::News(kept));
        }
        self.contradicted.extend(self.pool.take_contradictions());
        for contradiction in self.contradicted.drain(..) {
            context.say(Said::Contradicted(contradiction));
        }
    }

    fn hand_out(&mut self, said: Said, context: &mut WorldTurn) {
        match said {
            Said::News(kept) => context.watchers.publish(&Update::Revision(Arc::downgrade(&kept))),
            Said::Contradicted(contradiction) => {
                if let Some(watched) = self.watched.get(&contradiction.projection) {
                    watched.send_if_modified(|first| {
                        let is_first = first.is_none();
                        first.get_or_insert(contradiction);
                        is_first
                    });
                }
            }
        }
    }

    fn refuse(message: Message, behind: &Status) -> Option<Message> {
        match message {
            Message::Commit { answer, .. } => {
                let _ = answer.send(Err(behind.clone()));
                None
            }
            message => Some(message),
        }
    }

    /// A commit may have as many facts as a message can hold.
    fn is_large(message: &Message) -> bool {
        matches!(message, Message::Commit { .. })
    }

    fn turned(&mut self, _: &mut WorldTurn) {
        let pool = &self.pool;
        self.watched.retain(|id, watched| pool.has(*id) && !watched.is_closed());
    }
}

/// Whether a message needs a commit or projection that may still arrive.
fn is_early(pool: &WorldPool, message: &Message) -> bool {
    match message {
        Message::Project { projection: NewProjection { by, id, after, .. }, .. } => {
            // A request with a projection id is refused at once where that id is not promised any more, and so is a query of that
            // projection.
            let may_be = id.is_none_or(|id| pool.is_promised_to(by, id));
            may_be && after.as_ref().is_some_and(|commit| !pool.has_commit(by, commit))
        }
        Message::Query { projection, .. } | Message::Scene { projection, .. } => {
            projection.is_some_and(|id| pool.is_promised(id))
        }
        Message::WatchProjection { projection, .. } => pool.is_promised(*projection),
        _ => false,
    }
}

impl Message {
    /// The caller of a message that may have to wait.
    fn whose(&self) -> Arc<str> {
        match self {
            Message::Project { projection, .. } => projection.by.name.clone(),
            Message::Query { by, .. } | Message::Scene { by, .. } | Message::WatchProjection { by, .. } => by.clone(),
            _ => Arc::default(),
        }
    }

    /// Approximate memory of a message that may have to wait, in bytes.
    fn bytes(&self) -> usize {
        let of = match self {
            Message::Project { projection, .. } => {
                size::of_changes(&projection.changes) + size::of_footprint(&projection.reads)
            }
            Message::Query { patterns, .. } => size::of_patterns(patterns),
            _ => 0,
        };
        size_of::<Message>() + of
    }

    /// Answers a message that waited with a refusal.
    fn refused(self, status: Status) {
        match self {
            Message::Project { answer, .. } => drop(answer.send(Err(status))),
            Message::Query { answer, .. } => drop(answer.send(Err(status))),
            Message::Scene { answer, .. } => drop(answer.send(Err(status))),
            Message::WatchProjection { answer, .. } => drop(answer.send(Err(status))),
            _ => {}
        }
    }
}

impl WorldCore {
    /// Performs the messages that need not wait any more, and those for which these made the way free.
    fn take_up(&mut self, context: &mut WorldTurn) {
        loop {
            let pool = &self.pool;
            let ready = self.parked.take(context.now(), |message| is_early(pool, message));
            if ready.is_empty() {
                return;
            }
            ready.into_iter().for_each(|message| self.perform(message, context));
        }
    }

    // An answer whose receiver is gone does no harm: commits and projections are idempotent by id.
    fn perform(&mut self, message: Message, context: &mut WorldTurn) {
        match message {
            Message::Commit { commit, answer } => {
                let committed = match context.stopped() {
                    Some(stopped) => Err(stopped.status.clone()),
                    None => self.pool.commit(context.now(), &commit).map_err(|error| status::of_commit(&error)),
                };
                let contradictions = self.pool.take_contradictions();
                self.contradicted.extend(contradictions.iter().cloned());
                self.collect(context);
                let committed = committed.map(|revision| (revision, contradictions));
                tracing::debug!(id = commit.id, changes = commit.changes.len(), ?committed, "commit");
                context.reply(answer, committed);
            }
            Message::Project { projection, promise, answer } => {
                let by = projection.by.name.clone();
                let projected = self.project(projection, context.now());
                let projected = projected.map(|id| (id, self.pool.promise(context.now(), &by, promise)));
                context.reply(answer, projected);
            }
            Message::Query { projection, at, patterns, answer, by: _ } => {
                let view = self.pool.view(projection, at, &patterns).map_err(|error| status::of_query(&error));
                context.reply(answer, view);
            }
            Message::Watch { after, answer } => {
                let watch = self.watch(after, context);
                context.reply(answer, watch);
            }
            Message::WatchProjection { projection, answer, by: _ } => {
                let watch = match self.pool.contradiction(projection) {
                    Ok(contradiction) => {
                        let known = contradiction.cloned();
                        let new = || watch::Sender::new(known);
                        Ok(self.watched.entry(projection).or_insert_with(new).subscribe())
                    }
                    Err(error) => Err(status::of_query(&error)),
                };
                context.reply(answer, watch);
            }
            Message::Diff { from, to, answer } => {
                let to = to.unwrap_or(self.pool.root().revision());
                let between = self.pool.history.between(from, to).map_err(status::of_revision);
                context.reply(answer, between.map(|between| (between, to)));
            }
            Message::Versions { key, limit, answer } => {
                let versions = self.pool.history.versions(&key, limit);
                context.reply(answer, Ok(versions));
            }
            Message::Scene { projection, bases, answer, by: _ } => {
                let scene = self.pool.scene(projection, &bases).map_err(|error| status::of_query(&error));
                context.reply(answer, scene);
            }
            Message::Release { by, projection, answer } => {
                let released = self.pool.release_for(&by, projection).map_err(|error| status::of_release(&error));
                context.reply(answer, released);
            }
        }
    }

    fn watch(&self, after: Option<Revision>, context: &mut WorldTurn) -> Result<mpsc::Receiver<Update>, Status> {
        context.watchers.admit(self.config.max_watchers)?;
        let first = match after {
            None => vec![Update::Snapshot(self.pool.history.newest().map(Arc::downgrade).unwrap_or_default())],
            Some(after) => {
                let missed = self.pool.history.after(after).map_err(status::of_revision)?;
                missed.map(|kept| Update::Revision(Arc::downgrade(kept))).collect()
            }
        };
        context.watch(first)
    }

    fn project(&mut self, new: NewProjection, now: Timestamp) -> Result<ProjectionId, Status> {
        // Checked here and not in the service: a lease that ends from now on ends the projection, too.
        let held_by = match new.lease {
            None => HeldBy::Until(now + self.pool.unbound_ttl()),
            Some(lease) => match self.leases.borrow().known(lease) {
                Known::Lives { opened_by } if !new.by.may_act_for(opened_by) => {
                    return Err(status::lease_of_another(lease, opened_by, &new.by));
                }
                Known::Lives { .. } => HeldBy::Lease(lease),
                Known::Ended => return Err(status::lease_ended(lease)),
                Known::NotYet => return Err(status::lease_not_known(lease)),
            },
        };
        let NewProjection { by, request_id, id, after, base, changes, writers, reads, .. } = new;
        let request = ProjectRequest { by, request_id, id, after, base, changes, writers, reads, held_by };
        self.pool.project(request).map_err(|error: ProjectError| status::of_project(&error))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::super::leases::LiveLeases;
    use super::*;
    use crate::access::Role;
    use tonic::Code;

    #[tokio::test]
    async fn a_projection_is_made_under_a_lease_of_a_session_that_its_caller_opened() {
        let (config, directory) = (WorldPoolConfig::default(), tempfile::tempdir().unwrap());
        let log = Journal::log(&config.storage, directory.path());
        let kept = super::super::open(&config, Arc::new(log)).unwrap();
        let live = watch::Sender::new(LiveLeases::of(LeaseId(3), "world-model", "adam"));
        let over = CancellationToken::new();
        let (actor, _ended) = start(config, None, kept, live.subscribe(), Vitals::default(), over).unwrap();
        let project = async |name: &str, role: Role, lease: u64| {
            let projection = NewProjection {
                by: Caller { name: name.into(), roles: [role].into() },
                request_id: String::new(),
                id: None,
                after: None,
                base: Revision(0),
                changes: Vec::new(),
                writers: Vec::new(),
                reads: Footprint::Everything,
                lease: Some(LeaseId(lease)),
            };
            let made = actor.request(|answer| Message::Project { projection, promise: 0, answer }).await;
            made.map(drop).map_err(|refused| (refused.code(), refused.message().to_owned()))
        };
        for (name, role) in [("adam", Role::Task), ("world", Role::Agent), ("root", Role::Operator)] {
            assert_eq!(project(name, role, 3).await, Ok(()), "{name}");
        }
        let (code, message) = project("eve", Role::Task, 3).await.unwrap_err();
        assert!(code == Code::PermissionDenied && message.contains("of a session of `adam`"), "{message}");
        let ended = project("adam", Role::Task, 2).await.unwrap_err();
        assert_eq!(ended.0, Code::FailedPrecondition, "{}", ended.1);
        let (code, message) = project("adam", Role::Task, 77).await.unwrap_err();
        assert!(code == Code::Unavailable && message.starts_with("lease-77 is not known"), "{message}");
    }

    #[tokio::test]
    async fn what_comes_before_its_projection_or_its_commit_waits_for_that() {
        let (config, directory) = (WorldPoolConfig::default(), tempfile::tempdir().unwrap());
        let log = Journal::log(&config.storage, directory.path());
        let kept = super::super::open(&config, Arc::new(log)).unwrap();
        let live = watch::Sender::new(LiveLeases::default());
        let over = CancellationToken::new();
        let (actor, _ended) = start(config, None, kept, live.subscribe(), Vitals::default(), over).unwrap();
        let adam = Caller { name: "adam".into(), roles: [Role::Task].into() };
        let project = async |request: &str, id: Option<ProjectionId>, after: Option<&str>| {
            let projection = NewProjection {
                by: adam.clone(),
                request_id: request.to_owned(),
                id,
                after: after.map(str::to_owned),
                base: Revision(0),
                changes: Vec::new(),
                writers: Vec::new(),
                reads: Footprint::Everything,
                lease: None,
            };
            actor.request(|answer| Message::Project { projection, promise: 2, answer }).await
        };
        let look = async |id| {
            let (projection, patterns) = (Some(id), Vec::new());
            let view = actor
                .request(|answer| Message::Query { by: "adam".into(), projection, at: None, patterns, answer })
                .await;
            view.map(|view| view.revision).map_err(|status| status.code())
        };
        let (_, ids) = project("first", None, None).await.unwrap();
        let commit = async {
            tokio::time::sleep(Duration::from_millis(20)).await;
            let fact = FactKey { predicate: "at".to_owned(), arguments: Vec::new() };
            let changes = vec![Change::Set { fact, value: ratn_model::value::Value::Int(1) }];
            let commit = Commit { by: adam.clone(), id: "a".to_owned(), changes, ..Commit::default() };
            actor.request(|answer| Message::Commit { commit, answer }).await
        };
        let (seen, made, committed) = tokio::join!(look(ids[0]), project("one", Some(ids[0]), Some("a")), commit);
        assert_eq!((seen, made.unwrap().0, committed.unwrap().0), (Ok(Revision(1)), ids[0], Revision(1)));
        // What these two wait for never comes.
        let began = std::time::Instant::now();
        let (seen, made) = tokio::join!(look(ids[1]), project("two", None, Some("b")));
        assert_eq!((seen, made.unwrap_err().code()), (Err(Code::Unavailable), Code::FailedPrecondition));
        assert!(began.elapsed() >= super::super::parked::PATIENCE);
        // The id is one of an earlier pool: neither call waits.
        let (seen, made) = tokio::time::timeout(Duration::from_millis(900), async {
            tokio::join!(look(ProjectionId(77)), project("three", Some(ProjectionId(77)), Some("b")))
        })
        .await
        .unwrap();
        assert_eq!((seen, made.unwrap_err().code()), (Err(Code::NotFound), Code::FailedPrecondition));
    }
}
