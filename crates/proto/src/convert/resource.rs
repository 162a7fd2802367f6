//! Resources, requirements, leases, events of the pool.

use super::{Malformed, all, each, few, label, missing_choice, name, names, ports, required, wire_ports};
use crate::types::{
    Demand, EndingUnits, Holding, Recalled, Resource, ResourceEvent, ResourceEventKind, ResourceFilter, ResourceState,
    ResourceUpdate, SessionStatus, WaitingAcquire,
};
use crate::v1;
use ratn_model::condition::{Comparison, Condition};
use ratn_model::id::{FencingToken, LeaseId, Revision};
use ratn_model::resource::{
    Lease, LeasedResource, OperatedUnits, Quantity, Requirement, ResourceClass, ResourceOperation,
};
use ratn_model::value::Value;

impl From<ResourceClass> for v1::ResourceClass {
    fn from(class: ResourceClass) -> v1::ResourceClass {
        match class {
            ResourceClass::System => v1::ResourceClass::System,
            ResourceClass::Process => v1::ResourceClass::Process,
            ResourceClass::Module => v1::ResourceClass::Module,
            ResourceClass::World => v1::ResourceClass::World,
            ResourceClass::Task => v1::ResourceClass::Task,
        }
    }
}

/// The class of an enum field; unspecified is `None`.
fn class(number: i32) -> Result<Option<ResourceClass>, Malformed> {
    let class = v1::ResourceClass::try_from(number)
        .map_err(|_| Malformed::new("class", format!("{number} is no resource class")))?;
    Ok(match class {
        v1::ResourceClass::Unspecified => None,
        v1::ResourceClass::System => Some(ResourceClass::System),
        v1::ResourceClass::Process => Some(ResourceClass::Process),
        v1::ResourceClass::Module => Some(ResourceClass::Module),
        v1::ResourceClass::World => Some(ResourceClass::World),
        v1::ResourceClass::Task => Some(ResourceClass::Task),
    })
}

impl From<ResourceOperation> for v1::ResourceOperation {
    fn from(operation: ResourceOperation) -> v1::ResourceOperation {
        match operation {
            ResourceOperation::Block => v1::ResourceOperation::Block,
            ResourceOperation::Consume => v1::ResourceOperation::Consume,
            ResourceOperation::Create => v1::ResourceOperation::Create,
            ResourceOperation::Delete => v1::ResourceOperation::Delete,
            ResourceOperation::Exists => v1::ResourceOperation::Exists,
        }
    }
}

fn operation(number: i32) -> Result<ResourceOperation, Malformed> {
    match v1::ResourceOperation::try_from(number) {
        Ok(v1::ResourceOperation::Block) => Ok(ResourceOperation::Block),
        Ok(v1::ResourceOperation::Consume) => Ok(ResourceOperation::Consume),
        Ok(v1::ResourceOperation::Create) => Ok(ResourceOperation::Create),
        Ok(v1::ResourceOperation::Delete) => Ok(ResourceOperation::Delete),
        Ok(v1::ResourceOperation::Exists) => Ok(ResourceOperation::Exists),
        Ok(v1::ResourceOperation::Unspecified) => Err(Malformed::new("operation", "is not set")),
        Err(_) => Err(Malformed::new("operation", format!("{number} is no resource operation"))),
    }
}

/// An amount from the wire, which may be any number.
fn amount(number: f64, field: &str) -> Result<Quantity, Malformed> {
    Quantity::try_from(number).map_err(|error| Malformed::new(field, error.to_string()))
}

/// An amount greater than zero.
fn some(number: f64, field: &str) -> Result<Quantity, Malformed> {
    match amount(number, field)? {
        Quantity::ZERO => Err(Malformed::new(field, "is 0: it must be more than nothing")),
        quantity => Ok(quantity),
    }
}

impl From<Requirement> for v1::Requirement {
    fn from(requirement: Requirement) -> v1::Requirement {
        v1::Requirement {
            operation: v1::ResourceOperation::from(requirement.operation).into(),
            kind: requirement.kind,
            class: requirement.class.map_or(v1::ResourceClass::Unspecified, v1::ResourceClass::from).into(),
            attributes: wire_ports(requirement.attributes),
            count: requirement.count.into(),
            conditions: all(requirement.conditions),
            divisible: requirement.divisible,
        }
    }
}

impl TryFrom<v1::Requirement> for Requirement {
    type Error = Malformed;

