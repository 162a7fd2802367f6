//! Quotas: how much of a daemon one caller may use at the same time, so that no caller can block the others.
//!
//! ```text
//!   call ──admit(caller, path)──▶ Permit, held until the answer has been sent
//!                           └───▶ RESOURCE_EXHAUSTED: which quota, and whose
//! ```
//! Bytes count that are in answers which were made and not sent yet because the caller does not read; so do the bytes of the first part of a
//! watch. An answer that is too much is refused, but its request was performed: a caller who asks again learns of it.
//!
//! Quotas are by name ([`Caller::name`]): all anonymous callers are one. Operators have no quotas, and a share of what all others can use
//! together is kept for them. Sessions and waiting acquires have quotas in the pool ([`ratn_resources::Limits`]). Health and reflection
//! calls count like all others, but `HEALTH_CHECKS_PER_S` health checks of a caller are answered whatever else it does: a supervisor of the
//! process may have the same name as a client that does too much.

use crate::access::{Caller, HEALTH_CHECK};
use crate::config::{Check, ConfigError, rule};
use crate::details::retry_later;
use crate::metrics::Metrics;
use ratn_proto::MAX_MESSAGE_BYTES;
use ratn_worker::connections::ConnectionLimits;
use ratn_worker::gate::Permit;
use ratn_worker::token_bucket::TokenBucket;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use tonic::{Code, Status};

/// The section `[service.quotas]`. All keys are optional.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct QuotaConfig {
    /// Calls of one caller per second; twice as many may come in a burst.
    pub calls_per_s: u32,
    /// Calls of one caller in progress, waiting acquires and streams included.
    pub calls: usize,
    /// Watches of one caller.
    pub watches: usize,
    /// Watches of all callers that are not operators.
    pub watches_of_all: usize,
    /// Bytes of answers to one caller that it has not read yet.
    pub unread_bytes: usize,
    /// Bytes of unread answers to all callers that are not operators.
    pub unread_bytes_of_all: usize,
    /// A connection whose client takes nothing of such answers for so long is closed, in milliseconds.
    pub unread_ms: u64,
    /// Open connections: a new one replaces the one that has been silent for longest. Has to be below the process's limit of open files.
    pub connections: usize,
    /// New connections per second of one user of this machine or one host; as many as `connections` may come in a burst.
    pub connections_per_s: u32,
    /// Connections of one caller with calls in progress.
    pub connections_in_use: usize,
    /// Part of `connections` that only operators and new connections can use: the others leave this many without calls in progress. By
    /// default a sixth.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub connections_for_operators: Option<usize>,
    /// Maximum time from a connection to its first call, the TLS handshake included, in milliseconds.
    pub first_call_ms: u64,
    /// A connection without a call in progress is closed after this time, in milliseconds.
    pub idle_ms: u64,
}

impl QuotaConfig {
    pub(crate) fn connections(&self) -> ConnectionLimits {
        ConnectionLimits {
            connections: self.connections,
            per_s: self.connections_per_s,
            of_one_caller: self.connections_in_use,
            for_operators: self.connections_for_operators.unwrap_or(self.connections / OPERATORS_PART).max(1),
            first_call: Duration::from_millis(self.first_call_ms),
            idle: Duration::from_millis(self.idle_ms),
            unread: Duration::from_millis(self.unread_ms),
        }
    }
}

impl Default for QuotaConfig {
    fn default() -> QuotaConfig {
        QuotaConfig {
            calls_per_s: 20_000,
            calls: 8_192,
            watches: 256,
            watches_of_all: 896,
            unread_bytes: 128 << 20,
            unread_bytes_of_all: 512 << 20,
            unread_ms: 300_000,
            connections: 768,
            connections_per_s: 200,
            connections_in_use: 512,
            connections_for_operators: None,
            first_call_ms: 10_000,
            idle_ms: 600_000,
        }
    }
}

