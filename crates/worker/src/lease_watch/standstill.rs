//! Confirms standstill: if a lease did not end by its holder's release, its units of a resource are granted again when the resource's
//! provider confirms that nothing moves any more for that lease.
//!
//! ```text
//!   the watch tells of units that are ending ─▶ the goals of that lease have returned ─▶ ConfirmStandstill
//!                                                                └─ one has panicked ─▶ nothing: the bound decides
//! ```
//! Nothing is confirmed before the driver has reported that it is at rest ([`LeaseWatch::brought_to_rest`]): the lease may be one of an
//! earlier process, whose motion nobody has stopped.
//!
//! Only resources of the provider's own session are confirmed, as long as the provider follows the manager. If a goal's action does not
//! return, or panics, its standstill is never confirmed: then the bound that the resource was offered with (`standstill_ms`) decides.

use super::{LeaseWatch, RETRY_INTERVAL};
use crate::client::{CallError, ResourceClient};
use ratn_model::id::{FencingToken, LeaseId};
use ratn_proto::types::{Resource, ResourceEventKind, ResourceUpdate};
use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;
use tokio::time::{sleep, timeout};
use tokio_util::task::AbortOnDropHandle;
use tonic::Code;

/// Time limit for the answer to a confirmation; then the manager is asked again, over a new connection if the old one broke.
const ANSWERED_WITHIN: Duration = Duration::from_secs(1);

/// The units of a resource that an ended lease still occupies until the provider has confirmed standstill.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Ending {
    pub(super) resource: String,
    pub(super) lease: LeaseId,
    pub(super) token: FencingToken,
}

/// All endings that a provider has to confirm, as reported by the manager. Pure.
#[derive(Debug, Default)]
pub(super) struct Endings(BTreeSet<Ending>);

impl Endings {
    /// Applies an update; only resources of the session `owner` count. Without an owner, another process offers the resources, and
    /// confirms.
    pub(super) fn tell(&mut self, update: &ResourceUpdate, owner: Option<&str>) {
        let of = |resource: &Resource| -> Vec<Ending> {
            let is_own = owner == Some(resource.session.as_str());
            let ending = resource.ending.iter().filter(|_| is_own);
            let left = |(lease, token)| Ending { resource: resource.id.clone(), lease, token };
            ending.map(|units| left((units.lease, units.token))).collect()
        };
        match update {
            ResourceUpdate::Snapshot { resources, .. } => self.0 = resources.iter().flat_map(of).collect(),
            ResourceUpdate::Event(event) => {
                self.0.retain(|ending| ending.resource != event.resource.id);
                if event.kind != ResourceEventKind::Deleted {
                    self.0.extend(of(&event.resource));
                }
            }
        }
    }

    pub(super) fn clear(&mut self) {
        self.0.clear();
    }

    pub(super) fn all(&self) -> BTreeSet<Ending> {
        self.0.clone()
    }
}

impl LeaseWatch {
    /// Confirms the standstill of every ending, for as long as it is polled; `client` speaks for the session that provides the resources.
    pub(super) async fn confirm_standstill(self, client: ResourceClient) {
        let mut heard = self.heard();
        let mut confirming: BTreeMap<Ending, AbortOnDropHandle<()>> = BTreeMap::new();
        loop {
            heard.mark_unchanged();
            let endings = self.shared.holdings().endings();
            // An ending that is gone needs no confirmation.
            confirming.retain(|ending, _| endings.contains(ending));
            for ending in endings {
                confirming.entry(ending).or_insert_with_key(|ending| {
                    let confirm = self.clone().confirm(client.clone(), ending.clone());
                    AbortOnDropHandle::new(tokio::spawn(confirm))
                });
            }
            if heard.changed().await.is_err() {
                return;
            }
        }
    }

    async fn confirm(self, client: ResourceClient, ending: Ending) {
        let Ending { resource, lease, token } = ending;
        if self.shared.is_brought_to_rest.subscribe().wait_for(|said| *said).await.is_err() {
            return;
        }
        // No further goal begins under this lease: the watch refutes it.
        if !self.stands_still(&resource, (lease, token)).await {
            return tracing::debug!(%lease, resource, "no action server has this watch: its standstill is not confirmed");
        }
        loop {
            match timeout(ANSWERED_WITHIN, client.confirm_standstill(lease, &resource)).await {
                Ok(Ok(freed)) => return tracing::debug!(%lease, resource, freed, "standstill is confirmed"),
                Ok(Err(error)) if is_final(&error) => {
                    return tracing::warn!(%lease, resource, %error, "standstill is not confirmed");
                }
                Ok(Err(error)) => tracing::debug!(%lease, resource, %error, "standstill is confirmed again"),
                Err(_) => tracing::debug!(%lease, resource, "the resource manager does not answer to a standstill"),
            }
            sleep(RETRY_INTERVAL).await;
        }
    }

