//! The part of a provider's link that hears what is missing and what is held, and says why there is no more of it.

use ratn_model::value::Value;
use ratn_proto::types::{Demand, ResourceEventKind, ResourceUpdate};
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

/// Of which kinds there can be no more for now.
pub(crate) type Shortages = BTreeMap<String, Shortage>;

/// Of a kind there can be no more than so many for now, and why.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Shortage {
    /// Those there are count.
    pub most: u32,
    /// For people.
    pub reason: String,
}

/// Somebody holds a resource now, or nobody any more.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Use {
    pub(crate) id: String,
    pub(crate) held: bool,
}

/// What goes from and to the provider.
pub(crate) struct DemandLink {
    /// What it can provide: kinds, and how many of each at the most.
    pub(crate) kinds: BTreeMap<String, u32>,
    /// What all of it has in common.
    pub(crate) attributes: BTreeMap<String, Value>,
    /// Hears what is missing.
    pub(crate) heard: mpsc::Sender<Vec<Demand>>,
    pub(crate) shortages: watch::Receiver<Shortages>,
    /// Hears who of its kinds is held, its own and those of others.
    pub(crate) used: mpsc::Sender<Use>,
}

impl DemandLink {
    /// Goes on for as long as it is polled. What was missing counts until it is heard that it is not.
    pub(crate) async fn follow(&mut self, channels: &Channels, endpoint: &Endpoint, session: &Session) {
        let kinds: Vec<String> = self.kinds.keys().cloned().collect();
        let used = self.used.clone();
        let uses = async {
            loop {
                if let Err(error) = follow_uses(channels, endpoint, &kinds, &used).await {
                    tracing::debug!(%endpoint, %error, "who holds what is not heard now");
                }
                tokio::time::sleep(AGAIN_AFTER).await;
            }
        };
        let demand = async {
            loop {
                if session.alive(AGAIN_AFTER).await.is_ok()
                    && let Err(error) = self.follow_once(channels, endpoint, session).await
                {
                    tracing::debug!(%endpoint, %error, "the demand is not heard now");
                }
                tokio::time::sleep(AGAIN_AFTER).await;
            }
        };
        tokio::join!(uses, demand);
    }

    async fn follow_once(
        &mut self,
        channels: &Channels,
        endpoint: &Endpoint,
        session: &Session,
    ) -> Result<(), CallError> {
        let manager = ResourceClient::new(channels, endpoint, session.id())?;
        let mut demand = manager.watch_demand(&self.kinds, &self.attributes).await?;
        let mut said = Shortages::new();
        loop {
            let shortages = self.shortages.borrow_and_update().clone();
            for kind in said.keys().filter(|kind| !shortages.contains_key(*kind)) {
                manager.report_shortage(kind, 0, "").await?;
            }
            for (kind, shortage) in shortages.iter().filter(|(kind, shortage)| said.get(*kind) != Some(*shortage)) {
                manager.report_shortage(kind, shortage.most, &in_one_line(&shortage.reason)).await?;
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

/// From who holds what now on.
async fn follow_uses(
    channels: &Channels,
    endpoint: &Endpoint,
    kinds: &[String],
    used: &mpsc::Sender<Use>,
) -> Result<(), CallError> {
    if kinds.is_empty() {
        return std::future::pending().await;
    }
    let kinds: Vec<&str> = kinds.iter().map(String::as_str).collect();
    let mut watch = ResourceClient::new(channels, endpoint, "")?.watch(&kinds).await?;
    while let Some(update) = watch.next().await? {
        let changed = match update {
            ResourceUpdate::Snapshot { resources, .. } => resources,
            ResourceUpdate::Event(event) => match event.kind {
                ResourceEventKind::Leased | ResourceEventKind::Released => vec![event.resource],
                _ => continue,
            },
        };
        for resource in changed {
            let held = !resource.holdings.is_empty();
            if used.send(Use { id: resource.id, held }).await.is_err() {
                return Ok(());
            }
        }
    }
    Ok(())
}

/// Last words of a worker may have many.
fn in_one_line(reason: &str) -> String {
    reason.chars().map(|c| if c.is_control() { ' ' } else { c }).take(REASON_LENGTH).collect()
}
