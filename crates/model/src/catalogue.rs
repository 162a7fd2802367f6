//! The catalogue: the providers of actions and the resources that a system offers to tasks. Read from the system's config, so
//! that a task can be checked before anything is started. When a system runs, descriptions by its workers ([`WorkerDescription`])
//! extend the catalogue or are compared with it.

mod annotations;
mod description;
mod mismatch;

pub use annotations::{Annotations, InvalidAnnotation};
pub(crate) use annotations::{no_states, unknown_input};
pub use description::{DescriptionError, WorkerDescription};

use crate::resource::{Quantity, ResourceClass};
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
    /// The direct superclasses of kinds of resources, as the resource manager has them (`[resource-manager.kinds]`): a resource of a kind may be
    /// meant by a line of a superclass.
    #[serde(skip)]
    pub kinds: BTreeMap<String, Vec<String>>,
}

/// The catalogue of the bundled system, as text.
const STANDARD: &str = include_str!("../../../deploy/catalogue.toml");

/// Error: the text is no catalogue.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("not a catalogue: {0}")]
pub struct InvalidCatalogue(String);

impl Catalogue {
    /// Reads the TOML form, as in `deploy/catalogue.toml`.
    ///
    /// # Errors
    /// [`InvalidCatalogue`] with line and column of the first thing that does not fit, or with the first annotation that cannot
    /// be parsed.
    pub fn from_toml(text: &str) -> Result<Catalogue, InvalidCatalogue> {
        let catalogue: Catalogue =
            toml::from_str(text).map_err(|error| InvalidCatalogue(error.to_string().trim_end().to_owned()))?;
        catalogue.check().map(|()| catalogue)
    }

    /// Checks that all annotations of actions can be parsed.
    ///
    /// # Errors
    /// [`InvalidCatalogue`] with the first annotation that cannot be parsed.
    pub fn check(&self) -> Result<(), InvalidCatalogue> {
        for (name, provider) in &self.providers {
            for (action, signature) in &provider.actions {
                let wrong = |error| InvalidCatalogue(format!("annotations of {name}/{action}: {error}"));
                signature.annotations.check(signature).map_err(wrong)?;
                let lacks =
                    |said: &&Annotations| !said.resources.is_empty() && !said.resources.contains(&provider.resource);
                if signature.annotations.all().any(|said| lacks(&said)) {
                    let own = &provider.resource;
                    let message =
                        format!("annotations of {name}/{action}: `resources` lacks `{own}`, which performs it; add it");
                    return Err(InvalidCatalogue(message));
                }
            }
        }
        Ok(())
    }

    /// The catalogue of the bundled system (`deploy/catalogue.toml`).
    ///
    /// # Panics
    /// Never: the text is part of the program, and a test reads it.
    pub fn standard() -> Catalogue {
        match Catalogue::from_toml(STANDARD) {
            Ok(catalogue) => catalogue,
            Err(error) => unreachable!("the embedded catalogue is {error}"),
        }
    }

    /// The signature of `provider/action`.
    pub fn action(&self, provider: &str, action: &str) -> Option<&ActionSignature> {
        self.providers.get(provider)?.actions.get(action)
    }
}

/// Something that performs actions: a worker, or a module of the robot.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Provider {
    /// The kind of resource that performs the actions; a state that uses an action must block one.
    pub resource: String,
    /// Number of joint positions in its inputs of type `joints`; `None` allows any number.
    #[serde(default)]
    pub joints: Option<u32>,
    /// The names of these joints, for messages; known if the robot is known.
    #[serde(skip)]
    pub chain: Option<JointChain>,
    /// By action name, the part after the slash.
    #[serde(default)]
    pub actions: BTreeMap<String, ActionSignature>,
}

/// The joints that a provider moves.
#[derive(Debug, Clone, PartialEq)]
pub struct JointChain {
    /// The robot's name.
    pub robot: String,
    /// The arm's name.
    pub arm: String,
    /// Joint names from the base to the tool.
    pub joints: Vec<String>,
    /// The least and the greatest position of each, and their unit (`rad`, `m`). A joint that turns without end has infinite ones.
    pub limits: Vec<([f64; 2], &'static str)>,
}

/// The ports of an action, and everything else that a task has to know about it.
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
    /// Description, for people.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub description: String,
    /// Defaults of optional inputs, as people write them. For people: the provider fills them in.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub defaults: BTreeMap<String, String>,
    /// Annotations of every state that performs the action and does not say otherwise.
    #[serde(default, skip_serializing_if = "Annotations::is_empty")]
    pub annotations: Annotations,
}

/// A kind of resource that the system can have.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ResourceOffer {
    /// Its class.
    pub class: ResourceClass,
    /// Largest number of units, or total amount.
    pub count: Quantity,
    /// Whether fractions of a unit can be acquired (battery charge).
    #[serde(default)]
    pub divisible: bool,
    /// Whether a consumed amount returns when the task ends; true by default.
    #[serde(default = "renewable")]
    pub renewable: bool,
    /// Whether blocking it can change the environment; a state that computes or senses may not block it.
    #[serde(default)]
    pub actuates: bool,
}

impl ResourceOffer {
    /// An indivisible, renewable offer of `count` that does not actuate.
    pub fn new(class: ResourceClass, count: impl Into<Quantity>) -> ResourceOffer {
        ResourceOffer { class, count: count.into(), divisible: false, renewable: true, actuates: false }
    }
}

fn renewable() -> bool {
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_standard_catalogue_reads_and_its_providers_are_offered() {
        let catalogue = Catalogue::standard();
        assert!(catalogue.providers.values().all(|p| catalogue.resources.contains_key(&p.resource)));
        assert!(catalogue.action("path_planner", "plan").is_some_and(|plan| plan.outputs.contains_key("end_pose")));
    }

    #[test]
    fn an_unknown_key_in_a_catalogue_is_refused_with_its_line() {
        let error = Catalogue::from_toml("[resources.Arm]\nclass = \"module\"\ncount = 1\nactuate = true\n");
        assert!(error.is_err_and(|e| e.to_string().contains("line 4") && e.to_string().contains("actuate")));
    }
}
