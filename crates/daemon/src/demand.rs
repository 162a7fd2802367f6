//! The part of a provider's link that hears what is missing and what is held, and says why there is no more of it.

use ratn_model::value::Value;
use ratn_proto::types::{Demand, Provision, Resource, ResourceEventKind, ResourceUpdate};
use ratn_worker::client::{CallError, Channels, ResourceClient};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::session::Session;
use std::collections::{BTreeMap, BTreeSet};
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
    pub(crate) wanted: WantedLink,
    /// Hears who of its kinds is held, its own and those of others.
    pub(crate) used: mpsc::Sender<Use>,
    /// What of that it has heard.
    pub(crate) uses: Uses,
}

/// The part of it about what is missing.
pub(crate) struct WantedLink {
    /// What it can provide, by kind.
    pub(crate) kinds: BTreeMap<String, Provision>,
    /// What all of it has in common.
    pub(crate) attributes: BTreeMap<String, Value>,
    /// Hears what is missing.
    pub(crate) heard: mpsc::Sender<Vec<Demand>>,
    pub(crate) shortages: watch::Receiver<Shortages>,
}

impl DemandLink {
    /// Goes on for as long as it is polled. What was missing counts until it is heard that it is not.
    pub(crate) async fn follow(&mut self, channels: &Channels, endpoint: &Endpoint, session: &Session) {
        let DemandLink { wanted, used, uses } = self;
        let kinds: Vec<String> = wanted.kinds.keys().cloned().collect();
        let uses = async {
            loop {
                if let Err(error) = follow_uses(channels, endpoint, &kinds, uses, used).await {
                    tracing::debug!(%endpoint, %error, "who holds what is not heard now");
                }
                tokio::time::sleep(AGAIN_AFTER).await;
            }
        };
        let demand = async {
            loop {
                if session.alive(AGAIN_AFTER).await.is_ok()
                    && let Err(error) = wanted.follow_once(channels, endpoint, session).await
                {
                    tracing::debug!(%endpoint, %error, "the demand is not heard now");
                }
                tokio::time::sleep(AGAIN_AFTER).await;
            }
        };
        tokio::join!(uses, demand);
    }
}

impl WantedLink {
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
    uses: &mut Uses,
    used: &mpsc::Sender<Use>,
) -> Result<(), CallError> {
    if kinds.is_empty() {
        return std::future::pending().await;
    }
    let kinds: Vec<&str> = kinds.iter().map(String::as_str).collect();
    let mut watch = ResourceClient::new(channels, endpoint, "")?.watch(&kinds).await?;
    while let Some(update) = watch.next().await? {
        for changed in uses.heard(update) {
            if used.send(changed).await.is_err() {
                return Ok(());
            }
        }
    }
    Ok(())
}

/// Who is held, as far as it was heard. Pure.
#[derive(Debug, Default)]
pub(crate) struct Uses {
    held: BTreeSet<String>,
}

impl Uses {
    /// What an update of the watch says of who is held. What is not there any more is held by nobody, also where it went while nobody
    /// watched.
    fn heard(&mut self, update: ResourceUpdate) -> Vec<Use> {
        let is_held = |resource: &Resource| !resource.holdings.is_empty();
        let changed: Vec<Use> = match update {
            ResourceUpdate::Snapshot { resources, .. } => {
                let there: BTreeSet<&str> = resources.iter().map(|resource| resource.id.as_str()).collect();
                let gone = self.held.iter().filter(|id| !there.contains(id.as_str()));
                let gone = gone.map(|id| Use { id: id.clone(), held: false });
                gone.chain(resources.iter().map(|one| Use { id: one.id.clone(), held: is_held(one) })).collect()
            }
            ResourceUpdate::Event(event) => match event.kind {
                ResourceEventKind::Leased | ResourceEventKind::Released => {
                    vec![Use { held: is_held(&event.resource), id: event.resource.id }]
                }
                ResourceEventKind::Deleted => vec![Use { held: false, id: event.resource.id }],
                ResourceEventKind::Created | ResourceEventKind::Updated => vec![],
            },
        };
        for Use { id, held } in &changed {
            if *held {
                self.held.insert(id.clone())
            } else {
                self.held.remove(id)
            };
        }
        changed
    }
}

/// Last words of a worker may have many.
fn in_one_line(reason: &str) -> String {
    reason.chars().map(|c| if c.is_control() { ' ' } else { c }).take(REASON_LENGTH).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use ratn_model::id::{FencingToken, LeaseId, Revision};
    use ratn_model::resource::{Quantity, ResourceClass};
    use ratn_proto::types::{Holding, ResourceEvent};

    fn planner(id: &str, held: bool) -> Resource {
        let mut resource = Resource::new(id, ResourceClass::Process, "Planner");
        let holding = || Holding {
            lease: LeaseId(1),
            token: FencingToken(1),
            units: Quantity::ONE,
            session: String::new(),
            holder: String::new(),
            opened_by: String::new(),
        };
        resource.holdings.extend(held.then(holding));
        resource
    }

    fn event(kind: ResourceEventKind, resource: Resource) -> ResourceUpdate {
        ResourceUpdate::Event(ResourceEvent {
            revision: Revision(1),
            kind,
            resource,
            lease: None,
            reason: String::new(),
            part: 0,
        })
    }

    fn snapshot(resources: Vec<Resource>) -> ResourceUpdate {
        ResourceUpdate::Snapshot { revision: Revision(1), resources, youngest: LeaseId(1) }
    }

    fn heard(uses: &mut Uses, update: ResourceUpdate) -> Vec<(String, bool)> {
        uses.heard(update).into_iter().map(|changed| (changed.id, changed.held)).collect()
    }

    #[test]
    fn one_whose_resource_vanishes_while_it_is_held_is_held_by_nobody() {
        use ResourceEventKind::{Created, Deleted, Leased, Released};
        let mut uses = Uses::default();
        assert_eq!(heard(&mut uses, snapshot(vec![planner("p1", true)])), [("p1".to_owned(), true)]);
        assert_eq!(
            heard(&mut uses, event(Released, planner("p1", true))),
            [("p1".to_owned(), true)],
            "the lease lost it"
        );
        assert_eq!(heard(&mut uses, event(Deleted, planner("p1", true))), [("p1".to_owned(), false)]);
        // It is offered again, and leased again.
        assert!(heard(&mut uses, event(Created, planner("p1", false))).iter().all(|(_, held)| !held));
        assert_eq!(heard(&mut uses, event(Leased, planner("p1", true))), [("p1".to_owned(), true)]);
    }

    #[test]
    fn one_whose_resource_vanished_while_nobody_watched_is_held_by_nobody() {
        let mut uses = Uses::default();
        heard(&mut uses, snapshot(vec![planner("p1", true), planner("p2", true), planner("p3", false)]));
        heard(&mut uses, event(ResourceEventKind::Leased, planner("p3", true)));
        let told = heard(&mut uses, snapshot(vec![planner("p2", true)]));
        let expected = [("p1", false), ("p2", true), ("p3", false)];
        let mut told: Vec<(&str, bool)> = told.iter().map(|(id, held)| (id.as_str(), *held)).collect();
        told.sort_unstable();
        assert_eq!(told, expected);
        assert_eq!(heard(&mut uses, snapshot(vec![planner("p2", true)])), [("p2".to_owned(), true)], "it is said once");
    }
}
