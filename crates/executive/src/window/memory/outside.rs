//! Facts of the root that change from outside: which of them are beyond the tolerance of what anybody has seen.
//!
//! A fact that creeps, each step within the tolerance, is told of when it has come too far from what it was when somebody may have
//! looked.

use super::Memory;
use ratn_model::fact::{FactKey, FactPattern};
use ratn_model::tolerance::Tolerance;
use ratn_model::value::Value;
use ratn_world::world::World;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Of one fact, so many values that somebody may have seen are kept; then it counts as otherwise.
const MAX_VERSIONS: usize = 8;

/// What is known of changes from outside.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(super) struct Outside {
    /// What facts were that have changed within their tolerance.
    seen: BTreeMap<FactKey, Vec<Option<Value>>>,
    /// Facts that have changed, and nobody was told.
    news: News,
}

/// Facts that have changed from outside.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(crate) struct News {
    /// At all.
    pub(crate) changed: Vec<FactPattern>,
    /// Beyond the tolerance of what anybody has seen.
    pub(crate) otherwise: Vec<FactPattern>,
}

impl Memory {
    /// The root is about to be changed so from outside.
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

    /// The facts that have changed since this was asked last.
    pub(crate) fn take_news_from_outside(&mut self) -> News {
        std::mem::take(&mut self.outside.news)
    }
}
