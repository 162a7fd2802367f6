//! The facts on which a result depends, and a digest of their values.

use super::digests::hash;
use super::overlay::Overlay;
use super::view::{Blocked, ByWriter, View};
use super::walk::Looked;
use ratn_model::fact::{Change, FactKey, FactPattern, Footprint};
use ratn_model::value::Value;
use ratn_world::digest::{Digester, Quick};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// The inputs of a result: facts and input ports.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub(crate) struct Seen {
    /// The facts that it may have looked at.
    pub(crate) read: Vec<Footprint>,
    /// A digest of their values, one number per pattern.
    facts: Vec<u128>,
    /// A digest of the input ports.
    pub(crate) inputs: u128,
}

impl Seen {
    /// Adds facts without their values, so that no other result counts as having the same inputs.
    pub(crate) fn look_at(&mut self, read: Footprint) {
        self.read.push(read);
    }

    /// Sets the input ports of an action.
    pub(crate) fn see_inputs(&mut self, inputs: &BTreeMap<String, Value>) {
        let mut digester = Digester::<Quick>::default();
        digester.values(inputs);
        self.inputs = digester.quick();
    }

    /// Whether the same facts and input ports were seen, so that the result is the same.
    pub(crate) fn is_like(&self, other: &Seen) -> bool {
        self.inputs == other.inputs && self.facts == other.facts && self.read == other.read
    }

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
    /// Adds the facts of a footprint, with their values at this place.
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

    /// Whether the actual world shows these facts as they will be at this place.
    pub(crate) fn is_shown(&self, looked: &Footprint) -> Result<bool, Blocked> {
        let changes = self.changes(Looked::at(looked))?;
        let changes: Vec<&Change> = all(&changes).collect();
        Ok(Overlay::of(changes).differing(self.sight.root, |key| looked.contains(key)).is_empty())
    }
}

impl Seen {
    /// Adds further facts.
    pub(crate) fn extend(&mut self, other: Seen) {
        self.read.extend(other.read);
        self.facts.extend(other.facts);
    }
}