    /// Returns true when nothing moves any more for a lease at a resource, which may be never; false if no action server has this watch, so that
    /// nobody knows.
    pub(crate) async fn stands_still(&self, resource: &str, lease: (LeaseId, FencingToken)) -> bool {
        loop {
            let Some(under_way) = self.shared.under_way(resource, Some(lease)) else { return false };
            if under_way.is_empty() {
                return true;
            }
            for goal in under_way {
                goal.cancelled().await;
            }
            // Those whose actions have returned are not among them any more; of one that panicked it is not known whether anything moves.
        }
    }
}

/// Whether a retry would get the same answer.
fn is_final(error: &CallError) -> bool {
    use Code::{InvalidArgument, NotFound, PermissionDenied, Unimplemented};
    matches!(error.code(), Some(InvalidArgument | NotFound | PermissionDenied | Unimplemented))
}

#[cfg(test)]
mod tests {
    use super::*;
    use ratn_model::id::Revision;
    use ratn_model::resource::{Quantity, ResourceClass};
    use ratn_proto::types::{EndingUnits, ResourceEvent};

    fn resource(id: &str, session: &str, ending: &[u64]) -> Resource {
        let units = |&lease: &u64| EndingUnits {
            lease: LeaseId(lease),
            token: FencingToken(10 * lease),
            units: Quantity::ONE,
            session: "holder".to_owned(),
            within_ms: 6_000,
        };
        let mut resource = Resource::new(id, ResourceClass::Module, "Arm");
        (resource.session, resource.ending) = (session.to_owned(), ending.iter().map(units).collect());
        resource
    }

    fn snapshot(resources: &[Resource]) -> ResourceUpdate {
        let (revision, youngest) = (Revision(1), LeaseId(9));
        ResourceUpdate::Snapshot { revision, resources: resources.to_vec(), youngest }
    }

    fn event(kind: ResourceEventKind, resource: Resource) -> ResourceUpdate {
        let (revision, reason) = (Revision(2), String::new());
        ResourceUpdate::Event(ResourceEvent { revision, kind, resource, lease: None, reason, part: 0 })
    }

    fn left(endings: &Endings) -> Vec<(String, u64)> {
        endings.all().into_iter().map(|ending| (ending.resource, ending.lease.0)).collect()
    }

    #[test]
    fn what_is_ending_is_to_be_confirmed_until_the_manager_says_that_it_is_free() {
        let (mut endings, owner) = (Endings::default(), Some("cell"));
        endings.tell(&event(ResourceEventKind::Released, resource("arm", "cell", &[7])), owner);
        endings.tell(&event(ResourceEventKind::Released, resource("base", "cell", &[7])), owner);
        assert_eq!(left(&endings), [("arm".to_owned(), 7), ("base".to_owned(), 7)]);
        endings.tell(&event(ResourceEventKind::Updated, resource("arm", "cell", &[])), owner);
        assert_eq!(left(&endings), [("base".to_owned(), 7)]);
        endings.tell(&event(ResourceEventKind::Deleted, resource("base", "cell", &[7])), owner);
        assert_eq!(left(&endings), []);
    }

    #[test]
    fn a_snapshot_tells_all_that_is_ending_also_what_began_to_while_nothing_was_heard() {
        let (mut endings, owner) = (Endings::default(), Some("cell"));
        endings.tell(&snapshot(&[resource("arm", "cell", &[7]), resource("base", "cell", &[])]), owner);
        endings.tell(&snapshot(&[resource("arm", "cell", &[]), resource("base", "cell", &[8])]), owner);
        assert_eq!(left(&endings), [("base".to_owned(), 8)]);
    }

    #[test]
    fn of_what_another_session_provides_nothing_is_confirmed() {
        let mut endings = Endings::default();
        endings.tell(&snapshot(&[resource("arm", "another cell", &[7])]), Some("cell"));
        assert_eq!(left(&endings), []);
        // A pooled worker: its process manager offers the resource.
        endings.tell(&snapshot(&[resource("arm", "", &[7])]), None);
        assert_eq!(left(&endings), []);
    }
}
