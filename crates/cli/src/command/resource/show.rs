//! Resources, leases and events as tables for people and as JSON for programs.

use crate::columns::{aligned, columns};
use ratn_model::resource::Lease;
use ratn_model::value::Value;
use ratn_proto::types::{
    Resource, ResourceEvent, ResourceEventKind, ResourceState, ResourceUpdate, SessionStatus, WaitingAcquire,
};
use serde_json::json;
use std::time::Duration;

/// One line per resource: what it is, how much of it is free, and who holds the rest.
pub(super) fn table(resources: &[Resource]) -> String {
    let rows = resources.iter().map(|resource| {
        [
            resource.id.clone(),
            resource.kind.clone(),
            resource.class.to_string(),
            resource.host.clone(),
            format!("{}/{}", resource.free, resource.capacity),
            holders(resource),
        ]
    });
    columns(&["ID", "KIND", "CLASS", "HOST", "FREE", "HELD BY"], rows.collect())
}

/// All details of a resource.
pub(super) fn in_full(resource: &Resource) -> String {
    let mut rows = vec![
        ["id".to_owned(), resource.id.clone()],
        ["kind".to_owned(), resource.kind.clone()],
        ["class".to_owned(), resource.class.to_string()],
        ["host".to_owned(), resource.host.clone()],
        ["state".to_owned(), state(resource.state).to_owned()],
        ["free".to_owned(), amounts(resource)],
        [
            "owner".to_owned(),
            if resource.session.is_empty() { "nobody: it stays".into() } else { resource.session.clone() },
        ],
        ["revision".to_owned(), resource.revision.0.to_string()],
    ];
    rows.extend(resource.attributes.iter().map(|(name, value)| [format!("attribute {name}"), value.to_string()]));
    rows.extend(resource.holdings.iter().map(|holding| {
        let what =
            format!("{} units, token {}, by {} ({})", holding.units, holding.token.0, holding.holder, holding.session);
        [format!("lease {}", holding.lease.0), what]
    }));
    rows.extend(resource.ending.iter().map(|ending| {
        let provider = if resource.session.is_empty() { "an operator" } else { &resource.session };
        let what = format!("ending: {} units wait for {provider} up to {} ms", ending.units, ending.within_ms);
        [format!("lease {}", ending.lease.0), what]
    }));
    aligned(&rows).join("\n")
}

/// A change in one line.
pub(super) fn event(event: &ResourceEvent) -> String {
    let resource = &event.resource;
    let mut line = format!(
        "{} {} {} ({}) free {}/{}",
        event.revision.0,
        change(event.kind),
        resource.id,
        resource.kind,
        resource.free,
        resource.capacity
    );
    if let Some((lease, token)) = event.lease {
        line += &format!(" lease {} token {}", lease.0, token.0);
    }
    if !event.reason.is_empty() {
        line += &format!(": {}", event.reason);
    }
    line
}

/// The waiting requests in the order in which they are served, each with its obstacles below.
pub(super) fn waiting(waiting: &[WaitingAcquire]) -> String {
    let rows = waiting.iter().map(|one| {
        let (request, holder, session) = (one.request.clone(), one.holder.clone(), one.session.clone());
        let due = one.due_in_ms.map_or_else(|| "-".to_owned(), |due| format!("{:.0} s", due as f64 / 1e3));
        [one.ahead.to_string(), one.priority.to_string(), one.share.to_string(), due, request, holder, session]
    });
    let mut rows: Vec<[String; 7]> = rows.collect();
    let heads = ["AHEAD", "PRIORITY", "SHARE", "DUE IN", "REQUEST", "HOLDER", "SESSION"];
    rows.insert(0, heads.map(str::to_owned));
    let mut lines = aligned(&rows).into_iter();
    let mut shown: Vec<String> = lines.next().into_iter().collect();
    for (line, one) in lines.zip(waiting) {
        shown.push(line);
        shown.extend(one.obstacles.iter().map(|obstacle| format!("  {obstacle}")));
    }
    shown.join("\n")
}

pub(super) fn waiting_json(waiting: &WaitingAcquire) -> serde_json::Value {
    let WaitingAcquire { request, session, holder, priority, ahead, obstacles, .. } = waiting;
    let WaitingAcquire { share, due_in_ms, speculative, waiting_ms, .. } = waiting;
    json!({
        "request": request, "session": session, "holder": holder, "priority": priority, "ahead": ahead,
        "obstacles": obstacles, "share": share, "due_in_ms": due_in_ms, "speculative": speculative,
        "waiting_ms": waiting_ms,
    })
}

