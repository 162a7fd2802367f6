//! For each resource that the manager has lost: until when its former holder may still move it. These bounds are kept apart from the
//! desired state, because a resource may be withdrawn meanwhile, and offered again. They belong to what moves, not to one provider: a
//! [`super::Provider`] that is dropped may have offered what is leased, and the next one in its place has to wait for it
//! ([`crate::lease_watch::LeaseWatch`]).

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tokio::time::Instant;

/// Bounds by resource id. A handle: clones share everything.
#[derive(Debug, Clone, Default)]
pub(crate) struct Bounds(Arc<Mutex<Kept>>);

#[derive(Debug, Default)]
struct Kept {
    /// What the manager may have, with the bound that each was offered with.
    offered: BTreeMap<String, Duration>,
    /// Ends of the bounds of what it has lost; those that have passed are removed.
    lost: BTreeMap<String, Instant>,
}

impl Bounds {
    /// The manager may have the resource from now on; without a bound nothing moves.
    pub(super) fn offered(&self, id: &str, standstill: Option<Duration>) {
        if let Some(standstill) = standstill {
            let mut kept = self.kept();
            let longest = kept.offered.entry(id.to_owned()).or_default();
            *longest = (*longest).max(standstill);
        }
    }

    /// The manager does not have the resource; its loss, if it had it, has been reported.
    pub(super) fn not_offered(&self, id: &str) {
        self.kept().offered.remove(id);
    }

    /// The former holder may move the resource for `standstill` from now on.
    pub(super) fn lost(&self, id: &str, standstill: Option<Duration>) {
        let mut kept = self.kept();
        kept.offered.remove(id);
        standstill.into_iter().for_each(|standstill| kept.begin(id, standstill));
    }

    /// The provider that has offered all this is gone, and its session with it.
    pub(super) fn all_lost(&self) {
        let mut kept = self.kept();
        for (id, standstill) in std::mem::take(&mut kept.offered) {
            kept.begin(&id, standstill);
        }
    }

    pub(super) fn may_move(&self, id: &str) -> bool {
        self.kept().lost.get(id).is_some_and(|until| Instant::now() < *until)
    }

    fn kept(&self) -> MutexGuard<'_, Kept> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Kept {
    fn begin(&mut self, id: &str, standstill: Duration) {
        let now = Instant::now();
        self.lost.retain(|_, until| *until > now);
        let until = self.lost.entry(id.to_owned()).or_insert(now);
        *until = (*until).max(now + standstill);
    }
}
