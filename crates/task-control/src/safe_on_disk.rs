//! Syncs the event log of a run to disk in the background: only irreversible commands wait for it.
//!
//! A thread syncs the log on request; one sync covers everything written before it, so several marks that arrive in the meantime cost one more sync.
//! The thread reports to a single task of the run, which notifies all waiting ones: if the thread notified each itself, this would cost a system call
//! each, and they would not continue together.

use ratn_worker::panic::exit_on_panic;
use std::fs::File;
use std::io;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, channel};
use tokio::sync::watch;

/// Syncs the log. Dropping it ends its thread.
#[derive(Debug)]
pub(super) struct Syncer {
    asks: Asks,
    /// The last mark that is synced. Closed when no further sync will happen.
    safe: watch::Receiver<u64>,
    /// The reason why no further sync will happen.
    failure: watch::Receiver<Option<Arc<str>>>,
    last: u64,
    /// The last mark that the thread was asked to sync.
    asked: u64,
}

/// A position in the log: irreversible commands wait until everything before it is synced.
#[derive(Debug, Clone)]
pub(super) struct Mark {
    number: u64,
    safe: watch::Receiver<u64>,
}

/// Who syncs the log.
#[derive(Debug)]
enum Asks {
    /// The thread.
    Thread(Sender<u64>),
    /// Nobody: the log is not on a disk, and written lines count as synced.
    Nobody(watch::Sender<u64>),
    /// Nobody any more: the log could not be written.
    GivenUp,
}

/// The thread's reports.
#[derive(Debug)]
struct Tell {
    safe: watch::Sender<u64>,
    failure: watch::Sender<Option<Arc<str>>>,
}

impl Syncer {
    /// Syncs a file that others write; `None` if the log is not on a disk. Must be called within a tokio runtime.
    ///
    /// # Errors
    /// The thread cannot be started.
    pub(super) fn start(file: Option<File>) -> io::Result<Syncer> {
        match file {
            Some(file) => Syncer::of(move || file.sync_data()),
            None => {
                let (told, safe) = watch::channel(0);
                Ok(Syncer { asks: Asks::Nobody(told), safe, failure: watch::channel(None).1, last: 0, asked: 0 })
            }
        }
    }

    fn of(sync: impl Fn() -> io::Result<()> + Send + 'static) -> io::Result<Syncer> {
        let ((tell_safe, told), (tell_failure, failure)) = (watch::channel(0), watch::channel(None));
        let (wanted, marks) = channel();
        let tell = Tell { safe: tell_safe, failure: tell_failure };
        std::thread::Builder::new().name("event-log".to_owned()).spawn(move || work(&marks, &tell, sync))?;
        let (pass_on, safe) = watch::channel(0);
        tokio::spawn(exit_on_panic("what passes on what is safe on the disk", pass(told, pass_on)));
        Ok(Syncer { asks: Asks::Thread(wanted), safe, failure, last: 0, asked: 0 })
    }

    /// Marks everything noted so far, which is synced once it is written ([`Syncer::written`]).
    pub(super) fn mark(&mut self) -> Mark {
        self.last += 1;
        self.marked()
    }

    /// Everything marked has been written: it is synced as soon as possible.
    pub(super) fn written(&mut self) {
        if self.asked == self.last {
            return;
        }
        self.asked = self.last;
        match &self.asks {
            // A thread that has ended has reported why.
            Asks::Thread(wanted) => drop(wanted.send(self.last)),
            Asks::Nobody(safe) => drop(safe.send_replace(self.last)),
            Asks::GivenUp => {}
        }
    }

    /// Noted lines cannot be written: they and all later ones are never synced.
    pub(super) fn give_up(&mut self) {
        self.asks = Asks::GivenUp;
    }

    /// The mark of everything marked so far.
    pub(super) fn marked(&self) -> Mark {
        Mark { number: self.last, safe: self.safe.clone() }
    }

