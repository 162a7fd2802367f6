//! A resource: its description, the holdings of leases, and hence what is free.

use crate::crowd::Holders;
use crate::id::{SessionId, Slot};
use ratn_model::condition::Condition;
use ratn_model::id::{FencingToken, LeaseId, Revision};
use ratn_model::resource::{LeasedResource, Quantity, Requirement, ResourceClass};
use ratn_model::value::Value;
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::ops::Deref;
use std::sync::Arc;
use std::time::Duration;

/// The attribute with the endpoint of a resource's action service.
pub const ENDPOINT_ATTRIBUTE: &str = "endpoint";

/// The attribute by which a provider asks for time to stop what moves, in whole milliseconds: when a lease of the resource does not end by its
/// holder's release, its units stay taken until the provider has confirmed standstill ([`crate::Pool::confirm_standstill`]), at most for this time.
/// Without the attribute, or with 0, they are free at once.
pub const STANDSTILL_ATTRIBUTE: &str = "standstill_ms";

/// The maximum of [`STANDSTILL_ATTRIBUTE`], in milliseconds.
pub const LONGEST_STANDSTILL_MS: u64 = 60_000;

/// The description in a create request.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ResourceSpec {
    /// Its id; with `None` the pool numbers it: `box_delivered-3`.
    pub id: Option<String>,
    /// Its class.
    pub class: ResourceClass,
    /// Its kind, for example `PathPlanner`.
    pub kind: String,
    /// Attributes; `endpoint` is the endpoint of its action service.
    pub attributes: BTreeMap<String, Value>,
    /// The capacity: the number of units that may be held at the same time.
    pub capacity: Quantity,
    /// Whether fractions of a unit can be held (battery charge), not only whole units.
    pub divisible: bool,
    /// Whether units that a task consumed return when the task ends.
    pub renewable: bool,
    /// The host on which it is; may be empty.
    pub host: String,
}

/// The description of a resource; shared by all views.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Description {
    /// Its id.
    pub id: String,
    /// Its class.
    pub class: ResourceClass,
    /// Its kind.
    pub kind: String,
    /// Its attributes.
    pub attributes: Attributes,
    /// The total amount, including what is consumed.
    pub capacity: Quantity,
    /// Whether fractions of a unit can be held.
    pub divisible: bool,
    /// Whether units that a task consumed return when the task ends.
    pub renewable: bool,
    /// The host on which it is; may be empty.
    pub host: String,
}

/// Attributes by name, in order, in compact form.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Attributes(Box<[(Box<str>, Value)]>);

/// A resource as others see it: its description (by `Deref`) and its present state.
#[derive(Debug, Clone, PartialEq)]
pub struct ResourceView {
    /// Its description.
    pub description: Arc<Description>,
    /// The amount that is neither held nor consumed.
    pub free: Quantity,
    /// The amount that is consumed.
    pub consumed: Quantity,
    /// The session that provides it; the resource is deleted with it.
    pub owner: Option<SessionId>,
    /// The holders, and units that are neither held nor free yet.
    pub holders: Holders,
    /// The pool's revision at which it was created or updated.
    pub revision: Revision,
}

/// An amount of a resource under a lease.
#[derive(Debug, Clone, PartialEq)]
pub struct Holding {
    /// The lease.
    pub lease: LeaseId,
    /// Its fencing token.
    pub token: FencingToken,
    /// The holder.
    pub session: SessionId,
    /// The caller who opened that session, as its connection proved; empty if unknown.
    pub opened_by: Arc<str>,
    /// The amount.
    pub units: Quantity,
    /// The purpose of the lease.
    pub purpose: Arc<str>,
}

/// An amount of a resource whose lease has ended, while something may still move for that lease.
#[derive(Debug, Clone, PartialEq)]
pub struct EndingUnits {
    /// The lease that has ended.
    pub lease: LeaseId,
    /// Its fencing token.
    pub token: FencingToken,
    /// The former holder.
    pub session: SessionId,
    /// The amount.
    pub units: Quantity,
    /// The units are free after this time, whatever the provider reports until then.
    pub within: Duration,
}

