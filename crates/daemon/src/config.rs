//! Configs from TOML: unknown keys are refused, and every error names the file and the place in it.

pub use ratn_storage::Durability;
use ratn_storage::Store;
use ratn_storage::etcd::Holder;
use ratn_worker::endpoint::Endpoint;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// A config that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// It cannot be read.
    #[error("cannot read {}", file.display())]
    Unreadable {
        /// The file.
        file: PathBuf,
        /// Why.
        #[source]
        source: std::io::Error,
    },
    /// It is no TOML, or has a key or a value that it must not have.
    #[error("{}: {problem}", file.display())]
    Malformed {
        /// The file.
        file: PathBuf,
        /// What and where, with the line.
        problem: String,
    },
    /// A value breaks a rule.
    #[error("`{key}`: {rule}")]
    Rule {
        /// Which key.
        key: String,
        /// The rule, and what the value is.
        rule: String,
    },
}

/// A config with rules beyond its types.
pub trait Check {
    /// Says which rule is broken.
    ///
    /// # Errors
    /// [`ConfigError::Rule`] of the first.
    fn check(&self) -> Result<(), ConfigError>;
}

/// What keeps a daemon's state.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Engine {
    /// A log in files of this host.
    #[default]
    Log,
    /// A log in etcd: several processes may stand by for one another.
    Etcd,
}

/// Where and how a daemon keeps its state. All keys are optional; of etcd's, `endpoints` and `prefix` are needed with that engine, and
/// mean nothing without.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct StorageConfig {
    /// `log` or `etcd`.
    pub engine: Engine,
    /// The members of etcd.
    pub endpoints: Vec<Endpoint>,
    /// What stands before every key in etcd, as `/ratn/cell-7`; each role has its own keys behind it.
    pub prefix: String,
    /// The file with the authority that signed the certificates of etcd's members (PEM).
    pub ca: Option<PathBuf>,
    /// The file with the certificate that is shown to etcd (PEM).
    pub cert: Option<PathBuf>,
    /// The file with its private key (PEM).
    pub key: Option<PathBuf>,
    /// Starts also where an older state of etcd was restored: what was acknowledged since then is gone.
    pub accept_restored: bool,
    /// A directory of its own; `state/<role>` in the runtime directory unless given.
    pub directory: Option<PathBuf>,
    /// When an answer may leave: `none` at once, `group` when what it tells of is on the disk (many share a sync), `each` likewise,
    /// with a sync for every change.
    pub durability: Durability,
    /// After so many bytes of changes (and twice as many as the last snapshot had) a snapshot takes their place.
    pub compact_bytes: u64,
}

impl Default for StorageConfig {
    fn default() -> Self {
        StorageConfig {
            engine: Engine::default(),
            endpoints: Vec::new(),
            prefix: String::new(),
            ca: None,
            cert: None,
            key: None,
            accept_restored: false,
            directory: None,
            durability: Durability::default(),
            compact_bytes: 16 << 20,
        }
    }
}

impl StorageConfig {
    /// What a role's state is kept in, for who copies it.
    ///
    /// # Errors
    /// Where a file of it cannot be read.
    pub fn store(&self, role: &str) -> anyhow::Result<Arc<dyn Store>> {
        Ok(match self.engine {
            Engine::Log => {
                let directory = self.directory.clone().unwrap_or_else(|| role.into());
                Arc::new(crate::durable_actor::Journal::log(self, &directory))
            }
            Engine::Etcd => Arc::new(crate::standby::etcd(self, role, "a copy or a look", None)?),
        })
    }

    /// Who leads, as etcd says: where and what it is. Nobody where the state is in files. Blocks.
    ///
    /// # Errors
    /// Where etcd does not answer, or a file for its TLS cannot be read.
    pub fn leader(&self, role: &str) -> anyhow::Result<Option<Holder>> {
        match self.engine {
            Engine::Log => Ok(None),
            Engine::Etcd => Ok(crate::standby::etcd(self, role, "a copy or a look", None)?.holder()?),
        }
    }

    /// Where a role keeps its state.
    pub fn directory_of(&self, role: &str, runtime_directory: &Path) -> PathBuf {
        self.directory.clone().unwrap_or_else(|| state_directory(runtime_directory).join(role))
    }
}

impl Check for StorageConfig {
    fn check(&self) -> Result<(), ConfigError> {
        rule("storage.compact_bytes", self.compact_bytes >= 1 << 16, "at least 65536")?;
        if self.engine == Engine::Log {
            return rule("storage.endpoints", self.endpoints.is_empty(), "only with `engine = \"etcd\"`");
        }
        let member = |endpoint: &Endpoint| matches!(endpoint, Endpoint::Tcp { .. } | Endpoint::Tls { .. });
        let members = !self.endpoints.is_empty() && self.endpoints.iter().all(member);
        rule("storage.endpoints", members, "the addresses of etcd's members, as [\"https://a:2379\"]")?;
        let named = self.prefix.starts_with('/') && !self.prefix.trim_matches('/').is_empty();
        rule("storage.prefix", named, "begins with / and says more, as \"/ratn/cell-7\"")?;
        rule("storage.key", self.cert.is_some() == self.key.is_some(), "goes together with storage.cert")?;
        let durable = "group, with `engine = \"etcd\"`: etcd keeps what it has acknowledged";
        rule("storage.durability", self.durability == Durability::Group, durable)
    }
}

/// Where state is kept unless said otherwise: in a runtime directory, in a folder for each role.
pub fn state_directory(runtime_directory: &Path) -> PathBuf {
    runtime_directory.join("state")
}

/// Reads and checks a file that holds one daemon's config.
///
/// # Errors
/// [`ConfigError`] of what is wrong with it.
pub fn load<C: DeserializeOwned + Check>(file: &Path) -> Result<C, ConfigError> {
    let unreadable = |source| ConfigError::Unreadable { file: file.to_owned(), source };
    let text = std::fs::read_to_string(file).map_err(unreadable)?;
    let config: C = toml::from_str(&text).map_err(|error| ConfigError::Malformed {
        file: file.to_owned(),
        problem: error.to_string().trim_end().to_owned(),
    })?;
    config.check()?;
    Ok(config)
}

pub(crate) fn rule(key: impl Into<String>, holds: bool, rule: impl Into<String>) -> Result<(), ConfigError> {
    if holds { Ok(()) } else { Err(ConfigError::Rule { key: key.into(), rule: rule.into() }) }
}
