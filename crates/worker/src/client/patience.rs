//! Calls that may be repeated, because they only read or their request id makes them idempotent.

use super::CallError;
use std::time::Duration;

/// How often: for longer than a session lives ([`crate::session::DEFAULT_TTL`]), so that a daemon that comes back in time is met.
pub(crate) const TRIES: u32 = 16;
/// Between two of them.
pub const PAUSE: Duration = Duration::from_millis(250);

/// Repeats a call that was not answered, for 4 s in all; a refusal is an answer.
///
/// # Errors
/// That of the last one.
pub async fn patiently<T, F>(mut call: impl FnMut() -> F) -> Result<T, CallError>
where
    F: Future<Output = Result<T, CallError>>,
{
    for _ in 1..TRIES {
        match call().await {
            Err(error) if error.is_crash() => tokio::time::sleep(PAUSE).await,
            answer => return answer,
        }
    }
    call().await
}

/// As [`patiently`], for as long as it takes: for calls that somebody else ends, when the session is given up.
///
/// # Errors
/// A refusal.
pub async fn until_answered<T, F>(mut call: impl FnMut() -> F) -> Result<T, CallError>
where
    F: Future<Output = Result<T, CallError>>,
{
    loop {
        match call().await {
            Err(error) if error.is_crash() => tokio::time::sleep(PAUSE).await,
            answer => return answer,
        }
    }
}
