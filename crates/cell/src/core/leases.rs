//! Which leases live, as far as the cell was told. Lease ids grow, so one that is older than the youngest known and not
//! among the living has ended; of a younger one the word is still on its way.

use ratn_model::id::LeaseId;
use std::collections::BTreeSet;

#[derive(Debug, Clone, Default)]
pub(super) struct Leases {
    living: BTreeSet<LeaseId>,
    youngest: LeaseId,
    /// Why nothing is known any more.
    lost: Option<String>,
}

impl Leases {
    /// Only these live, and none is younger than `youngest`.
    pub(super) fn are(&mut self, living: BTreeSet<LeaseId>, youngest: LeaseId) {
        *self = Leases { living, youngest, lost: None };
    }

    pub(super) fn began(&mut self, lease: LeaseId) {
        self.living.insert(lease);
        self.youngest = self.youngest.max(lease);
    }

    pub(super) fn ended(&mut self, lease: LeaseId) {
        self.living.remove(&lease);
        self.youngest = self.youngest.max(lease);
    }

    pub(super) fn lost(&mut self, reason: String) {
        self.lost = Some(reason);
    }

    /// Whether something may be done under this lease.
    ///
    /// # Errors
    /// Why not.
    pub(super) fn check(&self, lease: LeaseId) -> Result<(), String> {
        if let Some(reason) = &self.lost {
            return Err(format!("its lease {lease} may have ended: {reason}"));
        }
        if lease <= self.youngest && !self.living.contains(&lease) {
            return Err(format!("its lease {lease} has ended: acquire a new one"));
        }
        Ok(())
    }
}
