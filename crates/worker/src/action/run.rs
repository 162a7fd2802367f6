//! One goal from its beginning to its end.
//!
//! ```text
//! begun ─ the action returns ─────────────────→ result told, place free
//!    └─ told to stop ─ it does not for a grace ─→ result told ─ the action returns ─→ place free
//!                                                      └─ it does not for much longer ─→ the server is stuck
//! ```
//! A goal has its resource until its action has returned, whatever was told of it before.

use super::context::bounded as bounded_progress;
use super::goal::{Ending, GoalEntry, StopCause};
use super::server::Inner;
use super::{Action, ActionFailure, ActionResult, GoalContext};
use crate::safety::{Safety, SafetyState};
use crate::trace;
use ratn_proto::MAX_PORTS_BYTES;
use ratn_proto::convert::{ports_bytes, value_bytes, wire_ports};
use ratn_proto::types::GoalOutcome;
use std::collections::BTreeMap;
use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;
use tokio::task::JoinError;
use tracing::Instrument;

/// Of a goal that was told to stop and does not the result is told after this long; it keeps its resource until it has ended.
pub const STOP_GRACE: Duration = Duration::from_secs(3);

/// A reason is for people; of a longer one the beginning is told.
const MAX_REASON_BYTES: usize = 64 * 1024;

/// Runs a goal to its end, whatever its action does.
pub(super) async fn run(
    server: Arc<Inner>,
    entry: Arc<GoalEntry>,
    action: Arc<dyn Action>,
    context: GoalContext,
    deadline_ms: u64,
) {
    tracing::debug!(goal = %entry.id, action = %context.action, "begun");
    let performing = trace::within_any(trace::current(), async move {
        match context.safety.state() {
            SafetyState::Stopped { reason } => Err(ActionFailure::emergency_stop(&reason)),
            // It may have been told to stop since it was admitted.
            _ => match context.checkpoint() {
                Ok(()) => perform(&*action, context).await,
                Err(stopped) => Err(stopped),
            },
        }
    });
    let mut performing = tokio::spawn(performing.in_current_span());
    let deadline = async {
        if deadline_ms > 0 {
            tokio::time::sleep(Duration::from_millis(deadline_ms)).await;
            entry.stop(StopCause::Deadline);
        }
        // It only tells the goal to stop; the goal ends by itself, or is overdue.
        std::future::pending::<Infallible>().await
    };
    let stopped = async {
        entry.stop(StopCause::EmergencyStop(server.safety.stopped().await));
        std::future::pending::<Infallible>().await
    };
    let pauses = async { tell_pauses(&entry, &server.safety).await };
    let overdue = async {
        entry.cancelled.cancelled().await;
        tokio::time::sleep(STOP_GRACE).await;
    };
    let mut returned = true;
    let result = tokio::select! {
        biased;
        performed = &mut performing => result_of(performed),
        () = overdue => {
            returned = false;
            let cause = GoalOutcome::from(entry.stopped()).reason;
            Err(ActionFailure::Aborted(format!("{cause}; it did not stop within {} s", STOP_GRACE.as_secs())))
        }
        never = deadline => match never {},
        never = stopped => match never {},
        never = pauses => match never {},
    };
    let lost = result.as_ref().is_err_and(|failure| matches!(failure, ActionFailure::Lost(_)));
    let outcome = bounded(result.unwrap_or_else(GoalOutcome::from));
    let outcome = match entry.cause() {
        // Whatever the action makes of being stopped.
        Some(cause @ StopCause::EmergencyStop(_)) if !outcome.is_success() => cause.failure().into(),
        _ => outcome,
    };
    tracing::debug!(goal = %entry.id, outcome = %outcome.outcome, reason = %outcome.reason, "ended");
    if returned {
        // No longer running before anybody hears of its end: the next goal must find its place free.
        server.state().end(&entry, server.limits.results_kept);
    }
    let ending = match entry.cause() {
        Some(StopCause::ShuttingDown) if !outcome.is_success() => Ending::Gone,
        None if lost => Ending::Lost(outcome.reason),
        cause => {
            let orphaned = !outcome.is_success() && cause.is_some_and(|cause| cause.is_orphaning());
            Ending::Outcome(outcome, orphaned)
        }
    };
    entry.result.send_replace(Some(ending));
    if !returned {
        let (goal, action, resource) = (&entry.id, &entry.action, &entry.resource);
        let grace_s = STOP_GRACE.as_secs();
        tracing::error!(%goal, %action, %resource, grace_s, "a goal that was told to stop still runs: nothing begins beside it");
        // Not torn down: what it does in threads or on a device would go on unseen.
        let patience = server.stuck_after.unwrap_or(Duration::MAX);
        if tokio::time::timeout(patience, &mut performing).await.is_err() {
            let told_s = (STOP_GRACE + patience).as_secs();
            server
                .stuck
                .send_replace(Some(format!("goal {goal} of {action} was told to stop {told_s} s ago, and still runs")));
            let _ = performing.await;
        }
        tracing::warn!(%goal, %action, %resource, "the goal that was told to stop has ended after all");
        server.state().end(&entry, server.limits.results_kept);
    }
    entry.returned.cancel();
}

