//! Records of changes: every durable change is one of these records, applied by
//! `apply.rs`, both when it happens and when it is read back.
//!
//! Records are physical (which slot, which amount, which token), never "what was asked": nothing is decided again when they
//! are read. The records of one call belong together, the answer remembered for its request id among them:
//! [`encode`] makes them one entry of a log. Waiters are not in them; their clients ask again with the same request id.

use crate::event::EndReason;
use crate::fingerprint::Fingerprint;
use crate::id::{SessionId, Slot};
use crate::lease::LeaseRecord;
use crate::memory::{Forgotten, Life, Remembered};
use crate::resource::Description;
use ratn_model::id::{LeaseId, Revision};
use ratn_model::resource::Quantity;
use ratn_model::versioned::{self, DecodeError};
use serde::{Deserialize, Serialize};
use std::sync::Arc;
use std::time::Duration;

/// The version that [`encode`] writes, its first byte. Every new variant at the end takes a new number, so that an older program
/// refuses what it does not know by its version; records since [`OLDEST_FORMAT`] are read as they are.
pub const FORMAT: u8 = 12;
/// The oldest version that [`decode`] reads: it has no `Effect::SessionOpened`, as none before this one has `Effect::UnitsFreed`.
pub const OLDEST_FORMAT: u8 = 2;
/// The newest version whose fingerprints are of how requests were written then, which says nothing to a later one.
const BYTE_FINGERPRINTS: u8 = 3;

/// One durable change of a pool.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Record(pub(crate) Effect);

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) enum Effect {
    /// A session lives for another time from now on. In records of [`OLDEST_FORMAT`] it may be new: who opened it is not known.
    SessionKept { session: SessionId, client: String, ttl: Duration },
    /// A session is gone; what hung on it went before.
    SessionEnded { session: SessionId },
    /// A resource is new. `numbered` is the last number given to a resource without an id of its own.
    ResourceCreated { slot: Slot, description: Arc<Description>, owner: Option<SessionId>, numbered: u64 },
    /// A resource has another description.
    ResourceUpdated { slot: Slot, description: Arc<Description> },
    /// A resource is gone; its holders have lost it.
    ResourceDeleted { slot: Slot, reason: EndReason },
    /// A session has consumed some of a resource.
    Consumed { session: SessionId, slot: Slot, amount: Quantity },
    /// What a session has consumed of what is renewable returned.
    TaskEnded { session: SessionId },
    /// A lease began.
    LeaseGranted { lease: LeaseId, granted: LeaseRecord },
    /// A lease ended.
    LeaseEnded { lease: LeaseId, reason: EndReason },
    /// In records of before: a request id has its answer, given to nobody knows whom; the oldest `forget` answers were forgotten for it.
    Answered { request_id: String, fingerprint: Fingerprint, reply: Remembered, forget: usize },
    /// What a session consumed of a resource with a grant that was undone is there again.
    Returned { session: SessionId, slot: Slot, amount: Quantity },
    /// In records of before: a session without a number is new.
    SessionOpened { session: SessionId, client: String, ttl: Duration, opened_by: Arc<str> },
    /// What a lease that has ended had left of a resource is free: standstill was confirmed, or its bound has passed.
    UnitsFreed { lease: LeaseId, slot: Slot, confirmed: bool },
    /// A request id of a caller has its answer; so many of the oldest answers of these callers were forgotten for it.
    AnsweredTo {
        caller: Arc<str>,
        request_id: Arc<str>,
        fingerprint: Fingerprint,
        reply: Remembered,
        forget: Forgotten,
    },
    /// A session is new.
    SessionNumbered { session: SessionId, client: String, ttl: Duration, opened_by: Arc<str>, number: u64 },
    /// Of what a session has consumed of what is renewable, so much returned as it has of the first so many resources.
    SomeReturned { session: SessionId, resources: usize },
    /// Revisions go on from here: those before it may have meant something else.
    RevisionsLeapt { revision: Revision },
    /// As `AnsweredTo`, of what ends with the session of this number.
    AnsweredForLife {
        caller: Arc<str>,
        request_id: Arc<str>,
        fingerprint: Fingerprint,
        reply: Remembered,
        forget: Forgotten,
        life: Life,
    },
}

/// What its bytes are, in messages.
const RECORDS: &str = "records of a resource pool";

/// The records of one call, as one entry of a log.
pub fn encode(records: &[Record]) -> Vec<u8> {
    versioned::encode(FORMAT, &records)
}

/// Reads what [`encode`] wrote.
///
/// # Errors
/// Bytes that it did not write, or another version did.
pub fn decode(bytes: &[u8]) -> Result<Vec<Record>, DecodeError> {
    let version = versioned::version(OLDEST_FORMAT, FORMAT, RECORDS, bytes)?;
    let mut records: Vec<Record> = versioned::decode(version, RECORDS, bytes)?;
    if !knows_fingerprints(version) {
        for record in &mut records {
            if let Effect::Answered { fingerprint, .. } = &mut record.0 {
                *fingerprint = Fingerprint::UNKNOWN;
            }
        }
    }
    Ok(records)
}

/// Whether the fingerprints in bytes of this version are those of this program.
pub(crate) fn knows_fingerprints(version: u8) -> bool {
    version > BYTE_FINGERPRINTS
}
