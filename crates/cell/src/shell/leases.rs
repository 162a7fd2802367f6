//! Which leases live, as the resource manager tells: a motion under way whose lease ends stops and holds.
//!
//! While the manager cannot be heard, leases are trusted as long as the cell's own session could live; then no motion under
//! a lease goes on. After a pause, what the manager says first is compared with what is under way.

use super::keeper::Keeper;
use crate::core::protocol::{Event, Module};
use ratn_model::id::LeaseId;
use ratn_proto::types::{ResourceEventKind, ResourceUpdate};
use ratn_worker::action::ActionServer;
use ratn_worker::client::ResourceClient;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::Notify;
use tokio::time::{Instant, sleep};

/// The pause before the manager is asked again.
const RETRY_INTERVAL: Duration = Duration::from_millis(100);

pub(crate) struct LeaseWatch {
    pub(crate) client: ResourceClient,
    pub(crate) keeper: Keeper,
    pub(crate) server: ActionServer,
    /// How long silence is borne.
    pub(crate) patience: Duration,
    /// Told once the manager has said which leases live.
    pub(crate) listening: Arc<Notify>,
}

impl LeaseWatch {
    /// Watches until dropped.
    pub(crate) async fn keep(self) {
        let mut heard = Instant::now();
        let mut silent = false;
        loop {
            match self.listen(&mut heard).await {
                Ok(()) => tracing::debug!("the watch of leases ended"),
                Err(error) => tracing::debug!(%error, "the watch of leases broke"),
            }
            if heard.elapsed() < RETRY_INTERVAL * 2 {
                silent = false;
            }
            if heard.elapsed() > self.patience && !silent {
                silent = true;
                let reason = format!("the resource manager was not heard for {:.1} s", self.patience.as_secs_f64());
                tracing::warn!("{reason}: motions under a lease stop");
                self.tell(Event::LeasesLost { reason });
            }
            sleep(RETRY_INTERVAL).await;
        }
    }

    async fn listen(&self, heard: &mut Instant) -> Result<(), ratn_worker::client::CallError> {
        let kinds = Module::ALL.map(Module::kind);
        let mut watch = self.client.watch(&kinds).await?;
        loop {
            let update = watch.next().await;
            *heard = Instant::now();
            match update? {
                None => return Ok(()),
                Some(ResourceUpdate::Snapshot { resources, .. }) => {
                    let living = resources.iter().flat_map(|r| r.holdings.iter().map(|h| h.lease)).collect();
                    self.tell(Event::LeasesAre { living });
                    self.listening.notify_one();
                }
                Some(ResourceUpdate::Event(event)) => {
                    let or =
                        |reason: &str| if event.reason.is_empty() { reason.to_owned() } else { event.reason.clone() };
                    match event.kind {
                        ResourceEventKind::Released => {
                            if let Some((lease, _)) = event.lease {
                                self.ended(lease, &or("it was released"));
                            }
                        }
                        ResourceEventKind::Deleted => {
                            for holding in &event.resource.holdings {
                                self.ended(holding.lease, &or("its resource is gone"));
                            }
                        }
                        _ => {}
                    }
                }
            }
        }
    }

    /// The core stops first; the goal's outcome follows.
    fn ended(&self, lease: LeaseId, reason: &str) {
        self.tell(Event::LeaseEnded { lease, reason: reason.to_owned() });
        self.server.end_lease(lease, reason);
    }

    fn tell(&self, event: Event) {
        if let Err(error) = self.keeper.tell(event) {
            tracing::error!(%error, "a lease that ended could not be told");
        }
    }
}
