//! One goal as the server keeps it: who listens, whether it was told to stop, how it ended.

use super::ActionFailure;
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

/// A listener that falls further behind misses the oldest of what a goal says before its end.
const PROGRESS_KEPT: usize = 64;

/// However long a client may want to come back.
const MAX_GRACE: Duration = Duration::from_secs(60);

/// Why a goal was told to stop.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum StopCause {
    /// Its client asked for it.
    Cancelled,
    /// Nobody listens to it any more.
    Abandoned,
    /// Its time is over.
    Deadline,
    /// Somebody with a newer lease wants the resource.
    Fenced(FencingToken),
    /// Its lease has ended.
    LeaseEnded(String),
    /// Its lease may have ended.
    LeaseUnheard(String),
    /// The provider ends.
    ShuttingDown,
    /// An emergency stop, and why.
    EmergencyStop(String),
}

/// How a goal ended.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Ending {
    /// With an outcome, and whether that is because its client or its lease was gone.
    Outcome(GoalOutcome, bool),
    /// Without one, as if the process had been killed: the provider ends, which is not the goal's doing.
    Gone,
    /// Without one: what it worked on is gone, and why. Another attempt may have more luck.
    Lost(String),
}

impl StopCause {
    /// Whether it has nothing to do with what the goal was about.
    pub(crate) fn is_orphaning(&self) -> bool {
        matches!(
            self,
            StopCause::Abandoned | StopCause::Fenced(_) | StopCause::LeaseEnded(_) | StopCause::LeaseUnheard(_)
        )
    }

    /// What the goal comes to: who asked for the stop gets `preempted`, who lost the right to go on `aborted`.
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

/// SHA-256 of a goal's inputs as they came over the wire: a goal is not joined by one that asks for something else.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Fingerprint([u8; 32]);

impl Fingerprint {
    /// Of a goal; of one that is missing as of one without inputs.
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

/// A lease as it was granted: its id, and its token.
pub(crate) type LeaseKey = (LeaseId, FencingToken);

/// A goal that waits to begin, is under way, or has ended and is remembered.
#[derive(Debug)]
pub(crate) struct GoalEntry {
    pub(crate) id: String,
    /// The name of the caller who gave it.
    pub(crate) giver: Arc<str>,
    pub(crate) action: String,
    pub(crate) inputs: Fingerprint,
    /// The resource that it has to itself where the server takes one goal at a time.
    pub(crate) resource: String,
    pub(crate) lease: Option<LeaseKey>,
    /// Whose lease that is, as the goal says; may be empty.
    pub(crate) session: String,
    pub(crate) cancelled: CancellationToken,
    /// How far it is.
    pub(crate) progress: broadcast::Sender<v1::GoalProgress>,
    /// The last result that can be used; whoever listens hears of it, also who comes later.
    pub(crate) improved: watch::Sender<Option<v1::GoalImproved>>,
    pub(crate) result: watch::Sender<Option<Ending>>,
    /// Fires when its action has returned; an action that does not stop in time does so after its result was told.
    pub(crate) returned: CancellationToken,
    /// It stands still, for its lease may have ended.
    suspended: watch::Sender<bool>,
    stop_when_abandoned: bool,
    /// For how long nobody may listen to it.
    grace: Duration,
    cause: Mutex<Option<StopCause>>,
    listeners: AtomicUsize,
    /// How often its last listener has left.
    left: AtomicUsize,
}

/// Somebody who waits for a goal's result.
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

    /// Tells it to stop; the first cause counts.
    pub(crate) fn stop(&self, cause: StopCause) {
        self.blame(cause);
        self.cancelled.cancel();
    }

    /// Why it ends, if it ends without success.
    pub(crate) fn blame(&self, cause: StopCause) {
        self.cause.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(cause);
    }

    /// Suspends it, or lets it go on.
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

    /// Returns once its result is there.
    pub(crate) async fn over(&self) {
        // The sender is in `self`, so the channel is open.
        let _ = self.result.subscribe().wait_for(Option::is_some).await;
    }

    /// Why it was told to stop.
    pub(crate) fn cause(&self) -> Option<StopCause> {
        self.cause.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// What being told to stop makes of the goal.
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

/// Stops a goal to which nobody has listened again for its grace since its last listener left the `left`-th time.
async fn abandoned(goal: Arc<GoalEntry>, left: usize) {
    tokio::select! {
        () = goal.over() => return,
        () = tokio::time::sleep(goal.grace) => {}
    }
    if goal.listeners.load(Ordering::Acquire) == 0 && goal.left.load(Ordering::Acquire) == left {
        goal.stop(StopCause::Abandoned);
    }
}
