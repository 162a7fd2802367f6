//! State that a writer shares with the writing thread and a compaction: the records that wait, and their positions.
//!
//! ```text
//!   append ──▶ batch ──take──▶ the writing thread ──▶ progress.durable ──▶ callers that hold answers back
//! ```
//! The lock is held for copying a record and for swapping two buffers, never during a write. In a batch every record follows its length:
//! `length u32 | payload`, little-endian.

use crate::durable::Progress;
use crate::error::{AppendError, CompactError, Fault};
use crate::store::Position;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tokio::sync::watch;

/// A larger buffer is shrunk to this size after use.
const KEEP_BYTES: usize = 1 << 20;

/// Size of the length before each payload.
pub(crate) const RECORD_HEADER: usize = 4;

/// Records that are written together.
#[derive(Debug)]
pub(crate) struct Batch {
    /// Room for a header, which the writing thread fills in; then the records.
    pub(crate) bytes: Vec<u8>,
    pub(crate) first: Position,
    pub(crate) count: u32,
    header: usize,
}

#[derive(Debug)]
pub(crate) struct Pending {
    /// The log's place, for messages.
    pub(crate) place: String,
    state: Mutex<State>,
    /// The writing thread waits for this.
    work: Condvar,
    progress: watch::Sender<Progress>,
}

#[derive(Debug)]
struct State {
    batch: Batch,
    /// The other buffer, while it is not being written.
    spare: Option<Batch>,
    next: Position,
    /// The writing thread waits and has to be woken.
    idle: bool,
    closing: bool,
    /// A compaction has begun: the next batch goes to a new segment, so that the earlier ones can be removed.
    rotate: bool,
    fault: Option<Fault>,
}

impl Batch {
    fn new(header: usize) -> Batch {
        Batch { bytes: vec![0; header], first: Position(0), count: 0, header }
    }

    pub(crate) fn last(&self) -> Position {
        Position(self.first.0 + u64::from(self.count) - 1)
    }

    fn clear(&mut self) {
        self.bytes.truncate(self.header);
        self.bytes.shrink_to(KEEP_BYTES);
        self.count = 0;
    }
}

impl Pending {
    /// Without records. `header`: size of the room for a header in a batch.
    pub(crate) fn new(place: String, header: usize, last: Position, compacted: Position) -> Pending {
        let state = State {
            batch: Batch::new(header),
            spare: Some(Batch::new(header)),
            next: last.next(),
            idle: false,
            closing: false,
            rotate: false,
            fault: None,
        };
        let progress = Progress { durable: last, compacted, ..Progress::default() };
        Pending { place, state: Mutex::new(state), work: Condvar::new(), progress: watch::Sender::new(progress) }
    }

    pub(crate) fn watch(&self) -> watch::Receiver<Progress> {
        self.progress.subscribe()
    }

    /// Appends a record. `at_once`: it counts as durable now.
    pub(crate) fn append(&self, record: &[u8], most: usize, at_once: bool) -> Result<Position, AppendError> {
        let mut state = self.lock();
        if let Some(fault) = &state.fault {
            return Err(fault.clone().into());
        }
        let buffered = state.batch.bytes.len();
        if buffered + RECORD_HEADER + record.len() > most {
            return Err(AppendError::Full { buffered, most });
        }
        let position = state.next;
        state.next = position.next();
        let batch = &mut state.batch;
        if batch.count == 0 {
            batch.first = position;
        }
        // The length was checked against a limit below 4 GiB.
        let length = u32::try_from(record.len()).unwrap_or(u32::MAX);
        batch.bytes.extend_from_slice(&length.to_le_bytes());
        batch.bytes.extend_from_slice(record);
        batch.count += 1;
        let before = buffered..batch.bytes.len();
        // An idle thread had nothing to write; a lingering one has enough now.
        let wake = std::mem::take(&mut state.idle) || (at_once && before.contains(&KEEP_BYTES));
        drop(state);
        if wake {
            self.work.notify_one();
        }
        if at_once {
            // Callers that check see this; no waiting caller has to be woken.
            self.progress.send_if_modified(|progress| {
                progress.durable = position;
                false
            });
        }
        Ok(position)
    }

