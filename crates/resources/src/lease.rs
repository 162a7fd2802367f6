//! Live leases, and those that have ended while something may still move for them.

use crate::event::EndReason;
use crate::id::{SessionId, Slot};
use crate::resource::{EndingUnits, Holding};
use ratn_model::id::{FencingToken, LeaseId};
use ratn_model::resource::Quantity;
use ratn_model::time::Timestamp;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

/// By id.
pub(crate) type Leases = BTreeMap<LeaseId, LeaseRecord>;

/// By id; none of them lives.
pub(crate) type EndingLeases = BTreeMap<LeaseId, EndingLease>;

/// What is left of a lease that has ended: units whose providers have not confirmed standstill.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct EndingLease {
    pub(crate) token: FencingToken,
    pub(crate) session: SessionId,
    pub(crate) reason: EndReason,
    /// Which resources, and when their units are free at the latest; counted anew after a restart.
    pub(crate) slots: BTreeMap<Slot, Bound>,
    /// Who opened the session; kept beside it.
    #[serde(skip)]
    pub(crate) opened_by: Arc<str>,
}

/// When units are free whatever the provider says; of no interest to another process.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Bound(#[serde(skip)] pub(crate) Timestamp);

impl EndingLease {
    pub(crate) fn without_bounds(&self) -> EndingLease {
        let slots = self.slots.keys().map(|slot| (*slot, Bound::default())).collect();
        EndingLease { slots, ..self.clone() }
    }

    pub(crate) fn view(&self, lease: LeaseId, slot: Slot, units: Quantity, now: Timestamp) -> EndingUnits {
        let until = self.slots.get(&slot).map_or(now, |bound| bound.0);
        let within = Duration::from_nanos(until.0.saturating_sub(now.0));
        EndingUnits { lease, token: self.token, session: self.session.clone(), units, within }
    }
}

/// A live lease. The resources know it too (as a holder), so that what is free is found without looking at every lease.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct LeaseRecord {
    pub(crate) token: FencingToken,
    pub(crate) session: SessionId,
    /// What it holds, in the order of the requirements.
    pub(crate) held: Vec<(Slot, Quantity)>,
    /// What was consumed when it was granted, as long as that could be taken back: with a grant that nobody heard of it is.
    pub(crate) consumed: Vec<(Slot, Quantity)>,
    pub(crate) hold_for: Option<Duration>,
    pub(crate) purpose: Arc<str>,
    /// Who opened its session; of the session, where it is kept.
    #[serde(skip)]
    pub(crate) opened_by: Arc<str>,
    /// When it ends by itself; counted anew after a restart.
    #[serde(skip)]
    pub(crate) expires: Option<Timestamp>,
}

/// A live lease as others see it.
#[derive(Debug, Clone, PartialEq)]
pub struct LeaseView {
    /// Its id.
    pub id: LeaseId,
    /// Its fencing token.
    pub token: FencingToken,
    /// Whose it is.
    pub session: SessionId,
    /// The ids of the resources held, in order.
    pub resources: Vec<String>,
    /// When it ends by itself.
    pub expires: Option<Timestamp>,
    /// What it was acquired for.
    pub purpose: Arc<str>,
}

impl LeaseRecord {
    /// The slots held, each once, in order.
    pub(crate) fn slots(&self) -> Vec<Slot> {
        let mut slots: Vec<Slot> = self.held.iter().map(|(slot, _)| *slot).collect();
        slots.sort_unstable();
        slots.dedup();
        slots
    }

    pub(crate) fn holding(&self, lease: LeaseId, units: Quantity) -> Holding {
        Holding {
            lease,
            token: self.token,
            session: self.session.clone(),
            opened_by: self.opened_by.clone(),
            units,
            purpose: self.purpose.clone(),
        }
    }
}
