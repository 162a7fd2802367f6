//! The context of an action: its goal with the inputs, and access to the world model, the lease and other providers.

use super::ActionFailure;
use super::called::CALL_GRACE_MS;
use super::goal::GoalEntry;
use crate::client::{ActionClient, CallError, Channels, WorldClient, retry_unanswered};
use crate::endpoint::{Endpoint, EndpointError};
use crate::safety::{Safety, SafetyState};
use crate::token_bucket::TokenBucket;
use ratn_model::fact::{Change, FactPattern};
use ratn_model::id::ProjectionId;
use ratn_model::program::{PREEMPTED, STOPPED};
use ratn_model::resource::Lease;
use ratn_model::value::Value;
use ratn_proto::MAX_PORTS_BYTES;
use ratn_proto::convert::{ports_bytes, wire_ports};
use ratn_proto::types::{FactRecord, Goal};
use ratn_proto::v1;
use ratn_world::scene::delta::DeltaError;
use ratn_world::world::{ChangeError, World};
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;
use tonic::Code;

/// Maximum size of one progress report in bytes, message and named values together. The last 64 reports of a goal are kept for slow
/// listeners, so at most one mebibyte per goal.
pub const MAX_PROGRESS_BYTES: usize = 16 * 1024;

/// Maximum number of progress reports of a goal per second, and in one burst. Further reports are dropped, so that the total size per
/// second is bounded, too.
pub const MAX_PROGRESS_PER_S: u32 = 100;

/// Bytes of the message that are kept when a report is too long.
const SHORTENED_PROGRESS_BYTES: usize = 1024;

/// A goal that an action performs.
#[derive(Debug)]
pub struct GoalContext {
    /// The goal's id. Every attempt of a state has one of its own.
    pub id: String,
    /// The action's name.
    pub action: String,
    /// The inputs by port. [`GoalContext`] has an `input_…` and an `optional_…` method for every type.
    pub inputs: BTreeMap<String, Value>,
    /// The seed from which the action derives every random choice: the same goal with the same seed gives the same result.
    pub seed: u64,
    /// The lease of the resources that the action may use; `None` where the worker asks for no lease.
    pub lease: Option<Lease>,
    /// The projection of the world that the goal works on; `None` for the world as it is.
    pub projection: Option<ProjectionId>,
    /// Fires when the goal has to stop; [`GoalContext::stopped`] is how it then ends.
    pub cancelled: CancellationToken,
    /// The id of the session that holds the lease, as the goal names it.
    session: String,
    improves: Option<Vec<String>>,
    world_pool: String,
    channels: Channels,
    pub(super) safety: Safety,
    entry: Arc<GoalEntry>,
    calls: AtomicU32,
    progress_left: Mutex<TokenBucket>,
}

