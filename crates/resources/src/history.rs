//! The latest events, for watches that begin at an earlier revision.

use crate::event::WatchEvent;
use ratn_model::id::Revision;
use std::collections::VecDeque;
use std::sync::Arc;

/// The latest events, oldest first, without gaps.
#[derive(Debug, Clone, Default)]
pub(crate) struct History {
    events: VecDeque<Arc<WatchEvent>>,
}

/// Some events after a revision are no longer kept.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{}", self.text())]
pub struct Compacted {
    /// The requested revision.
    pub after: Revision,
    /// The oldest revision after which all events are kept.
    pub oldest: Revision,
    /// The newest revision.
    pub newest: Revision,
}

impl History {
    pub(crate) fn push(&mut self, event: Arc<WatchEvent>, limit: usize) {
        self.events.push_back(event);
        while self.events.len() > limit {
            self.events.pop_front();
        }
    }

    /// The events after a revision, in order, if the pool is at `newest`.
    pub(crate) fn after(&self, after: Revision, newest: Revision) -> Result<Vec<Arc<WatchEvent>>, Compacted> {
        let oldest = Revision(newest.0 - self.events.len() as u64);
        if after < oldest || after > newest {
            return Err(Compacted { after, oldest, newest });
        }
        let skipped = usize::try_from(after.0 - oldest.0).unwrap_or(usize::MAX);
        Ok(self.events.iter().skip(skipped).cloned().collect())
    }
}

impl Compacted {
    fn text(&self) -> String {
        let Compacted { after, oldest, newest } = self;
        if after > newest {
            format!(
                "revision {} lies ahead of the pool's {}: watch without a revision, for a snapshot",
                after.0, newest.0
            )
        } else {
            format!(
                "the changes after revision {} are forgotten (known are those after {}): watch without a revision, for a snapshot",
                after.0, oldest.0
            )
        }
    }
}
