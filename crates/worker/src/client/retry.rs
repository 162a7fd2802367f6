//! Retries of calls that are idempotent: they only read, or their request id makes the server answer a repetition as before.

use super::CallError;
use std::time::Duration;

/// The number of tries: for longer than a session lives ([`crate::session::DEFAULT_TTL`]), so that a daemon that is started again in time is reached.
pub(crate) const TRIES: u32 = 16;
/// The pause between two tries.
pub const PAUSE: Duration = Duration::from_millis(250);

/// Repeats a call that was not answered, for 4 s in all. A refusal is an answer.
///
/// # Errors
/// The error of the last try.
pub async fn retry_unanswered<T, F>(mut call: impl FnMut() -> F) -> Result<T, CallError>
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

/// As [`retry_unanswered`], without a bound: for calls that the caller drops when it gives its session up.
///
/// # Errors
/// A refusal.
pub async fn retry_until_answered<T, F>(mut call: impl FnMut() -> F) -> Result<T, CallError>
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
