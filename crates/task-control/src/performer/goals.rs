//! The goals of a run that have not ended: at most one per instance has a result that somebody awaits; most others were cancelled. A provider
//! performs one goal at a time, and a cancel travels on another path than a goal: the next goal of the same resource is sent when the previous one
//! has ended, so that it is not refused as one too many. A goal that acts waits for every cancelled one before it in the program that acts, too: in a
//! sequential program one thing moves at a time. A lease is released when all goals under it have ended, so that the next holder finds its resources
//! idle; where it is not known of one whether it still moves, the release says so.

use ratn_model::id::{InstanceId, LeaseId};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

/// A goal whose result is awaited.
#[derive(Debug)]
pub(super) struct Job {
    pub(super) attempt: u32,
    /// The lease that it works under; a routine's lease serves several jobs.
    pub(super) lease: Option<LeaseId>,
    /// The resource that performs it; empty if there is none.
    pub(super) resource: String,
    /// Whether it changes the environment: it neither only computes nor only senses.
    pub(super) acts: bool,
    /// Cancelled when it is to end.
    pub(super) stop: CancellationToken,
    pub(super) ended: JoinHandle<()>,
    /// Cancelled when it has ended.
    pub(super) over: CancellationToken,
}

/// A goal that has not ended and whose result nobody awaits.
#[derive(Debug)]
struct Ending {
    instance: InstanceId,
    lease: Option<LeaseId>,
    resource: String,
    acts: bool,
    over: CancellationToken,
}

/// The leases for which something may still move: a goal under them was lost, or did not end when it was told to. Clones share them.
#[derive(Debug, Clone, Default)]
pub(super) struct Doubtful(Arc<Mutex<BTreeSet<LeaseId>>>);

impl Doubtful {
    pub(super) fn add(&self, leases: impl IntoIterator<Item = LeaseId>) {
        self.leases().extend(leases);
    }

    pub(super) fn has(&self, lease: LeaseId) -> bool {
        self.leases().contains(&lease)
    }

    /// The lease goes back: whether it is known that nothing moves for it.
    pub(super) fn goes_back_at_rest(&self, lease: LeaseId) -> bool {
        !self.leases().remove(&lease)
    }

    fn leases(&self) -> MutexGuard<'_, BTreeSet<LeaseId>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The goals of a run.
#[derive(Debug, Default)]
pub(super) struct Goals {
    awaited: BTreeMap<InstanceId, Job>,
    ending: Vec<Ending>,
    pub(super) doubtful: Doubtful,
}

impl Goals {
    /// Awaits the result of a goal, in place of an earlier one of the same instance.
    pub(super) fn awaits(&mut self, instance: InstanceId, job: Job) {
        if let Some(before) = self.awaited.insert(instance, job) {
            self.leave(instance, &before);
        }
    }

    /// Cancels a goal whose result nobody awaits.
    pub(super) fn stop(&mut self, instance: InstanceId, job: &Job) {
        job.stop.cancel();
        self.leave(instance, job);
    }

    /// Cancels the goal of an attempt; false if there is none whose result is awaited.
    pub(super) fn cancel(&mut self, instance: InstanceId, attempt: u32) -> bool {
        let Some(job) = self.awaited.get(&instance).filter(|job| job.attempt == attempt) else { return false };
        job.stop.cancel();
        self.ending.extend(Ending::of(instance, job));
        true
    }

    /// The results of an instance's goal, and of those under its lease, are not awaited any more. Each returned token is cancelled when its goal has
    /// ended.
    pub(super) fn leave_all(&mut self, instance: InstanceId, lease: Option<LeaseId>) -> Vec<CancellationToken> {
        let is_meant = |id: InstanceId, job: &Job| id == instance || (lease.is_some() && job.lease == lease);
        let left: Vec<_> = self.awaited.extract_if(.., |id, job| is_meant(*id, job)).collect();
        left.iter().for_each(|(id, job)| self.leave(*id, job));
        left.into_iter().map(|(_, job)| job.over).collect()
    }

    /// The goals that must end before this instance's goal of a resource begins: each token is cancelled when its goal has ended.
    pub(super) fn before(
        &mut self,
        instance: InstanceId,
        lease: Option<LeaseId>,
        resource: &str,
        acts: bool,
    ) -> Vec<CancellationToken> {
        self.of(|ending| {
            // Instances are numbered in the order of the program.
            let is_earlier = ending.instance <= instance || lease.is_some() && ending.lease == lease;
            ending.resource == resource || acts && ending.acts && is_earlier
        })
    }

    /// The goals that must end before this lease is released, likewise.
    pub(super) fn under(&mut self, lease: LeaseId) -> Vec<CancellationToken> {
        self.of(|ending| ending.lease == Some(lease))
    }

    /// Whether no goal with an awaited result is under way.
    pub(super) fn are_idle(&self) -> bool {
        self.awaited.values().all(|job| job.ended.is_finished())
    }

    /// Nobody awaits a goal's result any more.
    fn leave(&mut self, instance: InstanceId, job: &Job) {
        self.ending.extend(Ending::of(instance, job));
    }

    fn of(&mut self, is_meant: impl Fn(&Ending) -> bool) -> Vec<CancellationToken> {
        self.ending.retain(|ending| !ending.over.is_cancelled());
        self.ending.iter().filter(|ending| is_meant(ending)).map(|ending| ending.over.clone()).collect()
    }
}

impl Ending {
    /// `None` if the goal has ended.
    fn of(instance: InstanceId, job: &Job) -> Option<Ending> {
        let Job { lease, acts, .. } = *job;
        let (resource, over) = (job.resource.clone(), job.over.clone());
        (!job.ended.is_finished()).then_some(Ending { instance, lease, resource, acts, over })
    }
}
