//! The part of a provider's link that receives demands and holdings from the resource manager, and reports why the provider cannot
//! make more resources.

use ratn_model::value::Value;
use ratn_proto::types::{Demand, Provision, Resource, ResourceEventKind, ResourceUpdate};
use ratn_worker::client::{CallError, Channels, ResourceClient};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::session::Session;
use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;
use tokio::sync::{mpsc, watch};

/// Delay before a broken watch is opened again.
const AGAIN_AFTER: Duration = Duration::from_millis(250);

/// Maximum length of a reported reason in characters; the full reason is in the provider's log.
const REASON_LENGTH: usize = 250;

/// The kinds of which the provider can make no more for now.
pub(crate) type Shortages = BTreeMap<String, Shortage>;

/// The most resources of a kind that are possible for now, and why.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Shortage {
    /// Includes the resources that exist already.
    pub most: u32,
    /// For people.
    pub reason: String,
}

/// A change of a resource: it is held now, or no longer held.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Use {
    pub(crate) id: String,
    pub(crate) held: bool,
}

/// The channels between the link and the provider.
pub(crate) struct DemandLink {
    pub(crate) wanted: WantedLink,
    /// Receives which resources of the provider's kinds are held: its own and those of other providers.
    pub(crate) used: mpsc::Sender<Use>,
    /// The holdings that the link has heard of so far.
    pub(crate) uses: Uses,
}

/// The part of the link that deals with demand.
pub(crate) struct WantedLink {
    /// The resources that the provider can make, by kind.
    pub(crate) kinds: BTreeMap<String, Provision>,
    /// Attributes that all of them have.
    pub(crate) attributes: BTreeMap<String, Value>,
    /// Receives the demand.
    pub(crate) heard: mpsc::Sender<Vec<Demand>>,
    pub(crate) shortages: watch::Receiver<Shortages>,
}

impl DemandLink {
    /// Runs for as long as it is polled. A demand stays in force until the resource manager reports that it is gone.
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

/// Follows which resources are held, from now on.
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

/// The resources that are held, as far as the link has heard. Pure.
#[derive(Debug, Default)]
pub(crate) struct Uses {
    held: BTreeSet<String>,
}

impl Uses {
    /// The changes of holdings in an update of the watch. A resource that no longer exists is held by nobody, also where it vanished
    /// while nobody watched.
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

/// The last output of a worker may have many lines.
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
        // The resource is offered again, and leased again.
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