impl Check for QuotaConfig {
    fn check(&self) -> Result<(), ConfigError> {
        rule("quotas.calls_per_s", self.calls_per_s >= 1, "at least 1")?;
        rule("quotas.calls", self.calls >= 1, "at least 1")?;
        rule("quotas.watches", self.watches >= 1, "at least 1")?;
        let holds = self.unread_bytes >= 2 * MAX_MESSAGE_BYTES;
        rule("quotas.unread_bytes", holds, "at least 32 MiB: two messages of the greatest length")?;
        let holds = self.unread_bytes_of_all >= self.unread_bytes;
        rule("quotas.unread_bytes_of_all", holds, "at least quotas.unread_bytes")?;
        rule("quotas.unread_ms", self.unread_ms >= 1_000, "at least 1 s")?;
        rule("quotas.connections", self.connections >= 2, "at least 2")?;
        rule("quotas.connections_per_s", self.connections_per_s >= 1, "at least 1")?;
        rule("quotas.connections_in_use", self.connections_in_use >= 1, "at least 1")?;
        let for_operators = 1..self.connections.max(2);
        let good = self.connections_for_operators.is_none_or(|share| for_operators.contains(&share));
        rule("quotas.connections_for_operators", good, "at least 1, and fewer than quotas.connections")?;
        rule("quotas.first_call_ms", (10..=600_000).contains(&self.first_call_ms), "from 10 ms to 10 minutes")?;
        rule("quotas.idle_ms", self.idle_ms >= 1_000, "at least 1 s")?;
        rule("quotas.watches_of_all", self.watches_of_all >= self.watches, "at least quotas.watches")
    }
}

/// Operators have one part in this many of all connections, unless the config says otherwise.
const OPERATORS_PART: usize = 6;
/// Health checks of one caller per second that are answered even where its quotas are used up.
const HEALTH_CHECKS_PER_S: u32 = 20;
/// Retry delay of a caller that is over its quota.
const RETRY_DELAY: Duration = Duration::from_millis(200);

/// Current use by callers. A handle: clones share everything.
#[derive(Debug, Clone)]
pub(crate) struct Quotas {
    config: QuotaConfig,
    use_of: Arc<Mutex<Use>>,
    metrics: Arc<Metrics>,
}

#[derive(Debug, Default)]
struct Use {
    callers: BTreeMap<Arc<str>, UseOfOne>,
    watches: usize,
    unread: usize,
}

#[derive(Debug)]
struct UseOfOne {
    calls: usize,
    watches: usize,
    /// Bytes.
    unread: usize,
    /// Calls that may begin now.
    rate: TokenBucket,
    /// Health checks beyond the quotas.
    checks: TokenBucket,
}

/// Burst size at this rate per second.
fn at_once(per_s: u32) -> u32 {
    per_s.saturating_mul(2)
}

impl Quotas {
    pub(crate) fn new(config: QuotaConfig, metrics: Arc<Metrics>) -> Quotas {
        Quotas { config, use_of: Arc::default(), metrics }
    }

    /// Counts a call of a caller until the permit is dropped. Operators and health checks beyond the quotas need no permit.
    pub(crate) fn admit(&self, caller: &Caller, path: &str, now: Instant) -> Result<Option<Permit>, Status> {
        if caller.is_operator() {
            return Ok(None);
        }
        let is_watch = is_watch(path);
        let mut use_of = self.use_of();
        let all_watches = use_of.watches;
        let one = use_of.of(caller, self.config.calls_per_s, now);
        if let Err(beyond) = self.within(one, all_watches, is_watch, now) {
            if path == HEALTH_CHECK && one.checks.take(HEALTH_CHECKS_PER_S, at_once(HEALTH_CHECKS_PER_S), now) {
                return Ok(None);
            }
            self.metrics.refused("call", beyond.reason());
            return Err(beyond.of(&caller.name));
        }
        one.calls += 1;
        one.watches += usize::from(is_watch);
        use_of.watches += usize::from(is_watch);
        drop(use_of);
        Ok(Some(Permit::new(Held { quotas: self.clone(), caller: caller.name.clone(), is_watch })))
    }

