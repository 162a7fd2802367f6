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

/// Attribute names that labels may not use.
const TAKEN: [&str; 9] =
    ["host", "pid", "endpoint", "cores", "load_per_core", "idle_cores", "free_memory_mib", "free_disk_mib", "level"];
/// Maximum length of the name of a template or a host in bytes: ids contain both.
const MAX_NAME_BYTES: usize = 48;

/// The labels of a host, by name.
pub type Labels = BTreeMap<String, Label>;

/// A label of a host.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Label {
    /// Yes or no.
    Bool(bool),
    /// A whole number.
    Int(i64),
    /// A number.
    Float(f64),
    /// A text.
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
    /// Address of the resource manager; without it the address in the runtime directory is used.
    pub resource_manager: Option<Endpoint>,
    /// Time to live of the session without an answer from the resource manager, in milliseconds.
    pub session_ttl_ms: u64,
    /// A cgroup v2 directory that the process manager may divide, such as `/sys/fs/cgroup/ratn`: then each worker has a group of its own,
    /// which enforces `limits` for the worker and all processes that it starts.
    pub cgroup: Option<PathBuf>,
    /// How the processes of workers are tracked, so that all of a worker's processes end with it.
    pub tracking: Tracking,
    /// This process is only a process manager: orphans of workers become its children, and end with it. Set by the program, not by its
    /// config.
    #[serde(skip)]
    pub owns_process: bool,
    /// Directories of cgroup v1 that the process manager may divide, one for each controller; used where `cgroup` is not set.
    pub cgroup_v1: GroupsV1,
    /// Further attributes of this host and its workers, for tasks that choose by them: `gpu = true`.
    pub labels: Labels,
    /// The part of this machine that is offered.
    pub machine: MachineConfig,
    /// A worker's log file is rotated beyond this size, in bytes (the previous one is kept as `.log.1`).
    pub max_log_bytes: u64,
    /// Additional environment of every worker, such as where the roles of its callers are ([`ratn_worker::access::ACCESS_VARIABLE`]). Set
    /// by the program that starts the process manager, not by the file.
    #[serde(skip)]
    pub worker_environment: BTreeMap<&'static str, PathBuf>,
    /// The catalogue that workers' descriptions are compared with. Set by the program that starts the process manager, not by this section
    /// of the file.
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
    /// The kinds of its workers, and the maximum number of each. Where several templates have the same kind, the first one by name meets
    /// demand.
    pub(crate) fn kinds(&self) -> BTreeMap<String, Provision> {
        let mut templates: Vec<&Template> = self.templates.iter().collect();
        templates.sort_by(|a, b| b.name.cmp(&a.name));
        let provision =
            |template: &Template| Provision { most: template.max_workers(), grows: template.grows_with_the_queue() };
        templates.into_iter().map(|template| (template.kind.clone(), provision(template))).collect()
    }
}

impl ProcessManagerConfig {
    /// A message for each template that cannot be started on this machine: which one, and why.
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
