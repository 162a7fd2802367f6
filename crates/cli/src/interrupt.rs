//! Ctrl-C, SIGTERM and SIGHUP, as something that every part of a command can wait for.
//!
//! The first asks to end in order, the second to end at once, the third ends the process.

use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::watch;

const EXIT_CODE_INTERRUPTED: i32 = 130;
const PATIENCE: u32 = 3;

/// How often the user has asked this process to end.
#[derive(Debug, Clone)]
pub(crate) struct Interrupt {
    count: watch::Receiver<u32>,
}

impl Interrupt {
    /// Begins to listen. Needs a tokio runtime.
    ///
    /// # Errors
    /// Where the signals cannot be caught.
    pub(crate) fn listen() -> std::io::Result<Interrupt> {
        let (mut interrupt, mut terminate, mut hangup) =
            (signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?, signal(SignalKind::hangup())?);
        let (counter, count) = watch::channel(0);
        tokio::spawn(async move {
            for n in 1..PATIENCE {
                tokio::select! { _ = interrupt.recv() => {}, _ = terminate.recv() => {}, _ = hangup.recv() => {} }
                counter.send_replace(n);
            }
            tokio::select! { _ = interrupt.recv() => {}, _ = terminate.recv() => {}, _ = hangup.recv() => {} }
            std::process::exit(EXIT_CODE_INTERRUPTED);
        });
        Ok(Interrupt { count })
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
