//! Which leases live, as the resource manager tells: a motion under way whose lease ends stops and holds, and none begins
//! under a lease that has ended.
//!
//! While the manager cannot be heard, leases are trusted as long as the cell's own session lives; then no motion under a
//! lease goes on or begins. What the manager says first after a pause is compared with what is under way.

use super::keeper::Keeper;
use crate::core::protocol::{Event, Module};
use ratn_model::id::LeaseId;
use ratn_proto::types::{ResourceEvent, ResourceEventKind, ResourceUpdate};
use ratn_worker::action::ActionServer;
use ratn_worker::client::{CallError, ResourceClient, ResourceWatch};
use ratn_worker::session::Session;
use std::future::pending;
use std::time::Duration;
use tokio::sync::Notify;
use tokio::time::{sleep, timeout};

/// The pause before the manager is asked again.
const RETRY_INTERVAL: Duration = Duration::from_millis(100);

pub(crate) struct LeaseWatch<'a> {
    pub(crate) client: ResourceClient,
    pub(crate) keeper: Keeper,
    pub(crate) server: ActionServer,
    /// The cell's own.
    pub(crate) session: &'a Session,
    /// How long leases are trusted without a watch.
    pub(crate) patience: Duration,
    /// Told once the manager has said which leases live.
    pub(crate) listening: &'a Notify,
}

impl LeaseWatch<'_> {
    /// Watches until dropped.
    pub(crate) async fn keep(self) {
        let (mut generation, mut watch) = self.begin().await;
        loop {
            let patience = tokio::select! {
                biased;
                // Known before a connection that hangs breaks.
                () = self.session_is_not(generation) => Duration::ZERO,
                () = self.follow(watch) => {
                    sleep(RETRY_INTERVAL).await;
                    self.patience
                }
            };
            (generation, watch) = match timeout(patience, self.begin()).await {
                Ok(begun) => begun,
                Err(_) => {
                    let reason = "the resource manager is not heard".to_owned();
                    tracing::warn!("{reason}: motions under a lease stop");
                    self.tell(Event::LeasesLost { reason }).await;
                    self.begin().await
                }
            };
        }
    }

    /// A watch that has told which leases live, and the generation of the session that was alive by then.
    async fn begin(&self) -> (u64, ResourceWatch) {
        let mut state = self.session.state();
        loop {
            // A session that is closed tells nothing more, and this watch ends with it.
            let Ok(generation) = state.wait_for(|s| s.alive).await.map(|s| s.generation) else { pending().await };
            match self.snapshot().await {
                Ok(watch) => return (generation, watch),
                Err(error) => tracing::debug!(%error, "no watch of leases"),
            }
            sleep(RETRY_INTERVAL).await;
        }
    }

    /// Resolves when the session of that generation is not alive, also when that was so before.
    async fn session_is_not(&self, generation: u64) {
        let _ = self.session.state().wait_for(|s| !s.alive || s.generation != generation).await;
    }

    async fn snapshot(&self) -> Result<ResourceWatch, CallError> {
        let mut watch = self.client.watch(&Module::ALL.map(Module::kind)).await?;
        // The snapshot is always first.
        if let Some(ResourceUpdate::Snapshot { resources, youngest, .. }) = watch.next().await? {
            let living = resources.iter().flat_map(|r| r.holdings.iter().map(|h| h.lease)).collect();
            self.tell(Event::LeasesAre { living, youngest }).await;
            self.listening.notify_one();
        }
        Ok(watch)
    }

    /// Returns when the watch has ended.
    async fn follow(&self, mut watch: ResourceWatch) {
        loop {
            match watch.next().await {
                Ok(Some(ResourceUpdate::Event(event))) => self.happened(event).await,
                Ok(Some(ResourceUpdate::Snapshot { .. })) => {}
                Ok(None) => return tracing::debug!("the watch of leases ended"),
                Err(error) => return tracing::debug!(%error, "the watch of leases broke"),
            }
        }
    }

    async fn happened(&self, event: ResourceEvent) {
        let or = |reason: &str| if event.reason.is_empty() { reason.to_owned() } else { event.reason.clone() };
        match (event.kind, event.lease) {
            (ResourceEventKind::Leased, Some((lease, _))) => self.tell(Event::LeaseBegan { lease }).await,
            (ResourceEventKind::Released, Some((lease, _))) => self.ended(lease, &or("it was released")).await,
            (ResourceEventKind::Deleted, _) => {
                for holding in &event.resource.holdings {
                    self.ended(holding.lease, &or("its resource is gone")).await;
                }
            }
            _ => {}
        }
    }

    /// The core stops first; the goal's outcome follows.
    async fn ended(&self, lease: LeaseId, reason: &str) {
        self.server.lease_has_ended(lease, reason);
        self.tell(Event::LeaseEnded { lease, reason: reason.to_owned() }).await;
        self.server.end_lease(lease, reason);
    }

    async fn tell(&self, event: Event) {
        if let Err(error) = self.keeper.tell(event).await {
            tracing::error!(%error, "a lease that ended could not be told");
        }
    }
}
