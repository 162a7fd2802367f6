//! What must reach the world pool and the resource manager in the order in which it was decided: projections, commits,
//! creation and deletion of task resources. One task; what changes something is one request at a time, and projections of what a commit makes are
//! asked for while that is on its way.

use super::decided::{Unanswered, Undone, insist};
use super::ledger::{Began, Confirmed, Projecting, created, operation_request};
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

/// Others who write without a pause do not hold up a commit more often than this.
const MAX_OVERTAKEN: u32 = 100;

/// As the world pool names its refusals.
const NO_SUCH_COMMIT: &str = "NO_SUCH_COMMIT";
const ENDED: &str = "PROJECTION_ENDED";
const REUSED: &str = "REQUEST_ID_REUSED";

/// One thing to do, in order.
#[derive(Debug)]
pub(super) enum Record {
    Project {
        instance: InstanceId,
        asked: Projecting,
        /// Where its goal has it already.
        named: Option<Named>,
    },
    Commit {
        decided: Decided,
        /// Under which condition it is made, where the run has lost, or given back, what it was made with.
        untouched: Option<Untouched>,
        /// What has to be safe before.
        safe: Option<Mark>,
    },
    Operate {
        instance: InstanceId,
        /// Its number in the run.
        number: u64,
        operations: Vec<Requirement>,
        order: Order,
    },
    /// Something had failed before task control was gone: nothing is made behind that.
    Failed(String),
    /// Answers once everything before it is done: with the first failure of the run, if there was one.
    Flush(oneshot::Sender<Result<(), String>>),
}

/// The place of an operation among the leases of the run.
#[derive(Debug)]
pub(super) struct Order {
    /// What has to be safe before.
    pub(super) safe: Option<Mark>,
    /// Leases that were given back before and may be what is used up or deleted: each token is cancelled when its lease is back.
    pub(super) after: Vec<CancellationToken>,
    /// Is dropped when it has its answer: what is asked for behind it leaves then.
    pub(super) _ends: DropGuard,
}

/// A projection that was named before it is there.
#[derive(Debug)]
pub(super) struct Named {
    pub(super) id: ProjectionId,
    /// Told when it is there.
    pub(super) made: oneshot::Sender<Made>,
    /// Whether it may have been asked for before task control was gone.
    pub(super) again: bool,
}

/// What an instance has changed, to become real.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Decided {
    pub(super) instance: InstanceId,
    /// By path.
    pub(super) writer: String,
    pub(super) changes: Vec<Change>,
    pub(super) evidence: Evidence,
    /// What the run's root becomes: the pool's, as long as nobody else writes into it.
    pub(super) revision: Revision,
    /// How what led to that began.
    pub(super) began: Began,
    /// The pool's revision that the run had heard of when it was decided.
    pub(super) knew: Revision,
    /// How many operations were decided before it: it is made behind them.
    pub(super) behind: u64,
}

impl Decided {
    /// As the world pool is asked for it by the run.
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

/// Attempts whose projection nobody waits for any more.
pub(super) type Cancelled = Arc<Mutex<BTreeSet<(InstanceId, u32)>>>;

/// How far the recorder is. Goals that look at the root wait for that.
pub(super) type Recorded = Arc<watch::Sender<Confirmed>>;

/// The task that does it.
pub(super) struct Recorder {
    pub(super) run: String,
    pub(super) world: WorldClient,
    pub(super) resources: ResourceClient,
    pub(super) cancelled: Cancelled,
    pub(super) done: Recorded,
    pub(super) events: mpsc::Sender<Answer>,
    /// The run's session: what it no longer holds others may have changed since.
    pub(super) trust: Trust,
    /// Its number.
    pub(super) session: u64,
    /// The run's place in its trace.
    pub(super) trace: TraceContext,
    pub(super) root: Root,
    /// What the pool promises goes there.
    pub(super) promises: Promises,
    /// Whom it waits for.
    pub(super) waiting: Waiting,
}

/// The pool's root as far as it is known: what the run's own revisions come to there, and what it was told of others'. Clones share it.
#[derive(Debug, Clone, Default)]
pub(super) struct Root(Arc<AtomicU64>);

impl Root {
    pub(super) fn get(&self) -> Revision {
        Revision(self.0.load(Ordering::SeqCst))
    }

