//! Calls that may be repeated because their request id makes them idempotent.

use ratn_worker::client::CallError;
use std::time::Duration;

/// How often and how soon.
#[derive(Debug, Clone, Copy)]
pub(super) struct Attempts {
    count: u32,
    between: Duration,
}

impl Attempts {
    /// For whatever is idempotent: for longer than a session lives, so that a daemon that comes back while the run's lives is met.
    pub(super) const IDEMPOTENT: Attempts = Attempts { count: 16, between: Duration::from_millis(250) };
}

impl Attempts {
    /// Between two of them.
    pub(super) fn pause(self) -> Duration {
        self.between
    }
}

/// Repeats a call whose answer was lost; a refusal is an answer.
pub(super) async fn patiently<T, F>(attempts: Attempts, mut call: impl FnMut() -> F) -> Result<T, CallError>
where
    F: Future<Output = Result<T, CallError>>,
{
    let mut left = attempts.count;
    loop {
        left -= 1;
        match call().await {
            Err(error) if error.is_crash() && left > 0 => tokio::time::sleep(attempts.between).await,
            answer => return answer,
        }
    }
}
