//! Changes of the root from outside: which of them are beyond the tolerance of the values that readers may have seen.
//!
//! A fact that drifts in steps within the tolerance counts as changed once it is too far from a value that a reader may have seen.

use super::Memory;
use ratn_model::fact::{FactKey, FactPattern};
use ratn_model::tolerance::Tolerance;
use ratn_model::value::Value;
use ratn_world::world::World;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Limit of values per fact that readers may have seen; beyond it, the fact counts as changed.
const MAX_VERSIONS: usize = 8;

/// What is known about changes from outside.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(super) struct Outside {
    /// Earlier values of facts that have changed within their tolerance.
    seen: BTreeMap<FactKey, Vec<Option<Value>>>,
    /// Changed facts of which readers were not told yet.
    news: News,
}

/// Facts that have changed from outside.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(crate) struct News {
    /// All of them.
    pub(crate) changed: Vec<FactPattern>,
    /// Those beyond the tolerance of a value that a reader may have seen.
    pub(crate) otherwise: Vec<FactPattern>,
}

impl Memory {
    /// Compares changes from outside with the root, before they are applied to it.
    pub(crate) fn compare_outside(
        &mut self,
        root: &World,
        facts: &[(FactKey, Option<Value>)],
        tolerance: impl Fn(&FactKey) -> Tolerance,
    ) {
        for (key, now) in facts {
            let was = root.get(key).cloned();
            if was == *now {
                continue;
            }
            self.outside.news.changed.push(FactPattern::of(key));
            let mut versions = self.outside.seen.remove(key).unwrap_or_default();
            if !versions.contains(&was) {
                versions.push(was);
            }
            let is_close = |was: &Option<Value>| match (was, now) {
                (Some(was), Some(now)) => tolerance(key).equal(was, now),
                (was, now) => was == now,
            };
            if versions.len() <= MAX_VERSIONS && versions.iter().all(is_close) {
                self.outside.seen.insert(key.clone(), versions);
            } else {
                self.outside.news.otherwise.push(FactPattern::of(key));
            }
        }
    }

    /// Takes the facts that have changed since the last call.
    pub(crate) fn take_news_from_outside(&mut self) -> News {
        std::mem::take(&mut self.outside.news)
    }
}
