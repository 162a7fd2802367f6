//! The resource requirements of a state, and leases.

mod quantity;

pub use quantity::{Quantity, QuantityError};

use crate::condition::Condition;
use crate::expression::evaluate::equal;
use crate::value::Value;
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fmt;

/// The five resource classes of the paper (III-C). The class determines who may create a resource.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ResourceClass {
    /// Created by hardware interfaces: battery, a core.
    System,
    /// Created by a process manager: a path planner.
    Process,
    /// Created by the modules themselves: the arm.
    Module,
    /// Created by the world pool: room for a projection.
    World,
    /// Created by task control: a box delivered.
    Task,
}

/// The operations of the paper (V-B) that a state can be annotated with.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ResourceOperation {
    /// Exclusive use while the state runs.
    Block,
    /// Used up for the rest of the task.
    Consume,
    /// Added to the pool when the state retires.
    Create,
    /// Removed from the pool when the state retires.
    Delete,
    /// Must be there when the state starts.
    Exists,
}

/// One line of a state's `resources`, with every expression evaluated.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Requirement {
    /// The operation.
    pub operation: ResourceOperation,
    /// The kind of resource, `PathPlanner`.
    pub kind: String,
    /// The class, if the task gives it.
    pub class: Option<ResourceClass>,
    /// Required attributes (for create: the attributes that the new resource gets).
    pub attributes: BTreeMap<String, Value>,
    /// The total amount; for indivisible resources the number of units.
    pub count: Quantity,
    /// For create: whether fractions of a unit can be acquired.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub divisible: bool,
    /// Further conditions on attributes.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub conditions: Vec<Condition>,
}

impl fmt::Display for ResourceClass {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            ResourceClass::System => "system",
            ResourceClass::Process => "process",
            ResourceClass::Module => "module",
            ResourceClass::World => "world",
            ResourceClass::Task => "task",
        })
    }
}

impl fmt::Display for ResourceOperation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            ResourceOperation::Block => "block",
            ResourceOperation::Consume => "consume",
            ResourceOperation::Create => "create",
            ResourceOperation::Delete => "delete",
            ResourceOperation::Exists => "exists",
        })
    }
}

impl fmt::Display for Requirement {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {}", self.operation, self.kind)?;
        if self.count != Quantity::ONE {
            write!(f, " × {}", self.count)?;
        }
        for (name, value) in &self.attributes {
            write!(f, " {name}={value}")?;
        }
        for condition in &self.conditions {
            write!(f, " ({condition})")?;
        }
        Ok(())
    }
}

impl Requirement {
    /// One unit of a kind, with any attributes.
    pub fn new(operation: ResourceOperation, kind: impl Into<String>) -> Requirement {
        let (class, attributes, conditions) = Default::default();
        Requirement {
            operation,
            kind: kind.into(),
            class,
            attributes,
            conditions,
            count: Quantity::ONE,
            divisible: false,
        }
    }

    /// Whether the attributes satisfy the requirement; `of` returns the value of an attribute.
    pub fn accepts<'a>(&self, of: impl Fn(&str) -> Option<Cow<'a, Value>>) -> bool {
        self.attributes.iter().all(|(name, want)| of(name).is_some_and(|have| equal(&have, want)))
            && self.conditions.iter().all(|c| of(&c.attribute).is_some_and(|have| c.holds(&have)))
    }
}

/// The grant of an acquire: all blocked resources of one node, under one lease.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Lease {
    /// Its id.
    pub id: crate::id::LeaseId,
    /// Strictly increasing over all leases of a resource manager; a provider refuses a smaller token than it has seen.
    pub token: crate::id::FencingToken,
    /// The resources, in the order of the requirements.
    pub resources: Vec<LeasedResource>,
    /// What the grant has used up.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub consumed: Vec<OperatedUnits>,
}

/// Units of one resource that were created, deleted or used up.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct OperatedUnits {
    /// The resource's id.
    pub resource: String,
    /// Its kind, which may be a subclass of the requested one.
    pub kind: String,
    /// How much of it.
    pub units: Quantity,
    /// Whether the effect ends with the session for which it was made: created units vanish, used-up units return or vanish, and deleted units would
    /// have vanished. Otherwise the effect stays.
    pub ends_with_session: bool,
}

/// A resource under a lease.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LeasedResource {
    /// Its id, `path-planner-1@compute`.
    pub id: String,
    /// Its kind.
    pub kind: String,
    /// Address of its action service (`http://127.0.0.1:4000` or `unix:/path`); empty if it performs no actions.
    pub endpoint: String,
    /// The superclasses of its kind.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub superclasses: Vec<String>,
}

impl LeasedResource {
    /// Whether it is of this kind or of a subclass.
    pub fn is_a(&self, kind: &str) -> bool {
        self.kind == kind || self.superclasses.iter().any(|superclass| superclass == kind)
    }
}

impl Lease {
    /// The first leased resource of a kind or of a subclass.
    pub fn resource(&self, kind: &str) -> Option<&LeasedResource> {
        let exact = self.resources.iter().find(|r| r.kind == kind);
        exact.or_else(|| self.resources.iter().find(|r| r.is_a(kind)))
    }
}
