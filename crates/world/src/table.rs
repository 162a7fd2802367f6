//! Facts by key: a flat table that worlds share, and the changes of each world since.
//!
//! A lookup that misses the CPU caches costs two cache lines: one of the table, which contains the key as bytes, and one of the fact. Longer keys are
//! compared in place. The table uses open addressing with linear probing and backward shifts (Knuth, volume 3, 6.4, algorithm R), and is at most five
//! eighths full.
//!
//! The table is divided into shards, by the first bits of the hash. A shard that grows too large is split without touching the others (extendible
//! hashing: Fagin, Nievergelt, Pippenger, Strong, ACM TODS 1979). The only owner of a shard writes into it. An owner that shares it writes into a
//! persistent hash map of changes beside it; when these reach an eighth of the shard, both are merged into a new shard of its own. So a write costs a
//! constant amount on average, and at most one shard; a clone costs nothing.

use crate::world::Fact;
use imbl::GenericHashMap;
use imbl::shared_ptr::DefaultSharedPtr;
use ratn_model::fact::{FactKey, Term};
use std::hash::{BuildHasherDefault, Hash, Hasher};
use std::sync::Arc;

type Since = GenericHashMap<Arc<FactKey>, Option<Arc<Fact>>, BuildHasherDefault<KeyHasher>, DefaultSharedPtr>;

/// Below this number of changes a shared shard is never copied.
const MIN_SINCE: usize = 512;
/// A shard with more facts is split, because one write may have to copy it.
const MAX_SHARD: usize = 16_384;
/// Limit of the hash bits that select a shard. Beyond it, or if hashes collide on purpose, shards grow.
const MAX_BITS: u32 = 12;
/// Number of key bytes stored in the table.
const TEXT: usize = 39;
/// Length value of a key that does not fit.
const LONG: u8 = u8::MAX;

/// Facts by key.
#[derive(Debug, Clone, Default)]
pub(crate) struct Table {
    parts: Arc<Parts>,
    len: usize,
}

#[derive(Debug, Clone, Default)]
struct Parts {
    /// By first bits of a hash, the index of its shard; empty while there are no facts.
    directory: Vec<u32>,
    shards: Vec<Shard>,
    /// Number of these bits.
    bits: u32,
}

#[derive(Debug, Clone, Default)]
struct Shard {
    flat: Arc<Flat>,
    since: Since,
    len: usize,
    /// Number of first bits that all its hashes have in common.
    depth: u32,
}

#[derive(Debug, Clone, Default)]
struct Flat {
    /// Empty, or a power of two.
    slots: Vec<Option<Slot>>,
    len: usize,
}

/// Has the size of one cache line.
#[derive(Debug, Clone)]
#[repr(align(64))]
struct Slot {
    hash: u64,
    key: Arc<FactKey>,
    fact: Arc<Fact>,
    length: u8,
    text: [u8; TEXT],
}

/// A key to look up: its bytes, if they fit, and its hash.
struct Wanted {
    hash: u64,
    length: u8,
    text: [u8; TEXT],
}

impl Table {
    pub(crate) fn len(&self) -> usize {
        self.len
    }

    pub(crate) fn get(&self, key: &FactKey) -> Option<&Fact> {
        self.get_key_value(key).map(|(_, fact)| fact)
    }

    /// The fact, with the stored key.
    pub(crate) fn get_key_value(&self, key: &FactKey) -> Option<(&FactKey, &Fact)> {
        let wanted = Wanted::of(key);
        self.parts.shards[self.parts.find(wanted.hash)?].get_key_value(&wanted, key)
    }

    /// Inserts a fact; true if it is new.
    pub(crate) fn insert(&mut self, key: &Arc<FactKey>, fact: &Arc<Fact>) -> bool {
        let wanted = Wanted::of(key);
        let parts = Arc::make_mut(&mut self.parts);
        let at = parts.find_or_begin(wanted.hash);
        let shard = &mut parts.shards[at];
        let is_new = shard.insert(wanted, key, fact);
        self.len += usize::from(is_new);
        if shard.len > MAX_SHARD && shard.depth < MAX_BITS {
            parts.divide(at);
        }
        is_new
    }

    /// Removes a fact; true if it was there.
    pub(crate) fn remove(&mut self, key: &Arc<FactKey>) -> bool {
        let wanted = Wanted::of(key);
        let Some(at) = self.parts.find(wanted.hash) else { return false };
        let was_there = Arc::make_mut(&mut self.parts).shards[at].remove(&wanted, key);
        self.len -= usize::from(was_there);
        was_there
    }
}