/// The open sessions.
pub(super) fn sessions(sessions: &[SessionStatus]) -> String {
    let rows = sessions.iter().map(|session| {
        [
            session.id.clone(),
            session.client.clone(),
            session.opened_by.clone(),
            format!("{:.1} s", Duration::from_millis(session.expires_in_ms).as_secs_f64()),
            session.leases.len().to_string(),
            session.waiting.to_string(),
            session.resources.len().to_string(),
        ]
    });
    columns(&["SESSION", "CLIENT", "OPENED BY", "ENDS IN", "LEASES", "WAITING", "RESOURCES"], rows.collect())
}

pub(super) fn session_json(session: &SessionStatus) -> serde_json::Value {
    let SessionStatus { id, client, ttl_ms, expires_in_ms, leases, waiting, resources, opened_by, .. } = session;
    let SessionStatus { share, due_in_ms, .. } = session;
    let leases: Vec<u64> = leases.iter().map(|lease| lease.0).collect();
    json!({
        "session": id, "client": client, "ttl_ms": ttl_ms, "expires_in_ms": expires_in_ms, "leases": leases,
        "waiting": waiting, "resources": resources, "opened_by": opened_by, "share": share, "due_in_ms": due_in_ms,
    })
}

/// The granted lease.
pub(super) fn lease(lease: &Lease) -> String {
    let ids: Vec<&str> = lease.resources.iter().map(|resource| resource.id.as_str()).collect();
    format!("lease {} token {}: {}", lease.id.0, lease.token.0, ids.join(" "))
}

pub(super) fn lease_json(lease: &Lease) -> serde_json::Value {
    let resources = lease
        .resources
        .iter()
        .map(|resource| json!({ "id": resource.id, "kind": resource.kind, "endpoint": resource.endpoint }));
    json!({ "lease": lease.id.0, "token": lease.token.0, "resources": resources.collect::<Vec<_>>() })
}

pub(super) fn resource_json(resource: &Resource) -> serde_json::Value {
    let holdings = resource.holdings.iter().map(|holding| {
        json!({
            "lease": holding.lease.0, "token": holding.token.0, "units": holding.units,
            "session": holding.session, "holder": holding.holder,
        })
    });
    let ending = resource.ending.iter().map(|ending| {
        json!({
            "lease": ending.lease.0, "token": ending.token.0, "units": ending.units, "session": ending.session,
            "within_ms": ending.within_ms,
        })
    });
    let attributes: serde_json::Map<_, _> =
        resource.attributes.iter().map(|(name, value)| (name.clone(), plain(value))).collect();
    json!({
        "id": resource.id, "kind": resource.kind, "class": resource.class.to_string(), "host": resource.host,
        "state": state(resource.state), "free": resource.free, "capacity": resource.capacity,
        "divisible": resource.divisible, "renewable": resource.renewable,
        "session": resource.session, "revision": resource.revision.0, "attributes": attributes,
        "holdings": holdings.collect::<Vec<_>>(), "ending": ending.collect::<Vec<_>>(),
    })
}

pub(super) fn update_json(update: &ResourceUpdate) -> serde_json::Value {
    match update {
        ResourceUpdate::Snapshot { revision, resources, .. } => {
            let resources: Vec<_> = resources.iter().map(resource_json).collect();
            json!({ "revision": revision.0, "snapshot": resources })
        }
        ResourceUpdate::Event(event) => {
            let (lease, token) = event.lease.map_or((0, 0), |(lease, token)| (lease.0, token.0));
            json!({
                "revision": event.revision.0, "event": change(event.kind), "resource": resource_json(&event.resource),
                "lease": lease, "token": token, "reason": event.reason,
            })
        }
    }
}

/// Simple values as JSON values, others as text.
fn plain(value: &Value) -> serde_json::Value {
    match value {
        Value::Null => serde_json::Value::Null,
        Value::Bool(truth) => json!(truth),
        Value::Int(whole) => json!(whole),
        Value::Float(number) => json!(number),
        Value::String(text) => json!(text),
        other => json!(other.to_string()),
    }
}

