//! A resource: its description, how much each lease holds, and therefore what is free.

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

/// The attribute that says where a resource's action service is.
pub const ENDPOINT_ATTRIBUTE: &str = "endpoint";

/// The attribute by which a provider asks for time to stop what moves, in whole milliseconds: when a lease of the resource ends
/// otherwise than by its holder's release, its units stay taken until the provider has confirmed standstill
/// ([`crate::Pool::confirm_standstill`]), and no longer than this. Without it, or with 0, they are free at once.
pub const STANDSTILL_ATTRIBUTE: &str = "standstill_ms";

/// The longest [`STANDSTILL_ATTRIBUTE`], in milliseconds.
pub const LONGEST_STANDSTILL_MS: u64 = 60_000;

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
    /// How much of it there is: how many units may be held at once.
    pub capacity: Quantity,
    /// Whether parts of a unit can be had (battery charge), not only whole ones.
    pub divisible: bool,
    /// Whether what a task consumed returns when the task ends.
    pub renewable: bool,
    /// The host that it is on; may be empty.
    pub host: String,
}

/// What a resource is; shared by everybody who looks at it.
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
    /// How much of it there is in all, what is consumed included.
    pub capacity: Quantity,
    /// Whether parts of a unit can be had.
    pub divisible: bool,
    /// Whether what a task consumed returns when the task ends.
    pub renewable: bool,
    /// The host that it is on; may be empty.
    pub host: String,
}

/// Attributes by name, in order; as small as they can be.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Attributes(Box<[(Box<str>, Value)]>);

/// A resource as others see it: its description (by `Deref`) and what is going on with it.
#[derive(Debug, Clone, PartialEq)]
pub struct ResourceView {
    /// What it is.
    pub description: Arc<Description>,
    /// What nobody holds and nobody has consumed.
    pub free: Quantity,
    /// What is consumed.
    pub consumed: Quantity,
    /// The session with which it vanishes.
    pub owner: Option<SessionId>,
    /// Who holds some of it, and what is neither held nor free yet.
    pub holders: Holders,
    /// The pool's revision when it was created or updated.
    pub revision: Revision,
}

/// An amount of a resource under a lease.
#[derive(Debug, Clone, PartialEq)]
pub struct Holding {
    /// The lease.
    pub lease: LeaseId,
    /// Its fencing token.
    pub token: FencingToken,
    /// Whose lease.
    pub session: SessionId,
    /// Who opened that session, as its connection proved; empty where nobody knows.
    pub opened_by: Arc<str>,
    /// How much.
    pub units: Quantity,
    /// What the lease is for.
    pub purpose: Arc<str>,
}

/// An amount of a resource whose lease has ended, while something may still move for it.
#[derive(Debug, Clone, PartialEq)]
pub struct EndingUnits {
    /// The lease that has ended.
    pub lease: LeaseId,
    /// Its fencing token.
    pub token: FencingToken,
    /// Whose lease it was.
    pub session: SessionId,
    /// How much.
    pub units: Quantity,
    /// They are free after this time, whatever the provider says until then.
    pub within: Duration,
}

/// A resource in the pool. `holders` is what the live leases hold of it and what leases that end have left, and there is no other
/// count of what is taken.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Resource {
    pub(crate) description: Arc<Description>,
    pub(crate) owner: Option<SessionId>,
    pub(crate) revision: Revision,
    /// In the order of leases, those that end included.
    pub(crate) holders: Vec<(LeaseId, Quantity)>,
    /// What sessions have consumed of it until their task ends, in the order of sessions.
    pub(crate) consumers: Vec<(SessionId, Quantity)>,
    /// What was consumed for good.
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

    /// With this id.
    #[must_use]
    pub fn id(mut self, id: impl Into<String>) -> ResourceSpec {
        self.id = Some(id.into());
        self
    }

    /// With so much of it.
    #[must_use]
    pub fn capacity(mut self, capacity: impl Into<Quantity>) -> ResourceSpec {
        self.capacity = capacity.into();
        self
    }

    /// Whose provider needs up to this time to stop what moves, in whole milliseconds.
    #[must_use]
    pub fn standstill(self, bound: Duration) -> ResourceSpec {
        let bound = i64::try_from(bound.as_millis()).unwrap_or(i64::MAX);
        self.attribute(STANDSTILL_ATTRIBUTE, Value::Int(bound))
    }

    /// Of which parts of a unit can be had.
    #[must_use]
    pub fn divisible(mut self) -> ResourceSpec {
        self.divisible = true;
        self
    }

    /// Of which what is consumed is gone for good.
    #[must_use]
    pub fn non_renewable(mut self) -> ResourceSpec {
        self.renewable = false;
        self
    }

    /// On this host.
    #[must_use]
    pub fn host(mut self, host: impl Into<String>) -> ResourceSpec {
        self.host = host.into();
        self
    }

    /// With this attribute.
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

    /// In the order of names.
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
    /// Whether a requirement can be met with it, if it is of the right kind.
    pub(crate) fn fits(&self, requirement: &Requirement) -> bool {
        requirement.class.is_none_or(|class| class == self.class) && requirement.accepts(|name| self.attribute(name))
    }

    /// Whether its attributes are like this.
    pub fn meets(&self, condition: &Condition) -> bool {
        self.attribute(&condition.attribute).is_some_and(|value| condition.holds(&value))
    }

    /// An attribute; `host` is where it is, unless it says so itself.
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

    /// What a session has consumed of it that returns.
    pub(crate) fn consumed_by(&self, session: &SessionId) -> Quantity {
        let found = self.consumers.binary_search_by(|(other, _)| other.cmp(session));
        found.map_or(Quantity::ZERO, |at| self.consumers[at].1)
    }

    /// What exists and is not consumed, held or not.
    pub(crate) fn quantity(&self) -> Quantity {
        self.description.capacity.saturating_sub(self.consumed())
    }

    pub(crate) fn held(&self) -> Quantity {
        self.holders.iter().map(|(_, amount)| *amount).sum()
    }

    /// What can be given away now.
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

/// Adds to an amount in a list that is ordered by its keys.
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

/// Takes some out of an amount in such a list; whether anything is left of it.
pub(crate) fn take_from<K: Ord>(amounts: &mut Vec<(K, Quantity)>, key: &K, amount: Quantity) -> bool {
    let Ok(at) = amounts.binary_search_by(|(other, _)| other.cmp(key)) else { return false };
    amounts[at].1 = amounts[at].1.saturating_sub(amount);
    let left = !amounts[at].1.is_zero();
    if !left {
        amounts.remove(at);
    }
    left
}

/// Takes an amount out of such a list, whole.
pub(crate) fn remove_from<K: Ord>(amounts: &mut Vec<(K, Quantity)>, key: &K) -> Option<Quantity> {
    let at = amounts.binary_search_by(|(other, _)| other.cmp(key)).ok()?;
    Some(amounts.remove(at).1)
}

/// By slot, which is what everything else in the pool names them by.
pub(crate) type Units = BTreeMap<Slot, Quantity>;
