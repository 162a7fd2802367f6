//! A resource: its description, who has how much of it, and therefore what is free.

use crate::id::SessionId;
use crate::lease::Leases;
use ratn_model::id::{FencingToken, LeaseId, Revision};
use ratn_model::resource::{LeasedResource, Requirement, ResourceClass};
use ratn_model::value::Value;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};

/// The attribute that says where a resource's action service is.
pub const ENDPOINT_ATTRIBUTE: &str = "endpoint";

/// What a create asks for.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ResourceSpec {
    /// Its id; `None` lets the pool number it, `box_delivered-3`.
    pub id: Option<String>,
    /// Its class.
    pub class: ResourceClass,
    /// Its kind, `PathPlanner`.
    pub kind: String,
    /// Attributes; `endpoint` says where its action service is.
    pub attributes: BTreeMap<String, Value>,
    /// How many units it has: how many may hold one at once.
    pub capacity: u32,
    /// Whether what a task consumed returns when the task ends.
    pub renewable: bool,
    /// The host that it is on; may be empty.
    pub host: String,
}

/// A resource as others see it.
#[derive(Debug, Clone, PartialEq)]
pub struct ResourceView {
    /// Its id.
    pub id: String,
    /// Its class.
    pub class: ResourceClass,
    /// Its kind.
    pub kind: String,
    /// Its attributes.
    pub attributes: BTreeMap<String, Value>,
    /// Units in all, those consumed included.
    pub capacity: u32,
    /// Units that nobody holds and nobody has consumed.
    pub free: u32,
    /// Units consumed.
    pub consumed: u32,
    /// Whether what a task consumed returns when the task ends.
    pub renewable: bool,
    /// The host that it is on; may be empty.
    pub host: String,
    /// The session with which it vanishes.
    pub owner: Option<SessionId>,
    /// Who has units of it now, in the order of leases.
    pub holdings: Vec<Holding>,
    /// The pool's revision when it was created or updated.
    pub revision: Revision,
}

/// Units of a resource under a lease.
#[derive(Debug, Clone, PartialEq)]
pub struct Holding {
    /// The lease.
    pub lease: LeaseId,
    /// Its fencing token.
    pub token: FencingToken,
    /// Whose lease.
    pub session: SessionId,
    /// How many units.
    pub units: u32,
    /// What the lease is for.
    pub purpose: String,
}

/// A resource in the pool. `holders` is the only record of who holds how much.
#[derive(Debug, Clone)]
pub(crate) struct Resource {
    pub(crate) spec: ResourceSpec,
    pub(crate) owner: Option<SessionId>,
    pub(crate) revision: Revision,
    pub(crate) holders: BTreeMap<LeaseId, u32>,
    /// What sessions have consumed of it until their task ends.
    pub(crate) consumers: BTreeMap<SessionId, u32>,
    /// What was consumed for good.
    pub(crate) spent: u32,
}

/// Every resource, by id, and the ids of each kind.
#[derive(Debug, Clone, Default)]
pub(crate) struct Resources {
    by_id: BTreeMap<String, Resource>,
    by_kind: BTreeMap<String, BTreeSet<String>>,
}

impl ResourceSpec {
    /// A resource with one unit and no attributes.
    pub fn new(class: ResourceClass, kind: impl Into<String>) -> ResourceSpec {
        ResourceSpec {
            id: None,
            class,
            kind: kind.into(),
            attributes: BTreeMap::new(),
            capacity: 1,
            renewable: true,
            host: String::new(),
        }
    }

    /// With this id.
    #[must_use]
    pub fn id(mut self, id: impl Into<String>) -> ResourceSpec {
        self.id = Some(id.into());
        self
    }

    /// With this many units.
    #[must_use]
    pub fn capacity(mut self, capacity: u32) -> ResourceSpec {
        self.capacity = capacity;
        self
    }

    /// With this attribute.
    #[must_use]
    pub fn attribute(mut self, name: impl Into<String>, value: Value) -> ResourceSpec {
        self.attributes.insert(name.into(), value);
        self
    }
}

impl Resource {
    pub(crate) fn consumed(&self) -> u32 {
        self.consumers.values().fold(self.spent, |sum, units| sum.saturating_add(*units))
    }

