//! Goals that nobody waits for any more and that have not ended yet: most were told to stop. A provider performs one goal at a time, and a
//! cancel goes another way than a goal does: the next goal of the same resource leaves when the one before has ended, so that it is not
//! refused as one too many. A lease goes back when every goal under it has ended, so that whoever gets its resources finds them idle.

use super::Job;
use ratn_model::id::LeaseId;
use tokio_util::sync::CancellationToken;

/// One goal that still has to end.
#[derive(Debug)]
struct Ending {
    lease: Option<LeaseId>,
    resource: String,
    over: CancellationToken,
}

/// The goals of a run that still have to end.
#[derive(Debug, Default)]
pub(super) struct Stopping(Vec<Ending>);

impl Stopping {
    /// A goal is told to stop.
    pub(super) fn stop(&mut self, job: &Job) {
        job.stop.cancel();
        self.leave(job);
    }

    /// Nobody waits for a goal any more.
    pub(super) fn leave(&mut self, job: &Job) {
        if !job.ended.is_finished() {
            self.0.push(Ending { lease: job.lease, resource: job.resource.clone(), over: job.over.clone() });
        }
    }

    /// What a goal of this resource waits for: each token is cancelled when its goal has ended.
    pub(super) fn before(&mut self, resource: &str) -> Vec<CancellationToken> {
        self.of(|ending| ending.resource == resource)
    }

    /// What the return of this lease waits for, likewise.
    pub(super) fn under(&mut self, lease: LeaseId) -> Vec<CancellationToken> {
        self.of(|ending| ending.lease == Some(lease))
    }

    fn of(&mut self, is_meant: impl Fn(&Ending) -> bool) -> Vec<CancellationToken> {
        self.0.retain(|ending| !ending.over.is_cancelled());
        self.0.iter().filter(|ending| is_meant(ending)).map(|ending| ending.over.clone()).collect()
    }
}
