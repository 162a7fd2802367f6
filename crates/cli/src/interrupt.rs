//! Ctrl-C, SIGTERM and SIGHUP: every part of a command can wait for them.
//!
//! The first asks for an orderly end, the second for an immediate one, the third ends the process.

use ratn_task_control::{BackgroundRuntime, Interrupt as Asked};
use ratn_worker::panic::exit_on_panic;
use std::ops::Deref;
use std::sync::Arc;
use tokio::signal::unix::{SignalKind, signal};

const EXIT_CODE_INTERRUPTED: i32 = 130;
const PATIENCE: u32 = 3;

/// How often the user has asked this process to end.
#[derive(Debug, Clone)]
pub(crate) struct Interrupt {
    asked: Asked,
    _runtime: Arc<BackgroundRuntime>,
}

impl Interrupt {
    /// Begins to listen in a separate thread, so that a command that hangs can be ended, too.
    ///
    /// # Errors
    /// Where the signals cannot be caught.
    pub(crate) fn listen() -> std::io::Result<Interrupt> {
        let runtime = BackgroundRuntime::start("signals")?;
        let signals = [SignalKind::interrupt(), SignalKind::terminate(), SignalKind::hangup()];
        let [interrupt, terminate, hangup] = runtime.enter(|| signals.map(signal));
        let (mut interrupt, mut terminate, mut hangup) = (interrupt?, terminate?, hangup?);
        let (asks, asked) = Asked::new();
        let listening = async move {
            for _ in 1..PATIENCE {
                tokio::select! { _ = interrupt.recv() => {}, _ = terminate.recv() => {}, _ = hangup.recv() => {} }
                asks.ask();
            }
            tokio::select! { _ = interrupt.recv() => {}, _ = terminate.recv() => {}, _ = hangup.recv() => {} }
            std::process::exit(EXIT_CODE_INTERRUPTED);
        };
        runtime.enter(|| tokio::spawn(exit_on_panic("the watch of signals", listening)));
        Ok(Interrupt { asked, _runtime: Arc::new(runtime) })
    }
}

impl Deref for Interrupt {
    type Target = Asked;

    fn deref(&self) -> &Asked {
        &self.asked
    }
}