    fn try_from(requirement: v1::Requirement) -> Result<Requirement, Malformed> {
        name(&requirement.kind, "kind")?;
        few(requirement.attributes.len(), "attributes")?;
        few(requirement.conditions.len(), "conditions")?;
        Ok(Requirement {
            operation: operation(requirement.operation)?,
            kind: requirement.kind,
            class: class(requirement.class)?,
            attributes: ports(requirement.attributes, "attributes")?,
            count: some(requirement.count, "count")?,
            divisible: requirement.divisible,
            conditions: each(requirement.conditions, "conditions")?,
        })
    }
}

impl From<Condition> for v1::Condition {
    fn from(condition: Condition) -> v1::Condition {
        let comparison = match condition.comparison {
            Comparison::Equal => v1::Comparison::Equal,
            Comparison::NotEqual => v1::Comparison::NotEqual,
            Comparison::Less => v1::Comparison::Less,
            Comparison::LessOrEqual => v1::Comparison::LessOrEqual,
            Comparison::Greater => v1::Comparison::Greater,
            Comparison::GreaterOrEqual => v1::Comparison::GreaterOrEqual,
            Comparison::In => v1::Comparison::In,
            Comparison::Has => v1::Comparison::Has,
        };
        let value = (condition.comparison != Comparison::Has).then(|| condition.value.into());
        v1::Condition { attribute: condition.attribute, comparison: comparison.into(), value }
    }
}

impl TryFrom<v1::Condition> for Condition {
    type Error = Malformed;

    fn try_from(condition: v1::Condition) -> Result<Condition, Malformed> {
        name(&condition.attribute, "attribute")?;
        let number = condition.comparison;
        let comparison = match v1::Comparison::try_from(number) {
            Ok(v1::Comparison::Equal) => Comparison::Equal,
            Ok(v1::Comparison::NotEqual) => Comparison::NotEqual,
            Ok(v1::Comparison::Less) => Comparison::Less,
            Ok(v1::Comparison::LessOrEqual) => Comparison::LessOrEqual,
            Ok(v1::Comparison::Greater) => Comparison::Greater,
            Ok(v1::Comparison::GreaterOrEqual) => Comparison::GreaterOrEqual,
            Ok(v1::Comparison::In) => Comparison::In,
            Ok(v1::Comparison::Has) => Comparison::Has,
            Ok(v1::Comparison::Unspecified) => return Err(Malformed::new("comparison", "is not set")),
            Err(_) => return Err(Malformed::new("comparison", format!("{number} is no comparison"))),
        };
        let value = match comparison {
            Comparison::Has if condition.value.is_some() => {
                let rule = "is set: `has` asks whether the attribute is there and takes none";
                return Err(Malformed::new("value", rule));
            }
            Comparison::Has => Value::Null,
            _ => required(condition.value, "value")?,
        };
        if comparison == Comparison::In && !matches!(value, Value::List(_)) {
            return Err(Malformed::new("value", "is no list: `in` takes one"));
        }
        Ok(Condition { attribute: condition.attribute, comparison, value })
    }
}

impl From<Demand> for v1::Demand {
    fn from(demand: Demand) -> v1::Demand {
        v1::Demand {
            requirement: Some(demand.requirement.into()),
            kinds: demand.kinds,
            provided: demand.provided.into(),
            queued: demand.queued.into(),
        }
    }
}

impl TryFrom<v1::Demand> for Demand {
    type Error = Malformed;

    fn try_from(demand: v1::Demand) -> Result<Demand, Malformed> {
        let requirement = required(demand.requirement, "requirement")?;
        Ok(Demand {
            requirement,
            kinds: demand.kinds,
            provided: amount(demand.provided, "provided")?,
            queued: amount(demand.queued, "queued")?,
        })
    }
}

impl From<Lease> for v1::Lease {
    fn from(lease: Lease) -> v1::Lease {
        let session_id = String::new();
        let (resources, consumed) = (all(lease.resources), all(lease.consumed));
        v1::Lease { id: lease.id.0, token: lease.token.0, resources, session_id, consumed }
    }
}

impl TryFrom<v1::Lease> for Lease {
    type Error = Malformed;

    fn try_from(lease: v1::Lease) -> Result<Lease, Malformed> {
        Ok(Lease {
            id: LeaseId(lease.id),
            token: FencingToken(lease.token),
            resources: each(lease.resources, "resources")?,
            consumed: each(lease.consumed, "consumed")?,
        })
    }
}

impl From<OperatedUnits> for v1::OperatedUnits {
    fn from(operated: OperatedUnits) -> v1::OperatedUnits {
        let OperatedUnits { resource, kind, units, ends_with_session } = operated;
        v1::OperatedUnits { resource_id: resource, kind, units: units.into(), ends_with_session }
    }
}

