//! The expiry of facts: which facts have a time to live, and when it is over.
//!
//! Writing a fact restarts its time to live; so does a restore, because no clock continues over a restart.

use ratn_model::fact::{Change, FactKey, FactPattern};
use ratn_model::time::Timestamp;
use ratn_world::world::Written;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

/// See the module.
#[derive(Debug, Default)]
pub(super) struct Expiry {
    /// Times to live by predicate.
    ttl: BTreeMap<String, Duration>,
    ends: BTreeMap<Arc<FactKey>, Timestamp>,
    order: BTreeSet<(Timestamp, Arc<FactKey>)>,
}

impl Expiry {
    pub(super) fn new(ttl: BTreeMap<String, Duration>) -> Expiry {
        Expiry { ttl, ..Expiry::default() }
    }

    /// Whether no fact ever expires.
    pub(super) fn is_empty(&self) -> bool {
        self.ttl.is_empty()
    }

    /// Facts that were written now.
    pub(super) fn written(&mut self, now: Timestamp, written: &Written) {
        for (key, fact) in written {
            self.forget(key);
            if fact.is_some() {
                self.begin(now, key);
            }
        }
    }

    /// Restarts the time to live of a fact.
    pub(super) fn begin(&mut self, now: Timestamp, key: &Arc<FactKey>) {
        if let Some(ttl) = self.ttl.get(&key.predicate) {
            let end = now + *ttl;
            self.ends.insert(Arc::clone(key), end);
            self.order.insert((end, Arc::clone(key)));
        }
    }

    /// When the next fact expires.
    pub(super) fn next(&self) -> Option<Timestamp> {
        self.order.first().map(|(end, _)| *end)
    }

    /// The deletions of the facts that have expired.
    pub(super) fn due(&self, now: Timestamp) -> Vec<Change> {
        let due = self.order.iter().take_while(|(end, _)| *end <= now);
        due.map(|(_, key)| Change::Delete { pattern: FactPattern::of(key) }).collect()
    }

    /// Forgets the times of all facts.
    pub(super) fn clear(&mut self) {
        self.ends.clear();
        self.order.clear();
    }

    fn forget(&mut self, key: &Arc<FactKey>) {
        if let Some(end) = self.ends.remove(key) {
            self.order.remove(&(end, Arc::clone(key)));
        }
    }
}
