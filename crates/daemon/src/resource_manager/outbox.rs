//! What the actor has to say, held back until what it tells of is on the disk. In order: nothing overtakes.
//!
//! An answer waits for the last entry written before it was made, also when it changed nothing itself: it may tell of what others
//! changed.

use ratn_proto::types::ResourceUpdate;
use ratn_resources::Notice;
use ratn_storage::Position;
use std::collections::VecDeque;
use std::fmt;
use std::sync::Arc;
use tokio::sync::mpsc;
use tonic::Status;

/// With so much held back the actor takes on nothing new: the disk does not keep up.
pub(super) const MOST_HELD: usize = 16_384;

/// Sends an answer, or a status instead of it.
pub(super) type SendAnswer = Box<dyn FnOnce(Option<&Status>) + Send>;

/// Something that leaves.
pub(super) enum Outgoing {
    /// To one who asked.
    Answer(SendAnswer),
    /// What the pool has to say to waiters and watchers.
    Notice(Notice),
    /// From here on it sees every event.
    Watcher(mpsc::Sender<Arc<ResourceUpdate>>),
}

#[derive(Debug, Default)]
pub(super) struct Outbox {
    held: VecDeque<(Position, Outgoing)>,
}

impl Outbox {
    /// Puts it behind all others.
    pub(super) fn hold(&mut self, position: Position, outgoing: Outgoing) {
        self.held.push_back((position, outgoing));
    }

    /// What the first waits for.
    pub(super) fn waits_for(&self) -> Option<Position> {
        self.held.front().map(|(position, _)| *position)
    }

    pub(super) fn take(&mut self) -> Option<Outgoing> {
        self.held.pop_front().map(|(_, outgoing)| outgoing)
    }

    pub(super) fn is_full(&self) -> bool {
        self.held.len() >= MOST_HELD
    }
}

impl fmt::Debug for Outgoing {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Outgoing::Answer(_) => f.write_str("Answer"),
            Outgoing::Notice(notice) => notice.fmt(f),
            Outgoing::Watcher(_) => f.write_str("Watcher"),
        }
    }
}
