//! The resource manager's config.

use crate::config::{Check, ConfigError, StorageConfig, rule};
use ratn_model::name::{KIND_RULE, is_kind};
use ratn_resources::{Kinds, Limits};
use ratn_worker::endpoint::Endpoint;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::time::Duration;

/// All keys are optional.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ResourceManagerConfig {
    /// The address to listen at; `local` is a Unix socket in the runtime directory.
    pub listen: Endpoint,
    /// Maximum time to live of a session without a keep-alive, in milliseconds; longer requests are shortened to this.
    pub max_session_ttl_ms: u64,
    /// Maximum waiting time of an acquire, in milliseconds; longer requests are shortened to this.
    pub max_wait_ms: u64,
    /// Maximum number of clients that watch at the same time.
    pub max_watchers: usize,
    /// How long a provider may take for each resource that it is asked for, in milliseconds; then another provider is asked.
    pub provider_patience_ms: u64,
    /// After waiting this long for held resources, in milliseconds, a request makes providers start more of them.
    pub grow_after_ms: u64,
    /// The direct superclasses of kinds, `VacuumGripper = ["Gripper"]`: a request for a kind may get a subclass.
    pub kinds: BTreeMap<String, Vec<String>>,
    /// Limits for everything that clients can make grow.
    pub limits: Limits,
    /// What is stored across restarts.
    pub storage: StorageConfig,
}

impl Default for ResourceManagerConfig {
    fn default() -> Self {
        ResourceManagerConfig {
            listen: Endpoint::local(),
            max_session_ttl_ms: 60_000,
            max_wait_ms: 24 * 3_600_000,
            max_watchers: 1_024,
            provider_patience_ms: 15_000,
            grow_after_ms: 250,
            kinds: BTreeMap::new(),
            limits: Limits::default(),
            storage: StorageConfig::default(),
        }
    }
}

impl ResourceManagerConfig {
    /// The hierarchy of kinds; empty if they violate [`Check::check`].
    pub fn hierarchy(&self) -> Kinds {
        Kinds::new(&self.kinds).unwrap_or_default()
    }

    pub(crate) fn max_session_ttl(&self) -> Duration {
        Duration::from_millis(self.max_session_ttl_ms)
    }

    pub(crate) fn provider_patience(&self) -> Duration {
        Duration::from_millis(self.provider_patience_ms)
    }

    pub(crate) fn grow_after(&self) -> Duration {
        Duration::from_millis(self.grow_after_ms)
    }

    pub(crate) fn max_wait(&self) -> Duration {
        Duration::from_millis(self.max_wait_ms)
    }
}

impl Check for ResourceManagerConfig {
    fn check(&self) -> Result<(), ConfigError> {
        rule("max_session_ttl_ms", self.max_session_ttl_ms >= 100, "at least 100 ms")?;
        rule("max_wait_ms", self.max_wait_ms >= 1, "at least 1 ms")?;
        rule("max_watchers", self.max_watchers >= 1, "at least 1")?;
        rule("provider_patience_ms", self.provider_patience_ms >= 1, "at least 1 ms")?;
        rule("grow_after_ms", self.grow_after_ms >= 10, "at least 10 ms")?;
        rule(
            "limits.share_per_caller",
            self.limits.share_per_caller >= 1,
            "at least 1, the usual share of one session",
        )?;
        let named = self.kinds.iter().flat_map(|(kind, above)| above.iter().chain([kind]));
        for kind in named.filter(|kind| !is_kind(kind)) {
            rule("kinds", false, format!("`{kind}` has to be {KIND_RULE}"))?;
        }
        let kinds = Kinds::new(&self.kinds).map(drop).map_err(|cyclic| cyclic.to_string());
        rule("kinds", kinds.is_ok(), kinds.err().unwrap_or_default())?;
        self.storage.check()
    }
}