impl Parts {
    /// The index of the shard of a hash.
    fn find(&self, hash: u64) -> Option<usize> {
        let first = hash.checked_shr(u64::BITS - self.bits).unwrap_or(0) as usize;
        self.directory.get(first).map(|shard| *shard as usize)
    }

    fn find_or_begin(&mut self, hash: u64) -> usize {
        if self.shards.is_empty() {
            self.shards.push(Shard::default());
            self.directory.push(0);
        }
        self.find(hash).unwrap_or(0)
    }

    /// Splits a shard in two, by the next bit of the hashes.
    fn divide(&mut self, at: usize) {
        let depth = self.shards[at].depth;
        if depth == self.bits {
            self.directory = self.directory.iter().flat_map(|shard| [*shard, *shard]).collect();
            self.bits += 1;
        }
        let (zeros, ones) = std::mem::take(&mut self.shards[at]).halves(depth);
        self.shards[at] = zeros;
        self.shards.push(ones);
        let new = (self.shards.len() - 1) as u32;
        let bit = self.bits - depth - 1;
        for (first, shard) in self.directory.iter_mut().enumerate() {
            if *shard as usize == at && (first >> bit) & 1 == 1 {
                *shard = new;
            }
        }
    }
}

impl Shard {
    fn get_key_value(&self, wanted: &Wanted, key: &FactKey) -> Option<(&FactKey, &Fact)> {
        if !self.since.is_empty()
            && let Some((key, changed)) = self.since.get_key_value(key)
        {
            return changed.as_deref().map(|fact| (key.as_ref(), fact));
        }
        self.flat.get(wanted, key)
    }

    fn insert(&mut self, wanted: Wanted, key: &Arc<FactKey>, fact: &Arc<Fact>) -> bool {
        let is_new = self.get_key_value(&wanted, key).is_none();
        self.len += usize::from(is_new);
        match self.own() {
            Some(flat) => flat.insert(wanted, key, fact),
            None => drop(self.since.insert(Arc::clone(key), Some(Arc::clone(fact)))),
        }
        is_new
    }

    fn remove(&mut self, wanted: &Wanted, key: &Arc<FactKey>) -> bool {
        let was_there = self.get_key_value(wanted, key).is_some();
        if was_there {
            self.len -= 1;
            match self.own() {
                Some(flat) => flat.remove(wanted, key),
                None => drop(self.since.insert(Arc::clone(key), None)),
            }
        }
        was_there
    }

    /// The shard for writing: if nobody shares it, or if so much has changed beside it that it is copied now. `None`: write beside it.
    fn own(&mut self) -> Option<&mut Flat> {
        if Arc::get_mut(&mut self.flat).is_none() && self.since.len() < MIN_SINCE.max(self.flat.len / 8) {
            return None;
        }
        let flat = Arc::make_mut(&mut self.flat);
        for (key, fact) in std::mem::take(&mut self.since) {
            match fact {
                Some(fact) => flat.insert(Wanted::of(&key), &key, &fact),
                None => flat.remove(&Wanted::of(&key), &key),
            }
        }
        Some(flat)
    }

    /// Splits its facts by the hash bit after the first `depth` bits.
    fn halves(self, depth: u32) -> (Shard, Shard) {
        let mut halves = [Flat::default(), Flat::default()];
        let mut put = |key: &Arc<FactKey>, fact: &Arc<Fact>| {
            let wanted = Wanted::of(key);
            let bit = (wanted.hash >> (u64::BITS - 1 - depth)) & 1;
            halves[bit as usize].insert(wanted, key, fact);
        };
        for slot in self.flat.slots.iter().flatten().filter(|slot| !self.since.contains_key(&slot.key)) {
            put(&slot.key, &slot.fact);
        }
        for (key, fact) in &self.since {
            if let Some(fact) = fact {
                put(key, fact);
            }
        }
        let shard =
            |flat: Flat| Shard { len: flat.len, flat: Arc::new(flat), since: Since::default(), depth: depth + 1 };
        let [zeros, ones] = halves;
        (shard(zeros), shard(ones))
    }
}

impl Flat {
    fn get(&self, wanted: &Wanted, key: &FactKey) -> Option<(&FactKey, &Fact)> {
        let at = self.find(wanted, key).ok()?;
        self.slots[at].as_ref().map(|slot| (slot.key.as_ref(), slot.fact.as_ref()))
    }

    /// The slot of a key, or the slot where it would be inserted.
    fn find(&self, wanted: &Wanted, key: &FactKey) -> Result<usize, usize> {
        if self.slots.is_empty() {
            return Err(0);
        }
        let mask = self.slots.len() - 1;
        let mut at = wanted.hash as usize & mask;
        // The table is never full, so a free slot is found.
        loop {
            match &self.slots[at] {
                None => return Err(at),
                Some(slot) if slot.is(wanted, key) => return Ok(at),
                Some(_) => at = (at + 1) & mask,
            }
        }
    }

