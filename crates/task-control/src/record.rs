//! What must reach the world pool and the resource manager in the order in which it was decided: projections, commits,
//! creation and deletion of task resources. One task, one request at a time.

use super::ledger::{Confirmed, operation_request};
use super::performer::Answer;
use ratn_executive::protocol::Event;
use ratn_model::fact::{Change, Footprint};
use ratn_model::id::{FencingToken, InstanceId, LeaseId, Revision};
use ratn_model::measurement::Evidence;
use ratn_model::resource::{Requirement, ResourceClass, ResourceOperation};
use ratn_otlp::ids;
use ratn_proto::types::Resource;
use ratn_worker::client::retry_unanswered;
use ratn_worker::client::{CallError, Commit, Projection, ResourceClient, WorldClient};
use ratn_worker::session::Trust;
use ratn_worker::trace::{self, TraceContext};
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::sync::{Arc, Mutex, PoisonError};
use tokio::sync::{mpsc, oneshot};

/// How far the world pool may be behind before the run is given up.
pub(super) const MAX_PENDING_RECORDS: usize = 65_536;

/// Others who write without a pause do not hold up a commit more often than this.
const MAX_OVERTAKEN: u32 = 100;

/// One thing to do, in order.
#[derive(Debug)]
pub(super) enum Record {
    Project {
        instance: InstanceId,
        attempt: u32,
        base: Revision,
        changes: Vec<Change>,
        /// Who makes the change at the same place, by path.
        writers: Vec<Arc<str>>,
        reads: Footprint,
        lease: Option<(LeaseId, FencingToken)>,
    },
    Commit(Decided),
    /// The pool's root is at this revision, or has been.
    Known(Revision),
    Operate {
        instance: InstanceId,
        /// Its number in the run.
        number: u64,
        operations: Vec<Requirement>,
    },
    /// Answers once everything before it is done: with the first failure of the run, if there was one.
    Flush(oneshot::Sender<Result<(), String>>),
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

/// How far the recorder is.
pub(super) type Recorded = Arc<Mutex<Confirmed>>;

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
    /// The run's place in its trace.
    pub(super) trace: TraceContext,
    /// The pool's root as far as it is known: what the run's own revisions come to there, and what it was told of others'.
    pub(super) root: Revision,
}

impl Recorder {
    /// Until nobody can ask any more.
    pub(super) async fn work(mut self, mut records: mpsc::Receiver<Record>) {
        let mut recorded = Ok(());
        while let Some(record) = records.recv().await {
            let confirms = confirms(&record);
            let event = match record {
                Record::Project { instance, attempt, base, changes, writers, reads, lease } => {
                    let request = format!("{}/{instance}/{attempt}", self.run);
                    // What the run knows is real there by now, whatever number it has.
                    let base = base.max(self.root);
                    let wanted = Projection { request, base, changes, writers, reads, lease };
                    trace::within(self.of(instance), self.project(instance, attempt, wanted)).await
                }
                Record::Commit(decided) => {
                    let (instance, own) = (decided.instance, self.of(decided.instance));
                    let commit = decided.commit(&self.run);
                    trace::within(own, self.commit(instance, commit)).await
                }
                Record::Known(revision) => {
                    self.root = self.root.max(revision);
                    None
                }
                Record::Operate { instance, number, operations } => {
                    trace::within(self.of(instance), self.operate(instance, number, operations)).await
                }
                Record::Flush(done) => {
                    let _ = done.send(recorded.clone());
                    None
                }
            };
            if let (Some(Event::RetirementFailed { reason, .. }), Ok(())) = (&event, &recorded) {
                recorded = Err(reason.clone());
            }
            // Nothing behind a failure counts: what is confirmed is confirmed without a gap.
            if recorded.is_ok() {
                self.confirm(confirms);
            }
            if let Some(event) = event
                && self.events.send(event.into()).await.is_err()
            {
                return;
            }
        }
    }

    /// The place of an instance in the trace.
    fn of(&self, instance: InstanceId) -> TraceContext {
        self.trace.at(ids::instance(instance.0))
    }

    fn confirm(&self, confirmed: Confirmed) {
        let mut done = self.done.lock().unwrap_or_else(PoisonError::into_inner);
        done.commit = done.commit.max(confirmed.commit);
        done.operation = done.operation.max(confirmed.operation);
    }

