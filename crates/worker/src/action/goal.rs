//! One goal as the server keeps it: its listeners, whether it was told to stop, how it ended.

use super::ActionFailure;
use super::called::Calls;
use crate::access::Caller;
use crate::panic::exit_on_panic;
use ratn_model::id::{FencingToken, LeaseId};
use ratn_proto::convert::wire_form;
use ratn_proto::types::{Goal, GoalOutcome};
use ratn_proto::v1;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tokio::sync::{broadcast, watch};
use tokio_util::sync::CancellationToken;

/// Progress reports kept per goal. A listener that falls further behind misses the oldest.
const PROGRESS_KEPT: usize = 64;

/// Upper bound of the grace that a client may ask for.
const MAX_GRACE: Duration = Duration::from_secs(60);

/// Why a goal was told to stop.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum StopCause {
    /// Its client asked for it.
    Cancelled,
    /// Nobody listens to the goal any more.
    Abandoned,
    /// The goal's deadline has passed.
    Deadline,
    /// A goal came under a newer lease of the resource.
    Fenced(FencingToken),
    /// The goal's lease has ended.
    LeaseEnded(String),
    /// The goal's lease may have ended: the resource manager is not heard.
    LeaseUnheard(String),
    /// The provider shuts down.
    ShuttingDown,
    /// An emergency stop, with its reason.
    EmergencyStop(String),
}

/// How a goal ended.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Ending {
    /// With an outcome.
    Outcome {
        outcome: GoalOutcome,
        /// Its client or its lease was gone.
        orphaned: bool,
        /// Its action has not returned, or it is not known whether a goal that it gave has ended.
        may_move: bool,
    },
    /// Without an outcome, as if the process had been killed: the provider shuts down, which is not the goal's fault.
    Gone,
    /// Without an outcome: the world that it worked on is gone, and why. Another attempt may succeed.
    Lost(String),
}

impl StopCause {
    /// Whether the cause has nothing to do with the goal's own work.
    pub(crate) fn is_orphaning(&self) -> bool {
        matches!(
            self,
            StopCause::Abandoned | StopCause::Fenced(_) | StopCause::LeaseEnded(_) | StopCause::LeaseUnheard(_)
        )
    }

    /// The failure of a goal that stops for this cause: `preempted` if the stop was asked for, `aborted` if the right to go on was lost.
    pub(crate) fn failure(&self) -> ActionFailure {
        match self {
            StopCause::Cancelled => ActionFailure::Preempted("cancelled".to_owned()),
            StopCause::Abandoned => ActionFailure::Preempted("nobody listened to the goal any more".to_owned()),
            StopCause::Deadline => ActionFailure::Preempted("the goal's deadline was over".to_owned()),
            StopCause::Fenced(token) => {
                ActionFailure::Aborted(format!("a newer lease ({token}) took the resource over"))
            }
            StopCause::LeaseEnded(reason) => ActionFailure::Aborted(format!("the lease ended: {reason}")),
            StopCause::LeaseUnheard(reason) => ActionFailure::Aborted(format!("the lease may have ended: {reason}")),
            StopCause::ShuttingDown => ActionFailure::Aborted("the provider shuts down".to_owned()),
            StopCause::EmergencyStop(reason) => ActionFailure::emergency_stop(reason),
        }
    }
}

/// SHA-256 of a goal's inputs as received: a request with other inputs does not join the goal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Fingerprint([u8; 32]);

impl Fingerprint {
    /// The fingerprint of a goal; a missing goal counts as one without inputs.
    pub(crate) fn of(goal: Option<&v1::Goal>) -> Fingerprint {
        let mut digest = ring::digest::Context::new(&ring::digest::SHA256);
        if let Some(goal) = goal {
            wire_form(&goal.inputs, |bytes| digest.update(bytes));
        }
        let mut sum = [0; 32];
        sum.copy_from_slice(digest.finish().as_ref());
        Fingerprint(sum)
    }
}

/// A lease as it was granted: its id and its fencing token.
pub(crate) type LeaseKey = (LeaseId, FencingToken);

