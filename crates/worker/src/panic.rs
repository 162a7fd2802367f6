//! A panic in a task or thread that the process cannot do without ends the process, so that its supervisor (systemd, a process manager)
//! starts another one. Otherwise only the task or thread would end, and the process would go on without it, unnoticed.
//!
//! A panic in an action is not handled here: its goal is aborted (`action/run.rs`). The core of a daemon reports its panic to its
//! [`crate::vitals::Vitals`], which end serving, too.

use crate::vitals::CoreFailure;
use futures::FutureExt;
use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};

/// Performs `work`. A panic in it ends the process with [`crate::vitals::EXIT_CODE_PANICKED`]; the log names `part` as the part that
/// panicked.
pub async fn exit_on_panic<T>(part: &str, work: impl Future<Output = T>) -> T {
    AssertUnwindSafe(work).catch_unwind().await.unwrap_or_else(|panic| exit(part, &*panic))
}

/// As [`exit_on_panic`], for work that blocks its thread.
pub fn exit_on_panic_blocking<T>(part: &str, work: impl FnOnce() -> T) -> T {
    catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|panic| exit(part, &*panic))
}

fn exit(part: &str, panic: &(dyn Any + Send)) -> ! {
    let failure = CoreFailure::of_panic(part, panic);
    tracing::error!(%failure, "the process ends");
    std::process::exit(failure.exit_code().into())
}
