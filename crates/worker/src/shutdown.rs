//! Ends a process after a signal, or after the end of its parent. Both only cancel a token, at which the server drains. A process that does
//! not drain in time is ended hard, so that none outlives its parent.

use crate::adoption::Adoption;
use crate::panic::{exit_on_panic, exit_on_panic_blocking};
use std::io::{self, Read};
use std::time::Duration;
use tokio::signal::unix::{SignalKind, signal};
use tokio_util::sync::CancellationToken;

/// Maximum time that a process lives after its parent's end.
pub const EXIT_GRACE: Duration = Duration::from_millis(900);
/// The exit code of a process that did not drain in time after a signal or its parent's end.
const EXIT_CODE_OVERDUE: i32 = 3;
/// The exit code after a second signal: 128 + SIGINT.
const EXIT_CODE_INTERRUPTED: i32 = 130;

/// Cancels `token` at SIGTERM or SIGINT; a second signal ends the process at once. Needs a tokio runtime.
///
/// # Errors
/// The signals cannot be caught.
pub fn on_signals(token: &CancellationToken) -> io::Result<()> {
    let (mut terminate, mut interrupt) = (signal(SignalKind::terminate())?, signal(SignalKind::interrupt())?);
    let token = token.clone();
    let watch = async move {
        let mut next = async || tokio::select! { _ = terminate.recv() => {}, _ = interrupt.recv() => {} };
        next().await;
        token.cancel();
        next().await;
        std::process::exit(EXIT_CODE_INTERRUPTED);
    };
    tokio::spawn(exit_on_panic("the watch of signals", watch));
    Ok(())
}

/// As [`on_signals`], for a process that drains: `patience` after the first signal the process is ended in any case. This runs in a thread
/// of its own, so that a runtime that hangs (a disk that does not answer) cannot prevent it.
///
/// # Errors
/// The signals cannot be caught, or the thread cannot be started.
pub fn on_signals_within(token: &CancellationToken, patience: Duration) -> io::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let entered = runtime.enter();
    let (mut terminate, mut interrupt) = (signal(SignalKind::terminate())?, signal(SignalKind::interrupt())?);
    drop(entered);
    let token = token.clone();
    let watch = move || {
        let mut next = async || tokio::select! { _ = terminate.recv() => {}, _ = interrupt.recv() => {} };
        runtime.block_on(async {
            next().await;
            token.cancel();
            if tokio::time::timeout(patience, next()).await.is_ok() {
                std::process::exit(EXIT_CODE_INTERRUPTED);
            }
            let patience_ms = u64::try_from(patience.as_millis()).unwrap_or(u64::MAX);
            tracing::error!(patience_ms, "the process did not end in time and is ended");
            std::process::exit(EXIT_CODE_OVERDUE);
        });
    };
    let watch = || exit_on_panic_blocking("the watch of signals", watch);
    std::thread::Builder::new().name("signals".to_owned()).spawn(watch)?;
    Ok(())
}

/// Watches standard input, a pipe that the parent holds open, in a thread of its own (a busy runtime cannot starve it). When the pipe is
/// closed, cancels `token` and, [`EXIT_GRACE`] later, ends the process. A process that may be adopted ([`crate::adoption`]) first waits for
/// a successor of its parent.
///
/// # Errors
/// The thread cannot be started, or the socket for a successor cannot be made.
pub fn exit_with_parent(token: &CancellationToken) -> io::Result<()> {
    let token = token.clone();
    let adoption = Adoption::from_environment()?;
    let watch = move || {
        until_it_ends(&mut io::stdin().lock());
        while let Some(mut successor) = adoption.as_ref().and_then(Adoption::successor) {
            until_it_ends(&mut successor);
        }
        token.cancel();
        std::thread::sleep(EXIT_GRACE);
        std::process::exit(EXIT_CODE_OVERDUE);
    };
    let watch = || exit_on_panic_blocking("the watch of the parent", watch);
    std::thread::Builder::new().name("exit-with-parent".to_owned()).spawn(watch)?;
    Ok(())
}

fn until_it_ends(input: &mut impl Read) {
    let mut ignored = [0_u8; 256];
    loop {
        match input.read(&mut ignored) {
            Ok(0) => return,
            Ok(_) => {}
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(_) => return,
        }
    }
}
