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

/// Allowed times to live of a fact, in seconds.
const TTLS_S: RangeInclusive<f64> = 0.001..=1e9;

const MIB: usize = 1 << 20;

/// All keys are optional.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct WorldPoolConfig {
    /// Where to listen; `local` is a Unix socket in the runtime directory.
    pub listen: Endpoint,
    /// The name of this host: the end of the id of the pool's resource, `world-model@compute`.
    pub host: String,
    /// Address of the resource manager; without it the address in the runtime directory is used.
    pub resource_manager: Option<Endpoint>,
    /// Time to live of the session without an answer from the resource manager, in milliseconds.
    pub session_ttl_ms: u64,
    /// The kind of the pool's resource.
    pub kind: String,
    /// Units of the pool's resource: this many projections can be held by leases at once.
    pub capacity: u32,
    /// Maximum number of kept revisions of the root, for projections and for the history.
    pub revisions_kept: usize,
    /// Maximum number of facts that the kept revisions have written together; the root itself is always kept.
    pub changes_kept: usize,
    /// Approximate maximum memory of the kept revisions besides the root, in bytes.
    pub revision_bytes: usize,
    /// Maximum number of projections at once, those without a lease included.
    pub max_projections: usize,
    /// Part of these for one caller that is not an operator.
    pub projections_per_caller: usize,
    /// Part of `max_projections` that is only for operators, never more than half.
    pub projections_for_operators: usize,
    /// Approximate maximum memory of all projections in bytes, with the facts of forgotten revisions that are kept for them alone; a quarter
    /// is only for operators.
    pub projection_bytes: usize,
    /// Part of these bytes for the projections of one caller that is not an operator.
    pub projection_bytes_per_caller: usize,
    /// A projection whose lease holds no resource ends after this time, in seconds.
    pub unbound_ttl_s: f64,
    /// Maximum number of watching clients.
    pub max_watchers: usize,
    /// Maximum bytes of one fact with its evidence, as encoded on the wire.
    pub fact_bytes: usize,
    /// Maximum bytes of all changes of one commit or projection, at most 8 MiB.
    pub commit_bytes: usize,
    /// An ontology file in Turtle: facts that do not conform to it are not committed, and facts live as long as it declares.
    pub ontology: Option<PathBuf>,
    /// Time to live in seconds by predicate, in place of the ontology's: a fact that is not written again in that time is deleted.
    pub ttl_s: BTreeMap<String, f64>,
    /// Maximum number of remembered commits, and of remembered projections, so that a repeated id is not performed twice; the caller with
    /// the most loses the oldest.
    pub remembered_requests: usize,
    /// Part of these for one caller, who loses its oldest.
    pub remembered_per_caller: usize,
    /// The durable state.
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
