//! Ctrl-C, SIGTERM and SIGHUP, as something that every part of a command can wait for.
//!
//! The first asks to end in order, the second to end at once, the third ends the process.

use crate::background_runtime::BackgroundRuntime;
use ratn_worker::panic::exit_on_panic;
use std::sync::Arc;
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::watch;

const EXIT_CODE_INTERRUPTED: i32 = 130;
const PATIENCE: u32 = 3;

/// How often the user has asked this process to end.
#[derive(Debug, Clone)]
pub(crate) struct Interrupt {
    count: watch::Receiver<u32>,
    _runtime: Arc<BackgroundRuntime>,
}

impl Interrupt {
    /// Begins to listen, in a thread of its own: a command that hangs is ended, too.
    ///
    /// # Errors
    /// Where the signals cannot be caught.
    pub(crate) fn listen() -> std::io::Result<Interrupt> {
        let runtime = BackgroundRuntime::start("signals")?;
        let signals = [SignalKind::interrupt(), SignalKind::terminate(), SignalKind::hangup()];
        let [interrupt, terminate, hangup] = runtime.enter(|| signals.map(signal));
        let (mut interrupt, mut terminate, mut hangup) = (interrupt?, terminate?, hangup?);
        let (counter, count) = watch::channel(0);
        let listening = async move {
            for n in 1..PATIENCE {
                tokio::select! { _ = interrupt.recv() => {}, _ = terminate.recv() => {}, _ = hangup.recv() => {} }
                counter.send_replace(n);
            }
            tokio::select! { _ = interrupt.recv() => {}, _ = terminate.recv() => {}, _ = hangup.recv() => {} }
            std::process::exit(EXIT_CODE_INTERRUPTED);
        };
        runtime.enter(|| tokio::spawn(exit_on_panic("the watch of signals", listening)));
        Ok(Interrupt { count, _runtime: Arc::new(runtime) })
    }

    /// Whether the user asked this process to end.
    pub(crate) fn asked(&self) -> bool {
        *self.count.borrow() > 0
    }

    /// Resolves once the user has asked `times` times.
    pub(crate) async fn asked_times(&self, times: u32) {
        let mut count = self.count.clone();
        if count.wait_for(|n| *n >= times).await.is_err() {
            std::future::pending::<()>().await;
        }
    }
}
