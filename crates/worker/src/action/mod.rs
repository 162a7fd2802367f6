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
pub use context::{CallFailure, GoalContext, WorldFailure};
pub use port::{InputError, Port};
pub use ratn_proto::types::{Goal, GoalOutcome};
pub use run::STOP_GRACE;
pub use scene::SceneCache;
pub use server::{ActionServer, ActionServerBuilder};
pub use signature::{Signature, SignatureError};

use crate::client::chain;
use std::error::Error;
use std::iter;

/// Something that can be done.
#[tonic::async_trait]
pub trait Action: Send + Sync + 'static {
    /// Its name, the part after the slash of `path_planner/plan`.
    fn name(&self) -> &str;

    /// What it does, for people.
    fn description(&self) -> &str {
        ""
    }

    /// Its ports, outcomes and annotations; without them nobody is told, and the catalogue has to say them.
    fn signature(&self) -> Option<Signature> {
        None
    }

    /// The resource whose lease a goal needs, where it is another than the server's own.
    fn resource(&self) -> Option<&str> {
        None
    }

    /// Whether a goal is stopped when the last client that listens to it has gone.
    fn cancel_when_abandoned(&self) -> bool {
        true
    }

    /// Whether a goal is suspended, instead of ended, while the resource manager is not heard: its lease may have ended, so nothing may
    /// move for it. For an action that stands still while the goal is ([`GoalContext::while_held`], [`GoalContext::suspended`]), and for
    /// one that moves nothing.
    fn can_be_suspended(&self) -> bool {
        false
    }

    /// Does it. Has to look at `goal.cancelled` (or `goal.checkpoint()?`) and to end soon once that fired: its resource is its own until
    /// it returns, and nothing tears it down. What blocks for longer than a millisecond belongs into `tokio::task::spawn_blocking`.
    async fn execute(&self, goal: GoalContext) -> ActionResult;
}

/// How a goal ends.
pub type ActionResult = Result<GoalOutcome, ActionFailure>;

/// A goal that did not come to an outcome of its own. Made from any error by `?`: what another provider that was called
/// ([`GoalContext::call`]) ended as, where that is `preempted` or `stopped`; lost, where the world pool or the goal's projection is gone
/// ([`WorldFailure`]); else `aborted`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ActionFailure {
    /// It failed: the outcome is `aborted`.
    Aborted(String),
    /// It was told to stop: the outcome is `preempted`.
    Preempted(String),
    /// An emergency stop is in force: the outcome is `stopped`.
    Stopped(String),
    /// The world that it works on is gone: it comes to no outcome, as if its process had been killed, and another attempt may.
    Lost(String),
}

impl ActionFailure {
    /// It failed, and why.
    pub fn aborted(reason: impl Into<String>) -> ActionFailure {
        ActionFailure::Aborted(reason.into())
    }

    /// An emergency stop is in force, and why.
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
