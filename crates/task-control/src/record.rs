//! Performs in the order of decision what must reach the world pool and the resource manager: projections, commits, creation and deletion of task
//! resources. It is one task and makes one change at a time; projections that include a commit are requested while that commit is under way.

use super::decided::{Unanswered, Undone, insist};
use super::ledger::{Began, Confirmed, Guard, Projecting, created, operation_request};
use super::performer::{Answer, Untouched};
use super::promises::{Made, Promises};
use super::safe_on_disk::Mark;
use super::waits_for::{Waiting, WaitsFor};
use futures::FutureExt;
use ratn_executive::protocol::{Event, Unmade};
use ratn_model::fact::Change;
use ratn_model::id::{InstanceId, ProjectionId, Revision};
use ratn_model::measurement::Evidence;
use ratn_model::resource::{OperatedUnits, Requirement, ResourceClass, ResourceOperation};
use ratn_otlp::ids;
use ratn_proto::types::Resource;
use ratn_worker::client::retry_unanswered;
use ratn_worker::client::{CallError, Commit, Early, Projection, ResourceClient, WorldClient};
use ratn_worker::session::Trust;
use ratn_worker::trace::{self, TraceContext};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::pin::pin;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;
use tokio::sync::{mpsc, oneshot, watch};
use tokio_util::sync::{CancellationToken, DropGuard};

/// How far the world pool may be behind before the run is given up.
pub(super) const MAX_PENDING_RECORDS: usize = 65_536;

/// How often a commit is repeated at most because others write without a pause.
const MAX_OVERTAKEN: u32 = 100;

/// Reason codes of the world pool.
const NO_SUCH_COMMIT: &str = "NO_SUCH_COMMIT";
const ENDED: &str = "PROJECTION_ENDED";
const REUSED: &str = "REQUEST_ID_REUSED";

/// One thing to do, in order.
#[derive(Debug)]
pub(super) enum Record {
    Project {
        instance: InstanceId,
        asked: Projecting,
        /// The id under which its goal has the projection already.
        named: Option<Named>,
    },
    Commit {
        decided: Decided,
        /// The condition under which it is made, if the run has lost, or given back, the leases with which it was made.
        untouched: Option<Box<Untouched>>,
        /// What has to be safe on disk first.
        safe: Option<Mark>,
    },
    Operate {
        instance: InstanceId,
        /// Its number in the run.
        number: u64,
        operations: Vec<Requirement>,
        order: Order,
    },
    /// A failure before task control was restarted: nothing is performed behind it.
    Failed(String),
    /// Answers once everything before it is done, with the first failure of the run, if there was one.
    Flush(oneshot::Sender<Result<(), String>>),
}

/// The order of an operation relative to the leases of the run.
#[derive(Debug)]
pub(super) struct Order {
    /// What has to be safe on disk first.
    pub(super) safe: Option<Mark>,
    /// Leases that were given back before and may contain what is used up or deleted: each token is cancelled when its lease is back.
    pub(super) after: Vec<CancellationToken>,
    /// Dropped when the operation has its answer: requests that wait for it are sent then.
    pub(super) _ends: DropGuard,
}

/// A projection that has an id before it exists.
#[derive(Debug)]
pub(super) struct Named {
    pub(super) id: ProjectionId,
    /// Told when the projection exists.
    pub(super) made: oneshot::Sender<Made>,
    /// Whether it may have been requested before task control was restarted.
    pub(super) again: bool,
}

/// The changes by an instance, to become real.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Decided {
    pub(super) instance: InstanceId,
    /// The path of the instance or composite state.
    pub(super) writer: String,
    pub(super) changes: Vec<Change>,
    pub(super) evidence: Evidence,
    /// The revision of the run's root after it: the same as the pool's, as long as nobody else writes into that.
    pub(super) revision: Revision,
    /// How the instance or composite state began.
    pub(super) began: Began,
    /// What guarded it, if a goal has made it.
    #[serde(default)]
    pub(super) guard: Option<Guard>,
    /// The pool's revision that the run had heard of when the commit was decided.
    pub(super) knew: Revision,
    /// Number of operations that were decided before it: the commit is made behind them.
    pub(super) behind: u64,
}

