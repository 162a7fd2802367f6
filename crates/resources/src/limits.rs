//! The bounds of everything that a client can make grow.

use serde::{Deserialize, Serialize};

/// Bounds of a pool; a request beyond one is refused with [`crate::PoolError::TooMany`] or
/// [`crate::PoolError::Malformed`].
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Limits {
    /// Resources in all.
    pub resources: usize,
    /// Of these, what the sessions of one caller that is no operator provide.
    pub resources_per_caller: usize,
    /// Of all resources, so many are only for operators; at most half of them, as of all that follow.
    pub resources_for_operators: usize,
    /// Sessions in all.
    pub sessions: usize,
    /// Sessions of one caller that is no operator.
    pub sessions_per_caller: usize,
    /// Of all sessions, so many are only for operators.
    pub sessions_for_operators: usize,
    /// What the shares of those sessions of one caller that is no operator are together at the most which hold or wait for something of the same
    /// kinds: where they are more, each counts as so many times less. The usual share of one session is 1.
    pub share_per_caller: u32,
    /// Ids of sessions that have ended, which are kept for their openers: of the caller with the most, the oldest is given up first.
    pub kept_session_ids: usize,
    /// Of these, those of one caller: the caller's own oldest is given up first.
    pub kept_session_ids_per_caller: usize,
    /// And for so long at the most, in milliseconds. Then anybody may open a session of that id.
    pub keep_session_ids_for_ms: u64,
    /// Queued acquires in all. Who can be served at once does not queue, and is not refused for this.
    pub waiters: usize,
    /// Queued acquires of all sessions that one caller opened.
    pub waiters_per_caller: usize,
    /// Of all queued acquires, so many are only for operators.
    pub waiters_for_operators: usize,
    /// Queued acquires of one session.
    pub waiters_per_session: usize,
    /// Different selectors (kind, class, attributes) that are waited for.
    pub selectors: usize,
    /// Of these, what one caller that is no operator waits for.
    pub selectors_per_caller: usize,
    /// Of all selectors, so many are only for operators.
    pub selectors_for_operators: usize,
    /// How often a waiter may be overtaken (a later one gets what it waits for) before what it waits for is kept for it. Never
    /// (0) is the default: the most urgent request is not made later by less urgent ones, and units may be idle until the rest
    /// of what it waits for comes. A larger number uses them meanwhile.
    pub overtaken: u32,
    /// Leases in all: those that live, and those that have ended while a provider has not confirmed standstill.
    pub leases: usize,
    /// Of these, those of one caller that is no operator; its queued acquires count too, for each may become one.
    pub leases_per_caller: usize,
    /// Of all leases, so many are only for operators.
    pub leases_for_operators: usize,
    /// Requirements of one acquire.
    pub requirements: usize,
    /// Units that one requirement may ask for.
    pub units: u32,
    /// Units that the requirements of one request may ask for together: each may be another resource, and all of them are looked
    /// up, granted, written down and told of in one turn.
    pub units_per_request: u32,
    /// Comparisons of an attribute with a resource that one request may take, should it have to look at every resource of its
    /// kinds: resources of the kind times attributes and conditions, over its different selectors.
    pub comparisons: usize,
    /// Characters of a name, a kind or a request id.
    pub name_length: usize,
    /// Attributes of a resource.
    pub attributes: usize,
    /// Bytes of a resource: its id, kind, host and attributes with their values.
    pub resource_bytes: usize,
    /// Bytes of a requirement: its kind, attributes and conditions.
    pub requirement_bytes: usize,
    /// Leases that may hold some of one resource at the same time.
    pub holders: usize,
    /// Answers remembered so that a repeated request id is not performed twice; of the caller with the most, the oldest is forgotten first.
    pub remembered_requests: usize,
    /// Of those, answers to one caller: the caller's own oldest is forgotten first.
    pub remembered_per_caller: usize,
    /// And bytes of the answers to one caller, each with about 256 bytes besides its ids; the newest is kept whatever it has.
    pub remembered_bytes_per_caller: usize,
    /// And for so long at the most, in milliseconds (forgotten when the next one is remembered).
    pub remember_for_ms: u64,
    /// Watch events kept for those who watch from an earlier revision.
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
