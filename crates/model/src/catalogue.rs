//! What a system offers to tasks: its providers of actions and its resources. Read from the system's config, so that a
//! task can be checked before anything is started.

use crate::resource::ResourceClass;
use crate::value::Type;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// All providers and resource kinds of a system.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Catalogue {
    /// By provider name, the part before the slash of `path_planner/plan`.
    #[serde(default)]
    pub providers: BTreeMap<String, Provider>,
    /// By resource kind, `PathPlanner`.
    #[serde(default)]
    pub resources: BTreeMap<String, ResourceOffer>,
}

/// Something that performs actions: a worker, or a module of the robot.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Provider {
    /// The kind of resource that performs the actions; a state that uses one must block it.
    pub resource: String,
    /// By action name, the part after the slash.
    pub actions: BTreeMap<String, ActionSignature>,
}

/// The ports of an action.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ActionSignature {
    /// Input ports that a goal must have.
    #[serde(default)]
    pub inputs: BTreeMap<String, Type>,
    /// Input ports that a goal may have.
    #[serde(default)]
    pub optional: BTreeMap<String, Type>,
    /// Output ports, all written when the outcome is `success`.
    #[serde(default)]
    pub outputs: BTreeMap<String, Type>,
    /// Outcomes besides `success`, `aborted` and `preempted`.
    #[serde(default)]
    pub outcomes: Vec<String>,
}

/// A kind of resource that the system can have.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ResourceOffer {
    /// Its class.
    pub class: ResourceClass,
    /// How many there can be at the most.
    pub count: u32,
    /// Blocking it can change the environment: a state that computes or senses may not.
    #[serde(default)]
    pub actuates: bool,
}