    fn insert(&mut self, wanted: Wanted, key: &Arc<FactKey>, fact: &Arc<Fact>) {
        if self.slots.len() * 5 <= (self.len + 1) * 8 {
            self.grow();
        }
        match self.find(&wanted, key) {
            Ok(at) => {
                if let Some(slot) = &mut self.slots[at] {
                    slot.fact = Arc::clone(fact);
                }
            }
            Err(at) => {
                let Wanted { hash, length, text } = wanted;
                let slot = Slot { hash, key: Arc::clone(key), fact: Arc::clone(fact), length, text };
                self.slots[at] = Some(slot);
                self.len += 1;
            }
        }
    }

    fn remove(&mut self, wanted: &Wanted, key: &FactKey) {
        let Ok(mut free) = self.find(wanted, key) else { return };
        let mask = self.slots.len() - 1;
        self.slots[free] = None;
        self.len -= 1;
        let mut at = free;
        loop {
            at = (at + 1) & mask;
            let Some(slot) = &self.slots[at] else { return };
            // The entry moves into the gap, unless the gap is before its home slot.
            let home = slot.hash as usize & mask;
            if at.wrapping_sub(home) & mask >= at.wrapping_sub(free) & mask {
                self.slots.swap(free, at);
                free = at;
            }
        }
    }

    fn grow(&mut self) {
        let size = (self.slots.len() * 2).max(16);
        let old = std::mem::replace(&mut self.slots, vec![None; size]);
        for slot in old.into_iter().flatten() {
            let mut at = slot.hash as usize & (size - 1);
            while self.slots[at].is_some() {
                at = (at + 1) & (size - 1);
            }
            self.slots[at] = Some(slot);
        }
    }
}

impl Slot {
    fn is(&self, wanted: &Wanted, key: &FactKey) -> bool {
        self.hash == wanted.hash
            && self.length == wanted.length
            && if self.length == LONG { *self.key == *key } else { self.text == wanted.text }
    }
}

impl Wanted {
    fn of(key: &FactKey) -> Wanted {
        let mut bytes = Bytes { text: [0; TEXT], length: 0 };
        if bytes.add(key).is_some() {
            let Bytes { text, length } = bytes;
            let mut hasher = KeyHasher::default();
            let (words, rest) = text.as_chunks::<8>();
            let used = length.div_ceil(8);
            words.iter().take(used).for_each(|word| hasher.word(u64::from_le_bytes(*word)));
            if used > words.len() {
                hasher.write(rest);
            }
            return Wanted { hash: hasher.finish(), length: length as u8, text };
        }
        Wanted { hash: hash_of(key), length: LONG, text: [0; TEXT] }
    }
}

/// A key as unambiguous bytes.
struct Bytes {
    text: [u8; TEXT],
    length: usize,
}

impl Bytes {
    fn add(&mut self, key: &FactKey) -> Option<()> {
        self.text(&key.predicate)?;
        for argument in &key.arguments {
            match argument {
                Term::Int(i) => {
                    self.bytes(&[LONG])?;
                    self.bytes(&i.to_le_bytes())?;
                }
                Term::Name(name) => self.text(name)?,
            }
        }
        Some(())
    }

    /// Adds a text after its length, which is smaller than the mark of a number.
    fn text(&mut self, text: &str) -> Option<()> {
        let length = u8::try_from(text.len()).ok().filter(|length| *length < LONG)?;
        self.bytes(&[length])?;
        self.bytes(text.as_bytes())
    }

    fn bytes(&mut self, bytes: &[u8]) -> Option<()> {
        let end = self.length + bytes.len();
        self.text.get_mut(self.length..end)?.copy_from_slice(bytes);
        self.length = end;
        Some(())
    }
}

pub(crate) fn hash_of(key: &FactKey) -> u64 {
    let mut hasher = KeyHasher::default();
    key.hash(&mut hasher);
    hasher.finish()
}

