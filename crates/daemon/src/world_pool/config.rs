//! The world pool's config.

use super::in_memory::Most;
use super::memory::Bounds;
use crate::config::{Check, ConfigError, StorageConfig, rule};
use ratn_model::name::{KIND_RULE, is_kind};
use ratn_proto::MAX_PAGE_BYTES;
use ratn_worker::endpoint::Endpoint;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::ops::RangeInclusive;
use std::path::PathBuf;

/// How long a fact may live.
const TTLS_S: RangeInclusive<f64> = 0.001..=1e9;

const MIB: usize = 1 << 20;

/// All keys are optional.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct WorldPoolConfig {
    /// Where to listen; `local` is a Unix socket in the runtime directory.
    pub listen: Endpoint,
    /// The name of this host: the end of its resource's id, `world-model@compute`.
    pub host: String,
    /// Where the resource manager is; without it, where the runtime directory says.
    pub resource_manager: Option<Endpoint>,
    /// The session lives this long without an answer from the resource manager, in milliseconds.
    pub session_ttl_ms: u64,
    /// The kind of its resource.
    pub kind: String,
    /// Units of its resource: so many projections can be held by leases at once.
    pub capacity: u32,
    /// So many revisions of the root are kept, to project from and to look back at.
    pub revisions_kept: usize,
    /// And at most so many that have written so many facts together; the root itself is always kept.
    pub changes_kept: usize,
    /// And at most so many as take so many bytes of memory besides the root, about.
    pub revision_bytes: usize,
    /// Projections at once in all, those without a lease included.
    pub max_projections: usize,
    /// Of those, projections of one caller that is no operator.
    pub projections_per_caller: usize,
    /// Of `max_projections`, so many are only for operators, but never more than half.
    pub projections_for_operators: usize,
    /// Bytes of memory of all projections, about, with what of forgotten revisions is there for them alone; a quarter is only for operators.
    pub projection_bytes: usize,
    /// Of those, bytes of the projections of one caller that is no operator.
    pub projection_bytes_per_caller: usize,
    /// A projection whose lease holds no resource ends after this long, in seconds.
    pub unbound_ttl_s: f64,
    /// Clients that watch at the same time.
    pub max_watchers: usize,
    /// Bytes of one fact with its evidence, as it is written on the wire.
    pub fact_bytes: usize,
    /// Bytes of all changes of one commit or projection, at most 8 MiB.
    pub commit_bytes: usize,
    /// A file in Turtle: what does not fit it is not committed, and facts live as long as it declares.
    pub ontology: Option<PathBuf>,
    /// Seconds by predicate, instead of what the ontology declares: a fact that is not written again within them is gone.
    pub ttl_s: BTreeMap<String, f64>,
    /// Commits, and projections, remembered so that a repeated id is not performed twice; the caller with the most loses the oldest.
    pub remembered_requests: usize,
    /// Of those, of one caller, who loses the oldest.
    pub remembered_per_caller: usize,
    /// What is kept over a restart.
    pub storage: StorageConfig,
}

impl Default for WorldPoolConfig {
    fn default() -> Self {
        WorldPoolConfig {
            listen: Endpoint::local(),
            host: "localhost".to_owned(),
            resource_manager: None,
            session_ttl_ms: 3_000,
            kind: "WorldModel".to_owned(),
            capacity: 64,
            revisions_kept: 4_096,
            changes_kept: 1_000_000,
            revision_bytes: 256 * MIB,
            max_projections: 4_096,
            projections_per_caller: 1_024,
            projections_for_operators: 256,
            projection_bytes: 768 * MIB,
            projection_bytes_per_caller: 256 * MIB,
            unbound_ttl_s: 600.0,
            max_watchers: 1_024,
            fact_bytes: 1 << 20,
            commit_bytes: MAX_PAGE_BYTES,
            ontology: None,
            ttl_s: BTreeMap::new(),
            remembered_requests: 65_536,
            remembered_per_caller: 32_768,
            storage: StorageConfig::default(),
        }
    }
}

impl WorldPoolConfig {
    pub(super) fn most_in_memory(&self) -> Most {
        Most { in_all: self.projection_bytes, per_caller: self.projection_bytes_per_caller }
    }

    pub(super) fn remembered(&self) -> Bounds {
        Bounds { in_all: self.remembered_requests, per_caller: self.remembered_per_caller }
    }
}

impl Check for WorldPoolConfig {
    fn check(&self) -> Result<(), ConfigError> {
        rule("host", !self.host.is_empty(), "is not empty")?;
        rule("kind", is_kind(&self.kind), KIND_RULE)?;
        rule("session_ttl_ms", self.session_ttl_ms >= 100, "at least 100 ms")?;
        rule("capacity", self.capacity >= 1, "at least 1")?;
        rule("revisions_kept", self.revisions_kept >= 1, "at least 1")?;
        rule("changes_kept", self.changes_kept >= 1, "at least 1")?;
        rule("max_projections", self.max_projections >= 1, "at least 1")?;
        rule("projections_per_caller", self.projections_per_caller >= 1, "at least 1")?;
        rule("unbound_ttl_s", (1.0..=86_400.0).contains(&self.unbound_ttl_s), "from 1 s to a day")?;
        rule("max_watchers", self.max_watchers >= 1, "at least 1")?;
        rule("fact_bytes", (64..=self.commit_bytes).contains(&self.fact_bytes), "from 64 bytes to commit_bytes")?;
        rule("commit_bytes", self.commit_bytes <= MAX_PAGE_BYTES, "at most 8 MiB: a message has to have room for it")?;
        let holds = self.revision_bytes >= self.commit_bytes;
        rule("revision_bytes", holds, "at least commit_bytes: the revision before a large commit is kept, too")?;
        let holds = self.projection_bytes_per_caller >= 4 * self.commit_bytes;
        rule(
            "projection_bytes_per_caller",
            holds,
            "at least four times commit_bytes: a large projection has its changes twice",
        )?;
        let holds = self.projection_bytes >= self.projection_bytes_per_caller;
        rule("projection_bytes", holds, "at least projection_bytes_per_caller")?;
        let lasting = self.ttl_s.values().all(|ttl_s| TTLS_S.contains(ttl_s));
        rule("ttl_s", lasting, "from 0.001 s to 1,000,000,000 s each")?;
        rule("remembered_requests", self.remembered_requests >= 1, "at least 1")?;
        rule("remembered_per_caller", self.remembered_per_caller >= 1, "at least 1")?;
        self.storage.check()
    }
}
