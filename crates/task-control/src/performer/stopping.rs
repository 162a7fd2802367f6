//! Goals that were told to stop and have not ended yet. A provider performs one goal at a time, and a cancel goes another way than a goal
//! does: the next goal of the same resource leaves when the one before has been told to stop and has ended, so that it is not refused as
//! one too many.

use super::Job;
use tokio_util::sync::CancellationToken;

/// The goals of a run that were told to stop.
#[derive(Debug, Default)]
pub(super) struct Stopping(Vec<(String, CancellationToken)>);

impl Stopping {
    /// A goal is told to stop.
    pub(super) fn stop(&mut self, job: &Job) {
        job.stop.cancel();
        if !job.ended.is_finished() {
            self.0.push((job.resource.clone(), job.over.clone()));
        }
    }

    /// What a goal of this resource waits for: each is cancelled when that goal has ended.
    pub(super) fn before(&mut self, resource: &str) -> Vec<CancellationToken> {
        self.0.retain(|(_, over)| !over.is_cancelled());
        self.0.iter().filter(|(of, _)| of == resource).map(|(_, over)| over.clone()).collect()
    }
}
