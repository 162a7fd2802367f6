//! Replaces records by a snapshot: parts first, then the one key that makes them count, then what they stand for away.

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
        // The snapshot must not know of records that may never be there.
        if Durable::new(self.shared.pending.watch()).wait_blocking(self.through).is_err() {
            return;
        }
        result.result = self.write(&payload).map(|()| self.through).map_err(|fault| Some(self.failure(fault)));
    }

    fn write(&self, payload: &Bytes) -> Result<(), Fault> {
        let (keys, through) = (&self.shared.term.keys, self.through);
        // An attempt whose last answer never came may have made it count.
        if self.shared.counts(through)? {
            return self.tidy_up();
        }
        // Parts of an attempt that came to nothing.
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

    /// Takes away what the snapshot stands for.
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

/// Says that the compaction has ended, however it did.
struct Reported<'a> {
    shared: &'a Shared,
    result: Result<Position, Option<CompactionFailure>>,
}

impl Drop for Reported<'_> {
    fn drop(&mut self) {
        self.shared.pending.end_compaction(std::mem::replace(&mut self.result, Err(None)));
    }
}