/// A resource in the pool. `holders` lists what live leases hold of it and what ended leases have left; taken units are not counted anywhere else.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Resource {
    pub(crate) description: Arc<Description>,
    pub(crate) owner: Option<SessionId>,
    pub(crate) revision: Revision,
    /// Ordered by lease, ended ones included.
    pub(crate) holders: Vec<(LeaseId, Quantity)>,
    /// What sessions have consumed of it until their tasks end, ordered by session.
    pub(crate) consumers: Vec<(SessionId, Quantity)>,
    /// What was consumed permanently.
    pub(crate) spent: Quantity,
}

impl ResourceSpec {
    /// A resource with one unit and no attributes.
    pub fn new(class: ResourceClass, kind: impl Into<String>) -> ResourceSpec {
        ResourceSpec {
            id: None,
            class,
            kind: kind.into(),
            attributes: BTreeMap::new(),
            capacity: Quantity::ONE,
            divisible: false,
            renewable: true,
            host: String::new(),
        }
    }

    /// Sets the id.
    #[must_use]
    pub fn id(mut self, id: impl Into<String>) -> ResourceSpec {
        self.id = Some(id.into());
        self
    }

    /// Sets the capacity.
    #[must_use]
    pub fn capacity(mut self, capacity: impl Into<Quantity>) -> ResourceSpec {
        self.capacity = capacity.into();
        self
    }

    /// Sets the maximum time that its provider needs to stop what moves, in whole milliseconds.
    #[must_use]
    pub fn standstill(self, bound: Duration) -> ResourceSpec {
        let bound = i64::try_from(bound.as_millis()).unwrap_or(i64::MAX);
        self.attribute(STANDSTILL_ATTRIBUTE, Value::Int(bound))
    }

    /// Allows fractions of a unit.
    #[must_use]
    pub fn divisible(mut self) -> ResourceSpec {
        self.divisible = true;
        self
    }

    /// Makes consumption permanent.
    #[must_use]
    pub fn non_renewable(mut self) -> ResourceSpec {
        self.renewable = false;
        self
    }

    /// Sets the host.
    #[must_use]
    pub fn host(mut self, host: impl Into<String>) -> ResourceSpec {
        self.host = host.into();
        self
    }

    /// Adds an attribute.
    #[must_use]
    pub fn attribute(mut self, name: impl Into<String>, value: Value) -> ResourceSpec {
        self.attributes.insert(name.into(), value);
        self
    }

    pub(crate) fn described(self, id: String) -> Description {
        let attributes = self.attributes.into_iter().map(|(name, value)| (name.into(), value)).collect();
        Description {
            id,
            class: self.class,
            kind: self.kind,
            attributes: Attributes(attributes),
            capacity: self.capacity,
            divisible: self.divisible,
            renewable: self.renewable,
            host: self.host,
        }
    }
}

impl Attributes {
    /// The value of an attribute.
    pub fn get(&self, name: &str) -> Option<&Value> {
        self.0.binary_search_by(|(known, _)| (**known).cmp(name)).ok().map(|at| &self.0[at].1)
    }

    /// All attributes, ordered by name.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = (&str, &Value)> {
        self.0.iter().map(|(name, value)| (&**name, value))
    }
}

impl Deref for ResourceView {
    type Target = Description;

    fn deref(&self) -> &Description {
        &self.description
    }
}

impl Description {
    /// Whether it matches a requirement, if it is of the right kind.
    pub(crate) fn fits(&self, requirement: &Requirement) -> bool {
        requirement.class.is_none_or(|class| class == self.class) && requirement.accepts(|name| self.attribute(name))
    }

    /// Whether its attributes meet a condition.
    pub fn meets(&self, condition: &Condition) -> bool {
        self.attribute(&condition.attribute).is_some_and(|value| condition.holds(&value))
    }

