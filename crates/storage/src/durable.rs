//! The durable position of a log, for code that holds answers back until it is reached.

use crate::error::{CompactionFailure, Fault};
use crate::store::Position;
use std::future::Future;
use std::pin::pin;
use std::sync::Arc;
use std::task::{Context, Poll, Wake, Waker};
use std::thread::{self, Thread};
use tokio::sync::watch;

/// The progress of a log's writer.
#[derive(Debug, Clone, Default)]
pub struct Progress {
    /// All records through this one are durable (with [`crate::Durability::None`]: appended).
    pub durable: Position,
    /// The last snapshot replaces all records through this one.
    pub compacted: Position,
    /// A compaction is under way.
    pub compacting: bool,
    /// Why the last compaction failed.
    pub compaction_failure: Option<CompactionFailure>,
    /// Why no record becomes durable for now. The writer goes on by itself.
    pub stalled: Option<Arc<str>>,
    /// Why the writer has stopped. Records that are not durable by then never will be.
    pub fault: Option<Fault>,
}

/// Watches a writer's [`Progress`]. Cheap to clone.
#[derive(Debug, Clone)]
pub struct Durable {
    progress: watch::Receiver<Progress>,
}

impl Durable {
    pub(crate) fn new(progress: watch::Receiver<Progress>) -> Durable {
        Durable { progress }
    }

    /// The present progress.
    #[must_use]
    pub fn progress(&self) -> Progress {
        self.progress.borrow().clone()
    }

    /// Whether everything through this position is durable.
    ///
    /// # Errors
    /// The fault, if the position is not durable and never will be.
    pub fn reached(&self, position: Position) -> Result<bool, Fault> {
        let progress = self.progress.borrow();
        match &progress.fault {
            _ if progress.durable >= position => Ok(true),
            Some(fault) => Err(fault.clone()),
            None => Ok(false),
        }
    }

    /// Waits for the next change; returns the new progress. Cancel-safe.
    ///
    /// # Errors
    /// [`Fault::Closed`] if the writer is gone.
    pub async fn changed(&mut self) -> Result<Progress, Fault> {
        self.progress.changed().await.map_err(|_| Fault::Closed)?;
        Ok(self.progress.borrow_and_update().clone())
    }

    /// Waits until everything through this position is durable. Cancel-safe.
    ///
    /// # Errors
    /// The fault, if the position never will be durable.
    pub async fn wait(&mut self, position: Position) -> Result<(), Fault> {
        let done = |progress: &Progress| progress.durable >= position || progress.fault.is_some();
        let ended = self.progress.wait_for(done).await.is_err();
        match self.reached(position)? {
            true => Ok(()),
            false => {
                debug_assert!(ended, "a wait ends when it is over");
                Err(Fault::Closed)
            }
        }
    }

    /// As [`Durable::wait`], blocking the calling thread.
    ///
    /// # Errors
    /// The fault, if the position never will be durable.
    pub fn wait_blocking(&mut self, position: Position) -> Result<(), Fault> {
        let waker = Waker::from(Arc::new(Unpark(thread::current())));
        let mut waiting = pin!(self.wait(position));
        loop {
            match waiting.as_mut().poll(&mut Context::from_waker(&waker)) {
                Poll::Ready(waited) => return waited,
                Poll::Pending => thread::park(),
            }
        }
    }
}

struct Unpark(Thread);

impl Wake for Unpark {
    fn wake(self: Arc<Self>) {
        self.0.unpark();
    }
}
