//! The pool's views and events as the wire's.

use ratn_proto::types::{Holding, Resource, ResourceEvent, ResourceEventKind, ResourceState};
use ratn_resources::{Change, ResourceView, WatchEvent};

pub(super) fn resource(view: &ResourceView) -> Resource {
    let state = if !view.free.is_zero() {
        ResourceState::Free
    } else if view.consumed >= view.capacity {
        ResourceState::Exhausted
    } else {
        ResourceState::Leased
    };
    let holding = |holding: ratn_resources::Holding| Holding {
        lease: holding.lease,
        token: holding.token,
        units: holding.units.units(),
        session: holding.session.as_str().to_owned(),
        holder: holding.purpose.to_string(),
    };
    let description = &view.description;
    Resource {
        id: description.id.clone(),
        class: description.class,
        kind: description.kind.clone(),
        attributes: description.attributes.iter().map(|(name, value)| (name.to_owned(), value.clone())).collect(),
        capacity: description.capacity.units(),
        host: description.host.clone(),
        session: view.owner.as_ref().map(|owner| owner.as_str().to_owned()).unwrap_or_default(),
        revision: view.revision,
        state,
        free: view.free.units(),
        holdings: view.holdings.iter().cloned().map(holding).collect(),
    }
}

/// One event of the pool may touch several resources: one event each, all of one revision.
pub(super) fn events(event: &WatchEvent) -> Vec<ResourceEvent> {
    use ResourceEventKind::{Created, Deleted, Leased, Released, Updated};
    let revision = event.revision;
    let of = |kind, view: &ResourceView, lease, reason: String| ResourceEvent {
        revision,
        kind,
        resource: resource(view),
        lease,
        reason,
    };
    match &event.change {
        Change::ResourceCreated(view) => vec![of(Created, view, None, String::new())],
        Change::ResourceUpdated(view) => vec![of(Updated, view, None, String::new())],
        Change::ResourceDeleted { resource, reason } => vec![of(Deleted, resource, None, reason.to_string())],
        Change::ResourceLost { lease, token, resource, .. } => {
            vec![of(Released, resource, Some((*lease, *token)), "the resource is gone".to_owned())]
        }
        Change::LeaseGranted { lease, token, resources, .. } => {
            resources.iter().map(|view| of(Leased, view, Some((*lease, *token)), String::new())).collect()
        }
        Change::LeaseEnded { lease, token, resources, reason, .. } => {
            resources.iter().map(|view| of(Released, view, Some((*lease, *token)), reason.to_string())).collect()
        }
    }
}
