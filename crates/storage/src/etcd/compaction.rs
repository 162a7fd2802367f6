//! Replaces records by a snapshot: writes the parts, then the key that makes them count, then deletes the records they replace.

use super::format::{Current, text};
use super::keys::{delete_span, put};
use super::wire::RequestOp;
use super::writer::{Ended, Shared};
use crate::durable::Durable;
use crate::error::{CompactionFailure, Fault};
use crate::store::{MakeSnapshot, Position};
use bytes::Bytes;
use crc32c::crc32c;
use std::io;
use std::sync::Arc;

#[derive(Debug)]
pub(super) struct Compaction {
    pub(super) shared: Arc<Shared>,
    pub(super) through: Position,
}

impl Compaction {
    pub(super) fn run(self, make: MakeSnapshot) {
        let _ended = Ended(self.shared.clone());
        let mut result = Reported { shared: &self.shared, result: Err(None) };
        ratn_panic_point::panic_point("etcd-compaction");
        let payload = make();
        // The snapshot must not contain records that may never become durable.
        if Durable::new(self.shared.pending.watch()).wait_blocking(self.through).is_err() {
            return;
        }
        result.result = self.write(&payload).map(|()| self.through).map_err(|fault| Some(self.failure(fault)));
    }

    fn write(&self, payload: &Bytes) -> Result<(), Fault> {
        let (keys, through) = (&self.shared.term.keys, self.through);
        // An attempt whose last answer was lost may have made the snapshot count.
        if self.shared.counts(through)? {
            return self.tidy_up();
        }
        // Remove parts of a failed attempt.
        self.perform(delete_span(keys.snapshot(through)))?;
        let mut parts = 0;
        for (number, begin) in (0..).zip((0..payload.len()).step_by(self.shared.bounds.part)) {
            let end = payload.len().min(begin + self.shared.bounds.part);
            self.perform(put(keys.snapshot_part(through, number), payload.slice(begin..end)))?;
            parts = number + 1;
        }
        let current = Current { through: through.0, parts, bytes: payload.len() as u64, crc: crc32c(payload) };
        self.perform(put(keys.current(), text(&current)))?;
        self.tidy_up()
    }

    /// Deletes what the snapshot replaces.
    fn tidy_up(&self) -> Result<(), Fault> {
        let (keys, through) = (&self.shared.term.keys, self.through);
        self.perform(delete_span(keys.snapshots_before(through)))?;
        if let Some((from, before)) = self.shared.superfluous(through) {
            self.perform(delete_span(keys.frames(from, before)))?;
        }
        Ok(())
    }

    fn perform(&self, operation: RequestOp) -> Result<(), Fault> {
        self.shared.change_snapshots(vec![operation])
    }

    fn failure(&self, fault: Fault) -> CompactionFailure {
        let place = self.shared.pending.place.clone();
        CompactionFailure { through: self.through, action: "write", place, source: Arc::new(io::Error::other(fault)) }
    }
}

/// Reports that the compaction has ended, in whatever way.
struct Reported<'a> {
    shared: &'a Shared,
    result: Result<Position, Option<CompactionFailure>>,
}

impl Drop for Reported<'_> {
    fn drop(&mut self) {
        self.shared.pending.end_compaction(std::mem::replace(&mut self.result, Err(None)));
    }
}
