//! A thread with a runtime of its own, for what has to go on while that of the command decides or waits for the disk: keeping a
//! session alive, hearing the user.
//!
//! Commands run on one thread, because what an event leads to is then done without waking another; this is the price of that.

use std::io;
use tokio::runtime::{Builder, Handle};
use tokio_util::sync::{CancellationToken, DropGuard};

/// It ends with this.
#[derive(Debug)]
pub(crate) struct Aside {
    runtime: Handle,
    _over: DropGuard,
}

impl Aside {
    /// Starts it, under this name.
    ///
    /// # Errors
    /// Where there can be no further thread.
    pub(crate) fn start(name: &str) -> io::Result<Aside> {
        let runtime = Builder::new_current_thread().enable_all().build()?;
        let (handle, over) = (runtime.handle().clone(), CancellationToken::new());
        let ends = over.clone();
        std::thread::Builder::new().name(name.to_owned()).spawn(move || runtime.block_on(ends.cancelled()))?;
        Ok(Aside { runtime: handle, _over: over.drop_guard() })
    }

    /// Does something whose tasks are this thread's.
    pub(crate) fn within<T>(&self, act: impl FnOnce() -> T) -> T {
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
    fn what_is_begun_aside_goes_on_while_the_command_is_busy() {
        let aside = Aside::start("aside").unwrap();
        let (told, answer) = oneshot::channel();
        aside.within(|| tokio::spawn(async move { told.send(std::thread::current().name().map(str::to_owned)) }));
        // This thread does nothing else.
        assert_eq!(answer.blocking_recv().unwrap().as_deref(), Some("aside"));
    }
}
