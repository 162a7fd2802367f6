//! What was written of a run is made safe on the disk beside everything else: only what cannot be undone waits for that.
//!
//! A thread makes the event log safe when it is asked to; everything that was written before one look at the disk is safe after it, so many marks
//! that come meanwhile cost one more look. Its word goes to one task of the run, and from there to all that wait: each that the thread told itself would
//! cost it a system call, and they would not go on together.

use ratn_worker::panic::exit_on_panic;
use std::fs::File;
use std::io;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, channel};
use tokio::sync::watch;

/// Makes the log safe. Ends its thread when it is dropped.
#[derive(Debug)]
pub(super) struct Syncer {
    /// `None` where there is no disk.
    wanted: Option<Sender<u64>>,
    /// Through which mark it is safe. Closed when no more will be.
    safe: watch::Receiver<u64>,
    /// Why no more will be.
    failure: watch::Receiver<Option<Arc<str>>>,
    last: u64,
    /// The last mark that the thread was asked for.
    asked: u64,
}

/// A place in the log: what cannot be undone waits until everything before it is safe.
#[derive(Debug, Clone)]
pub(super) struct Mark {
    number: u64,
    safe: watch::Receiver<u64>,
}

/// What the thread tells.
#[derive(Debug)]
struct Tell {
    safe: watch::Sender<u64>,
    failure: watch::Sender<Option<Arc<str>>>,
}

impl Syncer {
    /// Of a file that others write; `None`: it is on no disk. Within a tokio runtime.
    ///
    /// # Errors
    /// Where the thread cannot be started.
    pub(super) fn start(file: Option<File>) -> io::Result<Syncer> {
        let Some(file) = file else { return Ok(Syncer::telling().0) };
        Syncer::of(move || file.sync_data())
    }

    fn of(sync: impl Fn() -> io::Result<()> + Send + 'static) -> io::Result<Syncer> {
        let ((mut syncer, tell), (wanted, marks)) = (Syncer::telling(), channel());
        std::thread::Builder::new().name("event-log".to_owned()).spawn(move || work(&marks, &tell, sync))?;
        let (pass_on, safe) = watch::channel(0);
        let told = std::mem::replace(&mut syncer.safe, safe);
        tokio::spawn(exit_on_panic("what passes on what is safe on the disk", pass(told, pass_on)));
        Ok(Syncer { wanted: Some(wanted), ..syncer })
    }

    fn telling() -> (Syncer, Tell) {
        let ((safe, is_safe), (failure, has_failed)) = (watch::channel(0), watch::channel(None));
        let syncer = Syncer { wanted: None, safe: is_safe, failure: has_failed, last: 0, asked: 0 };
        (syncer, Tell { safe, failure })
    }

    /// Everything that is noted so far, which is to be made safe once it is written ([`Syncer::written`]).
    pub(super) fn mark(&mut self) -> Mark {
        self.last += u64::from(self.wanted.is_some());
        self.marked()
    }

    /// Everything that was marked is written: it is made safe as soon as possible.
    pub(super) fn written(&mut self) {
        if let Some(wanted) = self.wanted.as_ref().filter(|_| self.asked < self.last) {
            self.asked = self.last;
            // Where the thread is gone it has said why.
            let _ = wanted.send(self.last);
        }
    }

    /// What was marked and is not written never will be: nothing that waits for it is done.
    pub(super) fn give_up(&mut self) {
        self.wanted = None;
    }

    /// Everything that was marked so far.
    pub(super) fn marked(&self) -> Mark {
        Mark { number: self.last, safe: self.safe.clone() }
    }

    /// Resolves when the log cannot be made safe any more, with the reason.
    pub(super) async fn failed(&self) -> Arc<str> {
        let mut failure = self.failure.clone();
        let looked = failure.wait_for(Option::is_some).await;
        let reason = looked.ok().and_then(|reason| reason.clone());
        match reason {
            Some(reason) => reason,
            // There is no thread that could.
            None => std::future::pending().await,
        }
    }
}

impl Mark {
    /// One that is not safe before its number, 1, is sent.
    #[cfg(test)]
    pub(super) fn not_yet() -> (watch::Sender<u64>, Mark) {
        let (told, safe) = watch::channel(0);
        (told, Mark { number: 1, safe })
    }

    /// Waits until everything before it is safe; false where it never will be.
    pub(super) async fn safe(mut self) -> bool {
        let number = self.number;
        // Where the thread is gone it has said the last that is to be said.
        let _ = self.safe.wait_for(|safe| *safe >= number).await;
        *self.safe.borrow() >= number
    }
}

/// Until no more is said.
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
                // What a disk has lost once it may not tell again.
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
    async fn what_is_marked_and_cannot_be_written_is_never_safe() {
        let mut syncer = Syncer::of(|| Ok(())).expect("a thread");
        assert!(syncer.marked_and_written().safe().await);
        let mark = syncer.mark();
        syncer.give_up();
        assert!(!syncer.marked_and_written().safe().await);
        assert!(!mark.safe().await);
    }

    #[tokio::test]
    async fn without_a_disk_nobody_waits() {
        let mut syncer = Syncer::start(None).expect("no thread is needed");
        assert!(syncer.marked_and_written().safe().await);
    }
}
