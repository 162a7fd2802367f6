//! Those who lack nothing, by family: where it is not known yet what there is of a family, none of its waiters is looked at.

use crate::queue::Place;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// See the module. A waiter for several families is in the first of them.
#[derive(Debug, Clone, Default)]
pub(crate) struct Ready {
    families: BTreeMap<Arc<str>, BTreeSet<Place>>,
    /// The first of each family.
    firsts: BTreeSet<(Place, Arc<str>)>,
}

impl Ready {
    pub(crate) fn is_empty(&self) -> bool {
        self.families.is_empty()
    }

    pub(crate) fn contains(&self, family: &str, place: Place) -> bool {
        self.families.get(family).is_some_and(|places| places.contains(&place))
    }

    pub(crate) fn insert(&mut self, family: &Arc<str>, place: Place) {
        self.change(family, |places| places.insert(place));
    }

    pub(crate) fn remove(&mut self, family: &Arc<str>, place: Place) {
        if self.contains(family, place) {
            self.change(family, |places| places.remove(&place));
        }
    }

    fn change(&mut self, family: &Arc<str>, change: impl FnOnce(&mut BTreeSet<Place>) -> bool) {
        let places = self.families.entry(family.clone()).or_default();
        let before = places.first().copied();
        change(places);
        let after = places.first().copied();
        if after.is_none() {
            self.families.remove(family);
        }
        if before != after {
            before.map(|place| self.firsts.remove(&(place, family.clone())));
            self.firsts.extend(after.map(|place| (place, family.clone())));
        }
    }

    /// The first who may be served, of families that are known; and how many families and waiters were looked at.
    pub(crate) fn first(
        &self,
        is_known: impl Fn(&str) -> bool,
        may_have: impl Fn(Place) -> bool,
    ) -> (Option<Place>, usize) {
        let (mut found, mut looked_at) = (None::<Place>, 0);
        for (first, family) in &self.firsts {
            if found.is_some_and(|found| found < *first) {
                break;
            }
            looked_at += 1;
            if !is_known(family) {
                continue;
            }
            let before = |place: &&Place| found.is_none_or(|found| **place < found);
            let mut places = self.families.get(family).into_iter().flatten().take_while(before);
            let better = places.find(|place| {
                looked_at += 1;
                may_have(**place)
            });
            found = better.copied().or(found);
        }
        (found, looked_at)
    }
}