/// A goal that waits to begin, is under way, or has ended and is remembered.
#[derive(Debug)]
pub(crate) struct GoalEntry {
    pub(crate) id: String,
    /// The name of the caller who gave it.
    pub(crate) giver: Arc<str>,
    pub(crate) action: String,
    pub(crate) inputs: Fingerprint,
    /// The resource that performs it; if the server takes one goal at a time, the goal has it exclusively.
    pub(crate) resource: String,
    pub(crate) lease: Option<LeaseKey>,
    /// The session that holds the lease, as the goal names it; may be empty.
    pub(crate) session: String,
    pub(crate) cancelled: CancellationToken,
    /// Progress reports.
    pub(crate) progress: broadcast::Sender<v1::GoalProgress>,
    /// The last intermediate result; every listener gets it, also one that comes later.
    pub(crate) improved: watch::Sender<Option<v1::GoalImproved>>,
    pub(crate) result: watch::Sender<Option<Ending>>,
    /// Fires when the goal's action has returned or panicked, and its calls are over. If an action does not stop in time, this is after its result
    /// was sent. A panic is recorded before.
    pub(crate) returned: CancellationToken,
    /// The goals that it gave to other providers.
    pub(crate) calls: Calls,
    /// The goal is suspended, because its lease may have ended.
    suspended: watch::Sender<bool>,
    stop_when_abandoned: bool,
    /// How long the goal may have no listener.
    grace: Duration,
    cause: Mutex<Option<StopCause>>,
    listeners: AtomicUsize,
    /// How often the last listener has left.
    left: AtomicUsize,
}

/// A client that waits for a goal's result.
#[derive(Debug)]
pub(crate) struct Listener(Arc<GoalEntry>);

impl GoalEntry {
    pub(crate) fn new(
        giver: &Caller,
        goal: &Goal,
        inputs: Fingerprint,
        resource: &str,
        stop_when_abandoned: bool,
    ) -> Arc<GoalEntry> {
        Arc::new(GoalEntry {
            id: goal.id.clone(),
            giver: giver.name.clone(),
            action: goal.action.clone(),
            inputs,
            resource: resource.to_owned(),
            lease: goal.lease.as_ref().map(|lease| (lease.id, lease.token)),
            session: goal.session.clone(),
            cancelled: CancellationToken::new(),
            progress: broadcast::channel(PROGRESS_KEPT).0,
            improved: watch::Sender::new(None),
            result: watch::channel(None).0,
            returned: CancellationToken::new(),
            calls: Calls::default(),
            suspended: watch::Sender::new(false),
            stop_when_abandoned,
            grace: Duration::from_millis(goal.grace_ms).min(MAX_GRACE),
            cause: Mutex::new(None),
            listeners: AtomicUsize::new(0),
            left: AtomicUsize::new(0),
        })
    }

    pub(crate) fn listen(self: &Arc<GoalEntry>) -> Listener {
        self.listeners.fetch_add(1, Ordering::AcqRel);
        Listener(Arc::clone(self))
    }

    /// Tells the goal to stop; the first cause counts.
    pub(crate) fn stop(&self, cause: StopCause) {
        self.blame(cause);
        self.cancelled.cancel();
    }

    /// Sets why the goal ends, in case it ends without success.
    pub(crate) fn blame(&self, cause: StopCause) {
        self.cause.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(cause);
    }

    /// Suspends the goal, or lets it go on.
    pub(crate) fn suspend(&self, suspended: bool) {
        self.suspended.send_if_modified(|now| std::mem::replace(now, suspended) != suspended);
    }

    pub(crate) fn is_suspended(&self) -> bool {
        *self.suspended.borrow()
    }

    pub(crate) fn suspension(&self) -> watch::Receiver<bool> {
        self.suspended.subscribe()
    }

    pub(crate) fn is_over(&self) -> bool {
        self.result.borrow().is_some()
    }

    /// Returns when the goal's result is there.
    pub(crate) async fn over(&self) {
        // The sender is in `self`, so the channel is open.
        let _ = self.result.subscribe().wait_for(Option::is_some).await;
    }

    /// Why the goal was told to stop.
    pub(crate) fn cause(&self) -> Option<StopCause> {
        self.cause.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// The failure that follows from being told to stop.
    pub(crate) fn stopped(&self) -> ActionFailure {
        self.cause().unwrap_or(StopCause::Cancelled).failure()
    }
}

impl Drop for Listener {
    fn drop(&mut self) {
        let last = self.0.listeners.fetch_sub(1, Ordering::AcqRel) == 1;
        if !last || !self.0.stop_when_abandoned || self.0.is_over() {
            return;
        }
        let left = self.0.left.fetch_add(1, Ordering::AcqRel) + 1;
        match tokio::runtime::Handle::try_current() {
            Ok(runtime) if !self.0.grace.is_zero() => {
                runtime.spawn(exit_on_panic("the task of an abandoned goal", abandoned(Arc::clone(&self.0), left)));
            }
            _ => self.0.stop(StopCause::Abandoned),
        }
    }
}

/// Stops a goal that has had no listener for its grace, since its last listener left for the `left`-th time.
async fn abandoned(goal: Arc<GoalEntry>, left: usize) {
    tokio::select! {
        () = goal.over() => return,
        () = tokio::time::sleep(goal.grace) => {}
    }
    if goal.listeners.load(Ordering::Acquire) == 0 && goal.left.load(Ordering::Acquire) == left {
        goal.stop(StopCause::Abandoned);
    }
}
