//! A tokio runtime in a thread of its own. Its tasks go on while the runtime of the command is busy or waits for the disk: they keep a
//! session alive and listen for signals.
//!
//! A command runs on one thread, so that an event is handled without waking another thread. What must not wait for it runs here.

use std::io;
use tokio::runtime::{Builder, Handle};
use tokio_util::sync::{CancellationToken, DropGuard};

/// The thread ends when this is dropped.
#[derive(Debug)]
pub struct BackgroundRuntime {
    runtime: Handle,
    _over: DropGuard,
}

impl BackgroundRuntime {
    /// Starts the thread, under this name.
    ///
    /// # Errors
    /// Where the thread or the runtime cannot be made.
    pub fn start(name: &str) -> io::Result<BackgroundRuntime> {
        let runtime = Builder::new_current_thread().enable_all().build()?;
        let (handle, over) = (runtime.handle().clone(), CancellationToken::new());
        let ends = over.clone();
        std::thread::Builder::new().name(name.to_owned()).spawn(move || runtime.block_on(ends.cancelled()))?;
        Ok(BackgroundRuntime { runtime: handle, _over: over.drop_guard() })
    }

    /// Calls `act` within the runtime: the tasks that it spawns run in this thread.
    pub fn enter<T>(&self, act: impl FnOnce() -> T) -> T {
        let _entered = self.runtime.enter();
        act()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use tokio::sync::oneshot;

    #[test]
    fn a_task_of_the_background_runtime_goes_on_while_the_command_is_busy() {
        let background = BackgroundRuntime::start("background").unwrap();
        let (told, answer) = oneshot::channel();
        background.enter(|| tokio::spawn(async move { told.send(std::thread::current().name().map(str::to_owned)) }));
        // This thread does nothing else.
        assert_eq!(answer.blocking_recv().unwrap().as_deref(), Some("background"));
    }
}