/// A fixed hash of keys: eight bytes at a time by a rotation and a multiplication, mixed at the end (the finaliser of `splitmix64`). Not secret: keys
/// that collide on purpose make a lookup slow, but are still distinguished.
#[derive(Debug, Default)]
pub(crate) struct KeyHasher(u64);

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

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]

    use super::*;
    use proptest::prelude::*;
    use ratn_model::id::Revision;
    use ratn_model::value::Value;
    use std::collections::{BTreeMap, BTreeSet};

    /// Every third key is too long for the table; some consist of numbers.
    fn key(i: u16) -> Arc<FactKey> {
        let name =
            if i.is_multiple_of(3) { format!("a_name_that_is_too_long_for_a_slot_{i}") } else { format!("o{i}") };
        let arguments = if i.is_multiple_of(5) { vec![Term::Int(i64::from(i))] } else { vec![Term::Name(name)] };
        Arc::new(FactKey { predicate: format!("p{}", i % 2), arguments })
    }

    fn fact(value: i64) -> Arc<Fact> {
        let world = crate::world::World::from_facts([((*key(0)).clone(), Value::Int(value))], Revision(1));
        Arc::new(world.fact(&key(0)).unwrap().clone())
    }

    /// Inserts or removals of neighbouring keys, and which clones are kept or dropped meanwhile.
    fn step() -> impl Strategy<Value = (u16, u16, bool, u8)> {
        (0_u16..3000, 1_u16..800, prop::bool::weighted(0.6), 0_u8..4)
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 60, ..ProptestConfig::default() })]

        #[test]
        fn versions_shared_and_alone_are_what_maps_would_be(steps in prop::collection::vec(step(), 1..20)) {
            let (mut table, mut model) = (Table::default(), BTreeMap::new());
            let mut kept: Vec<(Table, BTreeMap<Arc<FactKey>, i64>)> = Vec::new();
            for (round, (from, count, insert, keep)) in steps.into_iter().enumerate() {
                match keep {
                    0 => kept.push((table.clone(), model.clone())),
                    1 => kept.clear(),
                    _ => {}
                }
                let value = round as i64;
                let new = fact(value);
                for key in (from..from + count).map(key) {
                    if insert {
                        prop_assert_eq!(table.insert(&key, &new), model.insert(key, value).is_none());
                    } else {
                        prop_assert_eq!(table.remove(&key), model.remove(&key).is_some());
                    }
                }
                for (table, model) in kept.iter().chain([&(table.clone(), model.clone())]) {
                    prop_assert_eq!(table.len(), model.len());
                    for key in (0..4000).step_by(7).map(key) {
                        let found = table.get_key_value(&key).map(|(key, fact)| (key.clone(), fact.value.clone()));
                        prop_assert_eq!(found, model.get(&key).map(|value| ((*key).clone(), Value::Int(*value))));
                    }
                }
            }
        }
    }

    #[test]
    fn a_table_that_grows_is_divided_and_nothing_is_lost() {
        let key = |i: u64| {
            let arguments = vec![Term::Int(i.cast_signed())];
            Arc::new(FactKey { predicate: "p".to_owned(), arguments })
        };
        let (old, new) = (fact(1), fact(2));
        let (count, mut table) = (4 * MAX_SHARD as u64, Table::default());
        let mut before = Table::default();
        for i in 0..count {
            assert!(table.insert(&key(i), &old));
            if i == count / 2 {
                before = table.clone();
            }
        }
        let largest = |table: &Table| table.parts.shards.iter().map(|shard| shard.len).max();
        assert!(table.parts.shards.len() >= 4 && largest(&table) <= Some(MAX_SHARD));
        for i in (0..count).step_by(3) {
            assert!(!table.insert(&key(i), &new));
            assert!(table.remove(&key(i + 1)) == (i + 1 < count));
        }
        for i in 0..count {
            let expected = [Some(2), None, Some(1)][(i % 3) as usize];
            assert_eq!(table.get(&key(i)).map(|fact| fact.value.clone()), expected.map(Value::Int), "{i}");
            assert_eq!(before.get(&key(i)).is_some(), i <= count / 2, "{i}");
        }
        assert_eq!(table.len(), table.parts.shards.iter().map(|shard| shard.len).sum::<usize>());
    }

    #[test]
    fn keys_that_read_alike_are_told_apart() {
        let name = |text: &str| Term::Name(text.to_owned());
        let key = |predicate: &str, arguments: Vec<Term>| FactKey { predicate: predicate.to_owned(), arguments };
        let alike = [
            key("ab", vec![name("c")]),
            key("a", vec![name("bc")]),
            key("abc", vec![]),
            key("abc", vec![name("")]),
            key("a", vec![name("b"), name("c")]),
            key("a", vec![Term::Int(1)]),
            key("a", vec![name("1")]),
            key("a", vec![name("\u{1}\0\0\0\0\0\0\0")]),
            key("a", vec![name(&"x".repeat(300))]),
            key("a", vec![name(&"x".repeat(301))]),
        ];
        let texts: BTreeSet<(u64, u8, [u8; TEXT])> =
            alike.iter().map(Wanted::of).map(|wanted| (wanted.hash, wanted.length, wanted.text)).collect();
        assert_eq!(texts.len(), alike.len());
    }
}
