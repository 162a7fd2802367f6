//! Records of changes: every durable change is one of these records, applied by
//! `apply.rs`, both when it happens and when it is read back.
//!
//! Records are physical (which slot, which amount, which token), never the request itself: nothing is decided again when they are read. The records
//! of one call belong together, including the answer remembered for its request id: [`encode`] makes them one entry of a log. Waiters are not
//! recorded; their clients ask again with the same request id.

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

/// The version that [`encode`] writes as the first byte. Every new variant is added at the end and increases the number, so that an older program
/// refuses records that it does not know; records since [`OLDEST_FORMAT`] are read unchanged.
pub const FORMAT: u8 = 13;
/// The oldest version that [`decode`] reads: it has no `Effect::SessionOpened`, and versions before this one have no `Effect::UnitsFreed`.
pub const OLDEST_FORMAT: u8 = 2;
/// The newest version whose fingerprints hash the bytes of requests; later versions cannot compare them.
const BYTE_FINGERPRINTS: u8 = 3;

/// One durable change of a pool.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Record(pub(crate) Effect);

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) enum Effect {
    /// A session lives for another `ttl` from now. In records of [`OLDEST_FORMAT`] it may be new: then its opener is unknown.
    SessionKept { session: SessionId, client: String, ttl: Duration },
    /// A session is gone; everything that belonged to it was removed before.
    SessionEnded { session: SessionId },
    /// A resource is new. `numbered` is the last number given to a resource without an id.
    ResourceCreated { slot: Slot, description: Arc<Description>, owner: Option<SessionId>, numbered: u64 },
    /// A resource has a new description.
    ResourceUpdated { slot: Slot, description: Arc<Description> },
    /// A resource is gone; its holders have lost it.
    ResourceDeleted { slot: Slot, reason: EndReason },
    /// A session has consumed some of a resource.
    Consumed { session: SessionId, slot: Slot, amount: Quantity },
    /// The renewable units that a session has consumed have returned.
    TaskEnded { session: SessionId },
    /// A lease began.
    LeaseGranted { lease: LeaseId, granted: LeaseRecord },
    /// A lease ended.
    LeaseEnded { lease: LeaseId, reason: EndReason },
    /// In older records: a request id has its answer, to an unknown caller; the oldest `forget` answers were forgotten for it.
    Answered { request_id: String, fingerprint: Fingerprint, reply: Remembered, forget: usize },
    /// Units that a session consumed with an undone grant have returned.
    Returned { session: SessionId, slot: Slot, amount: Quantity },
    /// In older records: a session without a number is new.
    SessionOpened { session: SessionId, client: String, ttl: Duration, opened_by: Arc<str> },
    /// The units of a resource that an ended lease had left are free: standstill was confirmed, or its bound has passed.
    UnitsFreed { lease: LeaseId, slot: Slot, confirmed: bool },
    /// A request id of a caller has its answer; these callers have lost some of their oldest answers for it.
    AnsweredTo {
        caller: Arc<str>,
        request_id: Arc<str>,
        fingerprint: Fingerprint,
        reply: Remembered,
        forget: Forgotten,
    },
    /// A session is new.
    SessionNumbered { session: SessionId, client: String, ttl: Duration, opened_by: Arc<str>, number: u64 },
    /// The renewable units that a session has consumed from its first `resources` consumed resources have returned.
    SomeReturned { session: SessionId, resources: usize },
    /// Revisions continue from here: those before may have had another meaning.
    RevisionsLeapt { revision: Revision },
    /// As `AnsweredTo`, for effects that end with the session of this number.
    AnsweredForLife {
        caller: Arc<str>,
        request_id: Arc<str>,
        fingerprint: Fingerprint,
        reply: Remembered,
        forget: Forgotten,
        life: Life,
    },
}

/// The name of this format in messages.
const RECORDS: &str = "records of a resource pool";

/// The records of one call, as one entry of a log.
pub fn encode(records: &[Record]) -> Vec<u8> {
    versioned::encode(FORMAT, &records)
}

/// Reads what [`encode`] wrote.
///
/// # Errors
/// The bytes are not from it, or from another version.
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

/// Whether the fingerprints in this version are computed as in this program.
pub(crate) fn knows_fingerprints(version: u8) -> bool {
    version > BYTE_FINGERPRINTS
}