    /// Counts bytes that a caller has not read, until the permit is dropped. Small answers and those to operators do not count.
    pub(crate) fn unread(&self, caller: &Caller, bytes: usize, now: Instant) -> Result<Option<Permit>, Status> {
        if caller.is_operator() || bytes < UNREAD_COUNTED_FROM {
            return Ok(None);
        }
        let QuotaConfig { calls_per_s, unread_bytes, unread_bytes_of_all, .. } = self.config;
        let mut use_of = self.use_of();
        let of_all = use_of.unread.saturating_add(bytes);
        let one = use_of.of(caller, calls_per_s, now);
        let of_one = one.unread.saturating_add(bytes);
        let beyond = if of_one > unread_bytes {
            Some(("unread_bytes", unread_bytes))
        } else {
            (of_all > unread_bytes_of_all).then_some((UNREAD_OF_ALL, unread_bytes_of_all))
        };
        if let Some((key, most)) = beyond {
            let beyond = Beyond { key, what: "bytes of answers that were not read", most };
            drop(use_of);
            self.metrics.refused("call", beyond.reason());
            return Err(beyond.of(&caller.name));
        }
        one.unread = of_one;
        use_of.unread = of_all;
        drop(use_of);
        Ok(Some(Permit::new(HeldBytes { quotas: self.clone(), caller: caller.name.clone(), bytes })))
    }

    /// Whether a caller may have another call.
    fn within(&self, one: &mut UseOfOne, all_watches: usize, is_watch: bool, now: Instant) -> Result<(), Beyond> {
        let QuotaConfig { calls_per_s, calls, watches, watches_of_all, .. } = self.config;
        let beyond = |key, what, most| Err(Beyond { key, what, most });
        if !one.rate.take(calls_per_s, at_once(calls_per_s), now) {
            return beyond("calls_per_s", "calls a second", calls_per_s as usize);
        }
        if one.calls >= calls {
            return beyond("calls", "calls under way", calls);
        }
        if is_watch && one.watches >= watches {
            return beyond("watches", "watches", watches);
        }
        if is_watch && all_watches >= watches_of_all {
            return beyond(WATCHES_OF_ALL, "watches", watches_of_all);
        }
        Ok(())
    }

    fn use_of(&self) -> MutexGuard<'_, Use> {
        self.use_of.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Use {
    fn of(&mut self, caller: &Caller, calls_per_s: u32, now: Instant) -> &mut UseOfOne {
        self.callers.entry(caller.name.clone()).or_insert_with(|| UseOfOne {
            calls: 0,
            watches: 0,
            unread: 0,
            rate: TokenBucket::full(at_once(calls_per_s), now),
            checks: TokenBucket::full(at_once(HEALTH_CHECKS_PER_S), now),
        })
    }
}

/// Unread bytes of an answer.
struct HeldBytes {
    quotas: Quotas,
    caller: Arc<str>,
    bytes: usize,
}

impl Drop for HeldBytes {
    fn drop(&mut self) {
        let mut use_of = self.quotas.use_of();
        use_of.unread -= self.bytes;
        if let Some(one) = use_of.callers.get_mut(&self.caller) {
            one.unread -= self.bytes;
        }
    }
}

/// A call in progress.
struct Held {
    quotas: Quotas,
    caller: Arc<str>,
    is_watch: bool,
}

impl Drop for Held {
    fn drop(&mut self) {
        let mut use_of = self.quotas.use_of();
        use_of.watches -= usize::from(self.is_watch);
        if let Some(one) = use_of.callers.get_mut(&self.caller) {
            one.calls -= 1;
            one.watches -= usize::from(self.is_watch);
        }
        if use_of.callers.len() > MOST_REMEMBERED {
            use_of.callers.retain(|_, one| one.calls > 0 || one.unread > 0);
        }
    }
}

/// Maximum number of callers without a call in progress whose call rate is remembered.
const MOST_REMEMBERED: usize = 1_024;

/// Whether the answer is a stream of changes that lasts for as long as the caller likes.
fn is_watch(path: &str) -> bool {
    path.rsplit('/').next().is_some_and(|method| method.starts_with("Watch"))
}

/// The keys of the quotas that all callers share.
const WATCHES_OF_ALL: &str = "watches_of_all";
const UNREAD_OF_ALL: &str = "unread_bytes_of_all";
/// Smaller answers do not count in bytes: `calls` bounds them, and a caller who reads nothing still gets its refusal.
const UNREAD_COUNTED_FROM: usize = 16 << 10;

/// A quota that is used up.
#[derive(Debug, Clone, Copy)]
struct Beyond {
    key: &'static str,
    what: &'static str,
    most: usize,
}

impl Beyond {
    /// The reason code for programs.
    fn reason(self) -> String {
        format!("QUOTA_{}", self.key.to_uppercase())
    }

