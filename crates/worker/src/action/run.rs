//! Runs one goal from its beginning to its end.
//!
//! ```text
//! begun ─ the action returns ─ its calls are over ─→ result sent, resource free
//!    └─ told to stop ─ runs on after the grace ─→ result sent ─ the action returns ─ its calls are over ─→ resource free
//!                                                      └─ runs on for much longer ─→ the server is stuck
//! ```
//! A goal keeps its resource until its action has returned and the goals that it gave are over, even if a result was sent earlier. Of an action that
//! panicked it is not known whether what it moved stands still: its result says so, and its provider does not confirm standstill.

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

/// How long an action may take to return after its goal was told to stop. Then the goal's result is sent, but the goal keeps its resource
/// until the action has returned.
pub const STOP_GRACE: Duration = Duration::from_secs(3);

/// Maximum size of the reason, a text for people; a longer one is truncated.
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
            // The goal may have been told to stop since it was admitted.
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
        // A deadline only tells the goal to stop; the goal then ends by itself, or is overdue.
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
    let mut performing = std::pin::pin!(async {
        let performed = (&mut performing).await;
        // Its lease goes back with its end.
        entry.calls.end().await;
        performed
    });
    let (mut returned, mut panicked) = (true, false);
    let result = tokio::select! {
        biased;
        performed = &mut performing => {
            panicked = performed.is_err();
            result_of(performed)
        }
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
        // After an emergency stop the outcome is `stopped`, unless the action succeeded.
        Some(cause @ StopCause::EmergencyStop(_)) if !outcome.is_success() => cause.failure().into(),
        _ => outcome,
    };
    tracing::debug!(goal = %entry.id, outcome = %outcome.outcome, reason = %outcome.reason, "ended");
    if panicked {
        server.state().panicked(&entry);
    }
    if returned {
        // Remove the goal from the running ones before its end is announced: the next goal must find the resource free.
        server.state().end(&entry, server.limits.results_kept);
    }
    let may_move = !returned || panicked || entry.calls.is_unknown();
    let ending = match entry.cause() {
        Some(StopCause::ShuttingDown) if !outcome.is_success() => Ending::Gone,
        None if lost && !may_move => Ending::Lost(outcome.reason),
        cause => {
            let orphaned = !outcome.is_success() && cause.is_some_and(|cause| cause.is_orphaning());
            Ending::Outcome { outcome, orphaned, may_move }
        }
    };
    entry.result.send_replace(Some(ending));
    if !returned {
        let (goal, action, resource) = (&entry.id, &entry.action, &entry.resource);
        let grace_s = STOP_GRACE.as_secs();
        tracing::error!(%goal, %action, %resource, grace_s, "a goal that was told to stop still runs: nothing begins beside it");
        // The action is not aborted: its work in threads or on a device would go on unseen.
        let patience = server.stuck_after.unwrap_or(Duration::MAX);
        let performed = match tokio::time::timeout(patience, &mut performing).await {
            Ok(performed) => performed,
            Err(_) => {
                let told_s = (STOP_GRACE + patience).as_secs();
                let stuck = format!("goal {goal} of {action} was told to stop {told_s} s ago, and still runs");
                server.stuck.send_replace(Some(stuck));
                performing.as_mut().await
            }
        };
        if performed.is_err() {
            server.state().panicked(&entry);
        }
        tracing::warn!(%goal, %action, %resource, "the goal that was told to stop has ended after all");
        server.state().end(&entry, server.limits.results_kept);
    }
    entry.returned.cancel();
}

/// Reports as progress that a goal is held or suspended, and when that ends, so that its caller knows why nothing happens.
async fn tell_pauses(entry: &GoalEntry, safety: &Safety) -> Infallible {
    let (mut state, mut suspended) = (safety.watch(), entry.suspension());
    let mut told = None;
    loop {
        let pauses = match &*state.borrow_and_update() {
            SafetyState::Held { reason } => Some(format!("a hold is in force: {reason}")),
            // The goal ends, and its result says so.
            SafetyState::Stopped { .. } => told.clone(),
            SafetyState::Ready => {
                suspended.borrow_and_update().then(|| "stands still: the resource manager is not heard".to_owned())
            }
        };
        if pauses != told {
            let message = pauses.clone().unwrap_or_else(|| "goes on".to_owned());
            // It is no error if nobody listens.
            let _ = entry.progress.send(bounded_progress(message, BTreeMap::new()));
            told = pauses;
        }
        // The senders live in the goal and in its server.
        tokio::select! {
            _ = state.changed() => {}
            _ = suspended.changed() => {}
        }
    }
}

/// Performs a goal, and checks its inputs before and its outputs after against the action's signature.
async fn perform(action: &dyn Action, mut context: GoalContext) -> ActionResult {
    let Some(signature) = action.checked_by() else { return action.execute(context).await };
    let name = context.action.clone();
    signature.complete(&name, &mut context.inputs)?;
    let outcome = action.execute(context).await?;
    signature.check(&name, &outcome)?;
    Ok(outcome)
}

/// Returns the outcome, with a reason short enough, if its outputs fit into a message; otherwise a failure that names what is too large.
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
