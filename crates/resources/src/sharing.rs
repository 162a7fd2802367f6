//! Of which groups of a family somebody is to be looked at, because something may be had that could not be before.
//!
//! Each change adds the groups that it concerns. Sharing out takes the first of all those who wait in them, and goes on behind that
//! one; where it is interrupted, what is left of this is where it goes on. So a change does not begin the whole of it again.

use crate::group::Key;
use crate::id::WaiterId;
use crate::queue::Place;
use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};

/// Before every place.
pub(crate) const FIRST: Place = (Reverse(i64::MAX), WaiterId(0));

/// See the module.
#[derive(Debug, Clone, Default)]
pub(crate) struct ToShare {
    /// What is reserved is shared out anew.
    pub(crate) anew: bool,
    /// Every group of the family.
    pub(crate) all: bool,
    /// From which waiter on a group is to be looked at.
    from: BTreeMap<Key, Place>,
    /// The same, in the order in which waiters are served.
    order: BTreeSet<(Place, Key)>,
}

impl ToShare {
    /// A group, from a waiter on; from an earlier one, where that was asked for before.
    pub(crate) fn add(&mut self, key: &Key, place: Place) {
        match self.from.get_mut(key) {
            Some(known) if *known <= place => return,
            Some(known) => {
                self.order.remove(&(*known, key.clone()));
                *known = place;
            }
            None => drop(self.from.insert(key.clone(), place)),
        }
        self.order.insert((place, key.clone()));
    }

    /// Every group, from the first waiter on.
    pub(crate) fn add_all(&mut self) {
        (self.from, self.order) = Default::default();
        self.all = true;
    }

    /// The first waiter of all, and the group.
    pub(crate) fn pop_first(&mut self) -> Option<(Place, Key)> {
        let (place, key) = self.order.pop_first()?;
        self.from.remove(&key);
        Some((place, key))
    }

    /// Both.
    pub(crate) fn merge(&mut self, other: ToShare) {
        self.anew |= other.anew;
        if self.all {
            return;
        }
        if other.all {
            return self.add_all();
        }
        for (place, key) in other.order {
            self.add(&key, place);
        }
    }
}
