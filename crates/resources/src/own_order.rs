//! The order of one session's own requests, and which of them compete with requests of other sessions.
//!
//! ```text
//!   own order:   certain before speculative, then the larger priority, then the earlier arrival
//!   first ones:  in own order, each that takes units of no family from which an earlier first one takes units
//! ```
//!
//! So a request that waits behind another one in one family does not keep later requests from competing in another family. Of the requests for the
//! same set of families, only the earliest can be a first one: the computation is linear in the number of different sets of families.
//!
//! Several requests that come and go in one turn cost one computation, at the end ([`OwnOrder::settle`]).

use crate::id::WaiterId;
use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// The place of a request among those of its session: certain first, then the larger priority, then the earlier arrival.
pub(crate) type OwnPlace = (bool, Reverse<i64>, WaiterId);

/// The families from which a request takes units.
pub(crate) type Families = BTreeSet<Arc<str>>;

/// The waiting requests of one session that existing resources could satisfy, without requests that take nothing.
#[derive(Debug, Clone, Default)]
pub(crate) struct OwnOrder {
    waiting: BTreeMap<Families, BTreeSet<OwnPlace>>,
    /// The first one of each family, as of the last [`OwnOrder::settle`].
    first: BTreeMap<Arc<str>, OwnPlace>,
}

/// How the first requests of a session have changed.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Settled {
    /// Requests that are no longer first ones.
    pub(crate) no_more: Vec<WaiterId>,
    /// Requests that have become first ones, in own order.
    pub(crate) anew: Vec<WaiterId>,
    /// Number of requests and families that were read.
    pub(crate) looked_at: usize,
}

impl OwnOrder {
    /// Adds a waiting request; returns whether `settle` is needed.
    pub(crate) fn insert(&mut self, families: Families, own: OwnPlace) -> bool {
        let same = self.waiting.entry(families).or_default();
        same.insert(own);
        same.first() == Some(&own)
    }

    /// Removes a waiting request; returns whether `settle` is needed.
    pub(crate) fn remove(&mut self, families: &Families, own: &OwnPlace) -> bool {
        let Some(same) = self.waiting.get_mut(families) else { return false };
        let was_earliest = same.first() == Some(own);
        same.remove(own);
        if same.is_empty() {
            self.waiting.remove(families);
        }
        was_earliest
    }

    /// Whether a request for these families is a first one, or would be if it waited.
    pub(crate) fn is_first<'a>(&self, families: impl IntoIterator<Item = &'a str>, own: &OwnPlace) -> bool {
        families.into_iter().all(|family| self.first.get(family).is_none_or(|first| own <= first))
    }

    /// The first request for a family.
    pub(crate) fn first_of(&self, family: &str) -> Option<WaiterId> {
        self.first.get(family).map(|own| own.2)
    }

    /// Determines the first requests anew.
    pub(crate) fn settle(&mut self) -> Settled {
        let earliest = self.waiting.iter().filter_map(|(families, same)| Some((*same.first()?, families)));
        let mut earliest: Vec<(OwnPlace, &Families)> = earliest.collect();
        earliest.sort_unstable();
        let mut first = BTreeMap::new();
        let mut looked_at = 0;
        for (own, families) in earliest {
            looked_at += families.len();
            if families.iter().all(|family| !first.contains_key(family)) {
                first.extend(families.iter().map(|family| (family.clone(), own)));
            }
        }
        let before = std::mem::replace(&mut self.first, first);
        let places = |of: &BTreeMap<Arc<str>, OwnPlace>| of.values().copied().collect::<BTreeSet<OwnPlace>>();
        let (before, now) = (places(&before), places(&self.first));
        let ids = |places: &BTreeSet<OwnPlace>, others: &BTreeSet<OwnPlace>| {
            places.difference(others).map(|own| own.2).collect::<Vec<WaiterId>>()
        };
        Settled { no_more: ids(&before, &now), anew: ids(&now, &before), looked_at }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn families(names: &[&str]) -> Families {
        names.iter().map(|name| Arc::from(*name)).collect()
    }

    fn own(number: u64, priority: i64) -> OwnPlace {
        (false, Reverse(priority), WaiterId(number))
    }

    #[test]
    fn who_waits_behind_another_one_in_one_family_keeps_nobody_from_being_first_in_another() {
        let mut order = OwnOrder::default();
        let (tool, both, arm) = (own(1, 3), own(2, 2), own(3, 1));
        order.insert(families(&["Arm"]), arm);
        order.insert(families(&["Arm", "Tool"]), both);
        assert_eq!(order.settle().anew, [both.2], "the other one is behind it");
        order.insert(families(&["Tool"]), tool);
        assert!(order.is_first(["Tool"], &tool), "it would be");
        let settled = order.settle();
        assert_eq!((settled.no_more, settled.anew), (vec![both.2], vec![tool.2, arm.2]));
        let is_first = [order.is_first(["Tool"], &tool), order.is_first(["Arm", "Tool"], &both)];
        assert_eq!((is_first, order.is_first(["Arm"], &arm)), ([true, false], true));
        assert_eq!((order.first_of("Arm"), order.first_of("Tool")), (Some(arm.2), Some(tool.2)));
        order.remove(&families(&["Tool"]), &tool);
        let settled = order.settle();
        assert_eq!((settled.no_more, settled.anew), (vec![tool.2, arm.2], vec![both.2]));
    }

    #[test]
    fn a_look_is_as_long_as_there_are_sets_of_families() {
        let mut order = OwnOrder::default();
        let to_settle = (1..=1_000).filter(|number| order.insert(families(&["Arm"]), own(*number, 0))).count();
        assert_eq!((to_settle, order.settle().looked_at), (1, 1));
        assert!(!order.remove(&families(&["Arm"]), &own(500, 0)) && order.remove(&families(&["Arm"]), &own(1, 0)));
        assert_eq!(order.settle().anew, [WaiterId(2)]);
    }
}
