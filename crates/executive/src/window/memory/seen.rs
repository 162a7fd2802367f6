//! The facts that a result was made of, and a digest of their values.

use super::digests::hash;
use super::overlay::Overlay;
use super::view::{Blocked, ByWriter, View};
use super::walk::Looked;
use ratn_model::fact::{Change, FactKey, FactPattern, Footprint};
use ratn_model::value::Value;
use ratn_world::digest::{Digester, Quick};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// What a result was made of.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub(crate) struct Seen {
    /// The facts that it may have looked at.
    pub(crate) read: Vec<Footprint>,
    /// What they came to, one number per pattern.
    facts: Vec<u128>,
    /// What its inputs come to.
    pub(crate) inputs: u128,
}

impl Seen {
    /// These facts were looked at, whatever they were: no other result is made of the same.
    pub(crate) fn look_at(&mut self, read: Footprint) {
        self.read.push(read);
    }

    /// The inputs of an action.
    pub(crate) fn see_inputs(&mut self, inputs: &BTreeMap<String, Value>) {
        let mut digester = Digester::<Quick>::default();
        digester.values(inputs);
        self.inputs = digester.quick();
    }

    /// Whether the same is computed of it.
    pub(crate) fn is_like(&self, other: &Seen) -> bool {
        self.inputs == other.inputs && self.facts == other.facts && self.read == other.read
    }

    /// Whether the same facts were seen.
    pub(crate) fn saw_the_same(&self, other: &Seen) -> bool {
        self.facts == other.facts && self.read == other.read
    }

    /// Whether some fact of a pattern was looked at.
    pub(crate) fn overlaps(&self, pattern: &FactPattern) -> bool {
        self.read.iter().any(|read| Looked::at(read).overlaps(pattern))
    }
}

fn all(by_writer: &[ByWriter]) -> impl Iterator<Item = &Change> {
    by_writer.iter().flat_map(|(_, chunks)| chunks).flat_map(|chunk| chunk.iter())
}

impl View<'_> {
    /// Adds the facts of a footprint, as they are at this place, to what is seen.
    pub(crate) fn see(&self, read: Footprint, seen: &mut Seen) -> Result<(), Blocked> {
        if read.is_nothing() {
            return Ok(());
        }
        let changes = self.changes(Looked::at(&read))?;
        let root = self.sight.root;
        let overlay = Overlay::of(all(&changes));
        let mut digests = self.sight.memory.digests.borrow_mut();
        let mut add = |pattern: Option<&FactPattern>| {
            let mut sum = digests.sum(root, pattern);
            let matches = |key: &FactKey| pattern.is_none_or(|pattern| pattern.matches(key));
            for (key, below, here) in overlay.differing(root, matches) {
                sum = sum.wrapping_sub(below.map_or(0, |value| hash(key, value)));
                sum = sum.wrapping_add(here.map_or(0, |value| hash(key, value)));
            }
            seen.facts.push(sum);
        };
        match &read {
            Footprint::Everything => add(None),
            Footprint::Patterns(patterns) => patterns.iter().for_each(|pattern| add(Some(pattern))),
        }
        seen.read.push(read);
        Ok(())
    }

    /// Whether the actual world shows these facts as they are at this place.
    pub(crate) fn is_shown(&self, looked: &Footprint) -> Result<bool, Blocked> {
        let changes = self.changes(Looked::at(looked))?;
        let changes: Vec<&Change> = all(&changes).collect();
        Ok(Overlay::of(changes).differing(self.sight.root, |key| looked.contains(key)).is_empty())
    }
}

impl Seen {
    /// Adds what else was looked at.
    pub(crate) fn extend(&mut self, other: Seen) {
        self.read.extend(other.read);
        self.facts.extend(other.facts);
    }
}
