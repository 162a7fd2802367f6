//! Releases what an instance held: its lease, with a note about what the run has committed, and its projection. Each is released when nothing uses it
//! any more and earlier decisions are on disk. A lease for which something may still move is given back as such. Only operations wait for a release.

use super::Performer;
use crate::decided::{Unanswered, insist};
use crate::safe_on_disk::Mark;
use ratn_model::id::{InstanceId, LeaseId, ProjectionId};
use ratn_worker::client::WorldClient;
use ratn_worker::session::Trust;
use ratn_worker::trace;
use std::sync::Arc;
use std::time::Instant;
use tokio_util::sync::{CancellationToken, DropGuard};

impl Performer {
    /// Releases what an instance held when its goals, and those under the same lease, have ended.
    pub(super) fn release(
        &mut self,
        instance: InstanceId,
        lease: Option<LeaseId>,
        projection: Option<ProjectionId>,
        safe: Option<Mark>,
    ) {
        let idle = self.goals.leave_all(instance, lease);
        self.give_back_when(safe, instance, idle, lease, projection, None);
    }

    /// Releases what an instance was granted and does not want any more.
    pub(super) fn give_back(
        &mut self,
        instance: InstanceId,
        lease: Option<LeaseId>,
        projection: Option<ProjectionId>,
        withdrawn: Option<Arc<DropGuard>>,
    ) {
        self.give_back_when(None, instance, Vec::new(), lease, projection, withdrawn);
    }

    fn give_back_when(
        &mut self,
        safe: Option<Mark>,
        instance: InstanceId,
        mut idle: Vec<CancellationToken>,
        lease: Option<LeaseId>,
        projection: Option<ProjectionId>,
        withdrawn: Option<Arc<DropGuard>>,
    ) {
        if let Some(lease) = lease {
            let now = Instant::now();
            self.leases.given_back(lease, now);
            self.left.goes_back(self.decided, self.recorded.borrow().commit, now);
            self.holds.set(self.leases.has_speculative());
        }
        let (resources, world, trust) = (self.resources.clone(), self.world.clone(), self.trust.clone());
        let doubtful = self.goals.doubtful.clone();
        idle.extend(lease.into_iter().flat_map(|lease| self.goals.under(lease)));
        let returns = lease.map(|_| self.order.returning.begin());
        let note = self.told.left(self.decided).to_string();
        let (there, coming) = match projection.map(|id| (id, self.making.end(id))) {
            Some((id, None)) => (Some(id), None),
            Some((id, Some(coming))) => (None, Some((id, coming))),
            None => (None, None),
        };
        let returning = async move {
            // The next holder of the resources finds them idle.
            for goal in idle {
                goal.cancelled().await;
            }
            // What others then do may depend on what this run has decided.
            if let Some(safe) = safe {
                safe.safe().await;
            }
            if let Some(projection) = there {
                end_projection(&world, &trust, instance, projection).await;
            }
            if let Some(lease) = lease {
                let at_rest = doubtful.goes_back_at_rest(lease);
                let release = || resources.release_with_note(lease, note.clone(), at_rest);
                // An absent resource manager keeps the lease until it is told: wait for it as long as the session may live.
                if let Err(undone) = insist(&trust, Unanswered::Waits, release).await {
                    tracing::warn!(%instance, "a lease was not given back: {undone}");
                }
            }
            drop((returns, withdrawn));
            // The release of the lease does not wait until a promised projection exists.
            if let Some((projection, coming)) = coming
                && coming.await.is_ok()
            {
                end_projection(&world, &trust, instance, projection).await;
            }
        };
        self.giving_back.spawn(trace::within(self.of(instance), returning));
    }
}

async fn end_projection(world: &WorldClient, trust: &Trust, instance: InstanceId, projection: ProjectionId) {
    if let Err(undone) = insist(trust, Unanswered::GivenUp, || world.release(projection)).await {
        tracing::warn!(%instance, "a projection was not given back: {undone}");
    }
}
