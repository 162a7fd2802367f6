//! What this host has seen of a log at the most, in a file of its own: by that an older state of etcd is recognised which was put in place of
//! the one that there was. Nothing else depends on the file. Without it, only the number of etcd's cluster tells.

use super::term::Seen;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// See the module.
#[derive(Debug, Clone)]
pub(super) struct Mark {
    /// Nothing is kept without.
    file: Option<PathBuf>,
}

/// Grows, as long as it is of one log.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Height {
    pub(super) store: u64,
    pub(super) epoch: u64,
    pub(super) position: u64,
}

impl Height {
    /// Nothing where there is no log.
    pub(super) fn of(seen: &Seen) -> Option<Height> {
        let meta = seen.meta.as_ref()?;
        let epoch = seen.leader.as_ref().map_or(0, |(_, leader)| leader.epoch);
        let position = seen.head.map_or(0, |(_, head)| head.position);
        Some(Height { store: meta.store, epoch, position })
    }
}

impl Mark {
    pub(super) fn new(file: Option<PathBuf>) -> Mark {
        Mark { file }
    }

    /// Whether this host has seen more than there is, or another log.
    pub(super) fn is_above(&self, there: Option<Height>) -> bool {
        let Some(known) = self.read() else { return false };
        let reaches = |there: Height| {
            there.store == known.store && there.epoch >= known.epoch && there.position >= known.position
        };
        !there.is_some_and(reaches)
    }

    /// Keeps it. A file that cannot be written is told of, and no more: it is only a help.
    pub(super) fn keep(&self, height: Height) {
        let Some(file) = &self.file else { return };
        if self.read() == Some(height) {
            return;
        }
        let temporary = file.with_extension("new");
        let text = serde_json::to_vec(&height).unwrap_or_default();
        let made = file.parent().map_or(Ok(()), std::fs::create_dir_all);
        let written =
            made.and_then(|()| std::fs::write(&temporary, text)).and_then(|()| std::fs::rename(&temporary, file));
        if let Err(error) = written {
            tracing::warn!(file = %file.display(), %error, "it is not kept what was seen of etcd");
        }
    }

    fn read(&self) -> Option<Height> {
        serde_json::from_slice(&std::fs::read(self.file.as_ref()?).ok()?).ok()
    }
}
