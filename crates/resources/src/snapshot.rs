//! Writes a pool as bytes, and restores it from a snapshot and the records after it.
//!
//! ```text
//!   pool ──take_records──▶ log            snapshot + records after it ──restore──▶ the same pool
//!     └──── snapshot ────▶ file             (waiters have to ask again, the TTLs of sessions begin anew)
//! ```

use crate::caller::Callers;
use crate::expiry::Timer;
use crate::fingerprint::Fingerprint;
use crate::id::{SessionId, Slot};
use crate::lease::{Bound, EndingLease, LeaseRecord};
use crate::limits::Limits;
use crate::memory::{Life, Remembered, RequestId};
use crate::pool::Pool;
use crate::record::{FORMAT, OLDEST_FORMAT, Record, knows_fingerprints};
use crate::resource::Resource;
use crate::session::Session;
use ratn_model::id::{LeaseId, Revision};
use ratn_model::time::Timestamp;
use ratn_model::versioned::{self, DecodeError};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

/// The last format versions without: lives of answers, kept ids, numbers of sessions, callers of answers and openers of ended leases, ended leases,
/// openers of sessions.
const WITHOUT_LIVES: u8 = 10;
const WITHOUT_KEPT_IDS: u8 = 9;
const WITHOUT_NUMBERS: u8 = 6;
const WITHOUT_CALLERS: u8 = 5;
const WITHOUT_ENDING: u8 = 4;
const WITHOUT_OPENERS: u8 = 2;
/// Its name in messages.
const SNAPSHOT: &str = "snapshot of a resource pool";

/// The durable state of a pool. Taking a snapshot shares the descriptions of the resources and copies the rest.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Snapshot {
    revision: Revision,
    last_lease: u64,
    last_token: u64,
    last_number: u64,
    sessions: Vec<(SessionId, String, Duration)>,
    resources: Vec<(Slot, Resource)>,
    leases: Vec<(LeaseId, LeaseRecord)>,
    /// Oldest first.
    answers: Vec<(String, Fingerprint, Remembered)>,
    /// The callers who opened the sessions; unknown for sessions that are missing here.
    openers: Vec<(SessionId, Arc<str>)>,
    /// What ended leases have left.
    ending: Vec<(LeaseId, EndingLease)>,
    /// The callers who got the answers, in the order of the answers; unknown if missing.
    answered: Vec<Arc<str>>,
    /// The callers who opened the sessions of the ended leases, in the order of `ending`; unknown if missing.
    ended: Vec<Arc<str>>,
    /// The numbers of the sessions, in the order of `sessions`; 0 if missing.
    numbers: Vec<u64>,
    last_session: u64,
    /// The callers for whom the ids of ended sessions are kept, oldest first.
    kept_ids: Vec<(SessionId, Arc<str>)>,
    /// The numbers of the sessions with whose end the effects of the answered requests ended, in the order of the answers; 0 if they did not end, or
    /// if missing.
    lives: Vec<Life>,
}

/// A snapshot or a record that does not fit: the log has a gap, or belongs to another pool.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum RestoreError {
    /// The snapshot is inconsistent.
    #[error("the snapshot of revision {revision} contradicts itself: {reason}; restore a backup")]
    Snapshot {
        /// The revision of the snapshot.
        revision: u64,
        /// The inconsistency.
        reason: String,
    },
    /// A record does not follow from those before it.
    #[error("record {number} after the snapshot does not fit (revision {revision}): {reason}; restore a backup")]
    Record {
        /// The index of the record, from 0.
        number: usize,
        /// The pool's revision before it.
        revision: u64,
        /// The inconsistency.
        reason: String,
    },
}

impl Snapshot {
    /// The bytes for a file.
    pub fn encode(&self) -> Vec<u8> {
        versioned::encode(FORMAT, self)
    }

    /// Reads the bytes written by [`Snapshot::encode`], of this version or an earlier one: each version only adds to the end of the previous one.
    ///
    /// # Errors
    /// The bytes were not written by it, or by an unsupported version.
    pub fn decode(bytes: &[u8]) -> Result<Snapshot, DecodeError> {
        let version = versioned::version(OLDEST_FORMAT, FORMAT, SNAPSHOT, bytes)?;
        let without = |last: u8, fields: usize| if version <= last { fields } else { 0 };
        let missing = without(WITHOUT_OPENERS, 1)
            + without(WITHOUT_ENDING, 1)
            + without(WITHOUT_CALLERS, 2)
            + without(WITHOUT_NUMBERS, 2)
            + without(WITHOUT_KEPT_IDS, 1)
            + without(WITHOUT_LIVES, 1);
        // An empty list, or 0, for each missing field, as postcard writes it.
        let mut snapshot: Snapshot = versioned::decode(version, SNAPSHOT, &[bytes, &[0; 8][..missing]].concat())?;
        if !knows_fingerprints(version) {
            snapshot.answers.iter_mut().for_each(|(_, fingerprint, _)| *fingerprint = Fingerprint::UNKNOWN);
        }
        Ok(snapshot)
    }

    /// The pool's revision in the snapshot.
    pub fn revision(&self) -> Revision {
        self.revision
    }
}