impl TryFrom<v1::OperatedUnits> for OperatedUnits {
    type Error = Malformed;

    fn try_from(operated: v1::OperatedUnits) -> Result<OperatedUnits, Malformed> {
        name(&operated.resource_id, "resource_id")?;
        name(&operated.kind, "kind")?;
        Ok(OperatedUnits {
            resource: operated.resource_id,
            kind: operated.kind,
            units: amount(operated.units, "units")?,
            ends_with_session: operated.ends_with_session,
        })
    }
}

impl From<Option<Recalled>> for v1::RecalledRequest {
    fn from(recalled: Option<Recalled>) -> v1::RecalledRequest {
        let known = recalled.is_some();
        let Recalled { created, operated } = recalled.unwrap_or_default();
        v1::RecalledRequest { known, created_resource_id: created.unwrap_or_default(), operated: all(operated) }
    }
}

impl TryFrom<v1::RecalledRequest> for Option<Recalled> {
    type Error = Malformed;

    fn try_from(recalled: v1::RecalledRequest) -> Result<Option<Recalled>, Malformed> {
        label(&recalled.created_resource_id, "created_resource_id")?;
        let created = Some(recalled.created_resource_id).filter(|id| !id.is_empty());
        let operated = each(recalled.operated, "operated")?;
        Ok(recalled.known.then_some(Recalled { created, operated }))
    }
}

impl From<LeasedResource> for v1::LeasedResource {
    fn from(resource: LeasedResource) -> v1::LeasedResource {
        v1::LeasedResource {
            id: resource.id,
            kind: resource.kind,
            endpoint: resource.endpoint,
            superclasses: resource.superclasses,
        }
    }
}

impl TryFrom<v1::LeasedResource> for LeasedResource {
    type Error = Malformed;

    fn try_from(resource: v1::LeasedResource) -> Result<LeasedResource, Malformed> {
        name(&resource.id, "id")?;
        name(&resource.kind, "kind")?;
        label(&resource.endpoint, "endpoint")?;
        names(&resource.superclasses, "superclasses")?;
        Ok(LeasedResource {
            id: resource.id,
            kind: resource.kind,
            endpoint: resource.endpoint,
            superclasses: resource.superclasses,
        })
    }
}

impl From<Holding> for v1::Holding {
    fn from(holding: Holding) -> v1::Holding {
        v1::Holding {
            lease_id: holding.lease.0,
            token: holding.token.0,
            units: holding.units.into(),
            session_id: holding.session,
            holder: holding.holder,
            opened_by: holding.opened_by,
        }
    }
}

impl TryFrom<v1::Holding> for Holding {
    type Error = Malformed;

    fn try_from(holding: v1::Holding) -> Result<Holding, Malformed> {
        label(&holding.session_id, "session_id")?;
        label(&holding.holder, "holder")?;
        label(&holding.opened_by, "opened_by")?;
        Ok(Holding {
            lease: LeaseId(holding.lease_id),
            token: FencingToken(holding.token),
            units: amount(holding.units, "units")?,
            session: holding.session_id,
            holder: holding.holder,
            opened_by: holding.opened_by,
        })
    }
}

impl From<EndingUnits> for v1::EndingUnits {
    fn from(ending: EndingUnits) -> v1::EndingUnits {
        v1::EndingUnits {
            lease_id: ending.lease.0,
            token: ending.token.0,
            units: ending.units.into(),
            session_id: ending.session,
            within_ms: ending.within_ms,
        }
    }
}

impl TryFrom<v1::EndingUnits> for EndingUnits {
    type Error = Malformed;

    fn try_from(ending: v1::EndingUnits) -> Result<EndingUnits, Malformed> {
        label(&ending.session_id, "session_id")?;
        Ok(EndingUnits {
            lease: LeaseId(ending.lease_id),
            token: FencingToken(ending.token),
            units: amount(ending.units, "units")?,
            session: ending.session_id,
            within_ms: ending.within_ms,
        })
    }
}

impl From<Resource> for v1::Resource {
    fn from(resource: Resource) -> v1::Resource {
        let state = match resource.state {
            ResourceState::Free => v1::ResourceState::Free,
            ResourceState::Leased => v1::ResourceState::Leased,
            ResourceState::Exhausted => v1::ResourceState::Exhausted,
        };
        v1::Resource {
            id: resource.id,
            class: v1::ResourceClass::from(resource.class).into(),
            kind: resource.kind,
            attributes: wire_ports(resource.attributes),
            capacity: resource.capacity.into(),
            divisible: resource.divisible,
            non_renewable: !resource.renewable,
            host: resource.host,
            session_id: resource.session,
            revision: resource.revision.0,
            state: state.into(),
            free: resource.free.into(),
            holdings: all(resource.holdings),
            ending: all(resource.ending),
        }
    }
}

