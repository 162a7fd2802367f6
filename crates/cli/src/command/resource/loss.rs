//! How a holder learns that a lease has ended: the watch of its resources shows an operator's `release` or `delete`.
//!
//! The snapshot at the beginning of a watch is checked like its events, so a broken watch is opened again without missing
//! anything.

use ratn_model::resource::Lease;
use ratn_proto::types::{Resource, ResourceEventKind, ResourceUpdate};
use ratn_worker::client::ResourceClient;
use std::time::Duration;

/// Pause before a broken watch is opened again; if the manager is away for longer, the session ends.
const AGAIN: Duration = Duration::from_millis(250);

/// Resolves with a reason once a lease is not complete any more.
pub(super) async fn of(client: &ResourceClient, lease: &Lease) -> String {
    let mut kinds: Vec<&str> = lease.resources.iter().map(|resource| resource.kind.as_str()).collect();
    kinds.sort_unstable();
    kinds.dedup();
    loop {
        if let Ok(mut watch) = client.watch(&kinds).await {
            while let Ok(Some(update)) = watch.next().await {
                if let Some(why) = told(&update, lease) {
                    return why;
                }
            }
        }
        tokio::time::sleep(AGAIN).await;
    }
}

/// The end of the lease in an update, if there is one.
fn told(update: &ResourceUpdate, lease: &Lease) -> Option<String> {
    let number = lease.id.0;
    match update {
        ResourceUpdate::Snapshot { resources, .. } => lease.resources.iter().find_map(|held| {
            let holds = |resource: &&Resource| {
                resource.id == held.id && resource.holdings.iter().any(|holding| holding.lease == lease.id)
            };
            resources
                .iter()
                .all(|resource| !holds(&resource))
                .then(|| format!("lease {number} does not hold `{}` any more", held.id))
        }),
        ResourceUpdate::Event(event) => {
            let id = &event.resource.id;
            if !lease.resources.iter().any(|held| held.id == *id) {
                return None;
            }
            match (event.kind, event.lease) {
                (ResourceEventKind::Deleted, _) => Some(format!("`{id}` was deleted")),
                (ResourceEventKind::Released, Some((ended, _))) if ended == lease.id => {
                    Some(match event.reason.as_str() {
                        // Released by its own session, or by an operator.
                        "asked" | "revoked" => format!("lease {number} was released by another"),
                        "the resource is gone" => format!("`{id}` was deleted"),
                        // A lease that loses what moves ends; of several resources this need not be the one that was deleted.
                        "a resource of it is gone" if lease.resources.len() == 1 => format!("`{id}` was deleted"),
                        reason => format!("lease {number} ended: {reason}"),
                    })
                }
                _ => None,
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ratn_model::id::{FencingToken, LeaseId, Revision};
    use ratn_model::resource::{LeasedResource, Quantity, ResourceClass};
    use ratn_proto::types::{Holding, ResourceEvent};

    fn lease() -> Lease {
        let resource =
            LeasedResource { id: "t1".into(), kind: "Tool".into(), endpoint: String::new(), superclasses: Vec::new() };
        Lease { id: LeaseId(7), token: FencingToken(1), resources: vec![resource], consumed: Vec::new() }
    }

    fn tool(id: &str, lease: u64) -> Resource {
        let mut tool = Resource::new(id, ResourceClass::Module, "Tool");
        tool.holdings = vec![Holding {
            lease: LeaseId(lease),
            token: FencingToken(1),
            units: Quantity::ONE,
            session: "s".into(),
            holder: "h".into(),
            opened_by: String::new(),
        }];
        tool
    }

    fn event(kind: ResourceEventKind, id: &str, lease: Option<u64>, reason: &str) -> ResourceUpdate {
        ResourceUpdate::Event(ResourceEvent {
            part: 0,
            revision: Revision(3),
            kind,
            resource: tool(id, 7),
            lease: lease.map(|lease| (LeaseId(lease), FencingToken(1))),
            reason: reason.to_owned(),
        })
    }

    fn snapshot(resources: Vec<Resource>) -> ResourceUpdate {
        ResourceUpdate::Snapshot { revision: Revision(1), resources, youngest: LeaseId(9) }
    }

    #[test]
    fn a_release_a_deletion_and_an_expiry_end_a_lease_and_what_happens_to_others_does_not() {
        use ResourceEventKind::{Deleted, Leased, Released, Updated};
        let of = |update| told(&update, &lease());
        for by_whom in ["asked", "revoked"] {
            assert_eq!(of(event(Released, "t1", Some(7), by_whom)).as_deref(), Some("lease 7 was released by another"));
        }
        assert_eq!(
            of(event(Released, "t1", Some(7), "session expired")).as_deref(),
            Some("lease 7 ended: session expired")
        );
        assert_eq!(of(event(Deleted, "t1", None, "asked")).as_deref(), Some("`t1` was deleted"));
        for gone in ["the resource is gone", "a resource of it is gone"] {
            assert_eq!(of(event(Released, "t1", Some(7), gone)).as_deref(), Some("`t1` was deleted"));
        }
        for other in [
            event(Released, "t1", Some(8), "asked"),
            event(Released, "t2", Some(8), "asked"),
            event(Deleted, "t2", None, "asked"),
            event(Leased, "t1", Some(7), ""),
            event(Updated, "t1", None, ""),
        ] {
            assert_eq!(of(other), None);
        }
    }

    #[test]
    fn a_snapshot_in_which_the_lease_is_missing_ends_it() {
        assert_eq!(told(&snapshot(vec![tool("t1", 7), tool("t2", 8)]), &lease()), None);
        let gone = Some("lease 7 does not hold `t1` any more".to_owned());
        assert_eq!(told(&snapshot(vec![tool("t1", 8)]), &lease()), gone);
        assert_eq!(told(&snapshot(Vec::new()), &lease()), gone);
    }
}
