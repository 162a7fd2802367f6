//! Stable hashes of values, facts and what is read of a world: equal digests mean equal content, on every machine and in every
//! run (BLAKE3 over an encoding in which nothing can be read two ways: a tag for each kind, a length before each text and list).

use crate::world::World;
use ratn_model::fact::{FactKey, Footprint, Term};
use ratn_model::value::Value;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fmt;

/// A hash of content; the default is that of nothing anybody has digested.
#[derive(Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Digest([u8; 32]);

/// Makes a [`Digest`].
#[derive(Debug, Clone, Default)]
pub struct Digester(blake3::Hasher);

impl Digest {
    /// Of named values, the inputs of an action.
    pub fn of_values(values: &BTreeMap<String, Value>) -> Digest {
        let mut digester = Digester::default();
        digester.number(values.len() as u64);
        for (name, value) in values {
            digester.text(name);
            digester.value(value);
        }
        digester.finish()
    }

    /// Of what a world shows through a footprint: which facts were asked for, and which there are. So "nothing matched" has a
    /// digest, too, and two footprints that happen to show the same have not.
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
    /// A fact.
    pub fn fact(&mut self, key: &FactKey, value: &Value) {
        self.text(&key.predicate);
        self.number(key.arguments.len() as u64);
        key.arguments.iter().for_each(|argument| self.term(Some(argument)));
        self.value(value);
    }

    /// A value.
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
                self.0.update(bytes);
            }
        }
    }

    /// A text, with its length.
    pub fn text(&mut self, text: &str) {
        self.number(text.len() as u64);
        self.0.update(text.as_bytes());
    }

    /// A number.
    pub fn number(&mut self, number: u64) {
        self.0.update(&number.to_le_bytes());
    }

    /// What has been fed.
    pub fn finish(&self) -> Digest {
        Digest(*self.0.finalize().as_bytes())
    }

    fn tag(&mut self, tag: u8) {
        self.0.update(&[tag]);
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
