//! Stable hashes of values, facts and what is read of a world: equal digests mean equal content, on every machine and in every run
//! (BLAKE3 over an unambiguous encoding: a tag for each kind, a length before each text and list).

use crate::world::World;
use ratn_model::fact::{FactKey, Footprint, Term};
use ratn_model::value::Value;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fmt;

/// A hash of content; the default equals no real digest.
#[derive(Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Digest([u8; 32]);

/// Feeds content to a hash: to BLAKE3 if the digest must identify the content on every machine and for ever.
#[derive(Debug, Clone, Default)]
pub struct Digester<H = blake3::Hasher>(H);

/// A hash that takes bytes.
pub trait Feed {
    /// Feeds bytes.
    fn feed(&mut self, bytes: &[u8]);
}

impl Feed for blake3::Hasher {
    fn feed(&mut self, bytes: &[u8]) {
        self.update(bytes);
    }
}

/// A fast 128-bit hash for comparisons within one process: good enough for a cache, not cryptographic. Two lanes of multiply and
/// rotate, mixed at the end as in SplitMix64.
#[derive(Debug, Clone)]
pub struct Quick {
    lanes: [u64; 2],
}

impl Default for Quick {
    fn default() -> Quick {
        Quick { lanes: [0x243f_6a88_85a3_08d3, 0x1319_8a2e_0370_7344] }
    }
}

impl Feed for Quick {
    fn feed(&mut self, bytes: &[u8]) {
        for chunk in bytes.chunks(8) {
            let mut word = [0; 8];
            word[..chunk.len()].copy_from_slice(chunk);
            // The length of the last chunk is part of the hash.
            let word = u64::from_le_bytes(word) ^ ((chunk.len() as u64) << 56);
            let [a, b] = &mut self.lanes;
            *a = (*a ^ word).wrapping_mul(0x9e37_79b9_7f4a_7c15).rotate_left(29);
            *b = (*b ^ word.rotate_left(32)).wrapping_mul(0xc2b2_ae3d_27d4_eb4f).rotate_left(31);
        }
    }
}

impl Digester<Quick> {
    /// The hash of all bytes fed so far.
    pub fn quick(&self) -> u128 {
        let mix = |mut z: u64| {
            z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
            z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
            z ^ (z >> 31)
        };
        let [a, b] = self.0.lanes;
        u128::from(mix(a ^ b.rotate_left(17))) << 64 | u128::from(mix(b ^ a.rotate_left(41)))
    }

    /// Feeds named values, such as the inputs of an action.
    pub fn values(&mut self, values: &BTreeMap<String, Value>) {
        self.number(values.len() as u64);
        for (name, value) in values {
            self.text(name);
            self.value(value);
        }
    }
}

impl Digest {
    /// The digest of named values, such as the inputs of an action.
    pub fn of_values(values: &BTreeMap<String, Value>) -> Digest {
        let mut digester = Digester::default();
        digester.number(values.len() as u64);
        for (name, value) in values {
            digester.text(name);
            digester.value(value);
        }
        digester.finish()
    }

    /// The digest of what a world shows through a footprint: of the requested facts and of those that exist. So "nothing matched"
    /// has a digest, too, and different footprints have different digests even if they show the same.
    pub fn of_reads(world: &World, reads: &Footprint) -> Digest {
        let mut digester = Digester::default();
        match reads {
            Footprint::Everything => {
                digester.number(u64::MAX);
                world.iter().for_each(|(key, fact)| digester.fact(key, &fact.value));
            }
            Footprint::Patterns(patterns) => {
                let mut patterns: Vec<_> = patterns.iter().collect();
                patterns.sort_unstable();
                patterns.dedup();
                digester.number(patterns.len() as u64);
                for pattern in patterns {
                    digester.text(&pattern.predicate);
                    digester.number(pattern.arguments.len() as u64);
                    pattern.arguments.iter().for_each(|argument| digester.term(argument.as_ref()));
                    world.matching(pattern).for_each(|(key, fact)| digester.fact(key, &fact.value));
                    digester.tag(END);
                }
            }
        }
        digester.finish()
    }

