//! What a system offers to tasks: its providers of actions and its resources. Read from the system's config, so that a
//! task can be checked before anything is started. Where a system runs, what its workers say of
//! themselves ([`WorkerDescription`]) extends it, or is compared with it.

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
}

/// The catalogue of the bundled system, as text.
const STANDARD: &str = include_str!("../../../deploy/catalogue.toml");

/// A text that is no catalogue.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("not a catalogue: {0}")]
pub struct InvalidCatalogue(String);

impl Catalogue {
    /// Reads the TOML form, as in `deploy/catalogue.toml`.
    ///
    /// # Errors
    /// [`InvalidCatalogue`] with line and column of the first thing that does not fit, or with the annotation that does not read.
    pub fn from_toml(text: &str) -> Result<Catalogue, InvalidCatalogue> {
        let catalogue: Catalogue =
            toml::from_str(text).map_err(|error| InvalidCatalogue(error.to_string().trim_end().to_owned()))?;
        catalogue.check().map(|()| catalogue)
    }

    /// Whether all that it says of actions reads.
    ///
    /// # Errors
    /// [`InvalidCatalogue`] with the first annotation that does not.
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
    /// The kind of resource that performs the actions; a state that uses one must block it.
    pub resource: String,
    /// How many joint positions its inputs of type `joints` have; `None` is any number.
    #[serde(default)]
    pub joints: Option<u32>,
    /// Whose joints these are, for messages; known where the robot is.
    #[serde(skip)]
    pub chain: Option<JointChain>,
    /// By action name, the part after the slash.
    #[serde(default)]
    pub actions: BTreeMap<String, ActionSignature>,
}

/// The joints that a provider moves.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct JointChain {
    /// What the robot is called.
    pub robot: String,
    /// What its arm is called.
    pub arm: String,
    /// From the foot to the tool.
    pub joints: Vec<String>,
}

/// The ports of an action, and what else a task has to know of it.
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
    /// What it does, for people.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub description: String,
    /// What optional inputs are where they are not given, as people write it. For people: the provider fills them in.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub defaults: BTreeMap<String, String>,
    /// What is true of every state that performs it and says nothing else itself.
    #[serde(default, skip_serializing_if = "Annotations::is_empty")]
    pub annotations: Annotations,
}

/// A kind of resource that the system can have.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ResourceOffer {
    /// Its class.
    pub class: ResourceClass,
    /// How many there can be at the most, or how much in all.
    pub count: Quantity,
    /// Parts of a unit can be had (battery charge).
    #[serde(default)]
    pub divisible: bool,
    /// What a task consumed returns when the task ends; so it does unless it says otherwise.
    #[serde(default = "renewable")]
    pub renewable: bool,
    /// Blocking it can change the environment: a state that computes or senses may not.
    #[serde(default)]
    pub actuates: bool,
}

impl ResourceOffer {
    /// So much of something countable that does not act.
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
