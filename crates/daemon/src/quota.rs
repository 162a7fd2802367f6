//! What one caller may have of a daemon at the same time, so that one stops nobody else.
//!
//! ```text
//!   call ──admit(caller, path)──▶ Permit, held until the answer has been sent
//!                           └───▶ RESOURCE_EXHAUSTED: which quota, and whose
//! ```
//! Quotas are by name ([`Caller::name`]): all who are anonymous are one caller. Operators have none, and a share of what all others can take
//! together is kept for them. Sessions and acquires that wait have theirs in the pool ([`ratn_resources::Limits`]).

use crate::access::Caller;
use crate::config::{Check, ConfigError, rule};
use crate::details::retry_later;
use crate::metrics;
use ratn_worker::connections::ConnectionLimits;
use ratn_worker::gate::Permit;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use tonic::{Code, Status};

/// The section `[service.quotas]`. All keys are optional.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct QuotaConfig {
    /// Calls of one caller in a second; twice as many may come at once.
    pub calls_per_s: u32,
    /// Calls of one caller under way, waiting acquires and streams included.
    pub calls: usize,
    /// Watches of one caller.
    pub watches: usize,
    /// Watches of all callers that are no operators.
    pub watches_of_all: usize,
    /// Connections at once: the one that has said nothing for longest gives way to a new one. Fewer than the process may open files.
    pub connections: usize,
    /// Connections of one caller with calls under way.
    pub connections_in_use: usize,
    /// From a connection to its first call, the handshake of TLS included, in milliseconds.
    pub first_call_ms: u64,
    /// A connection without a call under way is closed after so long, in milliseconds.
    pub idle_ms: u64,
}

impl QuotaConfig {
    pub(crate) fn connections(&self) -> ConnectionLimits {
        ConnectionLimits {
            connections: self.connections,
            of_one_caller: self.connections_in_use,
            first_call: Duration::from_millis(self.first_call_ms),
            idle: Duration::from_millis(self.idle_ms),
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
            connections: 768,
            connections_in_use: 512,
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
        rule("quotas.connections", self.connections >= 2, "at least 2")?;
        rule("quotas.connections_in_use", self.connections_in_use >= 1, "at least 1")?;
        rule("quotas.first_call_ms", (10..=600_000).contains(&self.first_call_ms), "from 10 ms to 10 minutes")?;
        rule("quotas.idle_ms", self.idle_ms >= 1_000, "at least 1 s")?;
        rule("quotas.watches_of_all", self.watches_of_all >= self.watches, "at least quotas.watches")
    }
}

/// When whoever has too much may ask again.
const RETRY_DELAY: Duration = Duration::from_millis(200);

/// What callers have now. A handle: clones share everything.
#[derive(Debug, Clone)]
pub(crate) struct Quotas {
    config: QuotaConfig,
    use_of: Arc<Mutex<Use>>,
}

#[derive(Debug, Default)]
struct Use {
    callers: BTreeMap<Arc<str>, UseOfOne>,
    watches: usize,
}

#[derive(Debug)]
struct UseOfOne {
    calls: usize,
    watches: usize,
    /// Calls that may begin now, refilled with time.
    tokens: f64,
    refilled: Instant,
}

impl Quotas {
    pub(crate) fn new(config: QuotaConfig) -> Quotas {
        Quotas { config, use_of: Arc::default() }
    }

    /// One more call of a caller, until the permit is dropped; none is needed by an operator.
    pub(crate) fn admit(&self, caller: &Caller, path: &str, now: Instant) -> Result<Option<Permit>, Status> {
        if caller.is_operator() || !path.starts_with("/ratn.") {
            return Ok(None);
        }
        let QuotaConfig { calls_per_s, calls, watches, watches_of_all, .. } = self.config;
        let mut use_of = self.use_of();
        let all = use_of.watches;
        let burst = f64::from(calls_per_s) * 2.0;
        let fresh = || UseOfOne { calls: 0, watches: 0, tokens: burst, refilled: now };
        let one = use_of.callers.entry(caller.name.clone()).or_insert_with(fresh);
        let passed = now.saturating_duration_since(one.refilled).as_secs_f64();
        one.tokens = (one.tokens + passed * f64::from(calls_per_s)).min(burst);
        one.refilled = now;
        let is_watch = is_watch(path);
        if one.tokens < 1.0 {
            return Err(refused("calls_per_s", "calls a second", &caller.name, u64::from(calls_per_s)));
        }
        one.tokens -= 1.0;
        if one.calls >= calls {
            return Err(refused("calls", "calls under way", &caller.name, calls as u64));
        }
        if is_watch && one.watches >= watches {
            return Err(refused("watches", "watches", &caller.name, watches as u64));
        }
        if is_watch && all >= watches_of_all {
            return Err(refused("watches_of_all", "watches", "all who are no operators", watches_of_all as u64));
        }
        one.calls += 1;
        one.watches += usize::from(is_watch);
        use_of.watches += usize::from(is_watch);
        drop(use_of);
        Ok(Some(Permit::new(Held { quotas: self.clone(), caller: caller.name.clone(), is_watch })))
    }

    fn use_of(&self) -> MutexGuard<'_, Use> {
        self.use_of.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A call that is under way.
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
            use_of.callers.retain(|_, one| one.calls > 0);
        }
    }
}

/// Callers without a call under way that are remembered, for how often they call.
const MOST_REMEMBERED: usize = 1_024;

/// Whether the answer is a stream that tells of changes for as long as the caller likes.
fn is_watch(path: &str) -> bool {
    path.rsplit('/').next().is_some_and(|method| method.starts_with("Watch"))
}

fn refused(quota: &'static str, what: &str, whose: &str, most: u64) -> Status {
    let reason = format!("QUOTA_{}", quota.to_uppercase());
    if let Some(metrics) = metrics::get() {
        metrics.refused("call", reason.clone());
    }
    let message = format!("{what} of {whose}: the quota of {most} is reached (service.quotas.{quota})");
    retry_later(Code::ResourceExhausted, &reason, message, RETRY_DELAY)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use crate::access::Role;

    const WATCH: &str = "/ratn.v1.ResourceService/Watch";
    const LIST: &str = "/ratn.v1.ResourceService/List";

    fn caller(name: &str, role: Role) -> Caller {
        Caller { name: name.into(), roles: [role].as_slice().into() }
    }

    /// Each quota, the calls that it bounds, and who is refused in which words: admitted at its edge, refused one past it, and admitted
    /// again when one has ended.
    #[test]
    fn every_quota_at_its_edge_and_one_past_it() {
        let config =
            QuotaConfig { calls_per_s: 1_000, calls: 5, watches: 3, watches_of_all: 4, ..QuotaConfig::default() };
        let now = Instant::now();
        for (path, most, says) in [
            (LIST, 5, "calls under way of eve: the quota of 5 is reached (service.quotas.calls)"),
            (WATCH, 3, "watches of eve: the quota of 3 is reached (service.quotas.watches)"),
        ] {
            let quotas = Quotas::new(config.clone());
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
    fn a_share_of_the_watches_is_kept_for_operators() {
        let quotas = Quotas::new(QuotaConfig { watches: 3, watches_of_all: 4, ..QuotaConfig::default() });
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
        let quotas = Quotas::new(QuotaConfig { calls_per_s: 10, ..QuotaConfig::default() });
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
}
