//! The process manager's config: which workers it may start, and how. A client names a template, never a command.

use super::limits::GroupsV1;
use super::machine::MachineConfig;
use super::order;
use super::template::Template;
use super::tracking::Tracking;
use crate::config::{Check, ConfigError, rule};
use ratn_model::catalogue::Catalogue;
use ratn_model::value::Value;
use ratn_proto::types::Provision;
use ratn_worker::endpoint::Endpoint;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::sync::Arc;

/// Names that labels cannot have.
const TAKEN: [&str; 9] =
    ["host", "pid", "endpoint", "cores", "load_per_core", "idle_cores", "free_memory_mib", "free_disk_mib", "level"];
/// A name of a template or a host has at most so many bytes: ids are made of both.
const MAX_NAME_BYTES: usize = 48;

/// What is said of a host, by name.
pub type Labels = BTreeMap<String, Label>;

/// Something that is said of a host.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Label {
    /// Yes or no.
    Bool(bool),
    /// A whole number.
    Int(i64),
    /// A number.
    Float(f64),
    /// A word.
    Text(String),
}

impl From<&Label> for Value {
    fn from(label: &Label) -> Value {
        match label {
            Label::Bool(value) => Value::Bool(*value),
            Label::Int(value) => Value::Int(*value),
            Label::Float(value) => Value::Float(*value),
            Label::Text(value) => Value::String(value.clone()),
        }
    }
}

/// All keys are optional.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ProcessManagerConfig {
    /// Where to listen; `local` is a Unix socket in the runtime directory.
    pub listen: Endpoint,
    /// The name of this host: the end of every worker's id, `path-planner-1@compute`.
    pub host: String,
    /// Where the resource manager is; without it, where the runtime directory says.
    pub resource_manager: Option<Endpoint>,
    /// The session lives this long without an answer from the resource manager, in milliseconds.
    pub session_ttl_ms: u64,
    /// A directory of cgroup v2 that is the process manager's to divide, `/sys/fs/cgroup/ratn`: then `limits` are kept by a group for
    /// each worker, and with all that it starts.
    pub cgroup: Option<PathBuf>,
    /// How the processes of workers are kept track of, so that all of a worker ends with it.
    pub tracking: Tracking,
    /// This process is a process manager and nothing else: what workers leave behind becomes its children, and ends with it. Said by
    /// the program, not by its config.
    #[serde(skip)]
    pub owns_process: bool,
    /// Directories of cgroup v1 that are the process manager's to divide, one for each controller; where `cgroup` is not given.
    pub cgroup_v1: GroupsV1,
    /// What else is to be said of this host and its workers, for tasks that choose by it: `gpu = true`.
    pub labels: Labels,
    /// What of this machine is offered.
    pub machine: MachineConfig,
    /// A worker's log file is begun anew beyond this size, in bytes (the one before is kept as `.log.1`).
    pub max_log_bytes: u64,
    /// What every worker has in its environment besides, as where the roles of its callers are ([`ratn_worker::access::ACCESS_VARIABLE`]).
    /// Not of the file: of who starts the process manager.
    #[serde(skip)]
    pub worker_environment: BTreeMap<&'static str, PathBuf>,
    /// What workers that describe themselves are compared with. Not of this section of the file: of who starts the process manager.
    #[serde(skip)]
    pub catalogue: Option<Arc<Catalogue>>,
    /// The pools.
    #[serde(rename = "template")]
    pub templates: Vec<Template>,
}

impl Default for ProcessManagerConfig {
    fn default() -> Self {
        ProcessManagerConfig {
            listen: Endpoint::local(),
            host: "localhost".to_owned(),
            resource_manager: None,
            session_ttl_ms: 3_000,
            cgroup: None,
            tracking: Tracking::default(),
            owns_process: false,
            cgroup_v1: GroupsV1::default(),
            labels: Labels::new(),
            machine: MachineConfig::default(),
            max_log_bytes: 16 * 1024 * 1024,
            worker_environment: BTreeMap::new(),
            catalogue: None,
            templates: Vec::new(),
        }
    }
}

impl ProcessManagerConfig {
    /// The kinds of its workers, and how many there are of each at the most. Of several templates of a kind the first one, in the
    /// order of names, meets demand.
    pub(crate) fn kinds(&self) -> BTreeMap<String, Provision> {
        let mut templates: Vec<&Template> = self.templates.iter().collect();
        templates.sort_by(|a, b| b.name.cmp(&a.name));
        let provision =
            |template: &Template| Provision { most: template.max_workers(), grows: template.grows_with_the_queue() };
        templates.into_iter().map(|template| (template.kind.clone(), provision(template))).collect()
    }
}

impl ProcessManagerConfig {
    /// Of each template that cannot be started on this machine which, and why.
    pub fn obstacles(&self) -> Vec<String> {
        let obstacle = |template: &Template| Some(format!("template `{}`: {}", template.name, template.obstacle()?));
        self.templates.iter().filter_map(obstacle).collect()
    }
}

impl Check for ProcessManagerConfig {
    fn check(&self) -> Result<(), ConfigError> {
        check_name("host", &self.host)?;
        rule("session_ttl_ms", self.session_ttl_ms >= 100, "at least 100 ms")?;
        rule("max_log_bytes", self.max_log_bytes >= 4_096, "at least 4096")?;
        self.machine.check()?;
        for (name, label) in &self.labels {
            let key = format!("labels.{name}");
            check_name(&key, name)?;
            rule(&key, !TAKEN.contains(&name.as_str()), "is said of every host already")?;
            rule(&key, !matches!(label, Label::Float(value) if !value.is_finite()), "a finite number")?;
        }
        let mut names = BTreeSet::new();
        for (i, template) in self.templates.iter().enumerate() {
            let key = format!("template[{i}]");
            template.check(&key)?;
            let name = &template.name;
            rule(format!("{key}.name"), names.insert(name), format!("`{name}` is there twice"))?;
        }
        order::check(&self.templates)
    }
}

pub(super) fn check_name(key: &str, name: &str) -> Result<(), ConfigError> {
    let good = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.');
    let holds = (1..=MAX_NAME_BYTES).contains(&name.len()) && name.chars().all(good);
    let words = format!("`{name}` has to be 1 to {MAX_NAME_BYTES} letters, digits, `-`, `_` or `.`");
    rule(key, holds, words)
}
