//! The facts that projections share: one table and two orders of it, all persistent.
//!
//! - by key, hashed: a point lookup;
//! - by key, ordered, so that a predicate and its leading arguments (the subject) are a range;
//! - by argument, ordered, so that a predicate and any later argument (the object) are a range, too.
//!
//! A clone takes constant time. A write copies the path to it in each of the three (Bagwell's hash tries and B-trees), unless
//! nobody shares it: only commits pay that, projections write into an overlay of their own (`world`).

use crate::world::Fact;
use imbl::shared_ptr::DefaultSharedPtr;
use imbl::{GenericHashMap, OrdMap, OrdSet};
use ratn_model::fact::{FactKey, FactPattern, Term};
use std::cmp::Ordering;
use std::hash::{BuildHasherDefault, Hash, Hasher};
use std::ops::Bound;
use std::sync::Arc;

type Hashed = GenericHashMap<Arc<FactKey>, Arc<Fact>, BuildHasherDefault<KeyHasher>, DefaultSharedPtr>;

/// A persistent set of facts.
#[derive(Debug, Clone, Default)]
pub(crate) struct Store {
    by_key: Hashed,
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
        self.by_key.get(key).map(Arc::as_ref)
    }

    pub(crate) fn insert(&mut self, key: &Arc<FactKey>, fact: &Arc<Fact>) {
        if self.by_key.insert(Arc::clone(key), Arc::clone(fact)).is_none() {
            for position in 1..key.arguments.len() {
                self.by_argument.insert(ByArgument { position, key: Arc::clone(key) });
            }
        }
        self.in_order.insert(Arc::clone(key), Arc::clone(fact));
    }

    pub(crate) fn remove(&mut self, key: &Arc<FactKey>) {
        if self.by_key.remove(key.as_ref()).is_some() {
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

    /// The facts that match, and what the index cannot tell from them, in the order of keys; by the index that narrows most by
    /// position: a whole key, the leading arguments, a later argument, the predicate.
    pub(crate) fn candidates<'a>(
        &'a self,
        pattern: &'a FactPattern,
    ) -> Box<dyn Iterator<Item = (&'a FactKey, &'a Fact)> + 'a> {
        let first = first_of(pattern);
        let bound = first.arguments.len();
        if bound == pattern.arguments.len() {
            let found = self.by_key.get_key_value(&first);
            return Box::new(found.into_iter().map(|(key, fact)| (key.as_ref(), fact.as_ref())));
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

/// The least key that may match: its leading bound arguments.
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

/// A fixed hash of keys: eight bytes at a time by a rotation and a multiplication, mixed at the end (the finaliser of
/// `splitmix64`). Not secret: keys that collide on purpose make a lookup slow, and are still told apart.
#[derive(Debug, Default)]
pub(crate) struct KeyHasher(u64);

/// The hash of a key.
pub(crate) fn hash_of(key: &FactKey) -> u64 {
    let mut hasher = KeyHasher::default();
    key.hash(&mut hasher);
    hasher.finish()
}

const MULTIPLIER: u64 = 0x9e37_79b9_7f4a_7c15;

impl KeyHasher {
    fn word(&mut self, word: u64) {
        self.0 = (self.0.rotate_left(23) ^ word).wrapping_mul(MULTIPLIER);
    }
}

impl Hasher for KeyHasher {
    fn write(&mut self, bytes: &[u8]) {
        let (words, rest) = bytes.as_chunks::<8>();
        for word in words {
            self.word(u64::from_le_bytes(*word));
        }
        if !rest.is_empty() {
            let mut last = [0; 8];
            last[..rest.len()].copy_from_slice(rest);
            self.word(u64::from_le_bytes(last) ^ ((rest.len() as u64) << 56));
        }
    }

    fn write_u8(&mut self, byte: u8) {
        self.word(u64::from(byte));
    }

    fn write_u64(&mut self, word: u64) {
        self.word(word);
    }

    fn write_usize(&mut self, word: usize) {
        self.word(word as u64);
    }

    fn finish(&self) -> u64 {
        let mut hash = self.0;
        hash = (hash ^ (hash >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        hash = (hash ^ (hash >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        hash ^ (hash >> 31)
    }
}
