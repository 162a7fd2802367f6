//! Performing actions: what a driver or a worker implements, and the service around it.
//!
//! ```text
//! execute ─ unknown action, no such lease, busy ──────────────→ refused (a gRPC status)
//!    └→ accepted → progress* → result: success | the action's own | aborted | preempted | stopped
//!                      └─ cancel, deadline, lease over, nobody listens, emergency stop: `cancelled` fires, the action ends itself
//! ```
//!
//! An [`Action`] gets a [`GoalContext`] and returns an outcome; `?` on anything that is an error makes it `aborted` with
//! that error as reason. The [`ActionServer`] owns what is common to all: leases as the resource manager confirms them, fencing,
//! idempotence, exclusion, panics.

mod admission;
mod authority;
mod called;
mod context;
mod fence;
mod goal;
mod inputs;
mod memory;
mod port;
mod run;
mod scene;
mod server;
mod service;
mod signature;
mod stream;

pub(crate) use admission::TOO_MANY_WAITING;
pub(crate) use authority::{MANAGER_UNHEARD, NOT_AT_REST};
pub use context::{CallFailure, GoalContext, MAX_PROGRESS_BYTES, MAX_PROGRESS_PER_S, WorldFailure};
pub use port::{InputError, Port};
pub use ratn_proto::types::{Goal, GoalOutcome};
pub use run::STOP_GRACE;
pub use scene::SceneCache;
pub use server::{ActionServer, ActionServerBuilder};
pub use signature::{Signature, SignatureError};

use crate::client::chain;
use std::error::Error;
use std::iter;

/// Something that a worker can do: `nearest` of `inspector/nearest`.
#[tonic::async_trait]
pub trait Action: Send + Sync + 'static {
    /// The action's name: the part behind the slash in `path_planner/plan`.
    fn name(&self) -> &str;

    /// A sentence for people that says what the action does; `ratn actions` shows it.
    fn description(&self) -> &str {
        ""
    }

    /// The action's ports, outcomes and annotations. Without them the catalogue of the system has to say them, and goals are
    /// checked against [`Action::checked_by`] alone.
    fn signature(&self) -> Option<Signature> {
        None
    }

    /// The signature against which inputs of goals, and outputs after `success`, are checked: by default the action's own; for an action of
    /// the bundled system, the one in the catalogue ([`Signature::bundled`]).
    fn checked_by(&self) -> Option<Signature> {
        self.signature()
    }

    /// The id of the resource whose lease a goal needs, if it is not the worker's own.
    fn resource(&self) -> Option<&str> {
        None
    }

    /// The ids of all resources that goals of this action can need a lease of: one, unless several resources share the action.
    fn resources(&self) -> Vec<&str> {
        self.resource().into_iter().collect()
    }

    /// The id of the resource whose lease this goal needs, for an action that several resources share, as the arms of a robot do. It is called
    /// whenever the goal is given, and has to return the same every time. The lease is confirmed for the returned resource in any case.
    ///
    /// # Errors
    /// The goal is for none of the resources, or it is unclear for which one: the goal is refused with this sentence.
    fn resource_for(&self, _goal: &Goal) -> Result<Option<&str>, NoResource> {
        Ok(self.resource())
    }

    /// Whether a goal is stopped when the last client that listens to it has gone.
    fn cancel_when_abandoned(&self) -> bool {
        true
    }

    /// Whether a goal is suspended, instead of ended, while the resource manager does not answer. The goal's lease may have ended then, so
    /// nothing may move. Return true for an action that stands still while its goal is suspended ([`GoalContext::while_held`],
    /// [`GoalContext::suspended`]), and for one that moves nothing.
    fn can_be_suspended(&self) -> bool {
        false
    }

    /// Performs a goal. The action has to look at `goal.cancelled` (or call `goal.checkpoint()?`) and to return soon after that fired: it is
    /// never interrupted, and its resource stays taken until it returns. Work that blocks for longer than a millisecond belongs into
    /// `tokio::task::spawn_blocking`.
    async fn execute(&self, goal: GoalContext) -> ActionResult;
}

/// Why it is unclear which resource's lease a goal needs; the sentence also says what to do.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NoResource {
    /// An input of the goal names none of them: the goal is refused as `INVALID_ARGUMENT`.
    #[error("{0}")]
    Input(String),
    /// The lease of the goal holds none of them, or several: the goal is refused as `FAILED_PRECONDITION` with the reason `NO_LEASE`.
    #[error("{0}")]
    Lease(String),
}

/// How a goal ends: an outcome with its outputs, or a failure.
pub type ActionResult = Result<GoalOutcome, ActionFailure>;

/// A goal that came to no outcome of the action's own. `?` makes one from any error: `aborted`, with two exceptions. Where a called provider
/// ([`GoalContext::call`]) ended `preempted` or `stopped`, so does this goal. Where the world pool or the goal's projection is gone
/// ([`WorldFailure`]), the goal is lost.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ActionFailure {
    /// It failed: the outcome is `aborted`.
    Aborted(String),
    /// It was told to stop: the outcome is `preempted`.
    Preempted(String),
    /// An emergency stop is in force: the outcome is `stopped`.
    Stopped(String),
    /// The world that the goal works on is gone. The goal has no outcome, as if the worker's process had been killed, and may be tried again.
    Lost(String),
}

impl ActionFailure {
    /// The action failed, for this reason.
    pub fn aborted(reason: impl Into<String>) -> ActionFailure {
        ActionFailure::Aborted(reason.into())
    }

    /// An emergency stop is in force, for this reason.
    pub fn emergency_stop(reason: &str) -> ActionFailure {
        ActionFailure::Stopped(format!("emergency stop: {reason}"))
    }
}

impl<E: std::error::Error + 'static> From<E> for ActionFailure {
    fn from(error: E) -> ActionFailure {
        let reason = chain(&error);
        let mut causes = iter::successors(Some(&error as &(dyn Error + 'static)), |&error| error.source());
        let failure = causes.find_map(|cause| {
            let call = cause.downcast_ref().and_then(CallFailure::failure);
            call.or_else(|| cause.downcast_ref().and_then(WorldFailure::failure))
        });
        failure.unwrap_or(ActionFailure::Aborted)(reason)
    }
}

impl From<ActionFailure> for GoalOutcome {
    fn from(failure: ActionFailure) -> GoalOutcome {
        match failure {
            ActionFailure::Aborted(reason) | ActionFailure::Lost(reason) => GoalOutcome::aborted(reason),
            ActionFailure::Preempted(reason) => GoalOutcome::preempted(reason),
            ActionFailure::Stopped(reason) => GoalOutcome::stopped(reason),
        }
    }
}
