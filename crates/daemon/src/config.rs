//! Configs from TOML: unknown keys are refused, and every error names the file and the place in it.

use serde::de::DeserializeOwned;
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
