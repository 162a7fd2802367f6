//! What changes in a pool, as it is written down: every durable change is one of these records, applied by
//! `apply.rs`, both when it happens and when it is read back.
//!
//! Records are physical (which slot, which amount, which token), never "what was asked": nothing is decided again when they
//! are read. The records of one call belong together, the answer remembered for its request id among them:
//! [`encode`] makes them one entry of a log. Waiters are not in them; their clients ask again with the same request id.

use crate::event::EndReason;
use crate::id::{SessionId, Slot};
use crate::lease::LeaseRecord;
use crate::memory::Remembered;
use crate::resource::Description;
use ratn_model::id::LeaseId;
use ratn_model::resource::Quantity;
use ratn_model::versioned::{self, DecodeError};
use serde::{Deserialize, Serialize};
use std::sync::Arc;
use std::time::Duration;

/// The version that [`encode`] writes, its first byte. Variants and fields are only ever added at the end; whatever else
/// changes takes a new number.
pub const FORMAT: u8 = 2;

/// One durable change of a pool.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Record(pub(crate) Effect);

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) enum Effect {
    /// A session is there, or lives for another time from now on.
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
    /// A request id has its answer; the oldest `forget` answers were forgotten for it.
    Answered { request_id: String, fingerprint: u128, reply: Remembered, forget: usize },
    /// What a session consumed of a resource with a grant that was undone is there again.
    Returned { session: SessionId, slot: Slot, amount: Quantity },
}

/// What its bytes are, in messages.
const RECORDS: &str = "records of a resource pool";

/// The records of one call, as one entry of a log.
pub fn encode(records: &[Record]) -> Vec<u8> {
    to_bytes(&records)
}

/// Reads what [`encode`] wrote.
///
/// # Errors
/// Bytes that it did not write, or another version did.
pub fn decode(bytes: &[u8]) -> Result<Vec<Record>, DecodeError> {
    from_bytes(bytes)
}

pub(crate) fn to_bytes<T: Serialize>(value: &T) -> Vec<u8> {
    versioned::encode(FORMAT, value)
}

pub(crate) fn from_bytes<T: for<'a> Deserialize<'a>>(bytes: &[u8]) -> Result<T, DecodeError> {
    versioned::decode(FORMAT, RECORDS, bytes)
}
