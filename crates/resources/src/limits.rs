//! Limits for everything that clients can make grow.

use serde::{Deserialize, Serialize};

/// Limits of a pool; a request beyond a limit is refused with [`crate::PoolError::TooMany`] or [`crate::PoolError::Malformed`].
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Limits {
    /// Resources in total.
    pub resources: usize,
    /// Of these, resources provided by the sessions of one caller who is not an operator.
    pub resources_per_caller: usize,
    /// Of all resources, the number reserved for operators; at most half of them. The same applies to all `_for_operators` below.
    pub resources_for_operators: usize,
    /// Sessions in total.
    pub sessions: usize,
    /// Sessions of one caller who is not an operator.
    pub sessions_per_caller: usize,
    /// Of all sessions, the number reserved for operators.
    pub sessions_for_operators: usize,
    /// Maximum total share of those sessions of one caller, who is not an operator, that hold or wait for something of the same kinds: if they exceed
    /// it, each share is scaled down accordingly. The usual share of a session is 1.
    pub share_per_caller: u32,
    /// Kept ids of ended sessions: of the caller with the most, the oldest id is dropped first.
    pub kept_session_ids: usize,
    /// Of these, ids of one caller: the caller's own oldest is dropped first.
    pub kept_session_ids_per_caller: usize,
    /// Maximum time for which these ids are kept, in milliseconds. Then anybody may open a session with that id.
    pub keep_session_ids_for_ms: u64,
    /// Queued acquires in total. An acquire that can be served at once does not queue, and is not refused for this.
    pub waiters: usize,
    /// Queued acquires of all sessions that one caller opened.
    pub waiters_per_caller: usize,
    /// Of all queued acquires, the number reserved for operators.
    pub waiters_for_operators: usize,
    /// Queued acquires of one session.
    pub waiters_per_session: usize,
    /// Different selectors (kind, class, attributes) that requests wait for.
    pub selectors: usize,
    /// Of these, selectors that one caller who is not an operator waits for.
    pub selectors_per_caller: usize,
    /// Of all selectors, the number reserved for operators.
    pub selectors_for_operators: usize,
    /// How often a waiter may be overtaken (a later one gets what it waits for) before resources are reserved for it. The default is never (0): less
    /// urgent requests do not delay the most urgent one, but units may be idle until the rest of what it waits for is free. A larger number uses them
    /// in the meantime.
    pub overtaken: u32,
    /// Leases in total: live ones, and ended ones whose providers have not confirmed standstill.
    pub leases: usize,
    /// Of these, leases of one caller who is not an operator; queued acquires count too, because each may become a lease.
    pub leases_per_caller: usize,
    /// Of all leases, the number reserved for operators.
    pub leases_for_operators: usize,
    /// Requirements of one acquire.
    pub requirements: usize,
    /// Units in one requirement.
    pub units: u32,
    /// Units in all requirements of one request: each unit may be another resource, and all of them are looked up, granted, recorded and reported in
    /// one turn.
    pub units_per_request: u32,
    /// Comparisons of an attribute with a resource in one request, if every resource of its kinds has to be read: resources of the kind times
    /// attributes and conditions, summed over its different selectors.
    pub comparisons: usize,
    /// Characters of a name, a kind or a request id.
    pub name_length: usize,
    /// Attributes of a resource.
    pub attributes: usize,
    /// Bytes of a resource: its id, kind, host and attributes with their values.
    pub resource_bytes: usize,
    /// Bytes of a requirement: its kind, attributes and conditions.
    pub requirement_bytes: usize,
    /// Leases that may hold units of one resource at the same time.
    pub holders: usize,
    /// Remembered answers, so that a repeated request id is not performed twice; of the caller with the most, the oldest is forgotten first.
    pub remembered_requests: usize,
    /// Of these, answers to one caller: the caller's own oldest is forgotten first.
    pub remembered_per_caller: usize,
    /// Bytes of the remembered answers to one caller, each counted with about 256 bytes besides its ids; the newest is kept whatever its size.
    pub remembered_bytes_per_caller: usize,
    /// Maximum time for which answers are remembered, in milliseconds (they are forgotten when the next one is remembered).
    pub remember_for_ms: u64,
    /// Watch events kept for watches that begin at an earlier revision.
    pub history: usize,
}

impl Default for Limits {
    fn default() -> Self {
        Limits {
            resources: 100_000,
            resources_per_caller: 45_000,
            resources_for_operators: 5_000,
            sessions: 10_000,
            sessions_per_caller: 2_500,
            sessions_for_operators: 500,
            share_per_caller: 100,
            kept_session_ids: 10_000,
            kept_session_ids_per_caller: 2_500,
            keep_session_ids_for_ms: 604_800_000,
            waiters: 10_000,
            waiters_per_caller: 4_500,
            waiters_for_operators: 500,
            waiters_per_session: 4_096,
            selectors: 10_000,
            selectors_per_caller: 4_500,
            selectors_for_operators: 500,
            overtaken: 0,
            leases: 100_000,
            leases_per_caller: 45_000,
            leases_for_operators: 5_000,
            requirements: 32,
            units: 100_000,
            units_per_request: 4_096,
            comparisons: 1_000_000,
            name_length: 128,
            attributes: 32,
            resource_bytes: 65_536,
            requirement_bytes: 16_384,
            holders: 4_096,
            remembered_requests: 65_536,
            remembered_per_caller: 32_768,
            remembered_bytes_per_caller: 33_554_432,
            remember_for_ms: 3_600_000,
            history: 4_096,
        }
    }
}