impl Decided {
    /// The commit as the world pool gets it.
    pub(super) fn commit(self, run: &str) -> Commit {
        let id = self.id(run);
        let Decided { writer, changes, evidence, .. } = self;
        Commit { id, changes, revision: None, writer, evidence }
    }

    /// The commit's id. One instance may commit more than once (the parts of a routine); the revision tells its commits apart.
    pub(super) fn id(&self, run: &str) -> String {
        format!("{run}/{}/{}", self.instance, self.revision)
    }
}

/// Attempts whose projection is not needed any more.
pub(super) type Cancelled = Arc<Mutex<BTreeSet<(InstanceId, u32)>>>;

/// How far the recorder is. Goals that read the root wait for it.
pub(super) type Recorded = Arc<watch::Sender<Confirmed>>;

/// The task that performs the records.
pub(super) struct Recorder {
    pub(super) run: String,
    pub(super) world: WorldClient,
    pub(super) resources: ResourceClient,
    pub(super) cancelled: Cancelled,
    pub(super) done: Recorded,
    pub(super) events: mpsc::Sender<Answer>,
    /// Whether the run's session lives: what the run no longer holds may have been changed by others.
    pub(super) trust: Trust,
    /// The number of the session.
    pub(super) session: u64,
    /// The run's place in its trace.
    pub(super) trace: TraceContext,
    pub(super) root: Root,
    /// Receives the ids that the pool promises.
    pub(super) promises: Promises,
    /// What the recorder waits for.
    pub(super) waiting: Waiting,
}

/// The pool's root as far as it is known: from the run's own commits, and from what it was told of others'. Clones share it.
#[derive(Debug, Clone, Default)]
pub(super) struct Root(Arc<AtomicU64>);

impl Root {
    pub(super) fn get(&self) -> Revision {
        Revision(self.0.load(Ordering::SeqCst))
    }

    /// The pool's root has, or had, this revision.
    pub(super) fn reached(&self, revision: Revision) {
        self.0.fetch_max(revision.0, Ordering::SeqCst);
    }
}

/// A commit under way.
#[derive(Debug, Clone)]
struct UnderWay {
    id: String,
    /// Cancelled when the commit has its answer.
    over: CancellationToken,
}

