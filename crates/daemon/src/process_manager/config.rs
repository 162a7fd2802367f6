//! The process manager's config: which workers it may start, and how. A client names a template, never a command.

use crate::config::{Check, ConfigError, rule};
use ratn_worker::endpoint::Endpoint;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::time::Duration;

/// A name of a template or a host has at most so many bytes: ids are made of both.
const MAX_NAME_BYTES: usize = 48;
/// A pool has at most so many workers.
const MAX_WORKERS: u32 = 1_000;

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
    /// A worker's log file is begun anew beyond this size, in bytes (the one before is kept as `.log.1`).
    pub max_log_bytes: u64,
    /// The pools.
    #[serde(rename = "template")]
    pub templates: Vec<Template>,
}

/// A pool of equal workers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Template {
    /// Its name, the beginning of every worker's id.
    pub name: String,
    /// The kind of resource that a worker is, `PathPlanner`; its class is process.
    pub kind: String,
    /// What to run; without it, this program.
    #[serde(default)]
    pub program: Option<PathBuf>,
    /// Its arguments. `{id}`, `{kind}`, `{host}`, `{runtime_dir}` and `{endpoint_file}` are filled in. The worker writes
    /// where it serves to `{endpoint_file}`, which is `{runtime_dir}/{id}.endpoint`; its standard input is a pipe that
    /// ends with the process manager.
    #[serde(default)]
    pub args: Vec<String>,
    /// Environment variables in addition to the process manager's own.
    #[serde(default)]
    pub env: BTreeMap<String, String>,
    /// At least so many workers are kept.
    #[serde(default = "one")]
    pub min: u32,
    /// At most so many workers are started; without it `min`, but at least one.
    #[serde(default)]
    pub max: Option<u32>,
    /// So many more are kept ready beside those that are held (and beside `min`).
    #[serde(default)]
    pub spares: u32,
    /// A worker beyond what is kept ends when nobody has held it for this long, in seconds.
    #[serde(default = "minute")]
    pub idle_s: f64,
    /// A worker whose health is not SERVING after this long has failed, in seconds.
    #[serde(default = "ten")]
    pub start_timeout_s: f64,
    /// How a worker that serves is seen to hang.
    #[serde(default)]
    pub liveness: Liveness,
    /// A worker that is to stop while it is held is given this long to be released, in seconds; then its holder loses it.
    #[serde(default = "half_a_minute")]
    pub drain_s: f64,
    /// A worker that has not ended this long after SIGTERM is killed, in seconds.
    #[serde(default = "two")]
    pub stop_timeout_s: f64,
    /// A first crash is followed by a new start at once, a second one after this long, each further one after twice as
    /// long, in milliseconds.
    #[serde(default = "backoff")]
    pub backoff_ms: u64,
    /// … up to this, in milliseconds.
    #[serde(default = "max_backoff")]
    pub max_backoff_ms: u64,
    /// A worker that served this long was not part of a crash loop, in seconds.
    #[serde(default = "ten")]
    pub stable_s: f64,
    /// After so many crashes in a row the pool has failed: nothing is started until somebody asks for it.
    #[serde(default = "crash_limit")]
    pub crash_limit: u32,
}

/// How a worker that serves is seen to hang: it is asked for its health, and killed and replaced when it does not answer in time.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Liveness {
    /// The pause between an answer and the next question, in seconds.
    pub interval_s: f64,
    /// How long an answer may take, in seconds.
    pub timeout_s: f64,
}

impl Default for Liveness {
    fn default() -> Self {
        Liveness { interval_s: 5.0, timeout_s: 10.0 }
    }
}

impl Liveness {
    pub(crate) fn interval(self) -> Duration {
        Duration::from_secs_f64(self.interval_s)
    }

    pub(crate) fn timeout(self) -> Duration {
        Duration::from_secs_f64(self.timeout_s)
    }
}

impl Default for ProcessManagerConfig {
    fn default() -> Self {
        ProcessManagerConfig {
            listen: Endpoint::local(),
            host: "localhost".to_owned(),
            resource_manager: None,
            session_ttl_ms: 3_000,
            max_log_bytes: 16 * 1024 * 1024,
            templates: Vec::new(),
        }
    }
}

