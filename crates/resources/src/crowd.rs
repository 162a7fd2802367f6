//! The holders of a resource, as views show them: in parts that the views share.
//!
//! Every event of a lease contains views of its resources. If each view copied all holders, the end of thousands of leases of one resource would cost
//! quadratic time and memory. A resource with many holders therefore keeps them in parts; a change replaces one part, and a view shares all parts
//! without copying. The parts are derived from the leases and from what ended leases have left, and contain nothing else.

use crate::id::Slot;
use crate::pool::Pool;
use crate::resource::{EndingUnits, Holding, Resource};
use ratn_model::id::LeaseId;
use ratn_model::time::Timestamp;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

/// Maximum number of holders in one part. A resource with fewer holders keeps no parts.
const PART: usize = 64;

/// The crowds of all resources with more than [`PART`] holders.
pub(crate) type Crowds = BTreeMap<Slot, Crowd>;

/// The holders of one resource, ordered by lease; no part is empty.
#[derive(Debug, Clone, Default)]
pub(crate) struct Crowd(Vec<Arc<[Holder]>>);

#[derive(Debug, Clone, PartialEq)]
enum Holder {
    Lives(Holding),
    /// Its lease has ended; its units are free at this time at the latest.
    Ends(EndingUnits, Timestamp),
}

/// The holders of a resource at some time, ordered by lease.
#[derive(Debug, Clone, Default)]
pub struct Holders {
    crowd: Crowd,
    at: Timestamp,
}

impl Holders {
    /// Holdings of live leases.
    pub fn live(&self) -> impl Iterator<Item = &Holding> {
        self.crowd.iter().filter_map(|holder| match holder {
            Holder::Lives(holding) => Some(holding),
            Holder::Ends(..) => None,
        })
    }

    /// Units of leases that have ended, while something may still move for them.
    pub fn ending(&self) -> impl Iterator<Item = EndingUnits> {
        self.crowd.iter().filter_map(|holder| match holder {
            Holder::Lives(_) => None,
            Holder::Ends(left, until) => {
                let within = Duration::from_nanos(until.0.saturating_sub(self.at.0));
                Some(EndingUnits { within, ..left.clone() })
            }
        })
    }
}

impl PartialEq for Holders {
    fn eq(&self, other: &Holders) -> bool {
        self.live().eq(other.live()) && self.ending().eq(other.ending())
    }
}

impl Holder {
    fn lease(&self) -> LeaseId {
        match self {
            Holder::Lives(holding) => holding.lease,
            Holder::Ends(left, _) => left.lease,
        }
    }
}

impl Crowd {
    fn iter(&self) -> impl Iterator<Item = &Holder> {
        self.0.iter().flat_map(|part| part.iter())
    }

    /// Replaces the part in which a lease is or belongs; without a holder the lease is removed.
    fn set(&mut self, lease: LeaseId, holder: Option<Holder>) {
        let at = self.0.partition_point(|part| part.first().is_some_and(|first| first.lease() <= lease));
        let at = at.saturating_sub(1);
        let part = self.0.get(at).into_iter().flat_map(|part| part.iter());
        let mut part: Vec<Holder> = part.filter(|other| other.lease() != lease).cloned().collect();
        if let Some(holder) = holder {
            part.insert(part.partition_point(|other| other.lease() < lease), holder);
        }
        let mut end = at + 1;
        // So that the parts do not stay small when most holders have left.
        if let Some(next) = self.0.get(end).filter(|next| part.len() + next.len() <= PART / 2) {
            part.extend(next.iter().cloned());
            end += 1;
        }
        self.0.splice(at..end.min(self.0.len()), Crowd::of(part).0);
    }

    fn of(holders: Vec<Holder>) -> Crowd {
        Crowd(holders.chunks(PART).map(Arc::from).collect())
    }
}

impl Pool {
    pub(crate) fn holders(&self, slot: Slot, resource: &Resource) -> Holders {
        let crowd = self.crowds.get(&slot).cloned().unwrap_or_else(|| self.crowd(slot, resource));
        Holders { crowd, at: self.now }
    }

    /// What a lease holds, or has left, of a resource has changed.
    pub(crate) fn held_otherwise(&mut self, slot: Slot, lease: LeaseId) {
        let Some(resource) = self.resources.get(slot).filter(|resource| resource.holders.len() > PART) else {
            self.crowds.remove(&slot);
            return;
        };
        if !self.crowds.contains_key(&slot) {
            let crowd = self.crowd(slot, resource);
            self.crowds.insert(slot, crowd);
            return;
        }
        let units = resource.holders.binary_search_by_key(&lease, |(lease, _)| *lease).ok();
        let holder = units.and_then(|at| self.holder(slot, resource, at));
        if let Some(crowd) = self.crowds.get_mut(&slot) {
            crowd.set(lease, holder);
        }
    }