impl TryFrom<v1::Resource> for Resource {
    type Error = Malformed;

    fn try_from(resource: v1::Resource) -> Result<Resource, Malformed> {
        label(&resource.id, "id")?;
        name(&resource.kind, "kind")?;
        label(&resource.host, "host")?;
        label(&resource.session_id, "session_id")?;
        let state = match v1::ResourceState::try_from(resource.state) {
            Ok(v1::ResourceState::Unspecified | v1::ResourceState::Free) => ResourceState::Free,
            Ok(v1::ResourceState::Leased) => ResourceState::Leased,
            Ok(v1::ResourceState::Exhausted) => ResourceState::Exhausted,
            Err(_) => return Err(Malformed::new("state", format!("{} is no resource state", resource.state))),
        };
        Ok(Resource {
            id: resource.id,
            class: class(resource.class)?.ok_or_else(|| Malformed::new("class", "is not set"))?,
            kind: resource.kind,
            attributes: ports(resource.attributes, "attributes")?,
            capacity: some(resource.capacity, "capacity")?,
            divisible: resource.divisible,
            renewable: !resource.non_renewable,
            host: resource.host,
            session: resource.session_id,
            revision: Revision(resource.revision),
            state,
            free: amount(resource.free, "free")?,
            holdings: each(resource.holdings, "holdings")?,
            ending: each(resource.ending, "ending")?,
        })
    }
}

impl From<ResourceEvent> for v1::ResourceEvent {
    fn from(event: ResourceEvent) -> v1::ResourceEvent {
        let kind = match event.kind {
            ResourceEventKind::Created => v1::ResourceEventKind::Created,
            ResourceEventKind::Updated => v1::ResourceEventKind::Updated,
            ResourceEventKind::Deleted => v1::ResourceEventKind::Deleted,
            ResourceEventKind::Leased => v1::ResourceEventKind::Leased,
            ResourceEventKind::Released => v1::ResourceEventKind::Released,
        };
        let (lease, token) = event.lease.unwrap_or_default();
        v1::ResourceEvent {
            revision: event.revision.0,
            kind: kind.into(),
            resource: Some(event.resource.into()),
            lease_id: lease.0,
            token: token.0,
            reason: event.reason,
            part: event.part,
        }
    }
}

impl TryFrom<v1::ResourceEvent> for ResourceEvent {
    type Error = Malformed;

    fn try_from(event: v1::ResourceEvent) -> Result<ResourceEvent, Malformed> {
        let kind = match v1::ResourceEventKind::try_from(event.kind) {
            Ok(v1::ResourceEventKind::Created) => ResourceEventKind::Created,
            Ok(v1::ResourceEventKind::Updated) => ResourceEventKind::Updated,
            Ok(v1::ResourceEventKind::Deleted) => ResourceEventKind::Deleted,
            Ok(v1::ResourceEventKind::Leased) => ResourceEventKind::Leased,
            Ok(v1::ResourceEventKind::Released) => ResourceEventKind::Released,
            Ok(v1::ResourceEventKind::Unspecified) => return Err(Malformed::new("kind", "is not set")),
            Err(_) => return Err(Malformed::new("kind", format!("{} is no kind of event", event.kind))),
        };
        Ok(ResourceEvent {
            revision: Revision(event.revision),
            kind,
            resource: required(event.resource, "resource")?,
            lease: (event.lease_id != 0 || matches!(kind, ResourceEventKind::Leased | ResourceEventKind::Released))
                .then_some((LeaseId(event.lease_id), FencingToken(event.token))),
            reason: event.reason,
            part: event.part,
        })
    }
}

impl From<ResourceUpdate> for v1::ResourceServiceWatchResponse {
    fn from(update: ResourceUpdate) -> v1::ResourceServiceWatchResponse {
        use v1::resource_service_watch_response::Kind;
        let kind = match update {
            ResourceUpdate::Snapshot { revision, resources, youngest } => Kind::Snapshot(v1::ResourceSnapshot {
                revision: revision.0,
                resources: all(resources),
                youngest_lease_id: youngest.0,
                more: false,
            }),
            ResourceUpdate::Event(event) => Kind::Event(event.into()),
        };
        v1::ResourceServiceWatchResponse { kind: Some(kind) }
    }
}

impl TryFrom<v1::ResourceServiceWatchResponse> for ResourceUpdate {
    type Error = Malformed;

