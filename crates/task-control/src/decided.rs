//! Repeats a call whose effect has been decided (a commit, an operation, the release of a lease, a withdrawal), so that the run cannot do without it.
//! The call is repeated while it is not answered, for 30 s while it is refused because of load, and only while the run's session keeps its resources:
//! others may have acquired and changed what a run has lost. This is checked before every try, because a try may hang for longer than a session
//! lives.

use crate::performer::Overtaken;
use crate::record::said;
use ratn_worker::client::{CallError, LoadPatience};
use ratn_worker::session::Trust;
use std::fmt;
use std::time::Duration;

/// Maximum number of tries while a server cannot be reached, unless the run waits for it as long as for the resource manager: the pauses total 4 s.
const TRIES: u32 = 16;

/// How long the run repeats a call that is refused because of load. A limit may stay reached: nobody removes the resources that a run has created itself.
pub(super) const REFUSED_PATIENCE: Duration = Duration::from_secs(30);

/// How long to wait for a server that does not answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Unanswered {
    /// For [`TRIES`] tries.
    GivenUp,
    /// As long as the session is kept.
    Waits,
}

/// Why a call was not done.
#[derive(Debug, Clone)]
pub(super) enum Undone {
    /// The session was lost before. If there was a last try, it is unknown whether it was performed.
    Lost,
    /// Others have changed the facts that the call is based on.
    Overtaken(Overtaken),
    /// The call was refused, or not answered.
    Failed(CallError),
}

impl fmt::Display for Undone {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Undone::Lost => write!(
                f,
                "the run's session was lost before, and whoever had its resources since may have changed the same"
            ),
            Undone::Overtaken(overtaken) => write!(f, "{overtaken}"),
            Undone::Failed(error) => write!(f, "{}", said(error)),
        }
    }
}

/// Knows whether the run has kept its session and resources.
pub(super) trait Keeps: Clone {
    /// Whether the run has kept them. Waits while this is unknown.
    async fn is_kept(&mut self) -> bool;
    /// Resolves when the run has lost them.
    async fn gone(&self);
}

impl Keeps for Trust {
    async fn is_kept(&mut self) -> bool {
        Trust::is_kept(self).await
    }

    async fn gone(&self) {
        Trust::gone(self).await;
    }
}

/// Makes a call until it is done, finally refused, or must not be made any more.
///
/// # Errors
/// [`Undone`].
pub(super) async fn insist<T, F>(
    keeps: &impl Keeps,
    unanswered: Unanswered,
    mut call: impl FnMut() -> F,
) -> Result<T, Undone>
where
    F: Future<Output = Result<T, CallError>>,
{
    insist_for(REFUSED_PATIENCE, keeps, unanswered, &mut call).await
}

async fn insist_for<T, F>(
    patience: Duration,
    keeps: &impl Keeps,
    unanswered: Unanswered,
    call: &mut impl FnMut() -> F,
) -> Result<T, Undone>
where
    F: Future<Output = Result<T, CallError>>,
{
    let mut keeps = keeps.clone();
    let (mut tries, mut patience) = (0, LoadPatience::new(patience));
    loop {
        if !keeps.is_kept().await {
            return Err(Undone::Lost);
        }
        let answer = tokio::select! {
            biased;
            answer = call() => answer,
            () = keeps.gone() => return Err(Undone::Lost),
        };
        let error = match answer {
            Ok(done) => return Ok(done),
            Err(error) => error,
        };
        tries += u32::from(error.is_crash() && unanswered == Unanswered::GivenUp);
        match patience.again_after(&error) {
            Some(pause) if tries < TRIES => tokio::time::sleep(pause).await,
            _ => return Err(Undone::Failed(error)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ratn_worker::endpoint::Endpoint;
    use std::cell::{Cell, RefCell};
    use std::rc::Rc;
    use tonic::{Code, Status};
    use tonic_types::{ErrorDetails, StatusExt};

    /// Keeps its resources until its token is cancelled; counts how often it is asked.
    #[derive(Clone, Default)]
    struct Kept(tokio_util::sync::CancellationToken, Rc<Cell<u32>>);

    impl Keeps for Kept {
        async fn is_kept(&mut self) -> bool {
            self.1.set(self.1.get() + 1);
            !self.0.is_cancelled()
        }

        async fn gone(&self) {
            self.0.cancelled().await;
        }
    }

    fn failed(status: &Status) -> CallError {
        let endpoint = Endpoint::Unix("/nowhere".into());
        CallError::from_status(&endpoint, status)
    }

    fn busy() -> CallError {
        let details = ErrorDetails::with_retry_info(Some(Duration::from_millis(10)));
        failed(&Status::with_error_details(Code::ResourceExhausted, "busy", details))
    }

    #[tokio::test]
    async fn whether_the_session_is_kept_is_asked_before_every_try() {
        let (kept, calls) = (Kept::default(), Cell::new(0));
        let silent = || {
            calls.set(calls.get() + 1);
            if calls.get() == 2 {
                kept.0.cancel();
            }
            std::future::ready(Err::<(), _>(failed(&Status::unavailable("nobody"))))
        };
        assert!(matches!(insist(&kept, Unanswered::Waits, silent).await, Err(Undone::Lost)));
        assert_eq!((calls.get(), kept.1.get()), (2, 3));
        // A hanging try is abandoned.
        let kept = Kept::default();
        let hangs = || {
            kept.0.cancel();
            std::future::pending::<Result<(), CallError>>()
        };
        assert!(matches!(insist(&kept, Unanswered::Waits, hangs).await, Err(Undone::Lost)));
    }

    #[tokio::test]
    async fn what_was_decided_is_tried_again_whoever_has_too_much_to_do() {
        let answers = |all: Vec<Result<u32, CallError>>| RefCell::new(all.into_iter());
        let insisted = async |unanswered, all: Vec<Result<u32, CallError>>| {
            let answers = answers(all);
            let next = || std::future::ready(answers.borrow_mut().next().unwrap_or(Ok(0)));
            insist(&Kept::default(), unanswered, next).await
        };
        let mut long: Vec<_> = (0..2 * TRIES).map(|_| Err(busy())).collect();
        long.push(Ok(7));
        assert!(matches!(insisted(Unanswered::GivenUp, long).await, Ok(7)));
        // A limit that stays reached is reported.
        let short = Duration::from_millis(100);
        let full = &mut || std::future::ready(Err::<(), _>(busy()));
        let refused = insist_for(short, &Kept::default(), Unanswered::Waits, full).await;
        assert!(matches!(&refused, Err(Undone::Failed(error)) if error.to_string() == "busy"), "{refused:?}");
        let wrong = Err(failed(&Status::failed_precondition("another root")));
        let refused = insisted(Unanswered::Waits, vec![Err(busy()), wrong]).await;
        assert!(matches!(&refused, Err(Undone::Failed(error)) if error.to_string() == "another root"), "{refused:?}");
    }
}