    /// Builds all crowds, after a pool was restored.
    pub(crate) fn gather_crowds(&mut self) {
        let large = self.resources.iter().filter(|(_, resource)| resource.holders.len() > PART);
        self.crowds = large.map(|(slot, resource)| (slot, self.crowd(slot, resource))).collect();
    }

    /// Whether the parts match the leases.
    pub(crate) fn crowds_agree(&self) -> bool {
        let large = self.resources.iter().filter(|(_, resource)| resource.holders.len() > PART).count();
        self.crowds.len() == large
            && self.crowds.iter().all(|(slot, crowd)| {
                let made = self.resources.get(*slot).map(|resource| self.crowd(*slot, resource));
                made.is_some_and(|made| made.iter().eq(crowd.iter())) && crowd.0.iter().all(|part| part.len() <= PART)
            })
    }

    fn crowd(&self, slot: Slot, resource: &Resource) -> Crowd {
        let holders = 0..resource.holders.len();
        Crowd::of(holders.filter_map(|at| self.holder(slot, resource, at)).collect())
    }

    fn holder(&self, slot: Slot, resource: &Resource, at: usize) -> Option<Holder> {
        let (lease, units) = *resource.holders.get(at)?;
        if let Some(record) = self.leases.get(&lease) {
            return Some(Holder::Lives(record.holding(lease, units)));
        }
        let ending = self.ending.get(&lease)?;
        let until = ending.slots.get(&slot).map_or(self.now, |bound| bound.0);
        Some(Holder::Ends(ending.view(lease, slot, units, until), until))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use crate::{AcquireRequest, Pool, ResourceSpec, SessionId, Snapshot};
    use ratn_model::resource::{Requirement, ResourceClass, ResourceOperation};

    const NOW: Timestamp = Timestamp(0);

    /// A tool held by three hundred leases.
    fn crowded(spec: ResourceSpec) -> Pool {
        let mut pool = Pool::default();
        pool.set_limits(crate::Limits::default());
        let session = SessionId::from("s");
        pool.keep_alive(NOW, &session, "s", Duration::from_secs(60)).unwrap();
        pool.create(NOW, None, spec.id("tool").capacity(300)).unwrap();
        for _ in 0..300 {
            let tool = Requirement::new(ResourceOperation::Block, "Tool");
            pool.acquire(NOW, AcquireRequest::new(session.clone(), vec![tool])).unwrap();
        }
        pool
    }

    fn parts(pool: &Pool) -> Vec<Arc<[Holder]>> {
        pool.get("tool").unwrap().holders.crowd.0
    }

    #[test]
    fn the_views_before_and_after_the_end_of_one_of_300_leases_share_all_parts_but_its_own() {
        let mut pool = crowded(ResourceSpec::new(ResourceClass::Module, "Tool"));
        let before = parts(&pool);
        let lease = pool.leases()[100].id;
        pool.release(NOW, None, lease).unwrap();
        let after = parts(&pool);
        let shared = after.iter().filter(|part| before.iter().any(|other| Arc::ptr_eq(part, other))).count();
        assert_eq!((before.len(), after.len(), shared), (5, 5, 4));
    }

    #[test]
    fn the_holders_of_a_crowded_resource_are_shown_as_they_are_in_whatever_order_they_leave() {
        for standstill in [Duration::ZERO, Duration::from_secs(1)] {
            let mut pool = crowded(ResourceSpec::new(ResourceClass::Module, "Tool").standstill(standstill));
            let mut at = 0;
            while !pool.leases().is_empty() {
                at = (at + 77) % pool.leases().len();
                let lease = pool.leases()[at].id;
                pool.release(NOW, None, lease).unwrap();
                if pool.leases().len().is_multiple_of(5) && !standstill.is_zero() {
                    assert!(pool.confirm_standstill(NOW, None, lease, "tool").unwrap());
                }
                if pool.leases().len().is_multiple_of(30) {
                    pool.check_invariants().unwrap();
                    let again = Snapshot::decode(&pool.snapshot().encode()).unwrap();
                    let again = Pool::restore(crate::Limits::default(), NOW, Some(again), []).unwrap();
                    again.check_invariants().unwrap();
                    assert_eq!(again.list(), pool.list());
                }
            }
        }
    }
}