/// Says of a goal that a hold is in force or that it is suspended, and when that is over: else nobody who waits for it would know.
async fn tell_pauses(entry: &GoalEntry, safety: &Safety) -> Infallible {
    let (mut state, mut suspended) = (safety.watch(), entry.suspension());
    let mut told = None;
    loop {
        let pauses = match &*state.borrow_and_update() {
            SafetyState::Held { reason } => Some(format!("a hold is in force: {reason}")),
            // It ends, and its end says so.
            SafetyState::Stopped { .. } => told.clone(),
            SafetyState::Ready => {
                suspended.borrow_and_update().then(|| "stands still: the resource manager is not heard".to_owned())
            }
        };
        if pauses != told {
            let message = pauses.clone().unwrap_or_else(|| "goes on".to_owned());
            // Nobody may listen.
            let _ = entry.progress.send(bounded_progress(message, BTreeMap::new()));
            told = pauses;
        }
        // The senders are in the goal and in its server.
        tokio::select! {
            _ = state.changed() => {}
            _ = suspended.changed() => {}
        }
    }
}

/// Performs a goal that is as the action says, and sees that what comes of it is.
async fn perform(action: &dyn Action, mut context: GoalContext) -> ActionResult {
    let Some(signature) = action.checked_by() else { return action.execute(context).await };
    let name = context.action.clone();
    signature.complete(&name, &mut context.inputs)?;
    let outcome = action.execute(context).await?;
    signature.check(&name, &outcome)?;
    Ok(outcome)
}

/// An outcome whose outputs fit into a message, with a reason that does; a failure that says what does not, otherwise.
fn bounded(mut outcome: GoalOutcome) -> GoalOutcome {
    if outcome.reason.len() > MAX_REASON_BYTES {
        let bytes = outcome.reason.len();
        outcome.reason.truncate(outcome.reason.floor_char_boundary(MAX_REASON_BYTES));
        outcome.reason.push_str(&format!("… (shortened: {bytes} bytes)"));
    }
    let outputs = wire_ports(outcome.outputs.clone());
    let bytes = ports_bytes(&outputs);
    if bytes <= MAX_PORTS_BYTES {
        return outcome;
    }
    let largest = outcome.outputs.iter().max_by_key(|(name, _)| value_bytes(&outputs[*name]));
    let largest = largest.map_or("", |(name, _)| name.as_str());
    let reason =
        format!("the outputs have {bytes} bytes, most of them `{largest}`: at most {MAX_PORTS_BYTES} are sent");
    ActionFailure::Aborted(reason).into()
}

fn result_of(performed: Result<ActionResult, JoinError>) -> ActionResult {
    performed.unwrap_or_else(|error| {
        Err(ActionFailure::Aborted(match error.try_into_panic() {
            Ok(panic) => format!("the action panicked: {}", panic_message(&*panic)),
            Err(error) => format!("the action was torn down: {error}"),
        }))
    })
}

fn panic_message(panic: &(dyn std::any::Any + Send)) -> &str {
    match (panic.downcast_ref::<&str>(), panic.downcast_ref::<String>()) {
        (Some(text), _) => text,
        (_, Some(text)) => text,
        _ => "no message",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_reason_that_is_too_long_to_be_sent_is_told_without_its_end() {
        let told = bounded(GoalOutcome::aborted("ä".repeat(20_000_000)));
        assert!(told.reason.ends_with("… (shortened: 40000000 bytes)") && told.reason.len() < MAX_REASON_BYTES + 64);
        assert_eq!(told.outcome, "aborted");
        assert_eq!(bounded(GoalOutcome::aborted("short")).reason, "short");
    }
}
