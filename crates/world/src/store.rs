//! The facts that projections share: one table and two orders over it, all shared between versions.
//!
//! - by key, hashed: a point lookup (`table`);
//! - by key, ordered, so that a predicate and its leading arguments (the subject) are a range;
//! - by argument, ordered, so that a predicate and any later argument (the object) are a range, too.
//!
//! A clone takes constant time. A write copies the path to the fact in each of the three (hash tries by Bagwell, B-trees),
//! unless nobody shares it. Only commits pay for that; projections write into an overlay of their own (`world`).

use crate::table::Table;
use crate::world::Fact;
use imbl::{OrdMap, OrdSet};
use ratn_model::fact::{FactKey, FactPattern, Term};
use std::cmp::Ordering;
use std::ops::Bound;
use std::sync::Arc;

/// A persistent set of facts.
#[derive(Debug, Clone, Default)]
pub(crate) struct Store {
    by_key: Table,
    in_order: OrdMap<Arc<FactKey>, Arc<Fact>>,
    by_argument: OrdSet<ByArgument>,
}

/// A key, ordered by one of its arguments, then by itself.
#[derive(Debug, Clone, PartialEq, Eq)]
struct ByArgument {
    position: usize,
    key: Arc<FactKey>,
}

/// The place before all keys of a predicate with this argument.
struct Place<'a> {
    position: usize,
    argument: &'a Term,
    predicate: &'a str,
}

impl Store {
    pub(crate) fn len(&self) -> usize {
        self.by_key.len()
    }

    pub(crate) fn get(&self, key: &FactKey) -> Option<&Fact> {
        self.by_key.get(key)
    }

    pub(crate) fn insert(&mut self, key: &Arc<FactKey>, fact: &Arc<Fact>) {
        if self.by_key.insert(key, fact) {
            for position in 1..key.arguments.len() {
                self.by_argument.insert(ByArgument { position, key: Arc::clone(key) });
            }
        }
        self.in_order.insert(Arc::clone(key), Arc::clone(fact));
    }

    pub(crate) fn remove(&mut self, key: &Arc<FactKey>) {
        if self.by_key.remove(key) {
            self.in_order.remove(key.as_ref());
            for position in 1..key.arguments.len() {
                self.by_argument.remove(&ByArgument { position, key: Arc::clone(key) });
            }
        }
    }

    /// Every fact, in the order of keys.
    pub(crate) fn iter(&self) -> impl Iterator<Item = (&FactKey, &Fact)> {
        self.in_order.iter().map(|(key, fact)| (key.as_ref(), fact.as_ref()))
    }

    /// Every fact with a greater key, in the order of keys.
    pub(crate) fn iter_behind(&self, key: &FactKey) -> impl Iterator<Item = (&FactKey, &Fact)> {
        let behind = self.in_order.range::<_, FactKey>((Bound::Excluded(key), Bound::Unbounded));
        behind.map(|(key, fact)| (key.as_ref(), fact.as_ref()))
    }

    /// The facts that match, together with others that the index cannot separate, in the order of keys. Uses the most
    /// selective index: the whole key, the leading arguments, a later argument, or the predicate.
    pub(crate) fn candidates<'a>(
        &'a self,
        pattern: &'a FactPattern,
    ) -> Box<dyn Iterator<Item = (&'a FactKey, &'a Fact)> + 'a> {
        let first = first_of(pattern);
        let bound = first.arguments.len();
        if bound == pattern.arguments.len() {
            return Box::new(self.by_key.get_key_value(&first).into_iter());
        }
        let later = pattern.arguments.iter().enumerate().find_map(|(at, term)| Some((at, term.as_ref()?)));
        match later {
            Some((position, argument)) if bound == 0 => {
                let place = Place { position, argument, predicate: &pattern.predicate };
                let keys = self.by_argument.range((Bound::Included(place), Bound::Unbounded));
                let same = move |entry: &&ByArgument| {
                    entry.position == position
                        && entry.key.predicate == pattern.predicate
                        && entry.key.arguments.get(position) == Some(argument)
                };
                Box::new(keys.take_while(same).filter_map(|entry| Some((entry.key.as_ref(), self.get(&entry.key)?))))
            }
            _ => {
                let facts = self.in_order.range::<_, FactKey>(first..);
                let matching = facts.take_while(move |(key, _)| begins_as(key, pattern, bound));
                Box::new(matching.map(|(key, fact)| (key.as_ref(), fact.as_ref())))
            }
        }
    }
}

/// The smallest key that may match: its leading bound arguments.
pub(crate) fn first_of(pattern: &FactPattern) -> FactKey {
    FactKey {
        predicate: pattern.predicate.clone(),
        arguments: pattern.arguments.iter().map_while(Clone::clone).collect(),
    }
}

/// Whether `key` has the predicate and the first `bound` arguments of `pattern`.
pub(crate) fn begins_as(key: &FactKey, pattern: &FactPattern, bound: usize) -> bool {
    key.predicate == pattern.predicate
        && key.arguments.len() >= bound
        && key.arguments[..bound].iter().zip(&pattern.arguments).all(|(have, want)| want.as_ref() == Some(have))
}

impl Ord for ByArgument {
    fn cmp(&self, other: &ByArgument) -> Ordering {
        self.position
            .cmp(&other.position)
            .then_with(|| self.key.arguments.get(self.position).cmp(&other.key.arguments.get(other.position)))
            .then_with(|| self.key.cmp(&other.key))
    }
}

impl PartialOrd for ByArgument {
    fn partial_cmp(&self, other: &ByArgument) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl equivalent::Equivalent<ByArgument> for Place<'_> {
    fn equivalent(&self, _: &ByArgument) -> bool {
        false
    }
}

impl equivalent::Comparable<ByArgument> for Place<'_> {
    fn compare(&self, entry: &ByArgument) -> Ordering {
        self.position
            .cmp(&entry.position)
            .then_with(|| Some(self.argument).cmp(&entry.key.arguments.get(entry.position)))
            .then_with(|| self.predicate.cmp(&entry.key.predicate))
            .then(Ordering::Less)
    }
}
