//! Watches: each receives the whole state first, then every update. A watch that cannot keep up is closed; the actor never waits for
//! it.

use crate::details::{retry_later, status};
use std::fmt;
use std::time::Duration;
use tokio::sync::mpsc;
use tonic::{Code, Status};

/// Updates that may wait for a watcher; a watcher that falls further behind is closed.
const WATCH_BUFFER: usize = 4_096;
/// Retry delay of a watch that was refused.
const WATCH_AGAIN_AFTER: Duration = Duration::from_secs(1);

/// All watchers.
#[derive(Debug)]
pub(crate) struct Watchers<U> {
    all: Vec<Watcher<U>>,
}

/// A watcher.
pub(super) struct Watcher<U> {
    updates: mpsc::Sender<U>,
    wants: Box<dyn Fn(&U) -> bool + Send>,
}

impl<U> Watcher<U> {
    /// A watcher whose channel already holds the first updates.
    pub(super) fn begin(
        first: Vec<U>,
        wants: impl Fn(&U) -> bool + Send + 'static,
    ) -> Result<(Watcher<U>, mpsc::Receiver<U>), Status> {
        let (sender, updates) = mpsc::channel(WATCH_BUFFER + first.len());
        for update in first {
            sender.try_send(update).map_err(|_| status(Code::Internal, "BROKEN", "a new watch took no update"))?;
        }
        Ok((Watcher { updates: sender, wants: Box::new(wants) }, updates))
    }
}

impl<U> fmt::Debug for Watcher<U> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Watcher").finish_non_exhaustive()
    }
}

impl<U: Clone> Watchers<U> {
    /// Whether another watcher is allowed.
    ///
    /// # Errors
    /// Where there are too many already.
    pub(crate) fn admit(&mut self, most: usize) -> Result<(), Status> {
        self.all.retain(|watcher| !watcher.updates.is_closed());
        if self.all.len() >= most {
            let message = format!("{} clients watch already", self.all.len());
            return Err(retry_later(Code::ResourceExhausted, "TOO_MANY", message, WATCH_AGAIN_AFTER));
        }
        Ok(())
    }

    /// Sends the update to all watchers that want it.
    pub(crate) fn publish(&mut self, update: &U) {
        self.all.retain(|watcher| {
            if !(watcher.wants)(update) {
                return !watcher.updates.is_closed();
            }
            match watcher.updates.try_send(update.clone()) {
                Ok(()) => true,
                Err(mpsc::error::TrySendError::Closed(_)) => false,
                Err(mpsc::error::TrySendError::Full(_)) => {
                    tracing::warn!("a watcher did not keep up and was cut off");
                    false
                }
            }
        });
    }

    pub(crate) fn len(&self) -> usize {
        self.all.len()
    }

    pub(super) fn add(&mut self, watcher: Watcher<U>) {
        self.all.push(watcher);
    }

    pub(super) fn clear(&mut self) {
        self.all.clear();
    }
}

impl<U> Default for Watchers<U> {
    fn default() -> Watchers<U> {
        Watchers { all: Vec::new() }
    }
}
