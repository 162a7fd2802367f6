//! Configs from TOML: unknown keys are refused, and every error names the file and the place in it.

use ratn_model::name::is_unseen;
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
    /// The file cannot be read.
    #[error("cannot read {}", file.display())]
    Unreadable {
        /// The file.
        file: PathBuf,
        /// The reason.
        #[source]
        source: std::io::Error,
    },
    /// The file is not valid TOML, or has a key or a value that is not allowed.
    #[error("{}: {problem}", file.display())]
    Malformed {
        /// The file.
        file: PathBuf,
        /// The problem and its place, with the line number.
        problem: String,
    },
    /// A value breaks a rule.
    #[error("`{key}`: {rule}")]
    Rule {
        /// The key.
        key: String,
        /// The rule, and the value that breaks it.
        rule: String,
    },
}

/// A config with rules beyond its types.
pub trait Check {
    /// Reports the first rule that is broken.
    ///
    /// # Errors
    /// [`ConfigError::Rule`] of that rule.
    fn check(&self) -> Result<(), ConfigError>;
}

/// Storage engine of a daemon's state.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Engine {
    /// A log in files of this host.
    #[default]
    Log,
    /// A log in etcd: several processes may stand by for one another.
    Etcd,
}

/// Where and how a daemon keeps its state. All keys are optional, except that `engine = "etcd"` needs `endpoints` and `prefix`; other
/// engines refuse etcd's keys.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct StorageConfig {
    /// `log` or `etcd`.
    pub engine: Engine,
    /// Addresses of the etcd members.
    pub endpoints: Vec<Endpoint>,
    /// Prefix of every key in etcd, such as `/ratn/cell-7`; each role has its own keys under it.
    pub prefix: String,
    /// The file with the authority that signed the certificates of etcd's members (PEM).
    pub ca: Option<PathBuf>,
    /// The file with the certificate that is shown to etcd (PEM).
    pub cert: Option<PathBuf>,
    /// The file with its private key (PEM).
    pub key: Option<PathBuf>,
    /// Lets the daemon lead once although an older state of etcd was restored and acknowledged changes are lost. The value is the
    /// number that the daemon prints when it refuses to lead; it is not valid for the next restore.
    pub accept_restored: Option<u64>,
    /// A directory for this state alone; by default `state/<role>` in the runtime directory.
    pub directory: Option<PathBuf>,
    /// When an answer may be sent: `none` at once, `group` after its records are synced (many answers share a sync), `each` likewise,
    /// with one sync for every change.
    pub durability: Durability,
    /// A snapshot replaces the log after this many bytes of changes, and after at least twice the size of the last snapshot.
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
            accept_restored: None,
            directory: None,
            durability: Durability::default(),
            compact_bytes: 16 << 20,
        }
    }
}

impl StorageConfig {
    /// The store that keeps a role's state, for commands that copy it.
    ///
    /// # Errors
    /// Where one of its files cannot be read.
    pub fn store(&self, role: &str) -> anyhow::Result<Arc<dyn Store>> {
        Ok(match self.engine {
            Engine::Log => {
                let directory = self.directory.clone().unwrap_or_else(|| role.into());
                // A copy counts only when it is on the disk, whatever durability its daemon uses later.
                let config = StorageConfig { durability: Durability::Group, ..self.clone() };
                Arc::new(crate::durable_actor::Journal::log(&config, &directory))
            }
            Engine::Etcd => Arc::new(crate::standby::etcd(self, role, "a copy or a look", None)?),
        })
    }

    /// The current leader according to etcd: its address and its name. `None` where the state is in files. Blocks.
    ///
    /// # Errors
    /// Where etcd does not answer, or a file for its TLS cannot be read.
    pub fn leader(&self, role: &str) -> anyhow::Result<Option<Holder>> {
        match self.engine {
            Engine::Log => Ok(None),
            Engine::Etcd => Ok(crate::standby::etcd(self, role, "a copy or a look", None)?.holder()?),
        }
    }

    fn has_tls_everywhere(&self) -> bool {
        self.endpoints.iter().all(|endpoint| matches!(endpoint, Endpoint::Tls { .. }))
    }

    /// The directory in which a role keeps its state.
    pub fn directory_of(&self, role: &str, runtime_directory: &Path) -> PathBuf {
        self.directory.clone().unwrap_or_else(|| state_directory(runtime_directory).join(role))
    }
}

