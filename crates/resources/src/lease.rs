//! Live leases. How many units of each resource a lease holds is written at the resources, and only there.

use crate::id::SessionId;
use crate::resource::Holding;
use ratn_model::id::{FencingToken, LeaseId};
use ratn_model::time::Timestamp;
use std::collections::BTreeMap;

/// By id.
pub(crate) type Leases = BTreeMap<LeaseId, LeaseRecord>;

/// A live lease.
#[derive(Debug, Clone)]
pub(crate) struct LeaseRecord {
    pub(crate) token: FencingToken,
    pub(crate) session: SessionId,
    /// The ids of the resources held, in order.
    pub(crate) resources: Vec<String>,
    pub(crate) expires: Option<Timestamp>,
    pub(crate) purpose: String,
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
    /// The ids of the resources held.
    pub resources: Vec<String>,
    /// When it ends by itself.
    pub expires: Option<Timestamp>,
    /// What it was acquired for.
    pub purpose: String,
}

impl LeaseRecord {
    pub(crate) fn view(&self, id: LeaseId) -> LeaseView {
        LeaseView {
            id,
            token: self.token,
            session: self.session.clone(),
            resources: self.resources.clone(),
            expires: self.expires,
            purpose: self.purpose.clone(),
        }
    }

    pub(crate) fn holding(&self, lease: LeaseId, units: u32) -> Holding {
        Holding { lease, token: self.token, session: self.session.clone(), units, purpose: self.purpose.clone() }
    }
}
