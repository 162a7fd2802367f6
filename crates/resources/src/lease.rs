//! Live leases, and ended leases for which something may still move.

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

/// By id; these leases have ended.
pub(crate) type EndingLeases = BTreeMap<LeaseId, EndingLease>;

/// What is left of an ended lease: units whose providers have not confirmed standstill.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct EndingLease {
    pub(crate) token: FencingToken,
    pub(crate) session: SessionId,
    pub(crate) reason: EndReason,
    /// For each resource, when its units are free at the latest; restarted after a restart.
    pub(crate) slots: BTreeMap<Slot, Bound>,
    /// The caller who opened the session; stored separately.
    #[serde(skip)]
    pub(crate) opened_by: Arc<str>,
}

/// When units are free even without confirmation; only valid in this process.
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

/// A live lease. The resources also list it as a holder, so that free units are found without reading every lease.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct LeaseRecord {
    pub(crate) token: FencingToken,
    pub(crate) session: SessionId,
    /// What it holds, in the order of the requirements.
    pub(crate) held: Vec<(Slot, Quantity)>,
    /// What was consumed by the grant, as long as that can be undone: it is if the grant could not be delivered.
    pub(crate) consumed: Vec<(Slot, Quantity)>,
    pub(crate) hold_for: Option<Duration>,
    pub(crate) purpose: Arc<str>,
    /// The caller who opened the session; stored with the session.
    #[serde(skip)]
    pub(crate) opened_by: Arc<str>,
    /// When it expires; restarted after a restart.
    #[serde(skip)]
    pub(crate) expires: Option<Timestamp>,
}

/// A live lease as seen by others.
#[derive(Debug, Clone, PartialEq)]
pub struct LeaseView {
    /// Its id.
    pub id: LeaseId,
    /// Its fencing token.
    pub token: FencingToken,
    /// The holder.
    pub session: SessionId,
    /// The ids of the held resources, in order.
    pub resources: Vec<String>,
    /// When it expires.
    pub expires: Option<Timestamp>,
    /// The purpose given in the acquire.
    pub purpose: Arc<str>,
}

impl LeaseRecord {
    /// The held slots, each once, in order.
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