    /// The pool's root is at this revision, or has been.
    pub(super) fn reached(&self, revision: Revision) {
        self.0.fetch_max(revision.0, Ordering::SeqCst);
    }
}

/// A commit that is on its way.
#[derive(Debug, Clone)]
struct UnderWay {
    id: String,
    /// When it has its answer.
    over: CancellationToken,
}

impl Recorder {
    /// Until nobody can ask any more.
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
                // Nothing is made behind what was not: the world is that of a prefix of what was decided.
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
                            None => self.commit(instance, decided.commit(&self.run), untouched).await,
                        }
                    };
                    let mut committing = pin!(trace::within(self.of(instance), committing));
                    // It leaves here, and these right behind it: the world pool is woken once.
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
                    // Whoever resumes the run does not do it again.
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
            // Nothing behind a failure counts: what is confirmed is confirmed without a gap.
            if recorded.is_ok() {
                self.confirm(confirms);
            }
            self.waiting.set(WaitsFor::Nobody);
            // Where nobody hears of events any more, the run has ended and is told of the first failure by a flush.
            if let Some(event) = event {
                let _ = self.events.send(event.into()).await;
            }
            // Nobody is granted anything behind an operation before it is heard that this has failed.
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

    /// Begins to have a projection made.
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
        // It is asked for here, so that it goes with the commit before it.
        if making.as_mut().now_or_never().is_none() {
            tokio::spawn(making);
        }
    }

    /// The failure, where what has to be safe before never will be.
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
                    // With the session lost it was not refused, and may be done by whoever resumes the run.
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
    /// The event that it leads to, if any.
    async fn make(mut self) -> Option<Event> {
        let (instance, attempt) = (self.instance, self.attempt);
        if self.is_cancelled() {
            self.take_back().await;
            return None;
        }
        let made = self.ask().await;
        match (made, self.named.take()) {
            (Ok(_), Some(named)) => {
                // Nobody waits for that where its goal is under way.
                let _ = named.made.send(Made);
                None
            }
            (Ok(projection), None) if self.is_cancelled() => {
                let _ = self.world.release(projection).await;
                None
            }
            (Ok(projection), None) => Some(Event::Projected { instance, attempt, projection }),
            // It was there, whatever has become of it: its goal knows.
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
                })
            }
        }
    }

    /// It will not be made: a worker that waits for it need not wait longer.
    async fn take_back(&mut self) {
        if let Some(named) = self.named.take() {
            let _ = retry_unanswered(|| self.world.release(named.id)).await;
        }
    }

    /// Asks the world pool, again where the commit below it takes long.
    async fn ask(&mut self) -> Result<ProjectionId, CallError> {
        loop {
            // What the run knows is real there by now, whatever number it has.
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

/// Commits on top of whatever others have committed, while the run has what it had; the pool's root with it. `known` is a revision that the
/// pool has had: one that has lost it takes nothing. What others committed before the run is asked whether it has what it had, they committed while
/// the run held what its commit is about; so that is asked behind the reading of the root and before the commit. What was made with what the run has
/// lost since is committed only where it is `untouched` up to the root on which it is made.
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

/// An operation is done, in the session of this number, and has come to these units, if all of that is known.
pub(super) fn recorded(operation: u64, session: u64, units: Vec<Option<Vec<OperatedUnits>>>) -> Event {
    let units = units.into_iter().collect::<Option<Vec<_>>>().unwrap_or_default();
    Event::Recorded { operation, session, units, renamed: BTreeMap::new() }
}

/// Creates, deletes or consumes, once however often it is asked for under this request id; a resource manager that is away is waited for as long as
/// the run's session may live. What it has come to, if the manager says that.
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
        // The executive gives these to an acquire.
        ResourceOperation::Block | ResourceOperation::Exists => Ok(Some(Vec::new())),
    };
    insist(trust, Unanswered::Waits, ask).await
}

/// An error with its sources in one line.
pub(super) fn said(error: &CallError) -> String {
    format!("{:#}", anyhow::Error::new(error.clone()))
}
