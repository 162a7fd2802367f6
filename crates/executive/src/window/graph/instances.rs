//! The instances that are in the window, by id: found in constant time, however many there are.

use super::instance::Instance;
use ratn_model::id::InstanceId;
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;

/// The table of instances. Ids increase; an instance that left the window leaves a hole until everything older has
/// left, too.
#[derive(Default, Serialize, Deserialize)]
pub(super) struct Instances {
    first: u64,
    slots: VecDeque<Option<Box<Instance>>>,
    alive: usize,
}

impl Instances {
    pub(super) fn len(&self) -> usize {
        self.alive
    }

    fn place(&self, id: InstanceId) -> Option<usize> {
        id.0.checked_sub(self.first).and_then(|place| usize::try_from(place).ok())
    }

    pub(super) fn get(&self, id: InstanceId) -> Option<&Instance> {
        self.slots.get(self.place(id)?)?.as_deref()
    }

    pub(super) fn get_mut(&mut self, id: InstanceId) -> Option<&mut Instance> {
        let place = self.place(id)?;
        self.slots.get_mut(place)?.as_deref_mut()
    }

    /// Adds the youngest instance.
    pub(super) fn push(&mut self, instance: Box<Instance>) {
        if self.slots.is_empty() {
            self.first = instance.id.0;
        }
        // Ids of nodes inside of routines never enter the window; they are holes.
        while self.first + (self.slots.len() as u64) < instance.id.0 {
            self.slots.push_back(None);
        }
        self.slots.push_back(Some(instance));
        self.alive += 1;
    }

    pub(super) fn remove(&mut self, id: InstanceId) -> Option<Box<Instance>> {
        let place = self.place(id)?;
        let removed = self.slots.get_mut(place)?.take()?;
        self.alive -= 1;
        while matches!(self.slots.front(), Some(None)) {
            self.slots.pop_front();
            self.first += 1;
        }
        Some(removed)
    }

    /// All instances, oldest id first.
    pub(super) fn iter(&self) -> impl DoubleEndedIterator<Item = &Instance> {
        self.slots.iter().filter_map(Option::as_deref)
    }

    pub(super) fn iter_mut(&mut self) -> impl Iterator<Item = &mut Instance> {
        self.slots.iter_mut().filter_map(Option::as_deref_mut)
    }

    /// The range of ids in use, including holes.
    pub(super) fn ids(&self) -> std::ops::Range<u64> {
        self.first..self.first + self.slots.len() as u64
    }
}
