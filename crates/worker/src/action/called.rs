//! The goals that a goal gives to other providers under its lease ([`super::GoalContext::call`]).
//!
//! A lease goes back when the goals under it are over, so a goal is over when the goals that it gave are: a call whose future is dropped is told to
//! stop, and its end is waited for. Where the connection breaks, its end is asked for again over another one. What does not end in time, or ends
//! unheard, is unknown.
//!
//! ```text
//! given ─ its end is heard ─────────────────────────────────────────→ over
//!   ├─ the connection breaks ─ attach ─ its end is heard ───────────→ over
//!   │                            └─ the provider does not know it, or is not reached ─ cancel, attach ─┐
//!   └─ the call is dropped, the caller stops or has returned ─ cancel ─┬───────────────────────────────┘
//!                                                                      ├─ its end is heard ─→ over
//!                                                                      └─ not in time ──────→ over, unknown
//! ```

use super::run::STOP_GRACE;
use crate::client::{ActionClient, CallError, Fate};
use crate::endpoint::Endpoint;
use crate::panic::exit_on_panic;
use crate::trace;
use ratn_proto::types::{Goal, GoalOutcome};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;
use tokio::sync::oneshot;
use tokio_util::sync::{CancellationToken, DropGuard};
use tokio_util::task::TaskTracker;
use tracing::Instrument;

/// How long the end of a call that was told to stop is waited for: a provider says after [`STOP_GRACE`] that a goal has not ended.
const STOPS_WITHIN: Duration = STOP_GRACE.saturating_add(Duration::from_millis(500));

/// How long a called goal goes on without a listener: for as long as it may take to attach to it over another connection. A call that is dropped is
/// told to stop at once.
pub(super) const CALL_GRACE_MS: u64 = 1_000;

/// The calls of one goal.
#[derive(Debug, Default)]
pub(crate) struct Calls {
    under_way: TaskTracker,
    /// Cancelled when all of them have to end, and no other begins.
    end: CancellationToken,
    is_unknown: Arc<AtomicBool>,
}

/// A call under way. Dropping it tells the called goal to stop.
pub(super) struct Call {
    outcome: oneshot::Receiver<Result<GoalOutcome, CallError>>,
    stop: DropGuard,
}

impl Calls {
    /// Gives a goal to another provider; `None` if the goal that calls is over.
    pub(super) fn give(&self, client: ActionClient, endpoint: Endpoint, goal: Goal) -> Option<Call> {
        // Whoever waits for the calls counts this one, or has said before that no other begins.
        let counted = self.under_way.token();
        if self.end.is_cancelled() {
            return None;
        }
        let (told, outcome) = oneshot::channel();
        let (stop, is_unknown) = (self.end.child_token(), Arc::clone(&self.is_unknown));
        let guard = stop.clone().drop_guard();
        let performing = async move {
            let (outcome, is_known) = perform(&client, &endpoint, goal, stop).await;
            if !is_known {
                is_unknown.store(true, Ordering::Release);
            }
            // Nobody listens to a call that was dropped.
            let _ = told.send(outcome);
            drop(counted);
        };
        let performing = trace::within_any(trace::current(), performing).in_current_span();
        tokio::spawn(exit_on_panic("the task of a call", performing));
        Some(Call { outcome, stop: guard })
    }

    /// Tells all calls to stop, and waits until they are over. No other begins any more.
    pub(super) async fn end(&self) {
        self.end.cancel();
        self.under_way.close();
        self.under_way.wait().await;
    }

    /// A call under way, for tests of what waits for it.
    #[cfg(test)]
    pub(super) fn counted(&self) -> tokio_util::task::task_tracker::TaskTrackerToken {
        self.under_way.token()
    }

    /// Whether a call is over and it is not known whether its goal has ended.
    pub(super) fn is_unknown(&self) -> bool {
        self.is_unknown.load(Ordering::Acquire)
    }
}

impl Call {
    /// The outcome; `None` if `cancelled` fires before: then the called goal is told to stop, and is over.
    pub(super) async fn outcome(mut self, cancelled: &CancellationToken) -> Option<Result<GoalOutcome, CallError>> {
        tokio::select! {
            biased;
            () = cancelled.cancelled() => {}
            // Its task sends the outcome in any case.
            outcome = &mut self.outcome => return outcome.ok(),
        }
        drop(self.stop);
        let _ = self.outcome.await;
        None
    }
}

/// Performs a goal; returns how that ends, and whether it is known that nothing moves for it any more.
async fn perform(
    client: &ActionClient,
    endpoint: &Endpoint,
    goal: Goal,
    stop: CancellationToken,
) -> (Result<GoalOutcome, CallError>, bool) {
    let mut ending = Box::pin(given(client, endpoint, &goal, || !stop.is_cancelled()));
    let (outcome, is_known) = tokio::select! {
        // The goal is given before it is cancelled.
        biased;
        ended = &mut ending => ended,
        () = stop.cancelled() => {
            let stopping = async {
                tokio::select! {
                    ended = &mut ending => ended,
                    () = client.stop(endpoint, &goal.id) => ending.await,
                }
            };
            tokio::time::timeout(STOPS_WITHIN, stopping).await.unwrap_or_else(|_| {
                let reason = format!("goal {} has not ended within {:.1} s", goal.id, STOPS_WITHIN.as_secs_f64());
                (Err(CallError::Broken { endpoint: endpoint.clone(), reason }), false)
            })
        }
    };
    // An outcome was heard, with what it says of what may still move.
    if is_known || outcome.is_ok() {
        return (outcome, is_known);
    }
    let _ = tokio::time::timeout(STOPS_WITHIN, client.stop(endpoint, &goal.id)).await;
    let heard = tokio::time::timeout(STOPS_WITHIN, attached(client, endpoint, &goal)).await;
    let is_known = matches!(heard, Ok(Ok(Fate { may_move: false, .. })));
    (outcome, is_known)
}

/// Gives a goal and waits for its end, over a second connection if the first one breaks. The same as [`perform`].
async fn given(
    client: &ActionClient,
    endpoint: &Endpoint,
    goal: &Goal,
    is_wanted: impl Fn() -> bool,
) -> (Result<GoalOutcome, CallError>, bool) {
    match client.execute_hearing(endpoint, goal.clone(), is_wanted, |_| {}).await {
        Ok(fate) => (Ok(fate.outcome), !fate.may_move),
        // Of what cannot be read or has broken nothing is known yet.
        Err(error) if error.is_crash() || error.is_unreadable() => match attached(client, endpoint, goal).await {
            Ok(fate) if !fate.orphaned => (Ok(fate.outcome), !fate.may_move),
            Ok(fate) => (Err(error), !fate.may_move),
            Err(_) => (Err(error), false),
        },
        // A provider that refuses a goal has not begun it.
        Err(error) => (Err(error), true),
    }
}

/// The end of a goal that was given before.
async fn attached(client: &ActionClient, endpoint: &Endpoint, goal: &Goal) -> Result<Fate, CallError> {
    client.attach_hearing(endpoint, goal.clone(), |_| {}).await
}
