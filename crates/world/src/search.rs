//! Finds facts that match any of several patterns, visiting a bounded number of facts.
//!
//! Each pattern has its candidates in the order of keys; the smallest key of all is taken, as in a merge of sorted lists (Knuth, volume 3,
//! 5.4.1).

use crate::world::{Fact, World};
use ratn_model::fact::{FactKey, FactPattern};
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// The result of a search.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Found {
    /// All wanted facts were found.
    All,
    /// The limit was reached.
    Unfinished,
}

impl World {
    /// Visits the facts that match any of the patterns, in the order of keys, each once, until `visit` returns false. At most `most` facts
    /// are examined, including those that do not match; a fact examined for two patterns counts twice.
    pub fn search(
        &self,
        patterns: &[FactPattern],
        most: usize,
        visit: &mut dyn FnMut(&FactKey, &Fact) -> bool,
    ) -> Found {
        let mut left = most;
        let mut candidates: Vec<_> = patterns.iter().map(|pattern| self.merged(pattern)).collect();
        // The next match of each pattern; `None` if the limit is reached.
        let mut next = |at: usize| -> Option<Option<(&FactKey, &Fact)>> {
            for (key, fact) in candidates[at].by_ref() {
                left = left.checked_sub(1)?;
                if patterns[at].matches(key) {
                    return Some(Some((key, fact)));
                }
            }
            Some(None)
        };
        let mut first = BinaryHeap::new();
        let mut facts: Vec<Option<&Fact>> = vec![None; patterns.len()];
        for (at, first_fact) in facts.iter_mut().enumerate() {
            let Some(found) = next(at) else { return Found::Unfinished };
            first.extend(found.map(|(key, _)| Reverse((key, at))));
            *first_fact = found.map(|(_, fact)| fact);
        }
        let mut before: Option<&FactKey> = None;
        while let Some(Reverse((key, at))) = first.pop() {
            if let Some(fact) = facts[at].take_if(|_| before != Some(key))
                && !visit(key, fact)
            {
                return Found::All;
            }
            before = Some(key);
            let Some(found) = next(at) else { return Found::Unfinished };
            first.extend(found.map(|(key, _)| Reverse((key, at))));
            facts[at] = found.map(|(_, fact)| fact);
        }
        Found::All
    }
}