impl ProcessManagerConfig {
    /// The kinds of its workers, and how many there are of each at the most. Of several templates of a kind the first one, in the
    /// order of names, meets demand.
    pub(crate) fn kinds(&self) -> BTreeMap<String, u32> {
        let mut templates: Vec<&Template> = self.templates.iter().collect();
        templates.sort_by(|a, b| b.name.cmp(&a.name));
        templates.into_iter().map(|template| (template.kind.clone(), template.max_workers())).collect()
    }
}

impl Template {
    /// A template with the default of every optional key.
    pub fn new(name: impl Into<String>, kind: impl Into<String>) -> Template {
        Template {
            name: name.into(),
            kind: kind.into(),
            program: None,
            args: Vec::new(),
            env: BTreeMap::new(),
            min: one(),
            max: None,
            spares: 0,
            idle_s: minute(),
            start_timeout_s: ten(),
            liveness: Liveness::default(),
            drain_s: half_a_minute(),
            stop_timeout_s: two(),
            backoff_ms: backoff(),
            max_backoff_ms: max_backoff(),
            stable_s: ten(),
            crash_limit: crash_limit(),
        }
    }

    /// At most so many workers.
    pub fn max_workers(&self) -> u32 {
        self.max.unwrap_or(self.min.max(1))
    }

    pub(crate) fn start_timeout(&self) -> Duration {
        Duration::from_secs_f64(self.start_timeout_s)
    }

    pub(crate) fn idle(&self) -> Duration {
        Duration::from_secs_f64(self.idle_s)
    }

    pub(crate) fn drain(&self) -> Duration {
        Duration::from_secs_f64(self.drain_s)
    }

    pub(crate) fn stop_timeout(&self) -> Duration {
        Duration::from_secs_f64(self.stop_timeout_s)
    }

    pub(crate) fn stable(&self) -> Duration {
        Duration::from_secs_f64(self.stable_s)
    }
}

impl Check for ProcessManagerConfig {
    fn check(&self) -> Result<(), ConfigError> {
        check_name("host", &self.host)?;
        rule("session_ttl_ms", self.session_ttl_ms >= 100, "at least 100 ms")?;
        rule("max_log_bytes", self.max_log_bytes >= 4_096, "at least 4096")?;
        let mut names = BTreeSet::new();
        for (i, template) in self.templates.iter().enumerate() {
            let key = |name: &str| format!("template[{i}].{name}");
            check_name(&key("name"), &template.name)?;
            check_name(&key("kind"), &template.kind)?;
            rule(key("name"), names.insert(&template.name), format!("`{}` is there twice", template.name))?;
            let max = template.max_workers();
            rule(key("max"), template.min <= max, format!("min = {} is above max = {max}", template.min))?;
            rule(key("max"), max <= MAX_WORKERS, format!("at most {MAX_WORKERS}"))?;
            let kept = template.min.saturating_add(template.spares);
            rule(
                key("spares"),
                template.spares == 0 || kept <= max,
                format!("min + spares = {kept} is above max = {max}"),
            )?;
            for (name, seconds) in [
                ("start_timeout_s", template.start_timeout_s),
                ("drain_s", template.drain_s),
                ("stop_timeout_s", template.stop_timeout_s),
                ("stable_s", template.stable_s),
                ("idle_s", template.idle_s),
                ("liveness.interval_s", template.liveness.interval_s),
                ("liveness.timeout_s", template.liveness.timeout_s),
            ] {
                rule(key(name), (0.001..=86_400.0).contains(&seconds), "from 0.001 s to a day")?;
            }
            rule(key("crash_limit"), template.crash_limit >= 1, "at least 1")?;
            rule(key("backoff_ms"), template.backoff_ms >= 1, "at least 1 ms")?;
            rule(key("max_backoff_ms"), template.max_backoff_ms >= template.backoff_ms, "at least backoff_ms")?;
        }
        Ok(())
    }
}

fn check_name(key: &str, name: &str) -> Result<(), ConfigError> {
    let good = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.');
    let holds = (1..=MAX_NAME_BYTES).contains(&name.len()) && name.chars().all(good);
    let words = format!("`{name}` has to be 1 to {MAX_NAME_BYTES} letters, digits, `-`, `_` or `.`");
    rule(key, holds, words)
}

fn one() -> u32 {
    1
}

fn two() -> f64 {
    2.0
}

fn ten() -> f64 {
    10.0
}

fn half_a_minute() -> f64 {
    30.0
}

fn minute() -> f64 {
    60.0
}

fn backoff() -> u64 {
    100
}

fn max_backoff() -> u64 {
    5_000
}

fn crash_limit() -> u32 {
    5
}
