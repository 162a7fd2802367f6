//! Goals whose results nobody awaits and that have not ended yet: most were cancelled. A provider performs one goal at a time, and a cancel travels
//! on another path than a goal: the next goal of the same resource is sent when the previous one has ended, so that it is not refused as one too
//! many. A lease is released when all goals under it have ended, so that the next holder finds its resources idle.

use super::Job;
use ratn_model::id::LeaseId;
use tokio_util::sync::CancellationToken;

/// A goal that has not ended.
#[derive(Debug)]
struct Ending {
    lease: Option<LeaseId>,
    resource: String,
    over: CancellationToken,
}

/// The goals of a run that have not ended.
#[derive(Debug, Default)]
pub(super) struct Stopping(Vec<Ending>);

impl Stopping {
    /// Cancels a goal.
    pub(super) fn stop(&mut self, job: &Job) {
        job.stop.cancel();
        self.leave(job);
    }

    /// Nobody awaits a goal's result any more.
    pub(super) fn leave(&mut self, job: &Job) {
        if !job.ended.is_finished() {
            self.0.push(Ending { lease: job.lease, resource: job.resource.clone(), over: job.over.clone() });
        }
    }

    /// The goals that must end before a goal of this resource begins: each token is cancelled when its goal has ended.
    pub(super) fn before(&mut self, resource: &str) -> Vec<CancellationToken> {
        self.of(|ending| ending.resource == resource)
    }

    /// The goals that must end before this lease is released, likewise.
    pub(super) fn under(&mut self, lease: LeaseId) -> Vec<CancellationToken> {
        self.of(|ending| ending.lease == Some(lease))
    }

    fn of(&mut self, is_meant: impl Fn(&Ending) -> bool) -> Vec<CancellationToken> {
        self.0.retain(|ending| !ending.over.is_cancelled());
        self.0.iter().filter(|ending| is_meant(ending)).map(|ending| ending.over.clone()).collect()
    }
}
