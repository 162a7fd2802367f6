//! What must reach the world pool and the resource manager in the order in which it was decided: projections, commits,
//! creation and deletion of task resources. One task, one request at a time.

use super::ledger::operation_request;
use super::performer::{Answer, commit_request};
use super::retry::{Attempts, patiently};
use ratn_executive::protocol::Event;
use ratn_model::fact::{Change, Footprint};
use ratn_model::id::{FencingToken, InstanceId, LeaseId, Revision};
use ratn_model::resource::{Requirement, ResourceClass, ResourceOperation};
use ratn_proto::types::Resource;
use ratn_worker::client::{CallError, Commit, Projection, ResourceClient, WorldClient};
use std::collections::BTreeSet;
use std::sync::{Arc, Mutex, PoisonError};
use tokio::sync::{mpsc, oneshot};

/// How far the world pool may be behind before the run is given up.
pub(super) const MAX_PENDING_RECORDS: usize = 65_536;

/// One thing to do, in order.
#[derive(Debug)]
pub(super) enum Record {
    Project {
        instance: InstanceId,
        attempt: u32,
        base: Revision,
        changes: Vec<Change>,
        reads: Footprint,
        lease: Option<(LeaseId, FencingToken)>,
    },
    Commit {
        instance: InstanceId,
        changes: Vec<Change>,
        revision: Revision,
        /// The instance's path; empty where it is not known.
        writer: String,
    },
    Operate {
        instance: InstanceId,
        /// Its number in the run.
        number: u64,
        operations: Vec<Requirement>,
    },
    /// Answers once everything before it is done: with the first failure of the run, if there was one.
    Flush(oneshot::Sender<Result<(), String>>),
}

/// Attempts whose projection nobody waits for any more.
pub(super) type Cancelled = Arc<Mutex<BTreeSet<(InstanceId, u32)>>>;

/// The task that does it.
pub(super) struct Recorder {
    pub(super) run: String,
    pub(super) world: WorldClient,
    pub(super) resources: ResourceClient,
    pub(super) cancelled: Cancelled,
    pub(super) events: mpsc::Sender<Answer>,
}

impl Recorder {
    /// Until nobody can ask any more.
    pub(super) async fn work(self, mut records: mpsc::Receiver<Record>) {
        let mut recorded = Ok(());
        while let Some(record) = records.recv().await {
            let event = match record {
                Record::Project { instance, attempt, base, changes, reads, lease } => {
                    let request = format!("{}/{instance}/{attempt}", self.run);
                    let writers = Vec::new();
                    let wanted = Projection { request, base, changes, writers, reads, lease };
                    self.project(instance, attempt, wanted).await
                }
                Record::Commit { instance, changes, revision, writer } => {
                    let id = commit_request(&self.run, instance, revision);
                    let commit = Commit { id, changes, revision: Some(revision), writer, ..Commit::default() };
                    self.commit(instance, commit).await
                }
                Record::Operate { instance, number, operations } => self.operate(instance, number, operations).await,
                Record::Flush(done) => {
                    let _ = done.send(recorded.clone());
                    None
                }
            };
            if let (Some(Event::RetirementFailed { reason, .. }), Ok(())) = (&event, &recorded) {
                recorded = Err(reason.clone());
            }
            if let Some(event) = event
                && self.events.send(event.into()).await.is_err()
            {
                return;
            }
        }
    }

    async fn project(&self, instance: InstanceId, attempt: u32, wanted: Projection) -> Option<Event> {
        let cancelled = || self.cancelled.lock().unwrap_or_else(PoisonError::into_inner).remove(&(instance, attempt));
        if cancelled() {
            return None;
        }
        let made = patiently(Attempts::IDEMPOTENT, || self.world.project(wanted.clone())).await;
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

    async fn commit(&self, instance: InstanceId, commit: Commit) -> Option<Event> {
        match patiently(Attempts::IDEMPOTENT, || self.world.commit_as(commit.clone())).await {
            Ok(_) => None,
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
    patiently(Attempts::IDEMPOTENT, ask).await
}

/// An error with its sources in one line.
pub(super) fn said(error: &CallError) -> String {
    format!("{:#}", anyhow::Error::new(error.clone()))
}