    /// An attribute; `host` defaults to the resource's host.
    pub(crate) fn attribute(&self, name: &str) -> Option<Cow<'_, Value>> {
        let host = || (name == "host" && !self.host.is_empty()).then(|| Cow::Owned(Value::String(self.host.clone())));
        self.attributes.get(name).map(Cow::Borrowed).or_else(host)
    }

    /// How long its units stay taken after a lease has ended, unless its provider confirms standstill.
    pub(crate) fn standstill(&self) -> Duration {
        match self.attributes.get(STANDSTILL_ATTRIBUTE) {
            Some(Value::Int(bound)) => Duration::from_millis(u64::try_from(*bound).unwrap_or_default()),
            _ => Duration::ZERO,
        }
    }

    pub(crate) fn leased(&self, superclasses: &[String]) -> LeasedResource {
        let endpoint = match self.attributes.get(ENDPOINT_ATTRIBUTE) {
            Some(Value::String(endpoint)) => endpoint.clone(),
            _ => String::new(),
        };
        LeasedResource { id: self.id.clone(), kind: self.kind.clone(), endpoint, superclasses: superclasses.to_vec() }
    }
}

impl Resource {
    pub(crate) fn new(description: Arc<Description>, owner: Option<SessionId>, revision: Revision) -> Resource {
        let (holders, consumers, spent) = (Vec::new(), Vec::new(), Quantity::ZERO);
        Resource { description, owner, revision, holders, consumers, spent }
    }

    pub(crate) fn consumed(&self) -> Quantity {
        self.spent + self.consumers.iter().map(|(_, amount)| *amount).sum()
    }

    /// What a session has consumed of it that will return.
    pub(crate) fn consumed_by(&self, session: &SessionId) -> Quantity {
        let found = self.consumers.binary_search_by(|(other, _)| other.cmp(session));
        found.map_or(Quantity::ZERO, |at| self.consumers[at].1)
    }

    /// The amount that exists and is not consumed, held or not.
    pub(crate) fn quantity(&self) -> Quantity {
        self.description.capacity.saturating_sub(self.consumed())
    }

    pub(crate) fn held(&self) -> Quantity {
        self.holders.iter().map(|(_, amount)| *amount).sum()
    }

    /// The amount that can be given away now.
    pub(crate) fn free(&self) -> Quantity {
        self.quantity().saturating_sub(self.held())
    }

    pub(crate) fn view(&self, holders: Holders) -> ResourceView {
        ResourceView {
            description: self.description.clone(),
            free: self.free(),
            consumed: self.consumed(),
            owner: self.owner.clone(),
            holders,
            revision: self.revision,
        }
    }
}

/// Adds to an amount in a list ordered by key.
pub(crate) fn add_to<K: Ord + Clone>(amounts: &mut Vec<(K, Quantity)>, key: &K, amount: Quantity) {
    match amounts.binary_search_by(|(other, _)| other.cmp(key)) {
        Ok(at) => amounts[at].1 += amount,
        Err(at) => {
            if amounts.is_empty() {
                amounts.reserve_exact(1);
            }
            amounts.insert(at, (key.clone(), amount));
        }
    }
}

/// Subtracts from an amount in such a list; returns whether anything is left.
pub(crate) fn take_from<K: Ord>(amounts: &mut Vec<(K, Quantity)>, key: &K, amount: Quantity) -> bool {
    let Ok(at) = amounts.binary_search_by(|(other, _)| other.cmp(key)) else { return false };
    amounts[at].1 = amounts[at].1.saturating_sub(amount);
    let left = !amounts[at].1.is_zero();
    if !left {
        amounts.remove(at);
    }
    left
}

/// Removes a whole amount from such a list.
pub(crate) fn remove_from<K: Ord>(amounts: &mut Vec<(K, Quantity)>, key: &K) -> Option<Quantity> {
    let at = amounts.binary_search_by(|(other, _)| other.cmp(key)).ok()?;
    Some(amounts.remove(at).1)
}

/// Amounts by slot, the name of a resource within the pool.
pub(crate) type Units = BTreeMap<Slot, Quantity>;