    /// The last position that was assigned.
    pub(crate) fn appended(&self) -> Position {
        Position(self.lock().next.0 - 1)
    }

    /// Number of bytes that are not being written yet.
    pub(crate) fn waiting_bytes(&self) -> usize {
        let state = self.lock();
        if state.batch.count == 0 { 0 } else { state.batch.bytes.len() }
    }

    /// For the writing thread: waits for records, then for more of them during `linger`; returns them, and whether a compaction has begun
    /// since the last batch. `None` when all are written and the writer is closing.
    pub(crate) fn take(&self, linger: Duration) -> Option<(Batch, bool)> {
        let mut state = self.lock();
        while state.batch.count == 0 {
            if state.closing {
                return None;
            }
            state.idle = true;
            state = self.work.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
        state.idle = false;
        if !linger.is_zero() {
            let waits = |state: &mut State| !state.closing && state.batch.bytes.len() < KEEP_BYTES;
            let waited = self.work.wait_timeout_while(state, linger, waits);
            state = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
        let spare = state.spare.take().unwrap_or_else(|| Batch::new(state.batch.header));
        let batch = std::mem::replace(&mut state.batch, spare);
        Some((batch, std::mem::take(&mut state.rotate)))
    }

    /// For the writing thread: all records through this position are on disk.
    pub(crate) fn synced(&self, through: Position) {
        self.progress.send_if_modified(|progress| {
            let further = through > progress.durable;
            progress.durable = progress.durable.max(through);
            further
        });
    }

    /// For the writing thread: returns the buffer of a written batch.
    pub(crate) fn give_back(&self, mut batch: Batch) {
        batch.clear();
        self.lock().spare = Some(batch);
    }

    /// Accepts nothing any more. The first fault is kept.
    pub(crate) fn stop(&self, fault: &Fault) {
        let mut state = self.lock();
        if state.fault.is_some() {
            return;
        }
        state.fault = Some(fault.clone());
        state.batch.clear();
        drop(state);
        self.progress.send_modify(|progress| progress.fault = Some(fault.clone()));
    }

    /// Sets why nothing becomes durable for now; `None` when it does again.
    pub(crate) fn stalled(&self, why: Option<String>) {
        self.progress.send_if_modified(|progress| {
            let changed = progress.stalled.as_deref() != why.as_deref();
            if changed {
                progress.stalled = why.map(Arc::from);
            }
            changed
        });
    }

    pub(crate) fn fault(&self) -> Option<Fault> {
        self.lock().fault.clone()
    }

    pub(crate) fn close(&self) {
        self.lock().closing = true;
        self.work.notify_one();
    }

    pub(crate) fn is_closing(&self) -> bool {
        self.lock().closing
    }

    /// Reserves the right to compact.
    pub(crate) fn begin_compaction(&self, through: Position) -> Result<(), CompactError> {
        let mut state = self.lock();
        if let Some(fault) = &state.fault {
            return Err(fault.clone().into());
        }
        let last = Position(state.next.0 - 1);
        if through > last {
            return Err(CompactError::Ahead { through, last });
        }
        let (compacting, compacted) = {
            let progress = self.progress.borrow();
            (progress.compacting, progress.compacted)
        };
        if compacting {
            return Err(CompactError::Busy);
        }
        if through <= compacted {
            return Err(CompactError::Behind { through, compacted });
        }
        state.rotate = true;
        drop(state);
        self.progress.send_modify(|progress| progress.compacting = true);
        Ok(())
    }

    pub(crate) fn end_compaction(&self, result: Result<Position, Option<crate::error::CompactionFailure>>) {
        self.progress.send_modify(|progress| {
            progress.compacting = false;
            progress.compaction_failure = None;
            match result {
                Ok(through) => progress.compacted = through,
                Err(failure) => progress.compaction_failure = failure,
            }
        });
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