    async fn project(&self, instance: InstanceId, attempt: u32, wanted: Projection) -> Option<Event> {
        let cancelled = || self.cancelled.lock().unwrap_or_else(PoisonError::into_inner).remove(&(instance, attempt));
        if cancelled() {
            return None;
        }
        let made = retry_unanswered(|| self.world.project(wanted.clone())).await;
        match made {
            Ok(projection) if cancelled() => {
                let _ = self.world.release(projection).await;
                None
            }
            Ok(projection) => Some(Event::Projected { instance, attempt, projection }),
            Err(error) => {
                Some(Event::Crashed { instance, attempt, reason: format!("no projection: {}", said(&error)) })
            }
        }
    }

    async fn commit(&mut self, instance: InstanceId, commit: Commit) -> Option<Event> {
        if !self.trust.is_kept().await {
            let reason = "its effects are not recorded: the run's session was lost before, and whoever had its resources since may have \
                changed the same"
                .to_owned();
            return Some(Event::RetirementFailed { instance, reason });
        }
        match commit_next(&self.world, self.root, commit).await {
            Ok(revision) => {
                self.root = self.root.max(revision);
                None
            }
            Err(error) => Some(Event::RetirementFailed {
                instance,
                reason: format!("the world pool did not take its effects: {}", said(&error)),
            }),
        }
    }

    async fn operate(&self, instance: InstanceId, number: u64, operations: Vec<Requirement>) -> Option<Event> {
        for (index, operation) in operations.into_iter().enumerate() {
            let request = operation_request(&self.run, instance, number, index);
            if let Err(error) = operate_once(&self.resources, &request, &operation).await {
                let reason = format!("`{operation}` was not done: {}", said(&error));
                return Some(Event::RetirementFailed { instance, reason });
            }
        }
        None
    }
}

/// What is confirmed once a record is done.
fn confirms(record: &Record) -> Confirmed {
    match record {
        Record::Commit(decided) => Confirmed { commit: decided.revision, ..Confirmed::default() },
        Record::Operate { number, .. } => Confirmed { operation: *number, ..Confirmed::default() },
        _ => Confirmed::default(),
    }
}

/// Commits on top of whatever others have committed; the pool's root with it. `known` is a revision that the pool has had: one that
/// has lost it takes nothing.
pub(super) async fn commit_next(
    world: &WorldClient,
    mut known: Revision,
    mut commit: Commit,
) -> Result<Revision, CallError> {
    let mut attempts = MAX_OVERTAKEN;
    loop {
        commit.revision = Some(Revision(known.0 + 1));
        match retry_unanswered(|| world.commit_as(commit.clone())).await {
            Ok((revision, _)) => return Ok(revision),
            Err(error) if error.code() == Some(tonic::Code::FailedPrecondition) && attempts > 0 => {
                attempts -= 1;
                let (_, root) = retry_unanswered(|| world.diff(known, None, &[])).await?;
                if root == known {
                    return Err(error);
                }
                known = root;
            }
            Err(error) => return Err(error),
        }
    }
}

/// Creates, deletes or consumes, once however often it is asked for under this request id.
pub(super) async fn operate_once(
    resources: &ResourceClient,
    request: &str,
    operation: &Requirement,
) -> Result<(), CallError> {
    let ask = async || match operation.operation {
        ResourceOperation::Create => {
            let class = operation.class.unwrap_or(ResourceClass::Task);
            let mut resource = Resource::new("", class, operation.kind.clone()).with_capacity(operation.count);
            resource.divisible = operation.divisible;
            resource.attributes = operation.attributes.clone();
            resources.create_once(request, resource).await.map(|_| ())
        }
        ResourceOperation::Delete => resources.delete_matching_once(request, operation.clone()).await.map(|_| ()),
        ResourceOperation::Consume => resources.consume_once(request, operation.clone()).await.map(|_| ()),
        // The executive gives these to an acquire.
        ResourceOperation::Block | ResourceOperation::Exists => Ok(()),
    };
    retry_unanswered(ask).await
}

/// An error with its sources in one line.
pub(super) fn said(error: &CallError) -> String {
    format!("{:#}", anyhow::Error::new(error.clone()))
}
