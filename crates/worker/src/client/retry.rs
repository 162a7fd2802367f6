//! Retries of idempotent calls: they only read, or their request id makes the server answer a repetition as it did before.
//!
//! [`CallError::again_after`] decides what is retried and when: a call that was not answered after [`PAUSE`], and a call that was refused
//! because of load when the server says so. Every other refusal is an answer. The two functions differ in how long they retry.

use super::CallError;
use std::time::{Duration, Instant};

/// Number of tries. They last longer than a session's time to live ([`crate::session::DEFAULT_TTL`]), so that a daemon that restarts in
/// time is reached.
pub(crate) const TRIES: u32 = 16;
/// Pause between two tries of a call that is not answered.
pub const PAUSE: Duration = Duration::from_millis(250);

/// Retries a call that was not answered, or was refused because of load, up to 16 times with pauses of 4 s in total. A try that hangs adds
/// its own time, which the connection bounds.
///
/// # Errors
/// The error of the last try.
pub async fn retry_unanswered<T, F>(mut call: impl FnMut() -> F) -> Result<T, CallError>
where
    F: Future<Output = Result<T, CallError>>,
{
    for _ in 1..TRIES {
        match call().await {
            Err(error) if let Some(pause) = error.again_after() => tokio::time::sleep(pause).await,
            answer => return answer,
        }
    }
    call().await
}

/// Retries a call as long as it is not answered, for calls whose future the caller drops when it gives up its session. A call that is
/// refused because of load is retried for `patience`, counted anew after every try that failed otherwise.
///
/// # Errors
/// A refusal.
pub async fn retry_until_answered<T, F>(patience: Duration, mut call: impl FnMut() -> F) -> Result<T, CallError>
where
    F: Future<Output = Result<T, CallError>>,
{
    let mut patience = LoadPatience::new(patience);
    loop {
        match call().await {
            Err(error) if let Some(pause) = patience.again_after(&error) => tokio::time::sleep(pause).await,
            answer => return answer,
        }
    }
}

/// How long a call that is refused because of load is retried, counted anew after every try that failed otherwise: a limit may stay
/// reached.
#[derive(Debug)]
pub struct LoadPatience {
    patience: Duration,
    refused_since: Option<Instant>,
}

impl LoadPatience {
    /// A retry policy with this patience.
    pub fn new(patience: Duration) -> LoadPatience {
        LoadPatience { patience, refused_since: None }
    }

    /// As [`CallError::again_after`]; `None` also if the patience is exhausted.
    pub fn again_after(&mut self, error: &CallError) -> Option<Duration> {
        let pause = error.again_after()?;
        if error.is_crash() {
            self.refused_since = None;
            return Some(pause);
        }
        let is_over = self.refused_since.get_or_insert_with(Instant::now).elapsed() >= self.patience;
        (!is_over).then_some(pause)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use crate::endpoint::Endpoint;
    use std::cell::Cell;
    use tonic::{Code, Status};
    use tonic_types::{ErrorDetails, StatusExt};

    fn failed(status: &Status) -> CallError {
        CallError::from_status(&"http://a:1".parse::<Endpoint>().unwrap(), status)
    }

    fn behind() -> CallError {
        let mut details = ErrorDetails::with_error_info("STORAGE_BEHIND", "ratn", []);
        details.set_retry_info(Some(Duration::from_millis(10)));
        failed(&Status::with_error_details(Code::ResourceExhausted, "the disk is behind", details))
    }

    #[test]
    fn what_is_refused_for_load_says_when_it_is_asked_again_and_no_other_refusal_does() {
        assert_eq!(behind().again_after(), Some(Duration::from_millis(10)));
        assert_eq!(failed(&Status::unavailable("nobody")).again_after(), Some(PAUSE));
        assert_eq!(failed(&Status::resource_exhausted("a second goal")).again_after(), None);
        let mut details = ErrorDetails::with_retry_info(Some(Duration::from_secs(3_600)));
        let late = Status::with_error_details(Code::ResourceExhausted, "", details.clone());
        assert_eq!(
            failed(&late).again_after(),
            Some(Duration::from_secs(5)),
            "a server does not stop a run for an hour"
        );
        details.set_retry_info(Some(Duration::ZERO));
        let now = Status::with_error_details(Code::ResourceExhausted, "", details.clone());
        assert_eq!(failed(&now).again_after(), Some(Duration::from_millis(10)));
        let other = Status::with_error_details(Code::FailedPrecondition, "", details);
        assert_eq!(failed(&other).again_after(), None);
    }

    #[tokio::test]
    async fn a_call_that_is_refused_for_load_is_made_again_until_its_time_is_over() {
        let calls = Cell::new(0);
        let taken_at = |last: u32| {
            calls.set(calls.get() + 1);
            let answer = if calls.get() < last { Err(behind()) } else { Ok(calls.get()) };
            std::future::ready(answer)
        };
        assert_eq!(retry_unanswered(|| taken_at(5)).await.unwrap(), 5);
        calls.set(0);
        assert_eq!(retry_unanswered(|| taken_at(99)).await.unwrap_err().reason(), "STORAGE_BEHIND");
        assert_eq!(calls.get(), TRIES);
        calls.set(0);
        assert_eq!(retry_until_answered(Duration::from_secs(60), || taken_at(30)).await.unwrap(), 30);
        calls.set(0);
        let refused = retry_until_answered(Duration::ZERO, || taken_at(30)).await.unwrap_err();
        assert_eq!((calls.get(), refused.to_string()), (1, "the disk is behind".to_owned()));
    }
}