/// Why the world cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum WorldFailure {
    /// The goal names no world pool: its state reads nothing.
    #[error(
        "the goal's state says that it reads no facts (`reads: []`), so it is shown none; declare what it reads (reads: […])"
    )]
    NoWorldPool,
    /// The goal's address of the world pool is no endpoint.
    #[error("the goal's world pool")]
    Endpoint(#[from] EndpointError),
    /// The world pool did not answer, or refused.
    #[error("the world pool")]
    Call(#[from] CallError),
    /// The facts that were sent contradict each other.
    #[error("the projection's facts")]
    Facts(#[from] ChangeError),
    /// The facts that were sent make no scene: a shape or a pose is missing or malformed.
    #[error("the projection's scene")]
    Scene(#[from] DeltaError),
}

/// Why a call of another provider did not succeed ([`GoalContext::call`]).
#[derive(Debug, thiserror::Error)]
pub enum CallFailure {
    /// The goal's lease holds no resource of this kind.
    #[error("the goal's lease holds no {kind}: the state has to block one")]
    NotLeased {
        /// The kind.
        kind: String,
    },
    /// The resource does not say at which endpoint its actions are served.
    #[error("the endpoint of {resource}")]
    Endpoint {
        /// The resource's id.
        resource: String,
        /// What is wrong with the endpoint.
        #[source]
        source: EndpointError,
    },
    /// The provider refused the goal, or crashed.
    #[error("{action}")]
    Call {
        /// The action that was called.
        action: String,
        /// The error of the call.
        #[source]
        source: CallError,
    },
    /// The action did not end with success.
    #[error("{action} was {outcome}: {reason}")]
    Outcome {
        /// The action that was called.
        action: String,
        /// The outcome.
        outcome: String,
        /// The reason.
        reason: String,
    },
    /// This goal was told to stop during the call.
    #[error("{action} was given up: the goal shall stop")]
    Cancelled {
        /// The action that was called.
        action: String,
    },
}

impl CallFailure {
    /// The failure of the calling goal, where that is not `aborted`.
    pub(super) fn failure(&self) -> Option<fn(String) -> ActionFailure> {
        let CallFailure::Outcome { outcome, .. } = self else { return None };
        match outcome.as_str() {
            STOPPED => Some(ActionFailure::Stopped),
            PREEMPTED => Some(ActionFailure::Preempted),
            _ => None,
        }
    }
}

impl WorldFailure {
    /// The failure of the goal, where that is not `aborted`: when the world pool ends, so do its projections.
    pub(super) fn failure(&self) -> Option<fn(String) -> ActionFailure> {
        let WorldFailure::Call(error) = self else { return None };
        let gone = error.is_crash() || error.code() == Some(Code::NotFound);
        gone.then_some(ActionFailure::Lost)
    }
}

pub(super) fn bounded(mut message: String, values: BTreeMap<String, Value>) -> v1::GoalProgress {
    let values = wire_ports(values);
    let bytes = message.len() + ports_bytes(&values);
    if bytes <= MAX_PROGRESS_BYTES {
        return v1::GoalProgress { message, values };
    }
    message.truncate(message.floor_char_boundary(SHORTENED_PROGRESS_BYTES));
    message.push_str(&format!("… (shortened: {bytes} bytes with its values, at most {MAX_PROGRESS_BYTES} are told)"));
    v1::GoalProgress { message, ..v1::GoalProgress::default() }
}

impl GoalContext {
    pub(crate) fn new(goal: Goal, entry: Arc<GoalEntry>, channels: Channels, safety: Safety) -> GoalContext {
        GoalContext {
            id: goal.id,
            action: goal.action,
            inputs: goal.inputs,
            seed: goal.seed,
            lease: goal.lease,
            projection: goal.projection,
            session: goal.session,
            improves: goal.improves,
            cancelled: entry.cancelled.clone(),
            world_pool: goal.world_pool,
            channels,
            safety,
            entry,
            calls: AtomicU32::new(0),
            progress_left: Mutex::new(TokenBucket::full(MAX_PROGRESS_PER_S, Instant::now())),
        }
    }

    /// Reports progress to the client and to the event log. Never blocks.
    pub fn progress(&self, message: impl Into<String>) {
        self.progress_with(message, BTreeMap::new());
    }

    /// As [`GoalContext::progress`], with named values beside the message. If a report exceeds [`MAX_PROGRESS_BYTES`], only the beginning
    /// of its message is sent; reports beyond [`MAX_PROGRESS_PER_S`] are dropped.
    pub fn progress_with(&self, message: impl Into<String>, values: BTreeMap<String, Value>) {
        let mut left = self.progress_left.lock().unwrap_or_else(PoisonError::into_inner);
        if !left.take(MAX_PROGRESS_PER_S, MAX_PROGRESS_PER_S, Instant::now()) {
            return;
        }
        drop(left);
        // It is no error if nobody listens.
        let _ = self.entry.progress.send(bounded(message.into(), values));
    }

    /// `Some` if the goal may give a result, go on and give better ones ([`GoalContext::improved`]): the names of the outputs that must
    /// stay as they were in the first result, because others have used them. `None`: only the final result counts.
    pub fn improves(&self) -> Option<&[String]> {
        self.improves.as_deref()
    }

    /// Publishes an intermediate result that can be used, and goes on: the first one, or one that costs less than all before. `cost_s` is
    /// its cost to the user of the result, in seconds of the robot's time: how long the planned motion takes. The goal is cancelled when
    /// somebody uses the result or needs the worker; then the last published result counts, and how the goal ends does not matter. Never
    /// blocks.
    ///
    /// # Errors
    /// [`ActionFailure::Aborted`] if the goal may not publish intermediate results ([`GoalContext::improves`]), or if this is no valid
    /// result: too large to be sent, or a cost that is not finite.
    pub fn improved(&self, outputs: BTreeMap<String, Value>, cost_s: f64) -> Result<(), ActionFailure> {
        let refused = |why: String| Err(ActionFailure::Aborted(format!("a result of {}: {why}", self.action)));
        if self.improves.is_none() {
            return refused("only the end of this goal counts; see `improves`".to_owned());
        }
        if !cost_s.is_finite() {
            return refused(format!("it costs {cost_s} s, which is no finite number"));
        }
        let outputs = wire_ports(outputs);
        let bytes = ports_bytes(&outputs);
        if bytes > MAX_PORTS_BYTES {
            return refused(format!("the outputs have {bytes} bytes: at most {MAX_PORTS_BYTES} are sent"));
        }
        self.entry.improved.send_replace(Some(v1::GoalImproved { outputs, cost_s }));
        Ok(())
    }

    /// Returns an error if the goal has to stop: call it with `?` between two steps of the work.
    ///
    /// # Errors
    /// [`GoalContext::stopped`].
    pub fn checkpoint(&self) -> Result<(), ActionFailure> {
        if self.cancelled.is_cancelled() { Err(self.stopped()) } else { Ok(()) }
    }

    /// Waits while a hold is in force or the goal is suspended; returns at once otherwise. An action that moves something in steps calls it
    /// between two steps.
    ///
    /// # Errors
    /// [`GoalContext::stopped`].
    pub async fn while_held(&self) -> Result<(), ActionFailure> {
        let (mut state, mut suspended) = (self.safety.watch(), self.suspended());
        let over = async {
            loop {
                // The senders live in the goal's server and in the goal, so the channels are open.
                let _ = state.wait_for(|state| !matches!(state, SafetyState::Held { .. })).await;
                if !*suspended.borrow_and_update() {
                    return;
                }
                let _ = suspended.wait_for(|suspended| !suspended).await;
            }
        };
        self.unless_cancelled(over).await
    }

    /// Whether the goal is suspended, and every change of that. Nothing may move while it is, because its lease may have ended. Only goals of
    /// an action with [`super::Action::can_be_suspended`] are suspended; the others end.
    pub fn suspended(&self) -> watch::Receiver<bool> {
        self.entry.suspension()
    }

    /// The failure with which a goal ends that was told to stop: `preempted`; `aborted` if its lease ended; `stopped` after an emergency
    /// stop.
    pub fn stopped(&self) -> ActionFailure {
        self.entry.stopped()
    }

    /// Waits for `work`. If the goal has to stop before, `work` is dropped.
    ///
    /// # Errors
    /// [`GoalContext::stopped`].
    pub async fn unless_cancelled<T>(&self, work: impl Future<Output = T>) -> Result<T, ActionFailure> {
        tokio::select! {
            biased;
            () = self.cancelled.cancelled() => Err(self.stopped()),
            done = work => Ok(done),
        }
    }

    /// The facts that match any of the patterns, in the goal's projection (without a projection: in the root world).
    ///
    /// # Errors
    /// [`WorldFailure`]: the goal names no world pool, the world pool does not answer, or the projection is gone.
    pub async fn facts(&self, patterns: &[FactPattern]) -> Result<Vec<FactRecord>, WorldFailure> {
        let client = self.world_client()?;
        // The world pool may be restarting just now.
        Ok(retry_unanswered(|| client.query(self.projection, patterns)).await?)
    }

    pub(super) fn world_client(&self) -> Result<WorldClient, WorldFailure> {
        if self.world_pool.is_empty() {
            return Err(WorldFailure::NoWorldPool);
        }
        let world_pool: Endpoint = self.world_pool.parse()?;
        Ok(WorldClient::new(&self.channels, &world_pool)?)
    }

    /// As [`GoalContext::facts`], as a [`World`] that can be queried.
    ///
    /// # Errors
    /// As [`GoalContext::facts`].
    pub async fn world(&self, patterns: &[FactPattern]) -> Result<World, WorldFailure> {
        let facts = self.facts(patterns).await?;
        let changes: Vec<Change> =
            facts.into_iter().map(|record| Change::Set { fact: record.key, value: record.value }).collect();
        let mut world = World::default();
        world.apply(&changes)?;
        Ok(world)
    }

    /// Calls an action of another provider whose resource this goal's lease holds, under that lease. Returns the outputs of the action. If this
    /// goal has to stop, or the future is dropped, the called goal is told to stop, also where it would go on without a listener. This goal is
    /// over when the called one is.
    ///
    /// # Errors
    /// [`CallFailure`], also if the action does not end with success.
    pub async fn call(
        &self,
        kind: &str,
        action: &str,
        inputs: BTreeMap<String, Value>,
    ) -> Result<BTreeMap<String, Value>, CallFailure> {
        let resource = self.lease.as_ref().and_then(|lease| lease.resource(kind));
        let resource = resource.ok_or_else(|| CallFailure::NotLeased { kind: kind.to_owned() })?;
        let endpoint: Endpoint = resource
            .endpoint
            .parse()
            .map_err(|source| CallFailure::Endpoint { resource: resource.id.clone(), source })?;
        let name = format!("{kind}/{action}");
        let number = self.calls.fetch_add(1, Ordering::Relaxed) + 1;
        let goal = Goal {
            id: format!("{}/{action}-{number}", self.id),
            action: action.to_owned(),
            inputs,
            seed: self.seed,
            lease: self.lease.clone(),
            session: self.session.clone(),
            projection: self.projection,
            world_pool: self.world_pool.clone(),
            deadline_ms: 0,
            grace_ms: CALL_GRACE_MS,
            improves: None,
        };
        let given_up = || CallFailure::Cancelled { action: name.clone() };
        self.checkpoint().map_err(|_| given_up())?;
        let call = self.entry.calls.give(ActionClient::new(self.channels.clone()), endpoint, goal);
        let outcome = call.ok_or_else(given_up)?.outcome(&self.cancelled).await.ok_or_else(given_up)?;
        let outcome = outcome.map_err(|source| CallFailure::Call { action: name.clone(), source })?;
        if outcome.is_success() {
            Ok(outcome.outputs)
        } else {
            Err(CallFailure::Outcome { action: name, outcome: outcome.outcome, reason: outcome.reason })
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn progress_has_a_bound_for_the_message_and_the_values_together() {
        let of = |bytes: usize| BTreeMap::from([("picture".to_owned(), Value::Bytes(vec![7; bytes]))]);
        let told = bounded("half".to_owned(), of(MAX_PROGRESS_BYTES / 2));
        assert_eq!((told.message.as_str(), told.values.len()), ("half", 1));
        for (message, values) in [
            ("ä".repeat(MAX_PROGRESS_BYTES), BTreeMap::new()),
            ("x".repeat(MAX_PROGRESS_BYTES / 2), of(MAX_PROGRESS_BYTES / 2)),
        ] {
            let told = bounded(message, values);
            assert!(told.message.contains("shortened") && told.message.len() < 2 * SHORTENED_PROGRESS_BYTES);
            assert!(told.values.is_empty());
        }
    }
}