impl Recorder {
    /// Works until no more records can come.
    pub(super) async fn work(self, mut records: mpsc::Receiver<Record>) {
        let (mut recorded, mut next) = (Ok(()), None);
        loop {
            let record = match next.take() {
                Some(record) => record,
                None => match records.recv().await {
                    Some(record) => record,
                    None => return,
                },
            };
            let (confirms, mut behind) = (confirms(&record), None);
            let event = match record {
                Record::Project { instance, asked, named } => {
                    self.project(instance, asked, named, None);
                    None
                }
                // Nothing is performed behind a failure: the world is that of a prefix of what was decided.
                Record::Commit { decided: Decided { instance, .. }, .. } | Record::Operate { instance, .. }
                    if let Err(reason) = &recorded =>
                {
                    let reason = format!("not done behind what failed: {reason}");
                    Some(Event::RetirementFailed { instance, reason, unmade: Unmade::Untried })
                }
                Record::Commit { decided, untouched, safe } => {
                    let over = CancellationToken::new();
                    let (instance, under_way) = (decided.instance, UnderWay { id: decided.id(&self.run), over });
                    let _answered = under_way.over.clone().drop_guard();
                    let mut with_it = Vec::new();
                    let mut safe = pin!(self.unsafe_on_disk(instance, safe));
                    let refused = loop {
                        tokio::select! {
                            biased;
                            refused = &mut safe => break refused,
                            Some(record) = records.recv(), if next.is_none() => match record {
                                Record::Project { instance, asked, named } => with_it.push((instance, asked, named)),
                                record => next = Some(record),
                            },
                        }
                    };
                    let committing = async {
                        match refused {
                            Some(refused) => Some(refused),
                            None => self.commit(instance, decided.commit(&self.run), untouched.map(|it| *it)).await,
                        }
                    };
                    let mut committing = pin!(trace::within(self.of(instance), committing));
                    // The commit is sent here, and the projections right behind it: the world pool is woken once.
                    let answered = committing.as_mut().now_or_never();
                    for (instance, asked, named) in with_it {
                        self.project(instance, asked, named, Some(under_way.clone()));
                    }
                    match answered {
                        Some(event) => event,
                        None => loop {
                            tokio::select! {
                                biased;
                                event = &mut committing => break event,
                                Some(record) = records.recv(), if next.is_none() => match record {
                                    Record::Project { instance, asked, named } => {
                                        self.project(instance, asked, named, Some(under_way.clone()));
                                    }
                                    record => next = Some(record),
                                },
                            }
                        },
                    }
                }
                Record::Operate { instance, number, operations, order } => {
                    let operating = self.operate(instance, number, operations, &order);
                    let operated = trace::within(self.of(instance), operating).await;
                    behind = Some(order);
                    // The event is logged, so that a resumption does not repeat the operation.
                    Some(operated.unwrap_or_else(|failed| failed))
                }
                Record::Failed(reason) => {
                    recorded = recorded.and(Err(reason));
                    None
                }
                Record::Flush(done) => {
                    let _ = done.send(recorded.clone());
                    None
                }
            };
            if let (Some(Event::RetirementFailed { reason, instance, unmade }), Ok(())) = (&event, &recorded) {
                recorded = Err(reason.clone());
                self.done.send_modify(|done| done.failed = Some((*instance, *unmade)));
            }
            // Nothing behind a failure counts: confirmations have no gap.
            if recorded.is_ok() {
                self.confirm(confirms);
            }
            self.waiting.set(WaitsFor::Nobody);
            // If nobody receives events any more, the run has ended, and a flush tells it the first failure.
            if let Some(event) = event {
                let _ = self.events.send(event.into()).await;
            }
            // No acquire behind an operation is sent before the executive hears that the operation has failed.
            drop(behind);
        }
    }

    /// The place of an instance in the trace.
    fn of(&self, instance: InstanceId) -> TraceContext {
        self.trace.at(ids::instance(instance.0))
    }

    fn confirm(&self, confirmed: Confirmed) {
        self.done.send_if_modified(|done| {
            let before = *done;
            done.commit = done.commit.max(confirmed.commit);
            done.operation = done.operation.max(confirmed.operation);
            *done != before
        });
    }

    /// Starts to make a projection.
    fn project(&self, instance: InstanceId, asked: Projecting, named: Option<Named>, after: Option<UnderWay>) {
        let Projecting { attempt, base, changes, writers, reads, lease, .. } = asked;
        let request = format!("{}/{instance}/{attempt}", self.run);
        let making = MakingProjection {
            instance,
            attempt,
            wanted: Projection { request, base, changes, writers, reads, lease },
            named,
            after,
            world: self.world.clone(),
            cancelled: self.cancelled.clone(),
            root: self.root.clone(),
            promises: self.promises.clone(),
        };
        let (own, events) = (self.of(instance), self.events.clone());
        let mut making = Box::pin(trace::within(own, async move {
            if let Some(event) = making.make().await {
                let _ = events.send(event.into()).await;
            }
        }));
        // The request is sent here, so that it goes with the commit before it.
        if making.as_mut().now_or_never().is_none() {
            tokio::spawn(making);
        }
    }

    /// The failure event, if what has to be safe on disk never will be.
    async fn unsafe_on_disk(&self, instance: InstanceId, safe: Option<Mark>) -> Option<Event> {
        self.waiting.set(WaitsFor::Disk);
        let is_safe = match safe {
            Some(safe) => safe.safe().await,
            None => true,
        };
        let reason = || "the event log, which says what has happened, cannot be made safe on its disk".to_owned();
        (!is_safe).then(|| Event::RetirementFailed { instance, reason: reason(), unmade: Unmade::Untried })
    }

