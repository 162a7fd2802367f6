//! The threads in which goals run Python. The interpreter's state for a thread is made once per thread and not per goal, so that
//! `threading.local` also lasts from one goal to the next.

use pyo3::prelude::*;
use std::sync::mpsc::{Sender, channel};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::Duration;
use tokio::sync::oneshot;

type Work = Box<dyn FnOnce(Python<'_>, Finished) + Send>;

/// A thread pool: it has as many threads as goals ever ran at once. Clones share it.
#[derive(Clone, Default)]
pub(crate) struct Threads(Arc<Shared>);

#[derive(Default)]
struct Shared {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Default)]
struct State {
    /// Channels of the idle threads; the last one is used first.
    idle: Vec<Sender<Work>>,
    /// Number of threads.
    alive: usize,
    is_over: bool,
}

/// A thread that has finished its work and waits for more.
struct Finished {
    shared: Arc<Shared>,
    thread: Sender<Work>,
}

impl Finished {
    fn rest(self) {
        let mut state = self.shared.state();
        if !state.is_over {
            state.idle.push(self.thread);
        }
    }
}

impl Shared {
    fn state(&self) -> std::sync::MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Threads {
    /// Runs `work` in a thread that runs nothing else meanwhile. The receiver gets nothing if `work` panicked. An error if no further
    /// thread can be started.
    pub(crate) fn run<T: Send + 'static>(
        &self,
        work: impl FnOnce(Python<'_>) -> T + Send + 'static,
    ) -> std::io::Result<oneshot::Receiver<T>> {
        let (say, done) = oneshot::channel();
        let work: Work = Box::new(move |py, finished| {
            let result = work(py);
            // Before the result is sent, because its receiver may have the next work at once.
            finished.rest();
            let _ = say.send(result);
        });
        let idle = self.0.state().idle.pop();
        match idle {
            // The thread ends only when its channel is closed.
            Some(thread) => drop(thread.send(work)),
            None => self.begin(work)?,
        }
        Ok(done)
    }

    fn begin(&self, first: Work) -> std::io::Result<()> {
        let shared = Arc::clone(&self.0);
        let alive = Alive::new(Arc::clone(&self.0));
        std::thread::Builder::new().name("goal".to_owned()).spawn(move || {
            let _alive = alive;
            Python::attach(|py| {
                let mut next = Some(first);
                while let Some(work) = next {
                    let (thread, more) = channel();
                    work(py, Finished { shared: Arc::clone(&shared), thread });
                    // `None` when all senders are gone.
                    next = py.detach(move || more.recv().ok());
                }
            });
        })?;
        Ok(())
    }

    /// Ends all idle threads, and waits for the others at most for `patience`.
    pub(crate) fn end(&self, patience: Duration) {
        let mut state = self.0.state();
        state.is_over = true;
        state.idle.clear();
        let waited = self.0.changed.wait_timeout_while(state, patience, |state| state.alive > 0);
        drop(waited);
    }
}

/// Counts one existing thread.
struct Alive(Arc<Shared>);

impl Alive {
    fn new(shared: Arc<Shared>) -> Alive {
        shared.state().alive += 1;
        Alive(shared)
    }
}

impl Drop for Alive {
    fn drop(&mut self) {
        self.0.state().alive -= 1;
        self.0.changed.notify_all();
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    /// The thread in which work runs.
    async fn thread(threads: &Threads) -> std::thread::ThreadId {
        threads.run(|_| std::thread::current().id()).unwrap().await.unwrap()
    }

    #[tokio::test]
    async fn a_thread_serves_one_after_the_other_and_another_one_beside_it() {
        Python::initialize();
        let threads = Threads::default();
        let first = thread(&threads).await;
        assert_eq!(thread(&threads).await, first);
        let (go_on, wait) = channel::<()>();
        let busy = threads.run(move |py| py.detach(move || wait.recv().is_ok())).unwrap();
        assert_ne!(thread(&threads).await, first);
        go_on.send(()).unwrap();
        assert!(busy.await.unwrap());
        let fallen = threads.run(|_| -> () { std::panic::resume_unwind(Box::new(())) }).unwrap();
        assert!(fallen.await.is_err(), "who panics says nothing");
        tokio::task::spawn_blocking(move || {
            threads.end(Duration::from_secs(10));
            assert_eq!(threads.0.state().alive, 0);
        })
        .await
        .unwrap();
    }
}