impl Pool {
    /// The present state of the pool. Records taken later continue it; take earlier records first.
    pub fn snapshot(&self) -> Snapshot {
        Snapshot {
            revision: self.revision,
            last_lease: self.last_lease,
            last_token: self.last_token,
            last_number: self.last_number,
            sessions: self.sessions.iter().map(|(id, s)| (id.clone(), s.name.clone(), s.ttl)).collect(),
            resources: self.resources.iter().map(|(slot, resource)| (slot, resource.clone())).collect(),
            leases: self
                .leases
                .iter()
                .map(|(id, lease)| (*id, LeaseRecord { expires: None, opened_by: Arc::default(), ..lease.clone() }))
                .collect(),
            answers: self
                .memory
                .iter()
                .map(|(_, id, print, reply, _)| (id.to_string(), print, reply.clone()))
                .collect(),
            openers: self.sessions.iter().map(|(id, session)| (id.clone(), session.opened_by.clone())).collect(),
            ending: self.ending.iter().map(|(id, ending)| (*id, ending.without_bounds())).collect(),
            answered: self.memory.iter().map(|(caller, ..)| caller.clone()).collect(),
            ended: self.ending.values().map(|ending| ending.opened_by.clone()).collect(),
            numbers: self.sessions.values().map(|session| session.number).collect(),
            last_session: self.last_session,
            kept_ids: self.kept_ids.iter().map(|(id, opened_by)| (id.clone(), opened_by.clone())).collect(),
            lives: self.memory.iter().map(|(.., life)| life).collect(),
        }
    }

    /// Restores a pool from a snapshot (`None`: an empty pool) and the records after it, at `now` of a clock that need not be the previous one. The
    /// times of every session, of every lease with a maximum holding time, and of every provider that has to confirm standstill begin anew; the queue
    /// is empty.
    ///
    /// # Errors
    /// A snapshot or a record does not fit.
    pub fn restore(
        limits: Limits,
        now: Timestamp,
        snapshot: Option<Snapshot>,
        records: impl IntoIterator<Item = Record>,
    ) -> Result<Pool, RestoreError> {
        let mut pool = Pool { now, ..Pool::new(limits) };
        if let Some(snapshot) = snapshot {
            let revision = snapshot.revision.0;
            pool.fill(snapshot).map_err(|reason| RestoreError::Snapshot { revision, reason })?;
        }
        for (number, record) in records.into_iter().enumerate() {
            let revision = pool.revision.0;
            pool.apply(&record.0).map_err(|reason| RestoreError::Record { number, revision, reason })?;
            // Nobody receives the notices, and the events of a long log would pile up.
            pool.notices.clear();
        }
        Ok(pool)
    }

    fn fill(&mut self, snapshot: Snapshot) -> Result<(), String> {
        (self.revision, self.last_number) = (snapshot.revision, snapshot.last_number);
        (self.last_lease, self.last_token) = (snapshot.last_lease, snapshot.last_token);
        let mut openers: BTreeMap<SessionId, Arc<str>> = snapshot.openers.into_iter().collect();
        self.last_session = snapshot.last_session;
        let mut numbers = snapshot.numbers.into_iter();
        for (id, client, ttl) in snapshot.sessions {
            let (opened_by, number) = (openers.remove(&id).unwrap_or_default(), numbers.next().unwrap_or(0));
            let expires = self.now + ttl;
            self.sessions.insert(id.clone(), Session::new(client, opened_by, number, ttl, expires));
            self.start_session_timer(&id, expires);
        }
        for (id, opened_by) in &snapshot.kept_ids {
            self.kept_ids.keep(id, opened_by, self.now, &self.limits);
        }
        for (slot, resource) in snapshot.resources {
            let consumers = resource.consumers.iter().map(|(session, _)| (session, false));
            for (session, owns) in resource.owner.iter().map(|owner| (owner, true)).chain(consumers) {
                let session = self.sessions.get_mut(session).ok_or_else(|| format!("{session} is not there"))?;
                let slots = if owns { &mut session.provides } else { &mut session.consumed };
                slots.insert(slot);
            }
            let id = resource.description.id.clone();
            if !self.resources.insert(slot, resource) {
                return Err(format!("`{id}` or {slot} is there twice"));
            }
        }
        for (id, mut lease) in snapshot.leases {
            lease.expires = lease.hold_for.map(|hold_for| self.now + hold_for);
            if let Some(expires) = lease.expires {
                self.timers.insert((expires, Timer::Lease(id)));
            }
            let session =
                self.sessions.get_mut(&lease.session).ok_or_else(|| format!("{} is not there", lease.session))?;
            session.leases.insert(id);
            lease.opened_by = session.opened_by.clone();
            self.undoable(id, &lease.consumed);
            self.leases.insert(id, lease);
        }
        let mut ended = snapshot.ended.into_iter();
        for (id, mut ending) in snapshot.ending {
            ending.opened_by = ended.next().unwrap_or_default();
            for (slot, bound) in &mut ending.slots {
                let resource = self.resources.get(*slot).ok_or_else(|| format!("{slot} is empty"))?;
                *bound = Bound(self.now + resource.description.standstill());
                self.timers.insert((bound.0, Timer::Standstill(id, *slot)));
            }
            self.ending.insert(id, ending);
        }
        self.open_accounts();
        self.gather_crowds();
        self.callers = Callers::of(&self.sessions, &self.ending, &self.queue);
        let (mut answered, mut lives) = (snapshot.answered.into_iter(), snapshot.lives.into_iter());
        for (id, fingerprint, reply) in snapshot.answers {
            let id = RequestId::new(&answered.next().unwrap_or_default(), &id);
            self.memory.remember(id, fingerprint, reply, lives.next().unwrap_or(0), self.now);
        }
        Ok(())
    }
}