    async fn commit(&self, instance: InstanceId, commit: Commit, untouched: Option<Untouched>) -> Option<Event> {
        self.waiting.set(WaitsFor::WorldPool);
        let reason = match commit_next(&self.world, &self.trust, self.root.get(), commit, untouched).await {
            Ok(revision) => {
                self.root.reached(revision);
                return None;
            }
            Err(lost @ (Undone::Lost | Undone::Overtaken(_))) => format!("its effects are not recorded: {lost}"),
            Err(failed) => format!("the world pool did not take its effects: {failed}"),
        };
        Some(Event::RetirementFailed { instance, reason, unmade: Unmade::Untried })
    }

    async fn operate(
        &self,
        instance: InstanceId,
        number: u64,
        operations: Vec<Requirement>,
        order: &Order,
    ) -> Result<Event, Event> {
        if let Some(refused) = self.unsafe_on_disk(instance, order.safe.clone()).await {
            return Err(refused);
        }
        self.waiting.set(WaitsFor::Leases);
        for lease in &order.after {
            lease.cancelled().await;
        }
        self.waiting.set(WaitsFor::ResourceManager);
        let mut units = Vec::with_capacity(operations.len());
        for (index, operation) in operations.into_iter().enumerate() {
            let request = operation_request(&self.run, instance, number, index);
            match operate_once(&self.resources, &self.trust, &request, &operation).await {
                Ok(done) => units.push(done),
                Err(undone) => {
                    let reason = format!("`{operation}` was not done: {undone}");
                    // If the session was lost, the operation was not refused, and may be done by whoever resumes the run.
                    let lost = matches!(undone, Undone::Lost);
                    let unmade = if lost { Unmade::Untried } else { Unmade::Operation(number) };
                    return Err(Event::RetirementFailed { instance, reason, unmade });
                }
            }
        }
        Ok(recorded(number, self.session, units))
    }
}

/// A projection that is being made.
struct MakingProjection {
    instance: InstanceId,
    attempt: u32,
    wanted: Projection,
    named: Option<Named>,
    after: Option<UnderWay>,
    world: WorldClient,
    cancelled: Cancelled,
    root: Root,
    promises: Promises,
}

impl MakingProjection {
    /// Makes the projection; returns the resulting event, if there is one.
    async fn make(mut self) -> Option<Event> {
        let (instance, attempt) = (self.instance, self.attempt);
        if self.is_cancelled() {
            self.take_back().await;
            return None;
        }
        let made = self.ask().await;
        match (made, self.named.take()) {
            (Ok(_), Some(named)) => {
                // Nobody receives this message if the goal is under way already.
                let _ = named.made.send(Made);
                None
            }
            (Ok(projection), None) if self.is_cancelled() => {
                let _ = self.world.release(projection).await;
                None
            }
            (Ok(projection), None) => Some(Event::Projected { instance, attempt, projection }),
            // The projection existed, whatever has become of it: its goal knows.
            (Err(error), Some(Named { again: true, .. })) if matches!(error.reason(), ENDED | REUSED) => None,
            (Err(error), named) => {
                // If the world pool was started again, it has promised nothing.
                self.promises.forget();
                self.named = named;
                self.take_back().await;
                Some(Event::Crashed {
                    instance,
                    attempt,
                    reason: format!("no projection: {}", said(&error)),
                    unknown: false,
                    refused: false,
                })
            }
        }
    }

    /// The projection will not be made: a worker that waits for it is told so.
    async fn take_back(&mut self) {
        if let Some(named) = self.named.take() {
            let _ = retry_unanswered(|| self.world.release(named.id)).await;
        }
    }

    /// Asks the world pool, repeatedly if the commit below the projection takes long.
    async fn ask(&mut self) -> Result<ProjectionId, CallError> {
        loop {
            // What the run knows is real in the pool by now, whatever its revision there.
            let base = self.wanted.base.max(self.root.get());
            let wanted = Projection { base, ..self.wanted.clone() };
            let after = self.after.as_ref().map(|commit| commit.id.clone());
            let id = self.named.as_ref().map(|named| named.id);
            let early = Early { id, after, promise: self.promises.wanted(Instant::now()) };
            match retry_unanswered(|| self.world.project_early(wanted.clone(), early.clone())).await {
                Ok((projection, promised)) => {
                    self.promises.add(promised, Instant::now());
                    return Ok(projection);
                }
                Err(error) => match (error.reason(), self.after.take()) {
                    (NO_SUCH_COMMIT, Some(commit)) => commit.over.cancelled().await,
                    _ => return Err(error),
                },
            }
        }
    }

