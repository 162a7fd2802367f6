//! What a state asks of the resource manager.

use crate::value::Value;
use serde::{Deserialize, Serialize};
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
    /// How many resources (block), or how much of their capacity in all (consume, create).
    pub count: u32,
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
        if self.count != 1 {
            write!(f, " × {}", self.count)?;
        }
        for (name, value) in &self.attributes {
            write!(f, " {name}={value}")?;
        }
        Ok(())
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
}

impl Lease {
    /// The first leased resource of a kind.
    pub fn resource(&self, kind: &str) -> Option<&LeasedResource> {
        self.resources.iter().find(|r| r.kind == kind)
    }
}
