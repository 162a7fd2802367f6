//! The keys in etcd, and helpers that build transactions of them.
//!
//! ```text
//!   PREFIX/meta                       the log's identity and format version
//!   PREFIX/leader                     the leader; written when the place is taken, and when it is given up
//!   PREFIX/alive                      written regularly by the leader
//!   PREFIX/writable                   exists as long as the leader can write `alive`
//!   PREFIX/head                       the last record that counts
//!   PREFIX/step                       number of changes of a snapshot, of what it replaces, or of one of the next two keys
//!   PREFIX/unfinished                 exists until a copy counts; in a complete copy, the same text as `moved` in its source
//!   PREFIX/moved                      the place to which the log was moved
//!   PREFIX/log/POSITION/PART          a part of a frame, by the position of its first record
//!   PREFIX/snapshot/current           the snapshot that counts
//!   PREFIX/snapshot/THROUGH/PART      a part of a snapshot
//! ```
//! Positions and parts have a fixed number of digits, so that the order of the keys is the order of positions and parts.

use super::wire::{
    Compare, DeleteRangeRequest, KeyValue, PutRequest, RangeRequest, RequestOp, compare, request_op, response_op,
};
use super::wire::{ResponseOp, TxnRequest};
use crate::store::Position;
use bytes::Bytes;

/// The keys of one log.
#[derive(Debug, Clone)]
pub(super) struct Keys {
    prefix: String,
}

/// A half-open range of keys.
pub(super) type Span = (Bytes, Bytes);

impl Keys {
    pub(super) fn new(prefix: &str) -> Keys {
        Keys { prefix: prefix.trim_end_matches('/').to_owned() }
    }

    pub(super) fn prefix(&self) -> &str {
        &self.prefix
    }

    pub(super) fn meta(&self) -> Bytes {
        self.key("meta")
    }

    pub(super) fn leader(&self) -> Bytes {
        self.key("leader")
    }

    pub(super) fn alive(&self) -> Bytes {
        self.key("alive")
    }

    pub(super) fn writable(&self) -> Bytes {
        self.key("writable")
    }

    pub(super) fn head(&self) -> Bytes {
        self.key("head")
    }

    pub(super) fn step(&self) -> Bytes {
        self.key("step")
    }

    pub(super) fn unfinished(&self) -> Bytes {
        self.key("unfinished")
    }

    pub(super) fn moved(&self) -> Bytes {
        self.key("moved")
    }

    pub(super) fn current(&self) -> Bytes {
        self.key("snapshot/current")
    }

    pub(super) fn frame(&self, first: Position, part: u32) -> Bytes {
        self.key(&format!("log/{:020}/{part:06}", first.0))
    }

    /// Every frame whose first record is in this range.
    pub(super) fn frames(&self, from: Position, before: Position) -> Span {
        (self.key(&format!("log/{:020}", from.0)), self.key(&format!("log/{:020}", before.0)))
    }

    /// Every frame from this record on.
    pub(super) fn frames_from(&self, from: Position) -> Span {
        (self.key(&format!("log/{:020}", from.0)), self.key("log0"))
    }

    pub(super) fn snapshot_part(&self, through: Position, part: u32) -> Bytes {
        self.key(&format!("snapshot/{:020}/{part:06}", through.0))
    }

    /// Every part of one snapshot.
    pub(super) fn snapshot(&self, through: Position) -> Span {
        (self.key(&format!("snapshot/{:020}/", through.0)), self.key(&format!("snapshot/{:020}0", through.0)))
    }

    /// Every part of all older snapshots.
    pub(super) fn snapshots_before(&self, through: Position) -> Span {
        (self.key("snapshot/0"), self.key(&format!("snapshot/{:020}", through.0)))
    }

    /// Every part of all newer snapshots; `current` sorts after all of them.
    pub(super) fn snapshots_after(&self, through: Position) -> Span {
        (self.key(&format!("snapshot/{:020}", through.next().0)), self.key("snapshot/c"))
    }

    fn key(&self, name: &str) -> Bytes {
        Bytes::from(format!("{}/{name}", self.prefix))
    }
}

/// A condition: the key was last written at this revision; 0: the key does not exist.
pub(super) fn written_at(key: Bytes, revision: i64) -> Compare {
    Compare {
        result: compare::CompareResult::Equal.into(),
        target: compare::CompareTarget::Mod.into(),
        key,
        target_union: Some(compare::TargetUnion::ModRevision(revision)),
    }
}

pub(super) fn put(key: Bytes, value: impl Into<Bytes>) -> RequestOp {
    op(request_op::Request::RequestPut(PutRequest { key, value: value.into() }))
}

pub(super) fn get(key: Bytes) -> RequestOp {
    range(RangeRequest { key, ..RangeRequest::default() })
}

pub(super) fn range(range: RangeRequest) -> RequestOp {
    op(request_op::Request::RequestRange(range))
}

pub(super) fn delete(key: Bytes) -> RequestOp {
    delete_span((key, Bytes::new()))
}

pub(super) fn delete_span((key, range_end): Span) -> RequestOp {
    op(request_op::Request::RequestDeleteRange(DeleteRangeRequest { key, range_end }))
}

/// A read-only transaction.
pub(super) fn look(success: Vec<RequestOp>) -> TxnRequest {
    TxnRequest { success, ..TxnRequest::default() }
}

/// The keys that a range request found; none if the operation was another one.
pub(super) fn found(response: Option<ResponseOp>) -> (Vec<KeyValue>, bool) {
    match response.and_then(|response| response.response) {
        Some(response_op::Response::ResponseRange(range)) => (range.kvs, range.more),
        _ => (Vec::new(), false),
    }
}

/// The only key of a range.
pub(super) fn found_one(response: Option<ResponseOp>) -> Option<KeyValue> {
    found(response).0.pop()
}

fn op(request: request_op::Request) -> RequestOp {
    RequestOp { request: Some(request) }
}