    fn is_cancelled(&self) -> bool {
        let mut cancelled = self.cancelled.lock().unwrap_or_else(PoisonError::into_inner);
        cancelled.remove(&(self.instance, self.attempt))
    }
}

/// What is confirmed once a record is done.
fn confirms(record: &Record) -> Confirmed {
    match record {
        Record::Commit { decided, .. } => Confirmed { commit: decided.revision, ..Confirmed::default() },
        Record::Operate { number, .. } => Confirmed { operation: *number, ..Confirmed::default() },
        _ => Confirmed::default(),
    }
}

/// Commits on top of whatever others have committed, while the run's session lives; returns the pool's root, too. `known` is a revision that the pool
/// has had: a pool that has lost it takes nothing. The run is asked whether its session lives after the root was read and before the commit, so what
/// others had committed before, they committed while the run held what its commit is about. What was made with leases that the run has lost since is
/// committed only if it is `untouched` up to the root on which it is made.
pub(super) async fn commit_next(
    world: &WorldClient,
    trust: &Trust,
    mut known: Revision,
    mut commit: Commit,
    mut untouched: Option<Untouched>,
) -> Result<Revision, Undone> {
    let mut attempts = MAX_OVERTAKEN;
    loop {
        if let Some(untouched) = &mut untouched {
            untouched.up_to(known, (world, trust), (&commit.writer, &commit.changes)).await?;
        }
        commit.revision = Some(Revision(known.0 + 1));
        match insist(trust, Unanswered::GivenUp, || world.commit_as(commit.clone())).await {
            Ok((revision, _)) => return Ok(revision),
            Err(Undone::Failed(error)) if error.code() == Some(tonic::Code::FailedPrecondition) && attempts > 0 => {
                attempts -= 1;
                let (_, root) = insist(trust, Unanswered::GivenUp, || world.diff(known, None, &[])).await?;
                if root == known {
                    return Err(Undone::Failed(error));
                }
                known = root;
            }
            Err(undone) => return Err(undone),
        }
    }
}

/// The event of an operation that is done, in the session of this number; with its units if all of them are known.
pub(super) fn recorded(operation: u64, session: u64, units: Vec<Option<Vec<OperatedUnits>>>) -> Event {
    let units = units.into_iter().collect::<Option<Vec<_>>>().unwrap_or_default();
    Event::Recorded { operation, session, units, renamed: BTreeMap::new() }
}

/// Creates, deletes or consumes, once however often it is requested under this id; waits for an absent resource manager as long as the run's session
/// may live. Returns the units, if the manager reports them.
pub(super) async fn operate_once(
    resources: &ResourceClient,
    trust: &Trust,
    request: &str,
    operation: &Requirement,
) -> Result<Option<Vec<OperatedUnits>>, Undone> {
    let ask = async || match operation.operation {
        ResourceOperation::Create => {
            let class = operation.class.unwrap_or(ResourceClass::Task);
            let mut resource = Resource::new("", class, operation.kind.clone()).with_capacity(operation.count);
            resource.divisible = operation.divisible;
            resource.attributes = operation.attributes.clone();
            resources.create_once(request, resource).await.map(|made| Some(vec![created(operation, &made.id)]))
        }
        ResourceOperation::Delete => resources.delete_units_once(request, operation.clone()).await,
        ResourceOperation::Consume => resources.consume_units_once(request, operation.clone(), "").await,
        // The executive puts these into an acquire.
        ResourceOperation::Block | ResourceOperation::Exists => Ok(Some(Vec::new())),
    };
    insist(trust, Unanswered::Waits, ask).await
}

/// An error with its sources in one line.
pub(super) fn said(error: &CallError) -> String {
    format!("{:#}", anyhow::Error::new(error.clone()))
}
