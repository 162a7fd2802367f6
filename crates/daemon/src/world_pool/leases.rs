//! Live leases, as the resource manager's watch reports them. A projection lives as long as its lease.

use crate::link::Manager;
use ratn_model::id::LeaseId;
use ratn_proto::types::{Resource, ResourceEventKind, ResourceUpdate};
use ratn_worker::client::{CallError, Channels, ResourceClient};
use ratn_worker::endpoint::Endpoint;
use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;
use tokio::sync::watch;

/// Pause before a broken watch is opened again.
const RETRY_INTERVAL: Duration = Duration::from_millis(50);

/// The live leases, with their resources.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct LiveLeases {
    held: BTreeMap<LeaseId, Held>,
    /// The youngest lease ever reported: ids grow, so an older lease that is not live has ended.
    youngest: LeaseId,
    /// Number of snapshots so far: each replaces all leases.
    pub(super) snapshots: u64,
}

/// The resources of a live lease.
#[derive(Debug, Clone, Default, PartialEq)]
struct Held {
    resources: BTreeSet<String>,
    /// Who opened its session, as authenticated by the resource manager; empty where that is unknown.
    opened_by: String,
}

/// What is known of a lease.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Known<'a> {
    Lives {
        /// Who opened its session.
        opened_by: &'a str,
    },
    Ended,
    /// The lease is younger than any that the watch has reported.
    NotYet,
}

impl LiveLeases {
    pub(super) fn known(&self, lease: LeaseId) -> Known<'_> {
        if let Some(held) = self.held.get(&lease) {
            Known::Lives { opened_by: &held.opened_by }
        } else if lease <= self.youngest {
            Known::Ended
        } else {
            Known::NotYet
        }
    }

    fn snapshot(&mut self, resources: &[Resource], youngest: LeaseId) {
        self.held.clear();
        self.youngest = youngest;
        self.snapshots += 1;
        for resource in resources {
            for holding in &resource.holdings {
                self.hold(holding.lease, resource);
            }
        }
    }

    fn hold(&mut self, lease: LeaseId, resource: &Resource) {
        let held = self.held.entry(lease).or_default();
        held.resources.insert(resource.id.clone());
        if let Some(holding) = resource.holdings.iter().find(|holding| holding.lease == lease) {
            held.opened_by.clone_from(&holding.opened_by);
        }
        self.youngest = self.youngest.max(lease);
    }

    /// Returns whether the update changed anything.
    fn update(&mut self, update: &ResourceUpdate) -> bool {
        let event = match update {
            ResourceUpdate::Snapshot { resources, youngest, .. } => {
                self.snapshot(resources, *youngest);
                return true;
            }
            ResourceUpdate::Event(event) => event,
        };
        let Some((lease, _)) = event.lease else { return false };
        match event.kind {
            ResourceEventKind::Leased => self.hold(lease, &event.resource),
            ResourceEventKind::Released => {
                if let Some(held) = self.held.get_mut(&lease) {
                    held.resources.remove(&event.resource.id);
                    if held.resources.is_empty() {
                        self.held.remove(&lease);
                    }
                }
            }
            _ => return false,
        }
        true
    }
}

/// Keeps `live` up to date. Never returns.
pub(super) async fn follow(manager: Manager, live: watch::Sender<LiveLeases>) {
    let channels = Channels::new(&manager.tls);
    loop {
        let endpoint = manager.find().await;
        if let Err(error) = follow_at(&channels, &endpoint, &live).await {
            tracing::debug!(%endpoint, "the watch of leases ended: {error}");
        }
        tokio::time::sleep(RETRY_INTERVAL).await;
    }
}

async fn follow_at(
    channels: &Channels,
    endpoint: &Endpoint,
    live: &watch::Sender<LiveLeases>,
) -> Result<(), CallError> {
    let mut updates = ResourceClient::new(channels, endpoint, "")?.watch(&[]).await?;
    while let Some(update) = updates.next().await? {
        live.send_if_modified(|leases| leases.update(&update));
    }
    Ok(())
}

#[cfg(test)]
impl LiveLeases {
    /// One lease that holds one resource.
    pub(super) fn of(lease: LeaseId, resource: &str, opened_by: &str) -> LiveLeases {
        let held = Held { resources: [resource.to_owned()].into(), opened_by: opened_by.to_owned() };
        LiveLeases { held: [(lease, held)].into(), youngest: lease, snapshots: 1 }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use ratn_model::id::{FencingToken, Revision};
    use ratn_model::resource::{Quantity, ResourceClass};
    use ratn_proto::types::{Holding, ResourceEvent};

    /// `adam` opened the session of every lease.
    const ADAMS: Known<'_> = Known::Lives { opened_by: "adam" };

    fn event(kind: ResourceEventKind, resource: &str, lease: u64) -> ResourceUpdate {
        let holding = Holding {
            lease: LeaseId(lease),
            token: FencingToken(lease),
            units: Quantity::ONE,
            session: "s".to_owned(),
            holder: String::new(),
            opened_by: "adam".to_owned(),
        };
        let holdings = if kind == ResourceEventKind::Leased { vec![holding] } else { Vec::new() };
        ResourceUpdate::Event(ResourceEvent {
            part: 0,
            revision: Revision(1),
            kind,
            resource: Resource { holdings, ..Resource::new(resource, ResourceClass::World, "WorldModel") },
            lease: Some((LeaseId(lease), FencingToken(lease))),
            reason: String::new(),
        })
    }

    #[test]
    fn a_lease_lives_from_its_first_resource_to_its_last_and_is_not_known_before() {
        let mut leases = LiveLeases::default();
        assert_eq!(leases.known(LeaseId(3)), Known::NotYet);
        leases.update(&event(ResourceEventKind::Leased, "world", 3));
        leases.update(&event(ResourceEventKind::Leased, "planner", 3));
        assert_eq!(leases.known(LeaseId(2)), Known::Ended, "ids grow");
        leases.update(&event(ResourceEventKind::Released, "planner", 3));
        assert_eq!(leases.known(LeaseId(3)), ADAMS);
        leases.update(&event(ResourceEventKind::Released, "world", 3));
        assert_eq!(leases.known(LeaseId(3)), Known::Ended);
    }

    #[test]
    fn a_lease_that_came_and_went_while_nobody_listened_has_ended() {
        let mut leases = LiveLeases::default();
        let snapshot = ResourceUpdate::Snapshot { revision: Revision(9), resources: Vec::new(), youngest: LeaseId(5) };
        leases.update(&snapshot);
        assert_eq!((leases.known(LeaseId(5)), leases.known(LeaseId(6))), (Known::Ended, Known::NotYet));
    }
}
