//! Configs from TOML: unknown keys are refused, and every error names the file and the place in it.

pub use ratn_storage::Durability;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

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

/// Where and how a daemon keeps its state. All keys are optional.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct StorageConfig {
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
        StorageConfig { directory: None, durability: Durability::default(), compact_bytes: 16 << 20 }
    }
}

impl StorageConfig {
    /// Where a role keeps its state.
    pub fn directory_of(&self, role: &str, runtime_directory: &Path) -> PathBuf {
        self.directory.clone().unwrap_or_else(|| state_directory(runtime_directory).join(role))
    }
}

impl Check for StorageConfig {
    fn check(&self) -> Result<(), ConfigError> {
        rule("storage.compact_bytes", self.compact_bytes >= 1 << 16, "at least 65536")
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