    /// The digest with these bytes.
    pub fn from_bytes(bytes: [u8; 32]) -> Digest {
        Digest(bytes)
    }

    /// Its bytes.
    pub fn as_bytes(&self) -> &[u8; 32] {
        &self.0
    }
}

const END: u8 = 255;

impl Digester {
    /// The digest of everything fed so far.
    pub fn finish(&self) -> Digest {
        Digest(*self.0.finalize().as_bytes())
    }
}

impl<H: Feed> Digester<H> {
    /// Feeds a fact.
    pub fn fact(&mut self, key: &FactKey, value: &Value) {
        self.text(&key.predicate);
        self.number(key.arguments.len() as u64);
        key.arguments.iter().for_each(|argument| self.term(Some(argument)));
        self.value(value);
    }

    /// Feeds a value.
    pub fn value(&mut self, value: &Value) {
        match value {
            Value::Null => self.tag(0),
            Value::Bool(b) => self.tag(1 + u8::from(*b)),
            Value::Int(i) => {
                self.tag(3);
                self.number(i.cast_unsigned());
            }
            Value::Float(x) => {
                self.tag(4);
                self.number(x.to_bits());
            }
            Value::String(text) => {
                self.tag(5);
                self.text(text);
            }
            Value::Pose(pose) => {
                self.tag(6);
                pose.position.iter().chain(&pose.quaternion_xyzw).for_each(|x| self.number(x.to_bits()));
            }
            Value::Joints(joints) => {
                self.tag(7);
                self.floats(joints);
            }
            Value::Trajectory(trajectory) => {
                self.tag(8);
                self.number(trajectory.joints.len() as u64);
                trajectory.joints.iter().for_each(|joint| self.text(joint));
                self.number(trajectory.points.len() as u64);
                for point in &trajectory.points {
                    self.number(point.time_s.to_bits());
                    self.floats(&point.positions);
                    self.floats(&point.velocities);
                }
            }
            Value::List(items) => {
                self.tag(9);
                self.number(items.len() as u64);
                items.iter().for_each(|item| self.value(item));
            }
            Value::Map(fields) => {
                self.tag(10);
                self.number(fields.len() as u64);
                for (name, item) in fields {
                    self.text(name);
                    self.value(item);
                }
            }
            Value::Bytes(bytes) => {
                self.tag(11);
                self.number(bytes.len() as u64);
                self.0.feed(bytes);
            }
        }
    }

    /// Feeds a text, after its length.
    pub fn text(&mut self, text: &str) {
        self.number(text.len() as u64);
        self.0.feed(text.as_bytes());
    }

    /// Feeds a number.
    pub fn number(&mut self, number: u64) {
        self.0.feed(&number.to_le_bytes());
    }

    fn tag(&mut self, tag: u8) {
        self.0.feed(&[tag]);
    }

    fn term(&mut self, term: Option<&Term>) {
        match term {
            None => self.tag(0),
            Some(Term::Int(i)) => {
                self.tag(1);
                self.number(i.cast_unsigned());
            }
            Some(Term::Name(name)) => {
                self.tag(2);
                self.text(name);
            }
        }
    }

    fn floats(&mut self, floats: &[f64]) {
        self.number(floats.len() as u64);
        floats.iter().for_each(|x| self.number(x.to_bits()));
    }
}

impl fmt::Display for Digest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl fmt::Debug for Digest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{self}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn quick_hashes_of_different_content_differ() {
        let mut seen = BTreeSet::new();
        for n in 0..20_000_i64 {
            for value in [
                Value::Int(n),
                Value::Float(n as f64),
                Value::String(n.to_string()),
                Value::List(vec![Value::Int(n)].into()),
            ] {
                let mut digester = Digester::<Quick>::default();
                digester.values(&BTreeMap::from([("a".to_owned(), value)]));
                assert!(seen.insert(digester.quick()), "{n}");
            }
        }
        let text = |parts: &[&str]| {
            let mut digester = Digester::<Quick>::default();
            parts.iter().for_each(|part| digester.text(part));
            digester.quick()
        };
        assert_ne!(text(&["ab", "c"]), text(&["a", "bc"]));
        assert_ne!(text(&["", "a"]), text(&["a", ""]));
    }
}
