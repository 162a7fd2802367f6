//! Ids of ended sessions. Each is kept for a while for the caller that opened its session, so that nobody else opens a session with that id before
//! its owner returns, who would then be refused.
//!
//! Limited by number and age, and by number per caller. A caller's own oldest ids are dropped first; if all callers together have too many, those of
//! the caller with the most. So no caller can make the manager drop the ids of a caller with fewer. If the opener of a session is unknown, its id is
//! not kept.
//!
//! An id is kept by the record that ends its session, and dropped by the record that opens the next; nothing else is recorded. After a restart the
//! time begins anew, and a replay may keep more ids than before: those that had been dropped because of age or of smaller limits are kept again,
//! within the present limits.
//!
//! Every caller that may open sessions can reserve ids of its choice by opening and ending such sessions. Ids of the project's own parts are fresh
//! and cannot be guessed. `keep_session_ids_for_ms = 0` keeps no ids, including existing ones.

use crate::id::SessionId;
use crate::limits::Limits;
use ratn_model::time::Timestamp;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

/// See the module.
#[derive(Debug, Clone, Default)]
pub(crate) struct KeptIds {
    ids: BTreeMap<SessionId, Kept>,
    /// Oldest first.
    order: BTreeMap<u64, SessionId>,
    /// The ids kept for each caller, oldest first.
    callers: BTreeMap<Arc<str>, BTreeSet<u64>>,
    next: u64,
}

#[derive(Debug, Clone)]
struct Kept {
    number: u64,
    opened_by: Arc<str>,
    /// When its session ended.
    since: Timestamp,
}

impl KeptIds {
    /// The caller for whom an id is kept, if it is.
    pub(crate) fn opener(&self, id: &SessionId, now: Timestamp, limits: &Limits) -> Option<&Arc<str>> {
        self.ids.get(id).filter(|kept| now < kept.since + lifetime(limits)).map(|kept| &kept.opened_by)
    }

    /// Keeps the id of an ended session for the caller who opened it.
    pub(crate) fn keep(&mut self, id: &SessionId, opened_by: &Arc<str>, now: Timestamp, limits: &Limits) {
        self.give_up(id);
        if opened_by.is_empty() {
            return;
        }
        let number = self.next;
        self.next += 1;
        self.ids.insert(id.clone(), Kept { number, opened_by: opened_by.clone(), since: now });
        self.order.insert(number, id.clone());
        self.callers.entry(opened_by.clone()).or_default().insert(number);
        while let Some(surplus) = self.surplus(opened_by, now, limits) {
            self.give_up(&surplus);
        }
    }

    /// Drops an id: it is free, or a session uses it again.
    pub(crate) fn give_up(&mut self, id: &SessionId) {
        let Some(Kept { number, opened_by, .. }) = self.ids.remove(id) else { return };
        self.order.remove(&number);
        if let Some(of_caller) = self.callers.get_mut(&opened_by) {
            of_caller.remove(&number);
            if of_caller.is_empty() {
                self.callers.remove(&opened_by);
            }
        }
    }

    /// An id to drop after one was kept for `caller`.
    fn surplus(&self, caller: &str, now: Timestamp, limits: &Limits) -> Option<SessionId> {
        let (_, oldest) = self.order.first_key_value()?;
        if self.ids.get(oldest).is_some_and(|kept| kept.since + lifetime(limits) <= now) {
            return Some(oldest.clone());
        }
        let own = self.callers.get(caller).filter(|own| own.len() > limits.kept_session_ids_per_caller);
        let too_many = || self.ids.len() > limits.kept_session_ids;
        let of = own.or_else(|| self.callers.values().filter(|_| too_many()).max_by_key(|of| of.len()))?;
        self.order.get(of.first()?).cloned()
    }

    /// Every kept id with its caller, oldest first.
    pub(crate) fn iter(&self) -> impl Iterator<Item = (&SessionId, &Arc<str>)> {
        self.order.values().filter_map(|id| Some((id, &self.ids.get(id)?.opened_by)))
    }

    /// Whether the indices agree.
    pub(crate) fn agree(&self) -> bool {
        let listed = |(id, kept): (&SessionId, &Kept)| {
            self.order.get(&kept.number) == Some(id)
                && self.callers.get(&kept.opened_by).is_some_and(|of| of.contains(&kept.number))
        };
        let of_callers: usize = self.callers.values().map(BTreeSet::len).sum();
        self.order.len() == self.ids.len() && of_callers == self.ids.len() && self.ids.iter().all(listed)
    }
}

fn lifetime(limits: &Limits) -> Duration {
    Duration::from_millis(limits.keep_session_ids_for_ms)
}
