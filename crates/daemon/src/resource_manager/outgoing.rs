//! What the actor has to say; it leaves through the outbox.

use crate::outbox::SendAnswer;
use ratn_proto::types::ResourceUpdate;
use ratn_resources::Notice;
use std::fmt;
use std::sync::Arc;
use tokio::sync::mpsc;

/// Something that leaves.
pub(super) enum Outgoing {
    /// To one who asked.
    Answer(SendAnswer),
    /// What the pool has to say to waiters and watchers.
    Notice(Notice),
    /// From here on it sees every event.
    Watcher(mpsc::Sender<Arc<ResourceUpdate>>),
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
