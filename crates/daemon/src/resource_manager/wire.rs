//! Converts the pool's views and events to wire types.

use ratn_model::resource::Lease;
use ratn_model::time::Timestamp;
use ratn_proto::types::{
    EndingUnits, Holding, Resource, ResourceEvent, ResourceEventKind, ResourceFilter, ResourceState, SessionStatus,
    WaitingAcquire,
};
use ratn_proto::v1;
use ratn_resources::{AcquireRequest, Change, Explanation, ResourceView, SessionView, WatchEvent};
use std::time::Duration;

pub(super) fn resource(view: &ResourceView) -> Resource {
    let state = if !view.free.is_zero() {
        ResourceState::Free
    } else if view.consumed >= view.capacity {
        ResourceState::Exhausted
    } else {
        ResourceState::Leased
    };
    let holding = |holding: &ratn_resources::Holding| Holding {
        lease: holding.lease,
        token: holding.token,
        units: holding.units,
        session: holding.session.as_str().to_owned(),
        holder: holding.purpose.to_string(),
        opened_by: holding.opened_by.to_string(),
    };
    let ending = |ending: ratn_resources::EndingUnits| EndingUnits {
        lease: ending.lease,
        token: ending.token,
        units: ending.units,
        session: ending.session.as_str().to_owned(),
        within_ms: milliseconds(ending.within),
    };
    let description = &view.description;
    Resource {
        id: description.id.clone(),
        class: description.class,
        kind: description.kind.clone(),
        attributes: description.attributes.iter().map(|(name, value)| (name.to_owned(), value.clone())).collect(),
        capacity: description.capacity,
        divisible: description.divisible,
        renewable: description.renewable,
        host: description.host.clone(),
        session: view.owner.as_ref().map(|owner| owner.as_str().to_owned()).unwrap_or_default(),
        revision: view.revision,
        state,
        free: view.free,
        holdings: view.holders.live().map(holding).collect(),
        ending: view.holders.ending().map(ending).collect(),
    }
}

/// A lease for its holder.
pub(super) fn lease(lease: Lease, session_id: String) -> v1::Lease {
    v1::Lease { session_id, ..lease.into() }
}

/// One event of the pool may affect several resources: it becomes one event for each, with the same revision.
pub(super) fn events(event: &WatchEvent, wanted: impl Fn(&ResourceView) -> bool) -> Vec<ResourceEvent> {
    use ResourceEventKind::{Created, Deleted, Leased, Released, Updated};
    let revision = event.revision;
    let of = |part, kind, view: &ResourceView, lease, reason: String| ResourceEvent {
        revision,
        kind,
        resource: resource(view),
        lease,
        reason,
        part,
    };
    let each = |kind, views: &[ResourceView], lease, reason: &str| {
        let views = (0..).zip(views).filter(|(_, view)| wanted(view));
        views.map(|(part, view)| of(part, kind, view, lease, reason.to_owned())).collect()
    };
    match &event.change {
        change if !change.resources().iter().any(&wanted) => Vec::new(),
        Change::ResourceCreated(view) => vec![of(0, Created, view, None, String::new())],
        Change::ResourceUpdated(view) => vec![of(0, Updated, view, None, String::new())],
        Change::ResourceDeleted { resource, reason } => vec![of(0, Deleted, resource, None, reason.to_string())],
        Change::ResourceLost { lease, token, resource, .. } => {
            vec![of(0, Released, resource, Some((*lease, *token)), "the resource is gone".to_owned())]
        }
        Change::LeaseGranted { lease, token, resources, .. } => each(Leased, resources, Some((*lease, *token)), ""),
        Change::LeaseEnded { lease, token, resources, reason, .. } => {
            each(Released, resources, Some((*lease, *token)), &reason.to_string())
        }
        Change::UnitsFreed { lease, token, resource, confirmed } => {
            let why = if *confirmed { "standstill confirmed" } else { "standstill not confirmed within its bound" };
            vec![of(0, Updated, resource, Some((*lease, *token)), why.to_owned())]
        }
    }
}

pub(super) fn passes(view: &ResourceView, filter: &ResourceFilter) -> bool {
    let owner = view.owner.as_ref().map_or("", |owner| owner.as_str());
    (filter.kinds.is_empty() || filter.kinds.contains(&view.kind))
        && filter.class.is_none_or(|class| class == view.class)
        && (filter.host.is_empty() || filter.host == view.host)
        && (filter.session.is_empty() || filter.session == owner)
        && filter.attributes.iter().all(|(name, value)| view.attributes.get(name) == Some(value))
        && filter.conditions.iter().all(|condition| view.meets(condition))
}

/// Maximum number of leases and resources listed for a session.
pub(super) const NAMED: usize = 1_000;

pub(super) fn session(view: SessionView, now: Timestamp) -> SessionStatus {
    SessionStatus {
        id: view.id.as_str().to_owned(),
        client: view.name,
        ttl_ms: milliseconds(view.ttl),
        expires_in_ms: milliseconds(Duration::from_nanos(view.expires.0.saturating_sub(now.0))),
        leases: view.leases,
        waiting: u32::try_from(view.waiters.len()).unwrap_or(u32::MAX),
        resources: view.provides,
        opened_by: view.opened_by.to_string(),
        share: view.standing.share.number(),
        due_in_ms: view.standing.due.map(|due| due_in_ms(due, now)),
    }
}

/// Negative if overdue.
fn due_in_ms(due: Timestamp, now: Timestamp) -> i64 {
    let whole = |time: Duration| i64::try_from(time.as_millis()).unwrap_or(i64::MAX);
    whole(due.since(now)) - whole(now.since(due))
}

fn milliseconds(time: Duration) -> u64 {
    u64::try_from(time.as_millis()).unwrap_or(u64::MAX)
}

pub(super) fn waiting(request_id: &str, request: &AcquireRequest, why: &Explanation, now: Timestamp) -> WaitingAcquire {
    WaitingAcquire {
        request: request_id.to_owned(),
        session: request.session.as_str().to_owned(),
        holder: request.purpose.clone(),
        priority: request.priority,
        ahead: u32::try_from(why.ahead).unwrap_or(u32::MAX),
        obstacles: why.obstacles.iter().map(ToString::to_string).collect(),
        held_by: if why.is_hopeful() { why.held_by().collect() } else { Vec::new() },
        share: why.standing.share.number(),
        due_in_ms: why.standing.due.map(|due| due_in_ms(due, now)),
        speculative: request.speculative,
        waiting_ms: milliseconds(now.since(why.asked)),
    }
}