    /// Resolves with the reason when the log cannot be synced any more.
    pub(super) async fn failed(&self) -> Arc<str> {
        let mut failure = self.failure.clone();
        let looked = failure.wait_for(Option::is_some).await;
        let reason = looked.ok().and_then(|reason| reason.clone());
        match reason {
            Some(reason) => reason,
            // There is no thread.
            None => std::future::pending().await,
        }
    }
}

impl Mark {
    /// A mark that is not synced before its number, 1, is sent.
    #[cfg(test)]
    pub(super) fn not_yet() -> (watch::Sender<u64>, Mark) {
        let (told, safe) = watch::channel(0);
        (told, Mark { number: 1, safe })
    }

    /// Waits until everything before it is synced; false if it never will be.
    pub(super) async fn safe(mut self) -> bool {
        let number = self.number;
        // A thread that has ended has sent its last report.
        let _ = self.safe.wait_for(|safe| *safe >= number).await;
        *self.safe.borrow() >= number
    }
}

/// Forwards reports until there are no more.
async fn pass(mut told: watch::Receiver<u64>, on: watch::Sender<u64>) {
    while told.changed().await.is_ok() {
        let through = *told.borrow_and_update();
        on.send_replace(through);
    }
}

fn work(marks: &Receiver<u64>, tell: &Tell, sync: impl Fn() -> io::Result<()>) {
    while let Ok(mark) = marks.recv() {
        let through = marks.try_iter().last().unwrap_or(mark);
        match sync() {
            Ok(()) => tell.safe.send_modify(|safe| *safe = through),
            Err(error) => {
                // After an error, a later sync may succeed although data was lost.
                tell.failure.send_replace(Some(error.to_string().into()));
                return;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicUsize, Ordering};
    use std::time::Duration;

    impl Syncer {
        fn marked_and_written(&mut self) -> Mark {
            let mark = self.mark();
            self.written();
            mark
        }
    }

    #[tokio::test]
    async fn marks_that_come_while_the_disk_is_slow_are_safe_together() {
        let count = Arc::new(AtomicUsize::new(0));
        let counted = count.clone();
        let mut syncer = Syncer::of(move || {
            std::thread::sleep(Duration::from_millis(50));
            counted.fetch_add(1, Ordering::SeqCst);
            Ok(())
        })
        .expect("a thread");
        let first = syncer.marked_and_written();
        tokio::time::sleep(Duration::from_millis(10)).await;
        let others: Vec<Mark> = (0..10).map(|_| syncer.marked_and_written()).collect();
        assert!(first.safe().await);
        for mark in others {
            assert!(mark.safe().await);
        }
        assert!(count.load(Ordering::SeqCst) < 8, "eleven marks cost fewer looks");
    }

    #[tokio::test]
    async fn nothing_is_safe_behind_a_failure_and_it_is_told() {
        let looks = AtomicUsize::new(0);
        let mut syncer = Syncer::of(move || match looks.fetch_add(1, Ordering::SeqCst) {
            0 => Ok(()),
            _ => Err(io::Error::other("the disk is gone")),
        })
        .expect("a thread");
        let first = syncer.marked_and_written();
        assert!(first.clone().safe().await);
        assert!(!syncer.marked_and_written().safe().await);
        assert_eq!(&*syncer.failed().await, "the disk is gone");
        assert!(first.safe().await, "what was safe stays so");
        assert!(!syncer.marked_and_written().safe().await);
    }

    #[tokio::test]
    async fn nothing_is_safe_that_could_not_be_written() {
        for is_on_disk in [true, false] {
            let syncer = if is_on_disk { Syncer::of(|| Ok(())) } else { Syncer::start(None) };
            let mut syncer = syncer.expect("a thread");
            let first = syncer.marked_and_written();
            assert!(first.clone().safe().await);
            let noted = syncer.mark();
            syncer.give_up();
            syncer.written();
            assert!(!noted.safe().await && !syncer.marked().safe().await && !syncer.marked_and_written().safe().await);
            assert!(first.safe().await, "what was safe stays so");
        }
    }

    #[tokio::test]
    async fn without_a_disk_nobody_waits() {
        let mut syncer = Syncer::start(None).expect("no thread is needed");
        assert!(syncer.marked_and_written().safe().await);
    }
}