impl Check for StorageConfig {
    fn check(&self) -> Result<(), ConfigError> {
        rule("storage.compact_bytes", self.compact_bytes >= 1 << 16, "at least 65536")?;
        if self.engine == Engine::Log {
            let beside = "only with `engine = \"etcd\"`: leave it out, or say that engine";
            rule("storage.endpoints", self.endpoints.is_empty(), beside)?;
            rule("storage.prefix", self.prefix.is_empty(), beside)?;
            let files = [("storage.ca", &self.ca), ("storage.cert", &self.cert), ("storage.key", &self.key)];
            return files.into_iter().try_for_each(|(key, file)| rule(key, file.is_none(), beside));
        }
        let member = |endpoint: &Endpoint| matches!(endpoint, Endpoint::Tcp { .. } | Endpoint::Tls { .. });
        let members = !self.endpoints.is_empty() && self.endpoints.iter().all(member);
        rule("storage.endpoints", members, "the addresses of etcd's members, as [\"https://a:2379\"]")?;
        let named = self.prefix.strip_prefix('/').is_some_and(|names| names.split('/').all(|name| !name.is_empty()));
        rule(
            "storage.prefix",
            named,
            "begins with /, and names stand between single ones, none at the end, as \"/ratn/cell-7\"",
        )?;
        let seen = !self.prefix.chars().any(|character| is_unseen(character) || character == ' ');
        rule("storage.prefix", seen, "only characters that are seen, and no spaces, as \"/ratn/cell-7\"")?;
        let one_of_tls = |given: &Option<PathBuf>| given.is_none() || self.has_tls_everywhere();
        let everywhere =
            "only where every member's address is https://: write https:// in storage.endpoints, or leave it out";
        rule("storage.ca", one_of_tls(&self.ca), everywhere)?;
        rule("storage.cert", one_of_tls(&self.cert), everywhere)?;
        let beside = "only with `engine = \"log\"`: etcd keeps the state under storage.prefix, leave it out";
        rule("storage.directory", self.directory.is_none(), beside)?;
        rule("storage.key", self.cert.is_some() == self.key.is_some(), "goes together with storage.cert")?;
        let durable = "group, with `engine = \"etcd\"`: etcd keeps what it has acknowledged";
        rule("storage.durability", self.durability == Durability::Group, durable)
    }
}

/// The default directory of durable state: a folder of the runtime directory, with a folder for each role.
pub fn state_directory(runtime_directory: &Path) -> PathBuf {
    runtime_directory.join("state")
}

/// Reads and checks the config file of a daemon.
///
/// # Errors
/// [`ConfigError`] of what is wrong with it.
pub fn load<C: DeserializeOwned + Check>(file: &Path) -> Result<C, ConfigError> {
    let unreadable = |source| ConfigError::Unreadable { file: file.to_owned(), source };
    let text = ratn_regular_file::read_text(file, ratn_regular_file::USUAL).map_err(unreadable)?;
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

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    fn refused(text: &str) -> Option<String> {
        let config: StorageConfig = toml::from_str(text).unwrap();
        config.check().err().map(|error| error.to_string())
    }

    #[test]
    fn of_etcd_only_what_means_something_is_taken_and_what_does_not_is_refused_with_what_to_write() {
        let etcd = |more: &str| refused(&format!("engine = \"etcd\"\n{more}"));
        let https = "endpoints = [\"https://a:2379\"]\nprefix = \"/ratn/cell-7\"\n";
        let http = "endpoints = [\"https://a:2379\", \"http://b:2379\"]\nprefix = \"/ratn/cell-7\"\n";
        assert_eq!(etcd(https), None);
        assert_eq!(etcd(&format!("{https}ca = \"/ca.pem\"\ncert = \"/c.pem\"\nkey = \"/k.pem\"")), None);
        assert_eq!(etcd(http), None);
        let says = |said: Option<String>, key: &str, what: &str| {
            let said = said.unwrap_or_default();
            assert!(said.starts_with(key) && said.contains(what), "{key}: {said}");
        };
        says(etcd(&format!("{http}ca = \"/ca.pem\"")), "`storage.ca`", "write https://");
        says(etcd(&format!("{http}cert = \"/c.pem\"\nkey = \"/k.pem\"")), "`storage.cert`", "write https://");
        says(etcd(&format!("{https}directory = \"/state\"")), "`storage.directory`", "leave it out");
        for prefix in
            ["ratn", "", "/", "/ratn/", "//ratn", "/ratn//cell", "/ratn/\\u0007", "/ratn/a\\u200Bb", "/ratn/a b"]
        {
            let config = format!("endpoints = [\"https://a:2379\"]\nprefix = \"{prefix}\"");
            says(etcd(&config), "`storage.prefix`", "as \"/ratn/cell-7\"");
        }
        for key in ["prefix = \"/ratn\"", "ca = \"/ca.pem\"", "cert = \"/c.pem\"", "key = \"/k.pem\""] {
            let name = key.split_once(' ').unwrap().0;
            says(refused(key), &format!("`storage.{name}`"), "only with `engine = \"etcd\"`");
        }
    }
}
