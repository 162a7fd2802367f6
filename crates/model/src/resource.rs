//! What a state asks of the resource manager.

mod quantity;

pub use quantity::{Quantity, QuantityError};

use crate::condition::Condition;
use crate::expression::evaluate::equal;
use crate::value::Value;
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fmt;

/// The five classes of the paper (III-C); the class says who may create a resource.
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
    /// Nobody else has it while the state runs.
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
    /// What is done with it.
    pub operation: ResourceOperation,
    /// The kind of resource, `PathPlanner`.
    pub kind: String,
    /// The class, where the task says it.
    pub class: Option<ResourceClass>,
    /// Attributes that it must have (for create: that it gets).
    pub attributes: BTreeMap<String, Value>,
    /// How much of their capacity in all; of what is not divisible, how many.
    pub count: Quantity,
    /// For create: whether parts of a unit of it can be had.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub divisible: bool,
    /// What its attributes must be like besides.
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
    /// One of a kind, whatever it is like.
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

    /// Whether attributes are as it wants them; `of` gives the value of one.
    pub fn accepts<'a>(&self, of: impl Fn(&str) -> Option<Cow<'a, Value>>) -> bool {
        self.attributes.iter().all(|(name, want)| of(name).is_some_and(|have| equal(&have, want)))
            && self.conditions.iter().all(|c| of(&c.attribute).is_some_and(|have| c.holds(&have)))
    }
}

/// What an acquire was granted: every blocked resource of one node, under one lease.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Lease {
    /// Its id.
    pub id: crate::id::LeaseId,
    /// Grows strictly over all leases of a resource manager; who does the work refuses an older one than it has seen.
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
    /// Its kind, which may be below the one that was asked for.
    pub kind: String,
    /// How much of it.
    pub units: Quantity,
    /// Whether that is over with the session that it was done for: what was created vanishes, what was used up returns or vanishes, and what was
    /// deleted would have vanished. Otherwise it stays so.
    pub ends_with_session: bool,
}

/// A resource under a lease.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LeasedResource {
    /// Its id, `path-planner-1@compute`.
    pub id: String,
    /// Its kind.
    pub kind: String,
    /// Where its action service is served (`http://127.0.0.1:4000` or `unix:/path`); empty where it performs nothing.
    pub endpoint: String,
    /// The kinds that its kind is a subclass of.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub superclasses: Vec<String>,
}

impl LeasedResource {
    /// Whether it is of this kind, or of a subclass of it.
    pub fn is_a(&self, kind: &str) -> bool {
        self.kind == kind || self.superclasses.iter().any(|superclass| superclass == kind)
    }
}

impl Lease {
    /// The first leased resource of a kind, or of a subclass of it.
    pub fn resource(&self, kind: &str) -> Option<&LeasedResource> {
        let exact = self.resources.iter().find(|r| r.kind == kind);
        exact.or_else(|| self.resources.iter().find(|r| r.is_a(kind)))
    }
}