    fn try_from(update: v1::ResourceServiceWatchResponse) -> Result<ResourceUpdate, Malformed> {
        use v1::resource_service_watch_response::Kind;
        match update.kind.ok_or_else(|| missing_choice("snapshot, event"))? {
            Kind::Snapshot(snapshot) => Ok(ResourceUpdate::Snapshot {
                revision: Revision(snapshot.revision),
                resources: each(snapshot.resources, "snapshot.resources")?,
                youngest: LeaseId(snapshot.youngest_lease_id),
            }),
            Kind::Event(event) => {
                ResourceEvent::try_from(event).map(ResourceUpdate::Event).map_err(|m| m.within("event"))
            }
        }
    }
}

impl From<WaitingAcquire> for v1::WaitingAcquire {
    fn from(waiting: WaitingAcquire) -> v1::WaitingAcquire {
        v1::WaitingAcquire {
            request_id: waiting.request,
            session_id: waiting.session,
            holder: waiting.holder,
            priority: waiting.priority,
            ahead: waiting.ahead,
            obstacles: waiting.obstacles,
            held_by_leases: waiting.held_by.into_iter().map(|lease| lease.0).collect(),
            share: waiting.share,
            due_in_ms: waiting.due_in_ms,
            speculative: waiting.speculative,
            waiting_ms: waiting.waiting_ms,
        }
    }
}

impl TryFrom<v1::WaitingAcquire> for WaitingAcquire {
    type Error = Malformed;

    fn try_from(waiting: v1::WaitingAcquire) -> Result<WaitingAcquire, Malformed> {
        Ok(WaitingAcquire {
            request: waiting.request_id,
            session: waiting.session_id,
            holder: waiting.holder,
            priority: waiting.priority,
            ahead: waiting.ahead,
            obstacles: waiting.obstacles,
            held_by: waiting.held_by_leases.into_iter().map(LeaseId).collect(),
            share: waiting.share,
            due_in_ms: waiting.due_in_ms,
            speculative: waiting.speculative,
            waiting_ms: waiting.waiting_ms,
        })
    }
}

impl From<SessionStatus> for v1::SessionStatus {
    fn from(session: SessionStatus) -> v1::SessionStatus {
        v1::SessionStatus {
            session_id: session.id,
            client: session.client,
            ttl_ms: session.ttl_ms,
            expires_in_ms: session.expires_in_ms,
            lease_ids: session.leases.into_iter().map(|lease| lease.0).collect(),
            waiting: session.waiting,
            resource_ids: session.resources,
            opened_by: session.opened_by,
            share: session.share,
            due_in_ms: session.due_in_ms,
        }
    }
}

impl TryFrom<v1::SessionStatus> for SessionStatus {
    type Error = Malformed;

    fn try_from(session: v1::SessionStatus) -> Result<SessionStatus, Malformed> {
        Ok(SessionStatus {
            id: session.session_id,
            client: session.client,
            ttl_ms: session.ttl_ms,
            expires_in_ms: session.expires_in_ms,
            leases: session.lease_ids.into_iter().map(LeaseId).collect(),
            waiting: session.waiting,
            resources: session.resource_ids,
            opened_by: session.opened_by,
            share: session.share,
            due_in_ms: session.due_in_ms,
        })
    }
}

impl From<ResourceFilter> for v1::ListRequest {
    fn from(filter: ResourceFilter) -> v1::ListRequest {
        v1::ListRequest {
            kinds: filter.kinds,
            class: filter.class.map_or(v1::ResourceClass::Unspecified, v1::ResourceClass::from).into(),
            host: filter.host,
            attributes: wire_ports(filter.attributes),
            session_id: filter.session,
            conditions: all(filter.conditions),
            page_bytes: 0,
            page_token: String::new(),
        }
    }
}

impl TryFrom<v1::ListRequest> for ResourceFilter {
    type Error = Malformed;

    fn try_from(request: v1::ListRequest) -> Result<ResourceFilter, Malformed> {
        label(&request.host, "host")?;
        label(&request.session_id, "session_id")?;
        few(request.kinds.len(), "kinds")?;
        few(request.attributes.len(), "attributes")?;
        few(request.conditions.len(), "conditions")?;
        super::kinds(&request.kinds, "kinds")?;
        Ok(ResourceFilter {
            kinds: request.kinds,
            class: class(request.class)?,
            host: request.host,
            attributes: ports(request.attributes, "attributes")?,
            session: request.session_id,
            conditions: each(request.conditions, "conditions")?,
        })
    }
}