/// The free amount, the total, and whether it is divisible or consumable.
fn amounts(resource: &Resource) -> String {
    let parts = if resource.divisible { ", in parts" } else { "" };
    let spent = if resource.renewable { "" } else { ", gone when it is consumed" };
    format!("{} of {}{parts}{spent}", resource.free, resource.capacity)
}

fn holders(resource: &Resource) -> String {
    let one = |holding: &ratn_proto::types::Holding| format!("{} (lease {})", holding.holder, holding.lease.0);
    let ending = |ending: &ratn_proto::types::EndingUnits| format!("(lease {} is ending)", ending.lease.0);
    let mut holders: Vec<String> = resource.holdings.iter().map(one).collect();
    holders.extend(resource.ending.iter().map(ending));
    if holders.is_empty() && resource.state == ResourceState::Exhausted {
        holders.push("(consumed)".to_owned());
    }
    holders.join(", ")
}

fn state(state: ResourceState) -> &'static str {
    match state {
        ResourceState::Free => "free",
        ResourceState::Leased => "leased",
        ResourceState::Exhausted => "exhausted",
    }
}

fn change(kind: ResourceEventKind) -> &'static str {
    match kind {
        ResourceEventKind::Created => "created",
        ResourceEventKind::Updated => "updated",
        ResourceEventKind::Deleted => "deleted",
        ResourceEventKind::Leased => "leased",
        ResourceEventKind::Released => "released",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use insta::assert_snapshot;
    use ratn_model::id::{FencingToken, LeaseId, Revision};
    use ratn_model::resource::{Quantity, ResourceClass};
    use ratn_proto::types::Holding;

    fn arm() -> Resource {
        let mut arm = Resource::new("arm", ResourceClass::Module, "Arm")
            .with_attribute("reach", Value::Float(1.2))
            .on_host("sim");
        arm.free = Quantity::ZERO;
        arm.state = ResourceState::Leased;
        arm.holdings = vec![Holding {
            lease: LeaseId(7),
            token: FencingToken(12),
            units: Quantity::ONE,
            session: "s".to_owned(),
            holder: "fetch/approach".to_owned(),
            opened_by: "uid 1000".to_owned(),
        }];
        arm
    }

    #[test]
    fn a_table_says_who_has_what() {
        let room = Resource::new("world-model@compute", ResourceClass::World, "WorldModel").with_capacity(64);
        assert_snapshot!(table(&[arm(), room]), @r"
        ID                   KIND        CLASS   HOST  FREE   HELD BY
        arm                  Arm         module  sim   0/1    fetch/approach (lease 7)
        world-model@compute  WorldModel  world         64/64
        ");
    }

    #[test]
    fn one_resource_is_shown_in_full() {
        assert_snapshot!(in_full(&arm()), @r"
        id               arm
        kind             Arm
        class            module
        host             sim
        state            leased
        free             0 of 1
        owner            nobody: it stays
        revision         0
        attribute reach  1.2
        lease 7          1 units, token 12, by fetch/approach (s)
        ");
    }

    #[test]
    fn what_waits_says_what_is_in_its_way() {
        let one = WaitingAcquire {
            request: "run/7/1".to_owned(),
            session: "s".to_owned(),
            holder: "fetch/approach".to_owned(),
            priority: 5,
            ahead: 0,
            obstacles: vec!["`block Arm`: held by lease 7 of session t".to_owned()],
            share: 2.0,
            due_in_ms: Some(90_400),
            ..WaitingAcquire::default()
        };
        let other = WaitingAcquire {
            ahead: 1,
            due_in_ms: None,
            request: "run/8/1".to_owned(),
            obstacles: Vec::new(),
            ..one.clone()
        };
        assert_snapshot!(waiting(&[one, other]), @r"
        AHEAD  PRIORITY  SHARE  DUE IN  REQUEST  HOLDER          SESSION
        0      5         2      90 s    run/7/1  fetch/approach  s
          `block Arm`: held by lease 7 of session t
        1      5         2      -       run/8/1  fetch/approach  s
        ");
    }

    #[test]
    fn an_event_is_one_line() {
        let event = ResourceEvent {
            part: 0,
            revision: Revision(3),
            kind: ResourceEventKind::Released,
            resource: arm(),
            lease: Some((LeaseId(7), FencingToken(12))),
            reason: "session expired".to_owned(),
        };
        assert_snapshot!(super::event(&event), @"3 released arm (Arm) free 0/1 lease 7 token 12: session expired");
    }
}