    /// The refusal for its caller.
    fn of(self, caller: &str) -> Status {
        let Beyond { key, what, most } = self;
        let whose = if [WATCHES_OF_ALL, UNREAD_OF_ALL].contains(&key) { "all who are no operators" } else { caller };
        let message = format!("{what} of {whose}: the quota of {most} is reached (service.quotas.{key})");
        retry_later(Code::ResourceExhausted, &self.reason(), message, RETRY_DELAY)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use crate::access::Role;

    const WATCH: &str = "/ratn.v1.ResourceService/Watch";
    const LIST: &str = "/ratn.v1.ResourceService/List";

    fn quotas(config: QuotaConfig) -> Quotas {
        Quotas::new(config, Arc::new(Metrics::new("cell")))
    }

    fn caller(name: &str, role: Role) -> Caller {
        Caller { name: name.into(), roles: [role].as_slice().into() }
    }

    /// Each quota, the calls that it bounds, and the text of the refusal: admitted at the limit, refused one past it, and admitted again
    /// when a call has ended.
    #[test]
    fn every_quota_at_its_edge_and_one_past_it() {
        let config =
            QuotaConfig { calls_per_s: 1_000, calls: 5, watches: 3, watches_of_all: 4, ..QuotaConfig::default() };
        let now = Instant::now();
        for (path, most, says) in [
            (LIST, 5, "calls under way of eve: the quota of 5 is reached (service.quotas.calls)"),
            (WATCH, 3, "watches of eve: the quota of 3 is reached (service.quotas.watches)"),
        ] {
            let quotas = self::quotas(config.clone());
            let (eve, adam) = (caller("eve", Role::Viewer), caller("adam", Role::Task));
            let mut held: Vec<Option<Permit>> = (0..most).map(|_| quotas.admit(&eve, path, now).unwrap()).collect();
            let refused = quotas.admit(&eve, path, now).unwrap_err();
            assert_eq!((refused.code(), refused.message()), (Code::ResourceExhausted, says));
            let _adams = quotas.admit(&adam, path, now).unwrap();
            held.pop();
            held.push(quotas.admit(&eve, path, now).unwrap());
            assert!(quotas.admit(&eve, path, now).is_err());
        }
    }

    #[test]
    fn bytes_that_wait_for_their_reader_have_a_bound_for_one_caller_and_one_for_all() {
        let quotas = self::quotas(QuotaConfig {
            unread_bytes: 3 * UNREAD_COUNTED_FROM,
            unread_bytes_of_all: 4 * UNREAD_COUNTED_FROM,
            ..QuotaConfig::default()
        });
        let (eve, adam, now) = (caller("eve", Role::Task), caller("adam", Role::Task), Instant::now());
        let unread = |who: &Caller, parts: usize| quotas.unread(who, parts * UNREAD_COUNTED_FROM, now);
        let _first = unread(&eve, 2).unwrap().unwrap();
        let second = unread(&eve, 1).unwrap().unwrap();
        let refused = unread(&eve, 1).unwrap_err();
        let says =
            "bytes of answers that were not read of eve: the quota of 49152 is reached (service.quotas.unread_bytes)";
        assert_eq!((refused.code(), refused.message()), (Code::ResourceExhausted, says));
        assert!(quotas.unread(&eve, UNREAD_COUNTED_FROM - 1, now).unwrap().is_none(), "few are let through");
        let _adams = unread(&adam, 1).unwrap().unwrap();
        let refused = unread(&adam, 1).unwrap_err();
        assert!(refused.message().contains("all who are no operators: the quota of 65536"), "{refused}");
        assert!(unread(&caller("root", Role::Operator), 9).unwrap().is_none());
        drop(second);
        assert!(unread(&eve, 1).is_ok() && unread(&adam, 1).is_ok());
    }

    #[test]
    fn a_share_of_the_watches_is_kept_for_operators() {
        let quotas = self::quotas(QuotaConfig { watches: 3, watches_of_all: 4, ..QuotaConfig::default() });
        let now = Instant::now();
        let mut held = Vec::new();
        for (name, count) in [("eve", 3), ("adam", 1)] {
            held.extend((0..count).map(|_| quotas.admit(&caller(name, Role::Viewer), WATCH, now).unwrap()));
        }
        let refused = quotas.admit(&caller("adam", Role::Viewer), WATCH, now).unwrap_err();
        assert!(refused.message().contains("all who are no operators: the quota of 4"), "{refused}");
        assert!(quotas.admit(&caller("root", Role::Operator), WATCH, now).is_ok());
    }

    #[test]
    fn calls_a_second_are_refilled_with_time() {
        let quotas = self::quotas(QuotaConfig { calls_per_s: 10, ..QuotaConfig::default() });
        let (eve, now) = (caller("eve", Role::Viewer), Instant::now());
        for _ in 0..20 {
            quotas.admit(&eve, LIST, now).unwrap();
        }
        let refused = quotas.admit(&eve, LIST, now).unwrap_err();
        assert!(refused.message().contains("calls a second of eve: the quota of 10"), "{refused}");
        assert!(quotas.admit(&eve, LIST, now + Duration::from_millis(99)).is_err());
        assert!(quotas.admit(&eve, LIST, now + Duration::from_millis(101)).is_ok());
        assert!(quotas.admit(&caller("adam", Role::Viewer), LIST, now).is_ok());
    }

    #[test]
    fn calls_of_health_and_reflection_count_and_so_many_checks_are_always_answered() {
        let quotas = self::quotas(QuotaConfig { calls: 2, watches: 1, ..QuotaConfig::default() });
        let (eve, now) = (caller("eve", Role::Viewer), Instant::now());
        let admitted = |path: &str, at| quotas.admit(&eve, path, at);
        let reflection = "/grpc.reflection.v1.ServerReflection/ServerReflectionInfo";
        let _watch = admitted("/grpc.health.v1.Health/Watch", now).unwrap().unwrap();
        let refused = admitted("/grpc.health.v1.Health/Watch", now).unwrap_err();
        assert!(refused.message().contains("watches of eve: the quota of 1"), "{refused}");
        let _call = admitted(reflection, now).unwrap().unwrap();
        let refused = admitted(reflection, now).unwrap_err();
        assert!(refused.message().contains("calls under way of eve: the quota of 2"), "{refused}");
        let checks = |at| (0..1_000).filter(|_| admitted(HEALTH_CHECK, at).is_ok()).count();
        assert_eq!(checks(now), 2 * HEALTH_CHECKS_PER_S as usize);
        assert_eq!(checks(now + Duration::from_millis(1_001)), HEALTH_CHECKS_PER_S as usize);
        assert!(quotas.admit(&caller("adam", Role::Viewer), HEALTH_CHECK, now).unwrap().is_some());
    }

    #[test]
    fn operators_have_a_sixth_of_the_connections_unless_the_config_says_otherwise() {
        let share = |connections, connections_for_operators| {
            let config = QuotaConfig { connections, connections_for_operators, ..QuotaConfig::default() };
            config.check().map(|()| config.connections().for_operators).ok()
        };
        assert_eq!(share(768, None), Some(128));
        assert_eq!((share(2, None), share(5, None)), (Some(1), Some(1)));
        assert_eq!((share(30, Some(29)), share(30, Some(30)), share(30, Some(0))), (Some(29), None, None));
    }
}
