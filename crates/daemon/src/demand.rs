//! The part of a provider's link that hears what is missing, and says why there is no more of it.

use ratn_proto::types::Demand;
use ratn_worker::client::{CallError, Channels, ResourceClient};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::session::Session;
use std::collections::BTreeMap;
use std::time::Duration;
use tokio::sync::{mpsc, watch};

/// When to ask again after the watch broke.
const AGAIN_AFTER: Duration = Duration::from_millis(250);

/// Characters of a reason that are said; what they are is in the provider's log.
const REASON_LENGTH: usize = 250;

/// Why there is no more of a kind, by kind.
pub(crate) type Shortages = BTreeMap<String, String>;

/// What goes from and to the provider.
pub(crate) struct DemandLink {
    /// Hears what is missing.
    pub(crate) heard: mpsc::Sender<Vec<Demand>>,
    pub(crate) shortages: watch::Receiver<Shortages>,
}

impl DemandLink {
    /// Goes on for as long as it is polled. What was missing counts until it is heard that it is not.
    pub(crate) async fn follow(&mut self, channels: &Channels, endpoint: &Endpoint, session: &Session) {
        loop {
            if session.alive(AGAIN_AFTER).await.is_ok()
                && let Err(error) = self.follow_once(channels, endpoint, session).await
            {
                tracing::debug!(%endpoint, %error, "the demand is not heard now");
            }
            tokio::time::sleep(AGAIN_AFTER).await;
        }
    }

    async fn follow_once(
        &mut self,
        channels: &Channels,
        endpoint: &Endpoint,
        session: &Session,
    ) -> Result<(), CallError> {
        let manager = ResourceClient::new(channels, endpoint, session.id())?;
        let mut demand = manager.watch_demand().await?;
        let mut said = Shortages::new();
        loop {
            let shortages = self.shortages.borrow_and_update().clone();
            for kind in said.keys().filter(|kind| !shortages.contains_key(*kind)) {
                manager.report_shortage(kind, "").await?;
            }
            for (kind, reason) in shortages.iter().filter(|(kind, reason)| said.get(*kind) != Some(*reason)) {
                manager.report_shortage(kind, &in_one_line(reason)).await?;
            }
            said = shortages;
            tokio::select! {
                update = demand.next() => match update? {
                    Some(demand) => if self.heard.send(demand).await.is_err() { return Ok(()) },
                    None => return Ok(()),
                },
                changed = self.shortages.changed() => if changed.is_err() { return Ok(()) },
            }
        }
    }
}

/// Last words of a worker may have many.
fn in_one_line(reason: &str) -> String {
    reason.chars().map(|c| if c.is_control() { ' ' } else { c }).take(REASON_LENGTH).collect()
}