    /// Units that exist and are not consumed, held or not.
    pub(crate) fn quantity(&self) -> u32 {
        self.spec.capacity.saturating_sub(self.consumed())
    }

    /// Units that can be given away now.
    pub(crate) fn free(&self) -> u32 {
        self.holders.values().fold(self.quantity(), |free, units| free.saturating_sub(*units))
    }

    pub(crate) fn fits(&self, requirement: &Requirement) -> bool {
        self.spec.kind == requirement.kind
            && requirement.class.is_none_or(|class| class == self.spec.class)
            && requirement
                .attributes
                .iter()
                .all(|(name, want)| self.spec.attributes.get(name).is_some_and(|have| same(have, want)))
    }

    pub(crate) fn leased(&self, id: &str) -> LeasedResource {
        let endpoint = match self.spec.attributes.get(ENDPOINT_ATTRIBUTE) {
            Some(Value::String(endpoint)) => endpoint.clone(),
            _ => String::new(),
        };
        LeasedResource { id: id.to_owned(), kind: self.spec.kind.clone(), endpoint }
    }

    pub(crate) fn view(&self, id: &str, leases: &Leases) -> ResourceView {
        ResourceView {
            id: id.to_owned(),
            class: self.spec.class,
            kind: self.spec.kind.clone(),
            attributes: self.spec.attributes.clone(),
            capacity: self.spec.capacity,
            free: self.free(),
            consumed: self.consumed(),
            renewable: self.spec.renewable,
            host: self.spec.host.clone(),
            owner: self.owner.clone(),
            holdings: self
                .holders
                .iter()
                .filter_map(|(id, units)| leases.get(id).map(|lease| lease.holding(*id, *units)))
                .collect(),
            revision: self.revision,
        }
    }
}

impl Resources {
    pub(crate) fn len(&self) -> usize {
        self.by_id.len()
    }

    pub(crate) fn get(&self, id: &str) -> Option<&Resource> {
        self.by_id.get(id)
    }

    pub(crate) fn get_mut(&mut self, id: &str) -> Option<&mut Resource> {
        self.by_id.get_mut(id)
    }

    pub(crate) fn insert(&mut self, id: String, resource: Resource) {
        self.by_kind.entry(resource.spec.kind.clone()).or_default().insert(id.clone());
        self.by_id.insert(id, resource);
    }

    pub(crate) fn remove(&mut self, id: &str) -> Option<Resource> {
        let resource = self.by_id.remove(id)?;
        if let Some(ids) = self.by_kind.get_mut(&resource.spec.kind) {
            ids.remove(id);
            if ids.is_empty() {
                self.by_kind.remove(&resource.spec.kind);
            }
        }
        Some(resource)
    }

    /// In the order of ids.
    pub(crate) fn iter(&self) -> impl Iterator<Item = (&String, &Resource)> {
        self.by_id.iter()
    }

    pub(crate) fn has_kind(&self, kind: &str) -> bool {
        self.by_kind.contains_key(kind)
    }

    /// Those that a requirement can be met with, in the order of ids.
    pub(crate) fn fitting<'a>(
        &'a self,
        requirement: &'a Requirement,
    ) -> impl Iterator<Item = (&'a str, &'a Resource)> + 'a {
        self.by_kind
            .get(&requirement.kind)
            .into_iter()
            .flatten()
            .filter_map(|id| self.by_id.get(id).map(|resource| (id.as_str(), resource)))
            .filter(|(_, resource)| resource.fits(requirement))
    }

    /// How many units of what fits exist, held or not, consumed ones excluded.
    pub(crate) fn quantity(&self, requirement: &Requirement) -> u64 {
        self.fitting(requirement).map(|(_, resource)| u64::from(resource.quantity())).sum()
    }

    /// Whether the kind index says the same as the resources do.
    pub(crate) fn index_agrees(&self) -> bool {
        self.by_kind.values().map(BTreeSet::len).sum::<usize>() == self.by_id.len()
            && self
                .by_id
                .iter()
                .all(|(id, resource)| self.by_kind.get(&resource.spec.kind).is_some_and(|ids| ids.contains(id)))
    }
}

/// Equal, with `1` and `1.0` the same number.
fn same(have: &Value, want: &Value) -> bool {
    match (have.as_number(), want.as_number()) {
        (Some(a), Some(b)) => a == b,
        _ => have == want,
    }
}
