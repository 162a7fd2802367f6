//! Ids of sessions that have ended. Each is kept for a while for the caller that opened its session, so that nobody else opens a session of
//! that id before its owner returns: the owner would be refused from then on.
//!
//! Bounded by number and by age, and for each caller by number. A caller's own oldest ids are given up first; where all callers together
//! have too many, those of the caller with the most. So nobody's sessions make the manager give up the ids of a caller with fewer.
//! If the opener of a session is unknown, its id is not kept.
//!
//! An id is kept by the record that ends its session, and given up by the one that opens the next: nothing else is written down. After a
//! restart the time begins anew, and a replay may keep more ids than there were: those that had been given up for their age, or under narrower
//! bounds, are kept again, within the bounds of now.
//!
//! Every caller that may open sessions can reserve ids of its choice by opening and ending sessions of them. Ids of the project's own parts are fresh, and
//! nobody guesses them. `keep_session_ids_for_ms = 0` keeps none, also of those that are there.

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
    /// The oldest first.
    order: BTreeMap<u64, SessionId>,
    /// What is kept for each caller, the oldest first.
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
    /// For whom an id is kept, if it is.
    pub(crate) fn opener(&self, id: &SessionId, now: Timestamp, limits: &Limits) -> Option<&Arc<str>> {
        self.ids.get(id).filter(|kept| now < kept.since + lifetime(limits)).map(|kept| &kept.opened_by)
    }

    /// A session has ended: its id is kept for who opened it.
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

    /// An id is nobody's any more, or a session has it again.
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

    /// One that has to go after one of a caller was kept.
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

    /// Every id with whom it is kept for, the oldest first.
    pub(crate) fn iter(&self) -> impl Iterator<Item = (&SessionId, &Arc<str>)> {
        self.order.values().filter_map(|id| Some((id, &self.ids.get(id)?.opened_by)))
    }

    /// Whether the indices say the same.
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
