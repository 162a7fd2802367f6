//! Sums of hashes of the root's facts, by the facts that readers look at. They are updated with every change, so that a reader
//! of a whole scene need not hash it again each time.
//!
//! A sum does not depend on the order of facts, and a fact can be subtracted from it: a multiset hash (Clarke et al. 2003),
//! modulo 2¹²⁸.

use ratn_model::fact::{FactKey, FactPattern};
use ratn_model::value::Value;
use ratn_world::digest::{Digester, Quick};
use ratn_world::world::World;
use std::collections::BTreeMap;

/// Limit of patterns with `?` for which a sum is kept.
const MAX_KEPT: usize = 64;

/// The sums that are kept.
#[derive(Debug, Default)]
pub(super) struct Digests {
    /// By pattern; `None` stands for all facts.
    kept: BTreeMap<Option<FactPattern>, Sum>,
}

#[derive(Debug, Default)]
struct Sum {
    facts: BTreeMap<FactKey, u128>,
    sum: u128,
}

pub(super) fn hash(key: &FactKey, value: &Value) -> u128 {
    let mut digester = Digester::<Quick>::default();
    digester.fact(key, value);
    digester.quick()
}

impl Digests {
    /// The sum of the root's facts that match; `None` stands for all facts.
    pub(super) fn sum(&mut self, root: &World, pattern: Option<&FactPattern>) -> u128 {
        if let Some(single) = pattern.filter(|pattern| pattern.arguments.iter().all(Option::is_some)) {
            return root.matching(single).map(|(key, fact)| hash(key, &fact.value)).sum();
        }
        if let Some(kept) = self.kept.get(&pattern.cloned()) {
            return kept.sum;
        }
        if self.kept.len() >= MAX_KEPT {
            self.kept.clear();
        }
        let mut made = Sum::default();
        let mut add = |key: &FactKey, value: &Value| {
            let hash = hash(key, value);
            made.facts.insert(key.clone(), hash);
            made.sum = made.sum.wrapping_add(hash);
        };
        match pattern {
            Some(pattern) => root.matching(pattern).for_each(|(key, fact)| add(key, &fact.value)),
            None => root.iter().for_each(|(key, fact)| add(key, &fact.value)),
        }
        let sum = made.sum;
        self.kept.insert(pattern.cloned(), made);
        sum
    }

    /// Updates the sums for facts of the root that have changed.
    pub(super) fn update(&mut self, root: &World, changed: impl Iterator<Item = FactPattern>) {
        if self.kept.is_empty() {
            return;
        }
        for changed in changed {
            for (pattern, kept) in &mut self.kept {
                if pattern.as_ref().is_none_or(|pattern| pattern.overlaps(&changed)) {
                    kept.update(root, pattern.as_ref(), &changed);
                }
            }
        }
    }
}

impl Sum {
    fn update(&mut self, root: &World, own: Option<&FactPattern>, changed: &FactPattern) {
        let arguments: Option<Vec<_>> = changed.arguments.iter().cloned().collect();
        let keys: Vec<FactKey> = match arguments {
            Some(arguments) => vec![FactKey { predicate: changed.predicate.clone(), arguments }],
            None => self.facts.keys().filter(|key| changed.matches(key)).cloned().collect(),
        };
        for key in keys.into_iter().filter(|key| own.is_none_or(|own| own.matches(key))) {
            let before = match root.get(&key) {
                Some(value) => {
                    let hash = hash(&key, value);
                    self.sum = self.sum.wrapping_add(hash);
                    self.facts.insert(key, hash)
                }
                None => self.facts.remove(&key),
            };
            self.sum = self.sum.wrapping_sub(before.unwrap_or(0));
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]

    use super::*;
    use ratn_model::fact::{Change, Term};
    use ratn_model::id::Revision;

    #[test]
    fn a_sum_kept_up_to_date_is_that_of_the_facts_there_are() {
        let key = |n: i64| FactKey { predicate: "p".into(), arguments: vec![Term::Int(n % 7), Term::Int(n % 3)] };
        let mut root = World::from_facts((0..20).map(|n| (key(n), Value::Int(n))), Revision(0));
        let any = FactPattern { predicate: "p".into(), arguments: vec![None, None] };
        let some = FactPattern { predicate: "p".into(), arguments: vec![None, Some(Term::Int(1))] };
        let mut kept = Digests::default();
        for pattern in [None, Some(&any), Some(&some)] {
            kept.sum(&root, pattern);
        }
        for step in 0..60_i64 {
            let change = match step % 3 {
                0 => Change::Set { fact: key(step * 5), value: Value::Int(step) },
                1 => Change::Increase { fact: key(step * 11), by: 1.0 },
                _ => {
                    let subject = Some(Term::Int(step % 7));
                    Change::Delete { pattern: FactPattern { predicate: "p".into(), arguments: vec![subject, None] } }
                }
            };
            root.apply(std::slice::from_ref(&change)).unwrap();
            kept.update(&root, std::iter::once(change.pattern()));
            for pattern in [None, Some(&any), Some(&some)] {
                assert_eq!(kept.sum(&root, pattern), Digests::default().sum(&root, pattern), "after {change}");
            }
        }
    }
}
